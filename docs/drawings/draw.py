"""The drawings of the docs: `python docs/drawings/draw.py` writes them again next to this file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapf_env import MOVES, Instance, Solution, animate, communication_graph, draw, parse_instance, rules
from mapf_env.files import write_whole

HOME = Path(__file__).parent
CELL = 24
"""Side of a cell in the pictures of `mapf_env`."""
TEAM = """
    ..........
    .A.#..B...
    ...#......
    ..C##..D..
    ........d.
    .........c
    a......b..
"""


def drawings() -> dict[str, str]:
    """The SVG of each drawing by its name."""
    instance = parse_instance(TEAM)
    return {
        "instance": draw(instance),
        "view": view(instance, robot=2, radius=2),
        "channels": channels(instance, robot=2, radius=2),
        "graph": graph(instance, radius=5.0),
        "vertex_conflict": animate(*walked("bA.Ba", "R", "L", steps=1), title="Vertex conflict"),
        "swap_conflict": animate(*walked("bAB.a", "R", "L", steps=1), title="Swap conflict"),
        "shield": animate(*walked("..B..\n.....\nA...a\n..b..", "RRRR", "DIDD", steps=4), title="One goes, one waits"),
        "robots": robots(),
        **{name: animate(*failed, title=name.capitalize().replace("_", " ")) for name, failed in failures().items()},
    }


def failures() -> dict[str, tuple[Instance, Solution]]:
    """A team that fails in each of the ways."""
    return {
        "goal_blocked": walked("A.B.a\n#####", "R" + 23 * "I", "I", steps=24),
        "deadlock": walked("bA.Ba\n#####", "R" + 23 * "I", "I", steps=24),
        "oscillation": walked("A#a\n.#.\n...", "DU", steps=24),
        "livelock": walked("bA..Ba\n......", "RDLU", "LDRU", steps=24),
    }


def walked(drawing: str, *moves: str, steps: int) -> tuple[Instance, Solution]:
    """Robots that repeat their moves, U L D R or I, whatever they hit."""
    instance = parse_instance(drawing)
    paths = [instance.starts]
    for time in range(steps):
        paths.append(paths[-1] + MOVES[["ULDRI".index(each[time % len(each)]) for each in moves]])
    return instance, Solution(np.stack(paths))


def view(instance: Instance, robot: int, radius: int) -> str:
    """The field of view of a robot, and the line to its goal."""
    (row, col), (goal_row, goal_col) = instance.starts[robot], instance.goals[robot]
    side = (2 * radius + 1) * CELL
    corner = (col - radius) * CELL, (row - radius) * CELL
    window = (
        f'<rect x="{corner[0]}" y="{corner[1]}" width="{side}" height="{side}" fill="#ffc400" fill-opacity=".22" '
        'stroke="#d08700" stroke-width="2"/>'
    )
    x, y, to_x, to_y = ((each + 0.5) * CELL for each in (col, row, goal_col, goal_row))
    line = f'<path d="M{x} {y}L{to_x} {to_y}" stroke="#d08700" stroke-width="2" stroke-dasharray="5 4"/>'
    return under_the_robots(draw(instance), window + line)


def robots() -> str:
    """Two robots as processes: what is in each, and what goes between them."""
    boxes = [
        (40, 20, "Robot", "the policy's parts, ONNX or torch"),
        (40, 80, "Pilot and Reservation", "rounds, local shield"),
        (40, 140, "Radio", "zenoh"),
        (40, 220, "Driver", "sensors and motors, or a simulated world"),
    ]
    parts = []
    for left, name in ((0, "agent_3"), (400, "agent_7")):
        parts.append(
            f'<rect x="{left + 20}" y="6" width="300" height="188" rx="6" fill="#ffc400" fill-opacity=".12" '
            f'stroke="#d08700"/><text x="{left + 310}" y="188" text-anchor="end" font-size="11">process {name}</text>'
        )
        for x, y, title, note in boxes:
            parts.append(
                f'<rect x="{left + x}" y="{y}" width="260" height="40" rx="4" fill="#fff" stroke="#555"/>'
                f'<text x="{left + x + 130}" y="{y + 17}" text-anchor="middle" font-weight="bold">{title}</text>'
                f'<text x="{left + x + 130}" y="{y + 33}" text-anchor="middle" font-size="11">{note}</text>'
            )
        for y, z in ((60, 80), (120, 140), (180, 220)):
            parts.append(f'<path d="M{left + 170} {y}V{z}" stroke="#555" stroke-width="2"/>')
        parts.append(f'<text x="{left + 180}" y="212" font-size="11">sensed, accepted moves</text>')
    parts.append(
        '<path d="M300 160H440" stroke="#d08700" stroke-width="3" stroke-dasharray="6 4"/>'
        '<text x="370" y="140" text-anchor="middle" font-size="11">K - 1 rounds</text>'
        '<text x="370" y="153" text-anchor="middle" font-size="11">+ reservations</text>'
    )
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 740 270" width="740" height="270" '
        f'font-family="sans-serif" font-size="13"><rect width="740" height="270" fill="#fff"/>{"".join(parts)}</svg>\n'
    )


def graph(instance: Instance, radius: float) -> str:
    """Who hears whom."""
    weights = communication_graph(instance.starts, radius)
    centres = (instance.starts[:, ::-1] + 0.5) * CELL
    lines = [
        f'<path d="M{centres[i][0]} {centres[i][1]}L{centres[j][0]} {centres[j][1]}" stroke="#d08700" '
        'stroke-width="3"/>'
        for i, j in np.argwhere(np.triu(weights))
    ]
    return under_the_robots(draw(instance), "".join(lines))


def under_the_robots(picture: str, marks: str) -> str:
    """The picture with marks on the map, below robots and goals."""
    before, after = picture.split('<rect class="goal"', 1)
    return f'{before}{marks}<rect class="goal"{after}'


def channels(instance: Instance, robot: int, radius: int) -> str:
    """The three channels of a robot's view, side by side; the ring around them is grey."""
    obstacles = rules.bordered(instance.grid[None], radius)
    fov = rules.observe(obstacles, instance.starts[None], instance.goals[None], radius)[0, robot]
    side, gap = fov.shape[-1] * CELL, 24
    width, height = 3 * side + 4 * gap, side + 3 * gap
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'role="img" aria-label="The three channels of a view" font-family="system-ui,sans-serif">',
        f'<rect x=".5" y=".5" width="{width - 1}" height="{height - 1}" rx="10" fill="#f6f7f9" stroke="#cbd2da"/>',
    ]
    for number, (name, values) in enumerate(zip(("obstacles", "goal", "robots"), fov, strict=True)):
        left, top = gap + number * (side + gap), 2 * gap
        parts.append(
            f'<text x="{left}" y="{top - 12}" font-size="15" font-weight="600" fill="#1f2530">{number}: {name}</text>'
        )
        for row, col in np.ndindex(*values.shape):
            ring = not (0 < row < len(values) - 1 and 0 < col < len(values) - 1)
            fill = "#0049a1" if values[row, col] else "#e8ebef" if ring else "#ffffff"
            parts.append(
                f'<rect x="{left + col * CELL}" y="{top + row * CELL}" width="{CELL}" height="{CELL}" '
                f'fill="{fill}" stroke="#cbd2da"/>'
            )
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    for name, picture in drawings().items():
        write_whole(HOME / f"{name}.svg", picture)
