"""The batched environment: every executed step is checked, batches equal single environments, seeds decide all."""

import copy
import pickle
import subprocess
import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import oracles
import strategies
from mapf_env import BatchedEnv, EnvConfig, Instance, Observation, Solution, Step, random_instance

CORRIDOR = Instance(np.zeros((1, 4), bool), [[0, 0], [0, 3]], [[0, 1], [0, 3]])
IDLE, RIGHT, LEFT = oracles.IDLE, oracles.RIGHT, oracles.LEFT


def corridor(**settings: Any) -> BatchedEnv:
    """One team in the corridor, reset."""
    env = BatchedEnv(1, num_agents=2, height=1, width=4, density=0, **settings)
    env.reset(seed=0, instances=[CORRIDOR])
    return env


def assert_seen_rightly(env: BatchedEnv, observation: Observation) -> None:
    """Observations equal those rebuilt from scratch."""
    config = env.config
    for b, (grid, positions, goals) in enumerate(zip(env.grids, env.positions, env.goals, strict=True)):
        team, targets = oracles.cells(positions), oracles.cells(goals)
        for robot in range(env.num_agents):
            expected = oracles.field_of_view(grid, team, targets, robot, config.fov_radius)
            assert np.array_equal(observation.fov[b, robot], expected)
        assert np.array_equal(observation.graph[b], oracles.communication_graph(team, config.comm_radius))


def random_actions(env: BatchedEnv, generator: np.random.Generator) -> npt.NDArray[np.int64]:
    """Uniform joint actions."""
    return generator.integers(0, 5, (env.num_envs, env.num_agents))


def assert_equal(one: Any, other: Any) -> None:
    """Two (nested) tuples of arrays are equal in values and dtypes."""
    if isinstance(one, tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_equal(a, b)
    elif one is None:
        assert other is None
    else:
        assert one.dtype == other.dtype
        assert np.array_equal(one, other)


def episodes(env: BatchedEnv, seed: int | list[int] | None, steps: int) -> list[Any]:
    """Everything that `steps` steps of random actions bring, ended teams being reset; actions are seeded apart."""
    generator = np.random.default_rng(0)
    record: list[Any] = [env.reset(seed)]
    for _ in range(steps):
        outcome = env.step(random_actions(env, generator))
        ended = outcome.terminated | outcome.truncated
        record += [outcome, env.positions]
        if ended.any():
            record += [env.reset(mask=ended), env.grids, env.goals]
    return record


@given(strategies.settings(), strategies.seeds, st.integers(1, 3))
@hypothesis_settings(max_examples=60)
def test_every_step_is_sound_and_seen_rightly(settings: dict[str, Any], seed: int, num_envs: int) -> None:
    env, generator = BatchedEnv(num_envs, **settings), np.random.default_rng(seed)
    observation = env.reset(seed)
    assert_seen_rightly(env, observation)
    for time in range(1, settings["max_cycles"] + 1):
        before, wanted = env.positions, random_actions(env, generator)
        step = env.step(wanted)
        assert_seen_rightly(env, step.observation)
        assert_equal(env.observe(), step.observation)
        executed = np.where(step.replaced, IDLE, wanted)
        for b in range(num_envs):
            team, after = oracles.cells(before[b]), oracles.cells(env.positions[b])
            assert oracles.shield_faults(env.grids[b], team, wanted[b].tolist(), executed[b].tolist()) == []
            assert after == [oracles.moved(c, a) for c, a in zip(team, executed[b].tolist(), strict=True)]
            there = [cell == goal for cell, goal in zip(after, oracles.cells(env.goals[b]), strict=True)]
            assert step.rewards[b].tolist() == [0.0 if arrived else -1.0 for arrived in there]
            assert step.terminated[b] == all(there)
            assert step.truncated[b] == (time == settings["max_cycles"] and not all(there))
        assert (env.times == time).all()
        if (step.terminated | step.truncated).any():
            with pytest.raises(RuntimeError, match=r"have ended or were never reset: call reset\(mask=...\)"):
                env.step(wanted)
            break


@given(strategies.settings(max_agents=4), strategies.seeds)
@hypothesis_settings(max_examples=25)
def test_a_batch_equals_single_environments(settings: dict[str, Any], seed: int) -> None:
    num_envs, generator = 3, np.random.default_rng(seed)
    batch, singles = BatchedEnv(num_envs, **settings), [BatchedEnv(1, **settings) for _ in range(num_envs)]
    together = batch.reset(seed)
    apart = [single.reset(seed + b) for b, single in enumerate(singles)]
    for _ in range(25):
        for b in range(num_envs):
            assert_equal((together.fov[b], together.graph[b]), (apart[b].fov[0], apart[b].graph[0]))
        actions = random_actions(batch, generator)
        outcome = batch.step(actions)
        single_outcomes = [single.step(actions[b : b + 1]) for b, single in enumerate(singles)]
        for b, one in enumerate(single_outcomes):
            assert_equal(tuple(part[b] for part in outcome[1:6]), tuple(part[0] for part in one[1:6]))
        ended = outcome.terminated | outcome.truncated
        together = batch.reset(mask=ended)
        apart = [one.reset() if ended[b] else one.observe() for b, one in enumerate(singles)]


def test_equal_seeds_give_equal_episodes_and_others_differ() -> None:
    def record(seed: int | list[int]) -> list[Any]:
        env = BatchedEnv(4, num_agents=12, height=8, width=8, max_cycles=15)
        return episodes(env, seed, steps=200)

    first, again, as_list, shifted = record(3), record(3), record([3, 4, 5, 6]), record(4)
    assert_equal(tuple(first), tuple(again))
    assert_equal(tuple(first), tuple(as_list))
    assert not np.array_equal(first[0].fov, shifted[0].fov)
    assert np.array_equal(first[0].fov[1:], shifted[0].fov[:-1]), "environment b has the stream of seed + b"


def test_one_environment_meets_ever_new_instances() -> None:
    env = BatchedEnv(2, num_agents=5)
    env.reset(seed=0)
    seen = []
    for _ in range(30):
        seen += [(grid.tobytes(), team.tobytes()) for grid, team in zip(env.grids, env.positions, strict=True)]
        env.reset()
    assert len(set(seen)) == 60


def test_a_reset_without_a_seed_continues_the_stream() -> None:
    one, other = BatchedEnv(2, num_agents=3), BatchedEnv(2, num_agents=3)
    for env in (one, other):
        env.reset(seed=8)
        env.reset()
    assert_equal(tuple(episodes(one, None, 50)), tuple(episodes(other, None, 50)))
    unseeded = BatchedEnv(2, num_agents=3)
    assert not np.array_equal(unseeded.reset().fov, BatchedEnv(2, num_agents=3).reset().fov)


def test_the_instance_does_not_change_how_ties_are_drawn_nor_the_stream() -> None:
    env, other = BatchedEnv(1, num_agents=10), BatchedEnv(1, num_agents=10)
    env.reset(seed=4)
    instance = Instance(env.grids[0], env.positions[0], env.goals[0])
    other.reset(seed=4, instances=[instance])
    generator = np.random.default_rng(1)
    for _ in range(40):
        actions = random_actions(env, generator)
        assert_equal(env.step(actions), other.step(actions))
    assert_equal(env.reset(), other.reset())


def test_ties_are_drawn_again_in_each_step_and_episode() -> None:
    """Two robots want the cell between them, after so many idle steps of so many an episode."""
    rivals = Instance(np.zeros((1, 4), bool), [[0, 0], [0, 2]], [[0, 1], [0, 3]])
    env = BatchedEnv(1, num_agents=2, height=1, width=4, density=0)

    def first_wins(episode: int, idle_steps: int) -> bool:
        env.reset(seed=0, instances=[rivals])
        for _ in range(episode):
            env.reset(instances=[rivals])
        for _ in range(idle_steps):
            env.step([[IDLE, IDLE]])
        return not env.step([[RIGHT, LEFT]]).replaced[0, 0]

    assert 5 < sum(first_wins(0, time) for time in range(30)) < 25
    assert 5 < sum(first_wins(episode, 0) for episode in range(30)) < 25


def out_of_band(env: Any) -> Any:
    """A copy whose arrays came apart from it and may only be read, as between processes that share memory."""
    parts: list[pickle.PickleBuffer] = []
    whole = pickle.dumps(env, protocol=5, buffer_callback=parts.append)
    return pickle.loads(whole, buffers=[bytes(part.raw()) for part in parts])


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env)), out_of_band])
def test_copies_made_mid_episode_continue_identically(duplicate: Any) -> None:
    for reset in (lambda env: env.reset(seed=5), lambda env: env.reset()):
        env = BatchedEnv(3, num_agents=8, height=6, width=6, max_cycles=20)
        reset(env)
        for time in range(7):
            env.step(np.full((3, 8), time % 5))
        twin = duplicate(env)
        generator = np.random.default_rng(2)
        for _ in range(60):
            actions = random_actions(env, generator)
            one, other = env.step(actions), twin.step(actions)
            assert_equal(one, other)
            ended = one.terminated | one.truncated
            assert_equal(env.reset(mask=ended), twin.reset(mask=ended))


@given(strategies.instances(max_side=5, max_agents=8), strategies.seeds)
@hypothesis_settings(max_examples=50)
def test_every_valid_plan_replays_exactly(instance: Instance, seed: int) -> None:
    generator, team, plan = np.random.default_rng(seed), oracles.cells(instance.starts), []
    for _ in range(12):
        plan.append(team)
        wanted = generator.integers(0, 5, len(team)).tolist()
        team = [oracles.moved(c, a) for c, a in zip(team, oracles.harmless(instance.grid, team, wanted), strict=True)]
    plan.append(team)
    solution = Solution(np.array(plan))
    height, width = instance.grid.shape
    env = BatchedEnv(1, num_agents=instance.num_agents, height=max(height, 2), width=max(width, 2), density=0)
    grid = np.ones((max(height, 2), max(width, 2)), bool)
    grid[:height, :width] = instance.grid
    env.reset(instances=[Instance(grid, instance.starts, instance.goals)])
    for time, actions in enumerate(solution.actions, start=1):
        step = env.step(actions[None])
        assert not step.replaced.any()
        assert (env.positions[0] == solution.paths[time]).all()
        if step.terminated.any():
            break


def test_a_robot_on_its_goal_stays_there_as_an_obstacle_and_may_leave() -> None:
    env = corridor()
    assert env.on_goal().tolist() == [[False, True]]
    step = env.step([[RIGHT, LEFT]])
    assert env.positions.tolist() == [[[0, 1], [0, 2]]]
    assert step.rewards.tolist() == [[0.0, -1.0]]
    assert not step.terminated.any(), "robot 0 has arrived, robot 1 has left"
    step = env.step([[RIGHT, IDLE]])
    assert step.replaced.tolist() == [[True, False]]
    assert env.positions.tolist() == [[[0, 1], [0, 2]]]
    step = env.step([[IDLE, RIGHT]])
    assert step.terminated.tolist() == [True]


def test_a_team_that_starts_on_its_goals_ends_with_the_first_step() -> None:
    env = corridor()
    env.reset(instances=[CORRIDOR.at(CORRIDOR.goals)])
    assert env.step([[IDLE, IDLE]]).terminated.all()


def test_arriving_in_the_last_step_is_not_a_truncation() -> None:
    step = corridor(max_cycles=1).step([[RIGHT, IDLE]])
    assert step.terminated.tolist() == [True]
    assert step.truncated.tolist() == [False]
    step = corridor(max_cycles=1).step([[IDLE, IDLE]])
    assert step.terminated.tolist() == [False]
    assert step.truncated.tolist() == [True]


def test_rewards_add_up_to_the_flowtime() -> None:
    """As the docstring has it: robots that stay once they arrive return minus their arrival, plus the first step."""
    env = corridor()
    rewards = [env.step([[IDLE, IDLE]]).rewards, env.step([[IDLE, IDLE]]).rewards, env.step([[RIGHT, IDLE]]).rewards]
    flowtime, movers = 3, 1
    assert np.sum(rewards) == -(flowtime - movers)


def test_a_masked_reset_leaves_the_other_teams_alone() -> None:
    env, control = (BatchedEnv(3, num_agents=4, height=6, width=6) for _ in range(2))
    generator = np.random.default_rng(0)
    for each in (env, control):
        each.reset(seed=0)
    actions = random_actions(env, generator)
    env.step(actions)
    control.step(actions)
    before = env.positions
    env.reset(seed=77, mask=np.array([False, True, False]))
    assert env.times.tolist() == [1, 0, 1]
    for b in (0, 2):
        assert (env.positions[b] == before[b]).all()
    assert (env.grids[1] != control.grids[1]).any()
    for _ in range(20):
        actions = random_actions(env, generator)
        one, other = env.step(actions), control.step(actions)
        for b in (0, 2):
            assert np.array_equal(one.observation.fov[b], other.observation.fov[b])
            assert np.array_equal(one.replaced[b], other.replaced[b])
    assert_equal(env.reset().fov[0], control.reset().fov[0])
    untouched = env.positions
    env.reset(mask=np.zeros(3, bool))
    assert (env.positions == untouched).all()


def test_an_episode_of_a_masked_seed_is_that_of_the_seed() -> None:
    env, single = BatchedEnv(3, num_agents=4), BatchedEnv(1, num_agents=4)
    env.reset(seed=0)
    env.reset(seed=[5, 6, 7], mask=np.array([False, True, False]))
    single.reset(seed=6)
    assert (env.positions[1] == single.positions[0]).all()


def test_returned_arrays_are_never_overwritten() -> None:
    env = BatchedEnv(2, num_agents=6)
    first = env.reset(seed=0)
    kept = copy.deepcopy(first)
    exposed = (env.grids, env.positions, env.goals, env.times)
    for array in exposed:
        array[:] = 0
    steps: list[Step] = [env.step(np.full((2, 6), action)) for action in (0, 1, 2, 3)]
    kept_steps = copy.deepcopy(steps)
    env.reset(seed=9)
    assert_equal(first, kept)
    assert_equal(tuple(steps), tuple(kept_steps))
    assert env.goals.any()


def test_global_random_state_is_neither_read_nor_written() -> None:
    state = np.random.get_state(legacy=False)  # noqa: NPY002
    env = BatchedEnv(1, num_agents=2)
    env.reset()
    env.step([[0, 0]])
    assert str(state) == str(np.random.get_state(legacy=False))  # noqa: NPY002


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_agents": 0}, "num_agents must be at least 1, got 0"),
        ({"height": 0}, "height must be at least 1, got 0"),
        ({"fov_radius": 0}, "fov_radius must be at least 1, got 0"),
        ({"max_cycles": 0}, "max_cycles must be at least 1, got 0"),
        ({"density": 1.0}, r"density must lie in \[0, 1\), got 1.0"),
        ({"density": float("nan")}, r"density must lie in \[0, 1\), got nan"),
        ({"comm_radius": -1.0}, "comm_radius must not be negative, got -1.0"),
        ({"comm_radius": float("nan")}, "comm_radius must not be negative, got nan"),
        ({"style": "cave"}, "style must be one of cells, walls, maze, room, warehouse, empty, or a Maze, Rooms, W"),
        ({"shield": "none"}, "shield must be one of idle, pibt, pibt_swap, got 'none'"),
        ({"dtype": "float64"}, "dtype must be one of float32, uint8, got 'float64'"),
        ({"num_agents": 361}, "has 360 free cells, too few for 361 agents .*: ask for fewer agents or a lower"),
        ({"density": 0.99}, "has 4 free cells, too few for 10 agents"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EnvConfig(**settings)
    with pytest.raises(ValueError, match=message):
        BatchedEnv(1, **settings)


@pytest.mark.parametrize("name", ["num_agents", "height", "width", "fov_radius", "max_cycles"])
def test_settings_that_are_not_integers_are_refused(name: str) -> None:
    settings: dict[str, Any] = {name: 2.5}
    with pytest.raises(TypeError, match=f"{name} must be an integer, got 2.5"):
        EnvConfig(**settings)


def test_other_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        BatchedEnv(0)
    with pytest.raises(TypeError, match="colour"):
        BatchedEnv(1, colour="red")
    env = BatchedEnv(2, num_agents=2)
    with pytest.raises(RuntimeError, match=r"2 of 2 environments \(the first is 0\) have ended or were never reset"):
        env.step([[4, 4], [4, 4]])
    for seed in (-1, [1], [1, -2], 2**64, [1, 2**64]):
        with pytest.raises(ValueError, match="give one non-negative seed or 2 of them"):
            env.reset(seed)
    for mask in ([True], np.array([0, 1]), True):
        with pytest.raises(ValueError, match=r"mask must be bool of shape \(2,\)"):
            env.reset(mask=mask)  # pyright: ignore[reportArgumentType]
    env.reset(seed=0)
    for actions, error, message in (
        ([[4, 4]], ValueError, r"actions must have shape \(2, 2\), got \(1, 2\)"),
        ([4, 4], ValueError, r"actions must have shape \(2, 2\), got \(2,\)"),
        ([[4, 4, 4], [4, 4, 4]], ValueError, r"actions must have shape \(2, 2\), got \(2, 3\)"),
        ([[4, 4], [4, 7]], ValueError, r"action 7 of agent 1 in environment 1 is none of 0\.\.4"),
        ([[4.0, 4.0], [4.0, 4.0]], TypeError, "actions must be integers 0..4 .*, got dtype float64"),
    ):
        before = env.positions
        with pytest.raises(error, match=message):
            env.step(actions)
        assert (env.positions == before).all()
        assert (env.times == 0).all()


def test_a_refused_reset_changes_nothing() -> None:
    env, control = (BatchedEnv(2, num_agents=3) for _ in range(2))
    for each in (env, control):
        each.reset(seed=3)
        each.step(np.zeros((2, 3), int))
    fits = random_instance(num_agents=3, seed=0)
    for instances, message in (
        ([fits], "1 instances for 2 environments: give one for each"),
        (
            [fits, random_instance(num_agents=4)],
            "the instance has 4 agents, the environment 3: make it with",
        ),
        (
            [fits, random_instance(num_agents=3, width=9)],
            "map is 20x9, the environment's 20x20: make it with height",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            env.reset(seed=99, instances=instances)
    with pytest.raises(ValueError, match="mask must be bool"):
        env.reset(seed=99, mask=np.zeros(5, bool))
    out = env.buffers()
    with pytest.raises(ValueError, match="shape"):
        env.reset(seed=99, out=out._replace(fov=out.fov[:, :2].copy()))
    with pytest.raises(TypeError, match="out must be an Observation"):
        env.reset(seed=99, out=out._replace(fov=out.fov.astype(np.float64)))
    with pytest.raises(ValueError, match="max_cycles must be at least 1, got 0"):
        env.reset(seed=99, max_cycles=[3, 0])
    with pytest.raises(ValueError, match="non-negative seed"):
        env.reset(seed=-4)
    generator = np.random.default_rng(0)
    for _ in range(10):
        actions = random_actions(env, generator)
        assert_equal(env.step(actions), control.step(actions))
    assert_equal(env.reset(), control.reset())


def test_walls_that_cannot_reach_the_density_say_so_and_change_nothing() -> None:
    env = BatchedEnv(1, num_agents=2, density=0.8, style="walls")
    with pytest.raises(ValueError, match='lower the density or use the style "cells"'):
        env.reset(seed=0)
    with pytest.raises(RuntimeError, match="never reset"):
        env.step([[4, 4]])


def test_cases_are_those_that_were_given_whatever_becomes_of_the_list() -> None:
    cases = [random_instance(num_agents=2, height=5, width=5, seed=seed) for seed in range(3)]
    settings: dict[str, Any] = {"num_agents": 2, "height": 5, "width": 5}
    env, once = BatchedEnv(4, cases=cases, **settings), BatchedEnv(4, cases=(each for each in cases), **settings)
    cases.clear()
    assert_equal(env.reset(seed=1), once.reset(seed=1))


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
def test_threads_that_cannot_start_are_an_error_not_the_end_of_the_process() -> None:
    program = """
import resource
import mapf_env
env = mapf_env.BatchedEnv(1000, threads=1000, num_agents=2, height=4, width=4)
with open("/proc/self/statm") as file:
    used = int(file.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, used + 2**28))
try:
    env.reset(seed=0)
except (RuntimeError, MemoryError) as refusal:
    print("refused", refusal)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("refused")


@given(strategies.seeds, st.sampled_from(["one_shot", "lifelong"]))
@hypothesis_settings(max_examples=30)
def test_assigned_goals_are_seen_as_if_the_episode_had_begun_with_them(seed: int, task: str) -> None:
    settings: dict[str, Any] = {
        "num_agents": 3,
        "height": 6,
        "width": 5,
        "extra_channels": ("cost_to_go", "other_goals"),
    }
    env = BatchedEnv(2, task=task, **settings)
    generator = np.random.default_rng(seed)
    env.reset(seed=seed)
    env.step(random_actions(env, generator))
    other = BatchedEnv(2, task=task, **settings)
    fresh = [random_instance(grid=grid, num_agents=3, seed=int(generator.integers(2**32))).goals for grid in env.grids]
    env.assign_goals(fresh)
    instances = [Instance(*parts) for parts in zip(env.grids, env.positions, fresh, strict=True)]
    expected = other.reset(seed=0, instances=instances)
    assert_equal(env.observe(), expected)
    assert np.array_equal(env.goals, fresh)
    assert np.array_equal(env.on_goal(), other.on_goal())


def test_two_robots_may_be_sent_to_one_cell_and_the_first_to_come_counts() -> None:
    env = corridor(task="lifelong")
    env.assign_goals([[[0, 2], [0, 2]]])
    assert env.step([[RIGHT, IDLE]]).arrived.tolist() == [[False, False]]
    assert env.step([[RIGHT, IDLE]]).arrived.tolist() == [[True, False]]
    goals = env.goals
    goals[0, 0] = (0, 0)
    env.assign_goals(goals)
    assert env.goals.tolist() == [[[0, 0], [0, 2]]]


def test_goals_that_cannot_be_assigned_are_refused_and_change_nothing() -> None:
    walled = Instance(np.array([[0, 0, 1, 0]], bool), [[0, 0]], [[0, 1]])
    env = BatchedEnv(1, num_agents=1, height=1, width=4)
    with pytest.raises(RuntimeError, match=r"before the first reset: call reset\(\)"):
        env.assign_goals([[[0, 0]]])
    env.reset(seed=0, instances=[walled])
    for goals, error, message in (
        ([[[0, 2]]], ValueError, r"the goal \(0, 2\) of agent 0 in environment 0 is not a free cell"),
        ([[[0, -1]]], ValueError, r"the goal \(0, -1\) of agent 0 in environment 0 is not a free cell"),
        ([[[0, 3]]], ValueError, r"agent 0 in environment 0 cannot reach the goal \(0, 3\) from where it is"),
        ([[[0, 0], [0, 1]]], ValueError, r"goals must have shape \(1, 1, 2\), got \(1, 2, 2\)"),
        ([[[0.5, 0]]], TypeError, "goals must be integers"),
    ):
        with pytest.raises(error, match=message):
            env.assign_goals(goals)
    assert env.goals.tolist() == [[[0, 1]]]


def test_goals_of_absent_robots_are_ignored() -> None:
    env = BatchedEnv(1, num_agents=3, height=2, width=4, fill=True)
    env.reset(seed=0, instances=[CORRIDOR])
    env.assign_goals([[[0, 2], [0, 3], [9, 9]]])
    assert env.goals.tolist() == [[[0, 2], [0, 3], [0, 0]]]
