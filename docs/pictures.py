"""Draw the pictures of README and docs again: `python docs/pictures.py` all of them, or those that are named.

`field` draws the tables of docs/results/pogema.md, `learning_curve` the metrics that a training by the recipe `quick`
left in its run folder, and `animations` plays the packaged policies.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

import gnn_policy
import mapf_env
from gnn_policy.learning_curve import Round, draw_learning_curve

DOCS = Path(__file__).parent
DEPOT = """
    ....................
    .####.####.####.###.
    ....................
    .####.####.####.###.
    ....................
    .####.####.####.###.
    ....................
"""
SHELVES = mapf_env.Warehouse(shelf_length=5, shelf_depth=2, corridor_width=1)


def field() -> None:
    """Draw success and sum of costs in mazes against the size of the team, from the table of the results page."""
    page = (DOCS / "results" / "pogema.md").read_text(encoding="utf-8")
    table = page.split("| mazes: success, SoC |")[1].split("\n\n")[0].splitlines()
    sizes = [int(cell) for cell in table[0].strip("| ").split("|")]
    rows = {}
    for line in table[2:]:
        name, *cells = line.strip("| ").split("|")
        rows[name.strip(" *")] = [[float(number) for number in cell.split(",")] for cell in cells]
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    success, cost = figure.subplots(1, 2)
    search = rows["LaCAM3, search"]
    for name, results in rows.items():
        ours = name == "general"
        style = {"linewidth": 3, "color": "#d08700", "zorder": 3} if ours else {"linewidth": 1.4}
        style |= {"linestyle": "--", "color": "#667085"} if name == "LaCAM3, search" else {}
        label = "mapf-env, general" if ours else name
        success.plot(sizes, [share for share, _ in results], marker="o", markersize=4, label=label, **style)
        ratios = [soc / best for (_, soc), (_, best) in zip(results, search, strict=True)]
        cost.plot(sizes, ratios, marker="o", markersize=4, **style)
    success.set(title="mazes: success rate", xlabel="robots", ylim=(0, 1.03), xticks=sizes)
    cost.set(title="mazes: sum of costs / LaCAM3's", xlabel="robots", xticks=sizes)
    figure.legend(loc="outside right center", fontsize="small")
    figure.savefig(DOCS / "field.png", dpi=130)


def learning_curve() -> None:
    """Draw the learning curve of `mapf-env train` from the metrics of its run folder, as the training itself does."""
    rounds = []
    with (DOCS / "tutorials" / "learning_curve.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            numbers: dict[str, Any] = {name: float(text) if text else None for name, text in row.items()}
            rounds.append(Round(**numbers))
    draw_learning_curve(rounds, DOCS / "tutorials" / "learning_curve.png")


def animations() -> None:
    """Play teams under the packaged policies and draw them."""
    local, general = gnn_policy.load("n12"), gnn_policy.load()
    config = mapf_env.EnvConfig(comm_radius=general.config.comm_radius, fov_radius=general.config.fov_radius)
    scattered = mapf_env.random_instance(height=20, width=20, density=0.1, num_agents=12, seed=5)
    warehouse = mapf_env.random_instance(height=18, width=29, num_agents=50, style=SHELVES, seed=0)
    crowd = mapf_env.random_instance(height=20, width=20, density=0.2, num_agents=30, seed=7)
    depot = mapf_env.random_instance(grid=mapf_env.parse_map(DEPOT), num_agents=12, seed=1)
    for policy, instance, name, title, watched in (
        (local, scattered, "animation", "12 robots, local information only", None),
        (general, warehouse, "warehouse", "50 robots in a warehouse; what robot 3 sees and hears", 3),
        (general, crowd, "quickstart", "30 robots on an unseen map", None),
        (general, depot, "tutorials/depot", "Twelve robots in a depot", None),
    ):
        played = gnn_policy.rollout(policy, [instance], max_steps=128)
        path = DOCS / f"{name}.svg"
        mapf_env.animate(instance, played.solutions[0], path, title=title, watched=watched, config=config)
        print(f"{path}: {'all robots arrived' if played.success[0] else 'failed'} after {played.makespan[0]} steps")


if __name__ == "__main__":
    for draw in [globals()[name] for name in sys.argv[1:]] or [field, learning_curve, animations]:
        draw()
