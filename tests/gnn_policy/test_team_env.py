"""TeamEnv is the batched environment, seen by TorchRL."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

import experts
from gnn_policy.cases import Family, make_cases
from gnn_policy.team_env import (
    ACTION,
    CASE,
    EDGE_ATTR,
    ENDS,
    FOV,
    GRAPH,
    POSITIONS,
    REWARD,
    SCALARS,
    STATE_KEYS,
    TeamEnv,
    states_of,
)
from mapf_env import BatchedEnv, Instance, MapSet, Senses, parallel_env, perceive

SETTINGS = {"num_agents": 3, "height": 6, "width": 5, "fov_radius": 2, "comm_radius": 2.5}
RICH = {
    "fov_radius": 2,
    "comm_radius": 2.5,
    "extra_channels": ("previous_positions", "cost_to_go"),
    "robot_features": ("last_moves", "steps_left", "under_way", "stuck"),
    "edge_features": ("relative_position", "last_moves", "priority"),
}


@pytest.fixture(scope="module")
def cases():
    family = Family(num_agents=(3, 3), height=(6, 6), width=(5, 5))
    return make_cases("train", seed=0, maps=5, cases_per_map=2, families=[family]).instances


@pytest.fixture(scope="module")
def mixed():
    """Teams and maps of several sizes."""
    families = [
        Family(num_agents=(1, 5), height=(4, 7), width=(4, 7)),
        Family(style="maze", num_agents=(2, 6), height=(7, 9), width=(7, 9)),
    ]
    return make_cases("train", seed=1, maps=6, cases_per_map=3, families=families)


def acting(env, state, actions):
    return env.step(state.clone().set(ACTION, torch.as_tensor(actions)))["next"]


@pytest.mark.parametrize("observation", ["dense", "state"])
@pytest.mark.parametrize("dtype", ["float32", "uint8"])
def test_torchrl_finds_the_specs_right(cases, mixed, dtype, observation):
    settings = {"max_cycles": 5, "dtype": dtype, "observation": observation}
    check_env_specs(TeamEnv(4, **SETTINGS, **settings))
    check_env_specs(TeamEnv(3, cases, **settings))
    check_env_specs(TeamEnv(3, cases, **settings, shield="pibt"))
    check_env_specs(TeamEnv(3, cases, **settings, shield="pibt_swap"))
    check_env_specs(TeamEnv(5, mixed.instances, **settings, **RICH))
    check_env_specs(TeamEnv(5, mixed.instances, **settings, task="lifelong", message_loss=0.5))


def test_under_pibt_it_steps_by_the_scores_of_moves(cases):
    generator = np.random.default_rng(1)
    env = TeamEnv(6, cases, max_cycles=7, fov_radius=2, comm_radius=2.5, shield="pibt")
    twin = BatchedEnv(6, max_cycles=7, shield="pibt", **SETTINGS)
    env.set_seed(11)
    state = env.reset()
    twin.reset(11, instances=[cases[i] for i in state[CASE].tolist()])
    for _ in range(7):
        values = generator.normal(size=(6, 3, 5)).astype(np.float32)
        state, outcome = acting(env, state, values), twin.step(values)
        assert np.array_equal(state[POSITIONS].numpy(), twin.positions)
        assert np.array_equal(state[FOV].numpy(), outcome.observation.fov)
        if state["done"].any():
            break


def test_it_steps_as_the_batched_environment_does(cases):
    """The same instances, seeds and actions, with partial resets where teams end."""
    generator = np.random.default_rng(0)
    env = TeamEnv(6, cases, max_cycles=7, fov_radius=2, comm_radius=2.5)
    twin = BatchedEnv(6, max_cycles=7, **SETTINGS)
    env.set_seed(5)
    state = env.reset()
    seen = twin.reset(5, instances=[cases[i] for i in state[CASE].tolist()])
    resets = 0
    for _ in range(40):
        assert np.array_equal(state[FOV], seen.fov)
        assert np.array_equal(state[GRAPH], seen.graph)
        assert np.array_equal(state[POSITIONS], twin.positions)
        actions = generator.integers(5, size=(6, 3))
        wise, _ = experts.relabel([cases[i] for i in state[CASE].tolist()], twin.positions)
        actions[::2] = wise[::2]  # these teams end early, each at its own time
        both, state = env.step_and_maybe_reset(state.set(ACTION, torch.from_numpy(actions)))
        step = twin.step(actions)
        after = both["next"]
        assert np.array_equal(after[FOV], step.observation.fov)
        assert np.array_equal(after[POSITIONS], twin.positions)
        assert np.array_equal(after[REWARD].squeeze(-1), step.rewards)
        assert np.array_equal(after["terminated"].squeeze(-1), step.terminated)
        assert np.array_equal(after["truncated"].squeeze(-1), step.truncated)
        ended = step.terminated | step.truncated
        assert np.array_equal(after["done"].squeeze(-1), ended)
        seen = step.observation
        if ended.any():
            resets += int(ended.sum()) if not ended.all() else 0
            seen = twin.reset(instances=[cases[i] for i in state[CASE][torch.from_numpy(ended)].tolist()], mask=ended)
            assert not state["done"].any()
    assert resets > 0


def batched(env, instances, **settings):
    """The batched environment of the same settings that takes instances of any of these sizes."""
    sizes = {
        "num_agents": max(each.num_agents for each in instances),
        "height": max(each.grid.shape[0] for each in instances),
        "width": max(each.grid.shape[1] for each in instances),
    }
    return BatchedEnv(env.batch_size[0], fill=True, style="empty", **sizes, **settings)


@pytest.mark.parametrize("observation", ["dense", "state"])
def test_teams_and_maps_of_any_sizes_step_side_by_side(mixed, observation):
    generator, settings = np.random.default_rng(0), {**RICH, "max_cycles": 9, "message_loss": 0.2}
    env = TeamEnv(7, mixed.instances, observation=observation, **settings)
    twin = batched(env, mixed.instances, **settings)
    env.set_seed(5)
    state = env.reset()
    seen = twin.reset(5, instances=[mixed.instances[i] for i in state[CASE].tolist()])
    for _ in range(9):
        assert np.array_equal(state[POSITIONS], twin.positions)
        if observation == "dense":
            for key, part in zip((FOV, GRAPH, SCALARS, EDGE_ATTR), seen, strict=True):
                assert np.array_equal(state[key], part)
        else:
            assert set(state.exclude(ACTION, REWARD, *ENDS).keys(True, True)) == set(STATE_KEYS)
            found, expected = states_of(state, np.arange(len(mixed))), twin.states()
            assert np.array_equal(found.maps, state[CASE])
            for name in set(type(found).__slots__) - {"maps"}:
                assert np.array_equal(getattr(found, name), getattr(expected, name)), name
        actions = generator.integers(5, size=twin.present.shape)
        step = twin.step(actions)
        seen, state = step.observation, acting(env, state, actions)
        assert np.array_equal(state[REWARD].squeeze(-1), step.rewards)
        assert np.array_equal(state["terminated"].squeeze(-1), step.terminated)
        if (step.terminated | step.truncated).any():
            break


@pytest.mark.parametrize("task", ["one_shot", "lifelong"])
@pytest.mark.parametrize("dtype", ["float32", "uint8"])
def test_states_that_a_collector_recorded_rebuild_what_the_environment_showed(mixed, task, dtype):
    """Bags of the environment while it was played, and `perceive` of the states of the batch: equal to the bit."""
    generator, shown = np.random.default_rng(0), []
    settings = {**RICH, "comm_range": "connected", "comm_weights": "distance", "dtype": dtype}
    env = TeamEnv(5, mixed.instances, observation="state", task=task, max_cycles=7, message_loss=0.3, **settings)

    def play(state: TensorDict) -> TensorDict:
        shown.append(env._batch.bag())
        return state.set(ACTION, torch.from_numpy(generator.integers(5, size=tuple(state[POSITIONS].shape[:2]))))

    collector = Collector(env, play, frames_per_batch=5 * 20, total_frames=5 * 40, trust_policy=True)
    shown.clear()  # a collector tries the policy once
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    maps = MapSet([mixed.grids[k] for k in mixed.map_of], 2, dtype)
    played = torch.cat(batches, dim=1)  # pyright: ignore[reportArgumentType]
    assert tuple(played.batch_size) == (5, 40)  # pyright: ignore[reportAttributeAccessIssue]
    assert len(shown) == 40
    assert played["next", "done"].sum() >= 5 * 5  # pyright: ignore[reportArgumentType]
    for time in range(40):
        states = states_of(played[:, time], maps.index)  # pyright: ignore[reportArgumentType]
        bag = perceive(states, maps, Senses(**settings_of_senses(settings)), message_loss=0.3)
        for rebuilt, seen in zip(bag, shown[time], strict=True):
            assert rebuilt.dtype == seen.dtype
            assert np.array_equal(rebuilt, seen)
    together = states_of(played.reshape(-1), maps.index)  # pyright: ignore[reportArgumentType]
    assert len(together) == 200
    assert len(set(np.diff(together.offsets).tolist())) > 3
    if task == "lifelong":
        goals = {each.goals.tobytes() for each in mixed.instances}
        rows = [slice(*together.offsets[t : t + 2]) for t in range(200)]
        assert any(together.goals[own].astype(np.int32).tobytes() not in goals for own in rows)


def settings_of_senses(settings):
    return {name: value for name, value in settings.items() if name in Senses.__dataclass_fields__}


def test_a_reset_of_some_teams_leaves_the_others_alone(cases):
    env = TeamEnv(4, cases, max_cycles=50)
    state = env.reset(seed=1)
    moved = acting(env, state, np.random.default_rng(0).integers(4, size=(4, 3)))
    mask = torch.tensor([[True], [False], [False], [True]])
    fresh = env.reset(moved.exclude("reward").clone().set("_reset", mask))
    for team in (1, 2):
        assert torch.equal(fresh[POSITIONS][team], moved[POSITIONS][team])
        assert fresh[CASE][team] == moved[CASE][team]
    for team in (0, 3):
        assert np.array_equal(fresh[POSITIONS][team], cases[int(fresh[CASE][team])].starts)


def test_equal_seeds_give_equal_rollouts(cases):
    def played(env):
        env.set_seed(11)
        torch.manual_seed(3)
        return env.rollout(30, break_when_any_done=False)

    for make in (lambda: TeamEnv(3, cases, max_cycles=6), lambda: TeamEnv(3, max_cycles=6, **SETTINGS)):
        env = make()
        first, again, another = played(env), played(env), played(make())
        assert (first == again).all()
        assert (first == another).all()
        env.set_seed(12)
        torch.manual_seed(3)
        assert not (first[POSITIONS] == env.rollout(30, break_when_any_done=False)[POSITIONS]).all()


def test_a_pass_visits_every_case_once(cases):
    env = TeamEnv(4, cases, max_cycles=1)
    state, visits = env.reset(seed=0), []
    for _ in range(10):
        visits += state[CASE].tolist()
        _, state = env.step_and_maybe_reset(state.set(ACTION, torch.full((4, 3), 4)))
    for first in range(0, 40, len(cases)):
        assert sorted(visits[first : first + len(cases)]) == list(range(len(cases)))
    assert visits[:10] != visits[10:20]


def test_teams_without_cases_play_random_instances():
    env = TeamEnv(3, max_cycles=4, **SETTINGS)
    state = env.reset(seed=0)
    assert (state[CASE] == -1).all()
    assert len({state[POSITIONS][team].numpy().tobytes() for team in range(3)}) == 3


def test_a_collector_plays_whole_batches(cases):
    def idle(state: TensorDict) -> TensorDict:
        return state.set(ACTION, torch.full((*state.batch_size, 3), 4))

    collector = Collector(TeamEnv(4, cases, max_cycles=3), idle, frames_per_batch=24, total_frames=48)
    batches = list(collector)
    collector.shutdown()
    assert [tuple(each.batch_size) for each in batches] == [(4, 6)] * 2
    for batch in batches:
        starts = np.stack([cases[i].starts for i in batch[CASE].flatten().tolist()])
        assert np.array_equal(batch[POSITIONS].flatten(0, 1), starts)
        assert batch["next", "truncated"].sum() == 8


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested:UserWarning")  # torchrl, of any newer PettingZoo
def test_a_team_of_one_plays_as_torchrls_view_of_the_pettingzoo_environment(cases):
    case = cases[3]
    settings = {**SETTINGS, "max_cycles": 9}
    generator = np.random.default_rng(2)
    team = TeamEnv(1, [case], fov_radius=2, comm_radius=2.5, max_cycles=9)
    wrapped = PettingZooWrapper(parallel_env(**settings), categorical_actions=True)
    team.set_seed(7)
    ours = team.reset()
    theirs = wrapped.reset(seed=7, options={"instance": case})
    for _ in range(9):
        assert torch.equal(ours[FOV][0], theirs["agent", "observation", "fov"])
        assert torch.equal(ours[GRAPH][0], theirs["agent", "observation", "graph"])
        actions = torch.from_numpy(generator.integers(5, size=3))
        ours = acting(team, ours, actions[None])
        theirs = wrapped.step(theirs.set(("agent", "action"), actions))["next"]
        assert torch.equal(ours[REWARD][0], theirs["agent", "reward"])
        for end in ("terminated", "truncated", "done"):
            assert (theirs["agent", end] == ours[end][0]).all()
        if ours["done"].all():
            break
    assert ours["done"].all()


def test_maps_may_be_full_of_robots():
    grid = np.zeros((1, 3), bool)
    crowd = Instance(grid, [[0, 0], [0, 1], [0, 2]], [[0, 0], [0, 1], [0, 2]])
    env = TeamEnv(2, [crowd], fov_radius=1)
    env.set_seed(0)
    after = acting(env, env.reset(), np.zeros((2, 3), np.int64))
    assert after["terminated"].all()


def test_starts_and_goals_are_drawn_on_a_given_map():
    grid = np.zeros((3, 6), bool)
    grid[1, 1:5] = True
    env = TeamEnv(20, grid=grid, num_agents=4, fov_radius=2)
    starts = env.reset(seed=0)[POSITIONS].numpy()
    assert not grid[starts[..., 0], starts[..., 1]].any()
    assert len({each.tobytes() for each in starts}) > 15


def test_cases_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="no cases"):
        TeamEnv(2, [])
    with pytest.raises(ValueError, match="observation must be one of dense, state"):
        TeamEnv(2, observation="box", **SETTINGS)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="speed"):
        TeamEnv(2, speed=3, **SETTINGS)
