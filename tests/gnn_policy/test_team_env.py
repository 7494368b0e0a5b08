"""TeamEnv is the batched environment, seen by TorchRL."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

import experts
from gnn_policy.cases import make_cases
from gnn_policy.team_env import ACTION, CASE, FOV, GRAPH, POSITIONS, REWARD, TeamEnv
from mapf_env import BatchedEnv, Instance, parallel_env

SETTINGS = {"num_agents": 3, "height": 6, "width": 5, "fov_radius": 2, "comm_radius": 2.5}


@pytest.fixture(scope="module")
def cases():
    return make_cases(
        "train", seed=0, maps=5, cases_per_map=2, num_agents=3, height=6, width=5, density=0.1, styles=["cells"]
    )


def acting(env, state, actions):
    return env.step(state.clone().set(ACTION, torch.as_tensor(actions)))["next"]


@pytest.mark.parametrize("dtype", ["float32", "uint8"])
def test_torchrl_finds_the_specs_right(cases, dtype):
    check_env_specs(TeamEnv(4, max_cycles=5, dtype=dtype, **SETTINGS))
    check_env_specs(TeamEnv(3, cases, max_cycles=5, dtype=dtype))
    check_env_specs(TeamEnv(3, cases, max_cycles=5, dtype=dtype, shield="pibt"))


def test_under_pibt_it_steps_by_the_values_of_moves(cases):
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


def test_no_cases_at_all_are_refused():
    with pytest.raises(ValueError, match="no cases"):
        TeamEnv(2, [])
