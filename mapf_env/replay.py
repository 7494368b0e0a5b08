"""Solutions as one self-contained HTML page that plays, pauses and scrubs; a click on a robot shows what it knows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from mapf_env import arguments, rules, svg
from mapf_env.config import EnvConfig
from mapf_env.files import PathLike, write_whole
from mapf_env.instance import Cells, Instance
from mapf_env.render import goals_over_time, require_drawable, require_title
from mapf_env.solution import Solution


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One scene of a replay page: an instance, and solutions of it that play at the same time."""

    title: str
    """Its entry in the list of scenes."""
    instance: Instance
    """The map and the goals."""
    solutions: Mapping[str, Solution]
    """Paths (T + 1, N, 2) by the name above each; they need not solve the instance, nor be of equal length."""
    goals: Mapping[str, npt.ArrayLike] = field(default_factory=dict)
    """Goals (T + 1, N, 2) at each time of a solution by its name, where they changed, as in lifelong tasks."""


def replay(
    instance: Instance,
    solution: Solution,
    path: PathLike | None = None,
    *,
    title: str | None = None,
    config: EnvConfig | None = None,
    goals: npt.ArrayLike | None = None,
) -> str:
    """Return a page that works offline; a click on a robot shows its field of view, neighbours and goal.

    Args:
        instance: The map and the goals.
        solution: The paths (T + 1, N, 2), which need not solve the instance.
        path: A file to write the page to, if given.
        title: A line above the map.
        config: The settings whose fov_radius, comm_radius and comm_range are shown; the paper's if not given.
        goals: The goals (T + 1, N, 2) at each time, `env.goals` after the reset and each step of a lifelong task; those
            of the instance at all times if not given.

    Raises:
        ValueError: If the paths are of another number of agents or leave the map, or the goals do not belong to them.
        TypeError: If an argument has the wrong type.
        OSError: If the file cannot be written.
    """
    require_drawable(instance, solution)
    require_title(title)
    title = title or f"{instance.num_agents} robots, {len(solution.paths) - 1} steps"
    scene = Scene("", instance, {"": solution}, {} if goals is None else {"": goals})
    return replay_scenes([scene], path, title=title, config=config)


def replay_scenes(
    scenes: Sequence[Scene], path: PathLike | None = None, *, title: str, config: EnvConfig | None = None
) -> str:
    """Return the page of `replay` for several scenes to choose from, each with its solutions next to each other.

    Args:
        scenes: At least one.
        path: A file to write the page to, if given.
        title: A line above all of them.
        config: The settings whose fov_radius, comm_radius and comm_range are shown; the paper's if not given.

    Raises:
        ValueError: If there are no scenes, one has no solution, its paths are of another number of agents or leave the
            map, or goals do not belong to a solution.
        TypeError: If an argument has the wrong type.
        OSError: If the file cannot be written.
    """
    shown = list(arguments.each_of(scenes, Scene, "scenes"))
    if not shown:
        raise ValueError("there are no scenes to show; give at least one")
    config = EnvConfig() if config is None else arguments.instance_of(config, EnvConfig, "config")
    content = {
        "title": arguments.instance_of(title, str, "title"),
        "scenes": [_plain(scene, config) for scene in shown],
        "fov_radius": config.fov_radius,
    }
    page = files("mapf_env").joinpath("replay.html").read_text(encoding="utf-8")
    script = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")  # no text can end the script
    page = page.replace("/*DATA*/null", script)
    if path is not None:
        write_whole(path, page)
    return page


def _plain(scene: Scene, config: EnvConfig) -> dict[str, object]:
    arguments.instance_of(scene.title, str, "the title of a scene")
    if not arguments.instance_of(scene.solutions, Mapping, f"the solutions of the scene {scene.title!r}"):
        raise ValueError(f"the scene {scene.title!r} has no solution to show; give at least one")
    for name, solution in scene.solutions.items():
        arguments.instance_of(name, str, f"the name of a solution of the scene {scene.title!r}")
        require_drawable(scene.instance, solution)
    unknown = arguments.instance_of(scene.goals, Mapping, f"the goals of the scene {scene.title!r}").keys()
    unknown -= scene.solutions.keys()
    if unknown:
        raise ValueError(f"the scene {scene.title!r} has goals but no solution of the name {min(unknown)!r}")
    changing = {
        name: goals_over_time(scene.instance, scene.solutions[name], each) for name, each in scene.goals.items()
    }
    radius = config.comm_radius
    if config.comm_range == "connected":
        radius = rules.connecting_radius(scene.instance.starts, radius)
    return {
        "title": scene.title,
        "rows": ["".join("@" if cell else "." for cell in row) for row in scene.instance.grid],
        "goals": scene.instance.goals.tolist(),
        "comm_radius": min(radius, 1e9),
        "colours": svg.colours(min(scene.instance.num_agents, _MOST_COLOURS)),
        "panels": [
            {
                "name": name,
                "paths": _track(each.paths),
                "goals": _track(changing[name]) if name in changing else None,
            }
            for name, each in scene.solutions.items()
        ],
    }


_MOST_COLOURS = 256
"""Robots of larger teams share colours: the page draws all robots of one colour at once."""

_LETTERS = np.frombuffer(b"jujlwrjdj", np.uint8)
"""Letters of the moves by 3 * (rows + 1) + columns + 1: up, left, wait, right, down, and jumps."""


def _track(cells: Cells) -> dict[str, object]:
    """Return cells (T + 1, N, 2) as the first ones and a string of N letters for each step, with a list of jumps."""
    moves, jumps = list[str](), dict[int, list[list[int]]]()
    for step, (before, after) in enumerate(pairwise(cells)):
        change = after - before
        near = (np.abs(change) <= 1).all(axis=1)
        letters = _LETTERS[np.where(near, change @ (3, 1) + 4, 0)]
        moves.append(letters.tobytes().decode("ascii"))
        robots = np.flatnonzero(letters == ord("j"))
        if len(robots):
            jumps[step] = np.column_stack([robots, change[robots]]).tolist()
    return {"starts": cells[0].tolist(), "moves": moves, "jumps": jumps}
