"""A solution as one self-contained HTML page that plays, pauses and scrubs; a click on a robot shows what it knows."""

from __future__ import annotations

import json
from importlib.resources import files

from mapf_env import svg
from mapf_env.config import EnvConfig
from mapf_env.files import PathLike, write_whole
from mapf_env.instance import Instance
from mapf_env.render import require_drawable
from mapf_env.solution import Solution


def replay(
    instance: Instance,
    solution: Solution,
    path: PathLike | None = None,
    *,
    title: str | None = None,
    config: EnvConfig | None = None,
) -> str:
    """The page; it needs no network. A click on a robot shows its field of view, its neighbours and its goal.

    Args:
        instance: The map and the goals.
        solution: The paths (T + 1, N, 2), which need not solve the instance.
        path: Where to write the page too, if anywhere.
        title: A line above the map.
        config: The settings whose fov_radius and comm_radius are shown; the paper's if not given.

    Raises:
        ValueError: If the paths are of another number of agents or leave the map.
        OSError: If the file cannot be written.
    """
    require_drawable(instance, solution)
    config = EnvConfig() if config is None else config
    content = {
        "title": title or f"{instance.num_agents} robots, {len(solution.paths) - 1} steps",
        "rows": ["".join("@" if cell else "." for cell in row) for row in instance.grid],
        "goals": instance.goals.tolist(),
        "paths": solution.paths.tolist(),
        "colours": svg.colours(instance.num_agents),
        "fov_radius": config.fov_radius,
        "comm_radius": min(config.comm_radius, 1e9),
    }
    page = files("mapf_env").joinpath("replay.html").read_text(encoding="utf-8")
    script = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")  # no text can end the script
    page = page.replace("/*DATA*/null", script)
    if path is not None:
        write_whole(path, page)
    return page
