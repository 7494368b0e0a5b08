"""The instance that a command works on; `python -m experts` and `python -m gnn_policy.play` take the same files."""

from __future__ import annotations

from pathlib import Path

from mapf_env.ascii_map import parse_instance, parse_map
from mapf_env.files import PathLike, read_text
from mapf_env.generation import random_instance
from mapf_env.instance import Instance, Obstacles
from mapf_env.instance_set import InstanceSet, load_instances
from mapf_env.movingai import load_map, load_scen
from mapf_env.pogema_maps import load_pogema_maps

PROBLEM_SUFFIXES = frozenset({".map", ".scen", ".json", ".yaml"})
"""The kinds of files that are read from a folder; other text files than drawings end in .txt too."""


def load_problem(file: PathLike, *, agents: int | None, map: PathLike | None, index: int | None, seed: int) -> Instance:
    """Return the instance that a file and the options of a command define; messages name the options.

    Args:
        file: A scenario (.scen), a map (.map) on which robots are placed at random, a drawing (.txt) for `parse_map`
            or, if it has letters, `parse_instance`, a set of instances (.json), or maps of POGEMA (.yaml) on which
            robots are placed as POGEMA places them.
        agents: `--agents`, the number of robots: the first ones of a file, all of them if not given.
        map: `--map`, the map of a scenario that is not next to it.
        index: `--index`, which instance or map of a file; the first if not given.
        seed: `--seed`, the seed of random placement.

    Raises:
        ValueError: If the file is damaged or of another kind, or an option is missing, out of range or not for it.
        OSError: If the file cannot be read.
    """
    kind = Path(file).suffix.lower()
    if kind not in (".scen", ".map", ".txt", ".json", ".yaml"):
        raise ValueError(
            f"{file} must be a map (.map), a drawing (.txt), a scenario (.scen), a set of instances (.json) or maps of "
            "POGEMA (.yaml)"
        )
    if map is not None and kind != ".scen":
        raise ValueError(f"--map goes with a scenario only: {file} has its map already")
    if index is not None and kind not in (".json", ".yaml"):
        raise ValueError(
            f"--index goes with a set of instances (.json) or maps of POGEMA (.yaml) only, not with {file}"
        )
    if kind == ".scen":
        return load_scen(file, agents, map)
    if kind == ".json":
        return _of_set(file, index or 0, agents)
    if kind == ".yaml":
        return _of_pogema(file, index or 0, agents, seed)
    grid, drawn = _of_drawing(file) if kind == ".txt" else (load_map(file), None)
    if drawn is not None:
        return _first_robots(drawn, agents, str(file))
    if agents is None:
        raise ValueError("robots on a map are placed at random: give --agents N (and --seed S)")
    return random_instance(grid=grid, num_agents=agents, seed=seed)


def load_problems(path: PathLike) -> list[tuple[Obstacles, list[Instance]]]:
    """Return the maps in a file or a folder, each with the instances that the file has on it.

    Args:
        path: A map (.map), which has no instances; a drawing (.txt), with an instance if it has letters; a scenario
            (.scen), one instance with all its robots; a set of instances (.json); maps of POGEMA (.yaml); or a folder,
            all such files of which except for drawings are read in alphabetical order.

    Raises:
        ValueError: If a file is damaged or of another kind, or a folder has none of these files.
        OSError: If a file cannot be read.
    """
    place = Path(path)
    if place.is_dir():
        files = sorted(each for each in place.iterdir() if each.suffix.lower() in PROBLEM_SUFFIXES)
        if not files:
            raise ValueError(
                f"the folder {path} has no maps (.map, .yaml), scenarios (.scen) or sets of instances (.json)"
            )
        return [problem for file in files for problem in load_problems(file)]
    kind = place.suffix.lower()
    if kind == ".map":
        return [(load_map(path), [])]
    if kind == ".txt":
        grid, drawn = _of_drawing(path)
        return [(grid, [] if drawn is None else [drawn])]
    if kind == ".scen":
        instance = load_scen(path)
        return [(instance.grid, [instance])]
    if kind == ".json":
        return [(instance.grid, [instance]) for instance in load_instances(path)]
    if kind == ".yaml":
        return [(each.grid, []) for each in load_pogema_maps(path).values()]
    raise ValueError(
        f"{path} must be a map (.map), a drawing (.txt), a scenario (.scen), a set of instances (.json), maps of "
        "POGEMA (.yaml) or a folder of these"
    )


def _of_set(file: PathLike, index: int, agents: int | None) -> Instance:
    found = InstanceSet(file)
    if not 0 <= index < len(found):
        raise ValueError(f"{file} holds {len(found)} instances, counted from 0: there is no --index {index}")
    return _first_robots(found.instance(index), agents, f"instance {index} of {file}")


def _first_robots(instance: Instance, agents: int | None, name: str) -> Instance:
    if agents is None:
        return instance
    if not 1 <= agents <= instance.num_agents:
        raise ValueError(
            f"{agents} agents asked for, but {name} has {instance.num_agents}: "
            f"give --agents in 1..{instance.num_agents}"
        )
    return Instance(instance.shared_map, instance.starts[:agents], instance.goals[:agents])


def _of_drawing(file: PathLike) -> tuple[Obstacles, Instance | None]:
    """Return the map of a drawing, and its instance if it has letters."""
    drawing = read_text(file)
    try:
        grid = parse_map(drawing)
        return grid, parse_instance(drawing) if any(cell.isalpha() for cell in drawing) else None
    except ValueError as error:
        raise ValueError(f"{file} is not a drawing of a map: {error}") from None


def _of_pogema(file: PathLike, index: int, agents: int | None, seed: int) -> Instance:
    maps = list(load_pogema_maps(file).values())
    if not 0 <= index < len(maps):
        raise ValueError(f"{file} holds {len(maps)} maps, counted from 0: there is no --index {index}")
    if agents is not None:
        return maps[index].instance(agents, seed)
    if not len(maps[index].starts):
        raise ValueError("robots are placed on a map of POGEMA: give --agents N (and --seed S)")
    return maps[index].drawn_instance()
