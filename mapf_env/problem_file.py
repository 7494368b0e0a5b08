"""The instance that a command works on: `python -m experts` and `python -m gnn_policy.play` take the same files."""

from __future__ import annotations

from pathlib import Path

from mapf_env.files import PathLike
from mapf_env.generation import random_instance
from mapf_env.instance import Instance
from mapf_env.instance_set import load_instances
from mapf_env.movingai import load_map, load_scen


def load_problem(file: PathLike, *, agents: int | None, map: PathLike | None, index: int | None, seed: int) -> Instance:
    """The instance that a file and the options beside it define; messages speak of the options by their names there.

    Args:
        file: A scenario (.scen), a map (.map) on which robots are placed at random, or a set of instances (.json).
        agents: `--agents`, how many robots: the first ones of a file, all of them if not given.
        map: `--map`, the map of a scenario that does not lie beside it.
        index: `--index`, which instance of a set; the first if not given.
        seed: `--seed`, of random places.

    Raises:
        ValueError: If the file is damaged or of another kind, or an option is missing, out of range or not for it.
        OSError: If the file cannot be read.
    """
    kind = Path(file).suffix.lower()
    if kind not in (".scen", ".map", ".json"):
        raise ValueError(f"{file} must be a map (.map), a scenario (.scen) or a set of instances (.json)")
    if map is not None and kind != ".scen":
        raise ValueError(f"--map goes with a scenario only: {file} has its map already")
    if index is not None and kind != ".json":
        raise ValueError(f"--index goes with a set of instances (.json) only, and {file} is none")
    if kind == ".scen":
        return load_scen(file, agents, map)
    if kind == ".json":
        return _of_set(file, index or 0, agents)
    if agents is None:
        raise ValueError("robots on a map are placed at random: give --agents N (and --seed S)")
    return random_instance(grid=load_map(file), num_agents=agents, seed=seed)


def _of_set(file: PathLike, index: int, agents: int | None) -> Instance:
    instances = load_instances(file)
    if not 0 <= index < len(instances):
        raise ValueError(f"{file} holds {len(instances)} instances, counted from 0: there is no --index {index}")
    instance = instances[index]
    if agents is None:
        return instance
    if not 1 <= agents <= instance.num_agents:
        raise ValueError(
            f"{agents} agents asked for, but instance {index} of {file} has {instance.num_agents}: "
            f"give --agents in 1..{instance.num_agents}"
        )
    return Instance(instance.grid, instance.starts[:agents], instance.goals[:agents])
