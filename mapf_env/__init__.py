"""Instances, the rules of motion and perception, and the PettingZoo environment.

Importing it registers the environment as `mapf/grid-v0` with PettingZoo.
"""

import importlib.util

if importlib.util.find_spec("mapf_env._native") is None:
    raise ImportError(
        f"{__path__[0]} has no compiled extension, it is a source tree: install it in place with `pip install -e .` or "
        "start Python in another folder, where it finds the installed package"
    )

import pettingzoo

from mapf_env.ascii_map import parse_instance, parse_map
from mapf_env.batched_env import BatchedEnv, Observation, Step
from mapf_env.config import EnvConfig, Shield
from mapf_env.generation import (
    Maze,
    Rooms,
    Walls,
    Warehouse,
    random_instance,
    random_map,
    random_maps,
    random_starts_and_goals,
)
from mapf_env.grid_v0 import ENV_ID, GridEnv, env, parallel_env
from mapf_env.instance import Instance
from mapf_env.instance_set import instance_hash, load_instances, save_instances
from mapf_env.joint_v0 import JointEnv, joint_env
from mapf_env.movingai import load_map, load_scen, save_map, save_scen
from mapf_env.perception import Bag, MapSet, States, perceive
from mapf_env.pogema_maps import PogemaMap, load_pogema_maps, parse_pogema_map
from mapf_env.render import animate, draw
from mapf_env.replay import Scene, replay, replay_scenes
from mapf_env.rewards import SCHEMES, Rewards
from mapf_env.rules import Edges, communication_edges, communication_graph, distances
from mapf_env.senses import HISTORY, CommRange, CommWeights, Senses
from mapf_env.solution import MOVES, Action, Conflict, Solution

__all__ = [
    "HISTORY",
    "MOVES",
    "SCHEMES",
    "Action",
    "Bag",
    "BatchedEnv",
    "CommRange",
    "CommWeights",
    "Conflict",
    "Edges",
    "EnvConfig",
    "GridEnv",
    "Instance",
    "JointEnv",
    "MapSet",
    "Maze",
    "Observation",
    "PogemaMap",
    "Rewards",
    "Rooms",
    "Scene",
    "Senses",
    "Shield",
    "Solution",
    "States",
    "Step",
    "Walls",
    "Warehouse",
    "animate",
    "communication_edges",
    "communication_graph",
    "distances",
    "draw",
    "env",
    "instance_hash",
    "joint_env",
    "load_instances",
    "load_map",
    "load_pogema_maps",
    "load_scen",
    "parallel_env",
    "parse_instance",
    "parse_map",
    "parse_pogema_map",
    "perceive",
    "random_instance",
    "random_map",
    "random_maps",
    "random_starts_and_goals",
    "replay",
    "replay_scenes",
    "save_instances",
    "save_map",
    "save_scen",
]

if ENV_ID not in pettingzoo.parallel_registry:
    pettingzoo.register("parallel", ENV_ID, "mapf_env.grid_v0:parallel_env")
    pettingzoo.register("aec", ENV_ID, "mapf_env.grid_v0:env")
