"""Public calls of mapf_env: the message names the wrong argument."""

import inspect
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import mapf_env
from mapf_env import BatchedEnv, EnvConfig, Instance, Maze, Rewards, Rooms, Scene, Solution, Walls, Warehouse
from mapf_env.arguments import MOST_INT
from wrong_arguments import (
    ARRAY,
    COUNT,
    COUNT_32_BITS,
    FLAG,
    INTEGER,
    NUMBER,
    OBJECT,
    PATH,
    SEED,
    SEVERAL,
    STRING,
    TEXT,
    WORD,
    assert_refused,
    but,
    table,
)

SMALL: dict[str, Any] = {"num_agents": 2, "height": 4, "width": 4, "density": 0.0}
GRID = np.zeros((4, 4), bool)
INSTANCE = Instance(GRID, [[0, 0], [1, 1]], [[0, 1], [1, 2]])
STATES = mapf_env.States.start_of([INSTANCE], mapf_env.Senses(), [0])
SOLUTION = Solution(np.stack([INSTANCE.starts, INSTANCE.goals]))
SHARE = (*NUMBER, -0.1, 1.5)
FINITE = (*NUMBER, math.inf, -math.inf)
STYLE = (*WORD, EnvConfig)
SENSES: dict[str, tuple[Any, ...]] = {
    "fov_radius": COUNT_32_BITS,
    "extra_channels": (*SEVERAL, ("smell",)),
    "robot_features": (*SEVERAL, ("steps",)),
    "edge_features": (*SEVERAL, ("voice",)),
    "memory": (*COUNT, 17),
    "comm_radius": (*NUMBER, -1.0),
    "comm_range": WORD,
    "comm_weights": WORD,
}
SETTINGS: dict[str, tuple[Any, ...]] = SENSES | {
    "num_agents": COUNT_32_BITS,
    "height": COUNT_32_BITS,
    "width": COUNT_32_BITS,
    "density": (*SHARE, 1.0),
    "style": STYLE,
    "message_loss": SHARE,
    "shield": WORD,
    "task": WORD,
    "reward": WORD,
    "max_cycles": COUNT_32_BITS,
    "dtype": (*WORD, np.float32),
}


def begun(make: Callable[..., Any], method: str, **settings: Any) -> Callable[..., Any]:
    """A method of an environment that has just been reset."""

    def call(**arguments: Any) -> Any:
        env = make(**SMALL | settings)
        env.reset(seed=0)
        return getattr(env, method)(**arguments)

    return call


def batch(**settings: Any) -> BatchedEnv:
    return BatchedEnv(2, **settings)


def env_config(**settings: Any) -> EnvConfig:
    return EnvConfig(**SMALL | settings)


def parallel_env(**settings: Any) -> mapf_env.GridEnv:
    return mapf_env.parallel_env(**SMALL | settings)


RESET = {"seed": SEED, "options": (*but(OBJECT, NoneType, dict), {"instance": 1})}
STEP = {f"agent_{i}": 4 for i in range(2)}
CALLS: dict[str, Any] = {
    "Instance": (
        Instance,
        {"grid": GRID, "starts": [[0, 0]], "goals": [[1, 1]]},
        dict.fromkeys(("grid", "starts", "goals"), ARRAY),
    ),
    "Instance.at": (INSTANCE.at, {"positions": INSTANCE.starts}, {"positions": ARRAY}),
    "Solution": (Solution, {"paths": SOLUTION.paths}, {"paths": ARRAY}),
    "Solution.violations": (SOLUTION.violations, {"instance": INSTANCE}, {"instance": OBJECT}),
    "EnvConfig": (env_config, {}, SETTINGS),
    "Senses": (mapf_env.Senses, {}, SENSES),
    "MapSet": (
        mapf_env.MapSet,
        {"grids": [GRID], "border": 4},
        {"grids": (*SEVERAL, GRID), "border": COUNT_32_BITS, "dtype": (*WORD, "int8")},
    ),
    "perceive": (
        mapf_env.perceive,
        {"states": STATES, "maps": mapf_env.MapSet([GRID], 4), "senses": mapf_env.Senses()},
        {"states": OBJECT, "maps": OBJECT, "senses": OBJECT, "message_loss": SHARE, "threads": (*COUNT, 1025)},
    ),
    "States.take": (STATES.take, {"chosen": [0]}, {"chosen": but(ARRAY, int, list)}),
    "States.start_of": (
        mapf_env.States.start_of,
        {"instances": [INSTANCE], "senses": mapf_env.Senses(), "maps": [0]},
        {
            "instances": (*SEVERAL, INSTANCE),
            "senses": OBJECT,
            "maps": (*TEXT, None, 1.5, [0.5], [2**40]),
            "seeds": (*TEXT, 1.5, [0.5], [-1]),
            "limits": (*TEXT, None, 1.5, [0.5], [2**40]),
        },
    ),
    "Rewards": (Rewards, {}, dict.fromkeys(Rewards.__dataclass_fields__, FINITE)),
    "Maze": (mapf_env.Maze, {}, {"corridor_width": COUNT_32_BITS, "loops": SHARE}),
    "Rooms": (mapf_env.Rooms, {}, {"room_size": COUNT_32_BITS}),
    "Walls": (mapf_env.Walls, {}, {"segments": COUNT_32_BITS, "straight": SHARE, "ring": FLAG}),
    "Warehouse": (
        mapf_env.Warehouse,
        {},
        dict.fromkeys(("shelf_length", "shelf_depth", "corridor_width"), COUNT_32_BITS),
    ),
    "BatchedEnv": (
        BatchedEnv,
        SMALL | {"num_envs": 1},
        SETTINGS
        | {
            "num_envs": COUNT_32_BITS,
            "threads": (*COUNT, 1025),
            "autoreset": WORD,
            "cases": (*but(SEVERAL, NoneType), [], INSTANCE),
            "grid": (*but(ARRAY, NoneType), GRID[0], np.full((4, 4), 2)),
            "fill": FLAG,
        },
    ),
    "BatchedEnv.reset": (
        begun(batch, "reset"),
        {},
        {
            "seed": (
                *but(SEED, np.ndarray),
                ["a", "b"],
                [1.5, 2],
                [1, -1],
            ),
            "instances": (*but(SEVERAL, NoneType), INSTANCE, [INSTANCE, None]),
            "mask": but(ARRAY, NoneType),
            "max_cycles": (*but(COUNT_32_BITS, NoneType, np.ndarray), [1], [1, 0]),
            "out": (*but(SEVERAL, NoneType), (None, None)),
            "observe": FLAG,
        },
    ),
    "BatchedEnv.bag": (begun(batch, "bag"), {}, {"mask": but(ARRAY, NoneType)}),
    "BatchedEnv.states": (begun(batch, "states"), {}, {"mask": but(ARRAY, NoneType)}),
    "BatchedEnv.step": (
        begun(batch, "step"),
        {"actions": [[4, 4], [4, 4]]},
        {
            "actions": (*ARRAY, [[4, 4]], [[4, 5], [4, 4]], [[True, True]] * 2),
            "out": (*but(SEVERAL, NoneType), (None, None)),
            "observe": FLAG,
        },
    ),
    "BatchedEnv.assign_goals": (
        begun(batch, "assign_goals"),
        {"goals": [[[0, 0], [0, 1]], [[0, 0], [0, 1]]]},
        {"goals": ARRAY},
    ),
    "BatchedEnv.observe": (begun(batch, "observe"), {}, {"out": (*but(SEVERAL, NoneType), (None, None))}),
    "BatchedEnv.edges": (begun(batch, "edges"), {"graph": np.ones((2, 2, 2), np.float32)}, {"graph": ARRAY}),
    "parallel_env": (
        parallel_env,
        {},
        SETTINGS
        | {"observation": WORD, "preferences": FLAG, "reuse_buffers": FLAG, "render_mode": but(WORD, NoneType)},
    ),
    "env": (lambda **settings: mapf_env.env(**SMALL | settings), {}, SETTINGS),
    "joint_env": (lambda **settings: mapf_env.joint_env(**SMALL | settings), {}, SETTINGS),
    "parallel_env.reset": (begun(mapf_env.parallel_env, "reset"), {}, RESET),
    "env.reset": (begun(mapf_env.env, "reset"), {}, RESET),
    "joint_env.reset": (begun(mapf_env.joint_env, "reset"), {}, RESET),
    "parallel_env.step": (
        begun(mapf_env.parallel_env, "step"),
        {"actions": STEP},
        {
            "actions": (
                *OBJECT,
                {"agent_0": 4},
                STEP | {"agent_2": 4},
                *(STEP | {"agent_1": action} for action in (*but(INTEGER, bool), -1, 5, 2**70)),
            )
        },
    ),
    "parallel_env.step by preferences": (
        begun(mapf_env.parallel_env, "step", shield="pibt", preferences=True),
        {"actions": {agent: np.zeros(5) for agent in STEP}},
        {"actions": tuple({"agent_0": [0.0] * 5, "agent_1": wrong} for wrong in (*ARRAY, ["a"] * 5))},
    ),
    "parallel_env.observation_space": (
        begun(mapf_env.parallel_env, "observation_space"),
        {"agent": "agent_1"},
        {"agent": OBJECT},
    ),
    "parallel_env.action_space": (
        begun(mapf_env.parallel_env, "action_space"),
        {"agent": "agent_1"},
        {"agent": OBJECT},
    ),
    "joint_env.step": (begun(mapf_env.joint_env, "step"), {"action": [4, 4]}, {"action": (*ARRAY, [4], [4, 5])}),
    "random_map": (
        mapf_env.random_map,
        {},
        {name: SETTINGS[name] for name in ("height", "width", "density", "style")} | {"seed": SEED},
    ),
    "random_maps": (
        mapf_env.random_maps,
        {"seeds": [1]},
        {name: SETTINGS[name] for name in ("height", "width", "density", "style")} | {"seeds": (*ARRAY, [-1])},
    ),
    "random_instance": (
        mapf_env.random_instance,
        {},
        {name: SETTINGS[name] for name in ("height", "width", "density", "style", "num_agents")}
        | {"seed": SEED, "grid": but(ARRAY, NoneType)},
    ),
    "random_starts_and_goals": (
        mapf_env.random_starts_and_goals,
        {"seeds": [1], "grids": GRID[None], "num_agents": 2},
        {
            "seeds": ARRAY,
            "grids": (*ARRAY, GRID, np.full((1, 4, 4), 2), np.zeros((1, 4, 4))),
            "num_agents": COUNT_32_BITS,
        },
    ),
    "communication_graph": (
        mapf_env.communication_graph,
        {"positions": INSTANCE.starts, "radius": 5.0},
        {"positions": ARRAY, "radius": (*but(NUMBER, list), -1.0), "weights": WORD, "out": but(OBJECT, NoneType)},
    ),
    "communication_edges": (
        mapf_env.communication_edges,
        {"graph": np.ones((1, 2, 2), np.float32), "positions": INSTANCE.starts[None]},
        {"graph": (*ARRAY, np.ones((2, 2)), np.ones((1, 3, 3))), "positions": (*ARRAY, INSTANCE.starts)},
    ),
    "distances": (
        mapf_env.distances,
        {"grid": GRID, "cells": INSTANCE.starts},
        {"grid": (*ARRAY, np.full((4, 4), 2)), "cells": (*ARRAY, [[9, 9]])},
    ),
    "animate": (
        mapf_env.animate,
        {"instance": INSTANCE, "solution": SOLUTION},
        {
            "instance": OBJECT,
            "solution": OBJECT,
            "path": but(PATH, NoneType),
            "title": but(STRING, NoneType),
            "step_seconds": (*FINITE, 0.0),
            "pause_steps": (*INTEGER, -1),
        },
    ),
    "draw": (
        mapf_env.draw,
        {"instance": INSTANCE, "solution": SOLUTION},
        {"instance": OBJECT, "solution": but(OBJECT, NoneType)},
    ),
    "replay": (
        mapf_env.replay,
        {"instance": INSTANCE, "solution": SOLUTION},
        {
            "instance": OBJECT,
            "solution": OBJECT,
            "path": but(PATH, NoneType),
            "title": but(STRING, NoneType),
            "config": but(OBJECT, NoneType),
        },
    ),
    "replay_scenes": (
        mapf_env.replay_scenes,
        {"scenes": [Scene("", INSTANCE, {"": SOLUTION})], "title": ""},
        {
            "scenes": (*SEVERAL, [], INSTANCE),
            "path": but(PATH, NoneType),
            "title": STRING,
            "config": but(OBJECT, NoneType),
        },
    ),
    "instance_hash": (mapf_env.instance_hash, {"instance": INSTANCE}, {"instance": OBJECT}),
    "parse_map": (mapf_env.parse_map, {"drawing": "A.a"}, {"drawing": (*STRING, "")}),
    "parse_instance": (mapf_env.parse_instance, {"drawing": "A.a"}, {"drawing": (*STRING, "")}),
    "parse_pogema_map": (mapf_env.parse_pogema_map, {"drawing": "aA."}, {"drawing": (*STRING, "")}),
    "load_map": (mapf_env.load_map, {"path": "a.map"}, {"path": PATH}),
    "load_pogema_maps": (mapf_env.load_pogema_maps, {"path": "a.yaml"}, {"path": PATH}),
    "save_map": (mapf_env.save_map, {"path": "b.map", "grid": GRID}, {"path": PATH, "grid": ARRAY}),
    "load_scen": (
        mapf_env.load_scen,
        {"path": "a.scen"},
        {"path": PATH, "num_agents": but(COUNT, NoneType), "map_path": but(PATH, NoneType)},
    ),
    "save_scen": (
        mapf_env.save_scen,
        {"path": "b.scen", "instance": INSTANCE, "map_path": "a.map"},
        {"path": PATH, "instance": OBJECT, "map_path": PATH},
    ),
    "load_instances": (mapf_env.load_instances, {"path": "a.json"}, {"path": PATH}),
    "save_instances": (
        mapf_env.save_instances,
        {"path": "b.json", "instances": [INSTANCE]},
        {"path": PATH, "instances": (*SEVERAL, INSTANCE)},
    ),
}


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the files that are read to the working folder."""
    monkeypatch.chdir(tmp_path)
    mapf_env.save_map("a.map", GRID)
    mapf_env.save_scen("a.scen", INSTANCE, "a.map")
    mapf_env.save_instances("a.json", [INSTANCE])
    Path("a.yaml").write_text("one: |-\n  ..\n")


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(("call", "sound", "argument", "wrong"), table(CALLS))
def test_wrong_arguments_are_refused_by_name(
    call: Callable[..., Any], sound: dict[str, Any], argument: str, wrong: tuple[Any, ...]
) -> None:
    assert_refused(call, sound, argument, wrong)


def test_every_public_call_is_among_these() -> None:
    found = {name.partition(".")[0] for name in CALLS}
    given_by_the_world = {
        "Action",
        "Bag",
        "CommRange",
        "CommWeights",
        "Conflict",
        "Edges",
        "GridEnv",
        "HISTORY",
        "JointEnv",
        "MOVES",
        "Observation",
        "PogemaMap",
        "SCHEMES",
        "Scene",
        "Shield",
        "Step",
    }
    assert found | given_by_the_world == set(mapf_env.__all__)


def test_a_scene_is_checked_when_it_is_shown() -> None:
    for scene, message in (
        (Scene(1, INSTANCE, {"": SOLUTION}), "the title of a scene must be a str, got int"),  # pyright: ignore[reportArgumentType]
        (Scene("s", 1, {"": SOLUTION}), "instance must be a mapf_env.Instance, got int"),  # pyright: ignore[reportArgumentType]
        (Scene("s", INSTANCE, SOLUTION), "the solutions of the scene 's' must be a .*Mapping, got Solution"),  # pyright: ignore[reportArgumentType]
        (Scene("s", INSTANCE, {1: SOLUTION}), "the name of a solution of the scene 's' must be a str, got int"),  # pyright: ignore[reportArgumentType]
        (Scene("s", INSTANCE, {"": None}), "solution must be a mapf_env.Solution, got NoneType"),  # pyright: ignore[reportArgumentType]
    ):
        with pytest.raises(TypeError, match=message):
            mapf_env.replay_scenes([scene], title="")


def test_numbers_of_numpy_are_numbers() -> None:
    config = EnvConfig(num_agents=np.int64(2), comm_radius=np.float32(3.0), density=0)  # pyright: ignore[reportArgumentType]
    assert (config.num_agents, config.comm_radius, config.density) == (2, 3.0, 0)
    side = np.int16(200)  # whose square needs more bits
    large = EnvConfig(num_agents=2, height=side, width=side, fov_radius=np.uint8(127))  # pyright: ignore[reportArgumentType]
    assert BatchedEnv(1, **asdict(large)).reset(seed=0).fov.shape == (1, 2, 3, 257, 257)
    one, other = BatchedEnv(2, num_agents=2), BatchedEnv(2, num_agents=2)
    assert np.array_equal(one.reset(np.int8(3)).fov, other.reset(np.array([3, 4])).fov)  # pyright: ignore[reportArgumentType]
    assert BatchedEnv(np.int32(1), autoreset="NextStep").autoreset is AutoresetMode.NEXT_STEP  # pyright: ignore[reportArgumentType]
    cells = np.array([[0, 0]], np.uint64)
    assert Instance(GRID, cells, cells + np.uint64(1)).goals.tolist() == [[1, 1]]


def test_maps_of_more_cells_than_can_be_numbered_are_refused() -> None:
    for make in (mapf_env.random_map, EnvConfig):
        with pytest.raises(ValueError, match=f"with a border of . has more than {MOST_INT} cells"):
            make(height=50_000, width=50_000)


def test_a_file_in_no_folder_is_refused_by_its_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"a\.map cannot be written: make the folder .*none first"):
        mapf_env.save_map(tmp_path / "none" / "a.map", GRID)
    with pytest.raises(IsADirectoryError, match="is a folder: give the name of a file"):
        mapf_env.save_map(tmp_path, GRID)


@pytest.mark.parametrize("kind", [EnvConfig, mapf_env.Senses, Rewards, Maze, Rooms, Walls, Warehouse])
def test_an_unknown_setting_is_refused_with_all_that_exist(kind: Callable[..., Any]) -> None:
    names = sorted(inspect.signature(kind).parameters)
    assert names
    with pytest.raises(TypeError) as refusal:
        kind(nonsense=1)
    assert str(refusal.value) == (f"{kind.__name__} has no setting 'nonsense': the settings are {', '.join(names)}")
    with pytest.raises(TypeError, match=f"did you mean '{names[0]}'. The settings are {', '.join(names)}"):
        kind(**{names[0][:-1]: 1})
