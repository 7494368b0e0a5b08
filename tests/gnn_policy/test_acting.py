"""One call from any environment's observations to moves, which are those of the network on the bag of robots."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import bags
import strategies
from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig
from gnn_policy.acting import bag_of, logits_of
from gnn_policy.execution import alarmed
from gnn_policy.team_env import ACTION, POSITIONS, TeamEnv
from mapf_env import MOVES, Action, Bag, BatchedEnv, Instance, distances, parallel_env, random_instance

CASES = [
    random_instance(num_agents=agents, height=height, width=width, density=0.1, seed=agents)
    for agents, height, width in ((11, 6, 7), (4, 5, 5), (1, 3, 8))
]
PLAIN = Execution()
NETWORKS = {
    "paper": PolicyConfig(encoder="lean", features=16, fov_radius=2, comm_radius=2.5),
    "attention": PolicyConfig(
        encoder="lean",
        features=16,
        fov_radius=2,
        comm_radius=2.5,
        graph_layer="attention",
        extra_channels=("previous_positions", "cost_to_go"),
        robot_features=("last_moves", "on_goal"),
        edge_features=("goal_direction", "relative_position"),
        memory=3,
    ),
}


def seeded_policy(name="paper", execution=PLAIN, **changes):
    """A policy with clear preferences that differ from state to state."""
    torch.manual_seed(0)
    policy = DecentralizedPolicy(replace(NETWORKS[name], **changes), execution)
    bags.spread_preferences(policy, CASES)
    return policy


def batched(policy, cases=CASES, **more):
    sizes = {
        "num_agents": max(case.num_agents for case in cases),
        "height": max(case.grid.shape[0] for case in cases),
        "width": max(case.grid.shape[1] for case in cases),
    }
    return BatchedEnv(len(cases), fill=True, style="empty", **sizes, **policy.env_settings(), **more)


def of_network(policy, bag):
    with torch.no_grad():
        return policy(Bag(*(torch.from_numpy(each) for each in bag))).numpy()


def played(policy, steps=6, **more):
    """Teams some steps under way, with history and robots that were stopped."""
    env, generator = batched(policy, max_cycles=50, **more), np.random.default_rng(1)
    observation = env.reset(seed=3, instances=CASES)
    for _ in range(steps):
        observation = env.step(generator.integers(5, size=(3, 11))).observation
    assert env.running.all()
    return env, observation


@pytest.mark.parametrize("name", NETWORKS)
def test_moves_for_a_batched_environment_are_those_of_the_network_on_the_bag(name):
    policy = seeded_policy(name)
    env, observation = played(policy)
    expected = of_network(policy, env.bag()).argmax(-1)
    moves = policy.act(observation)
    assert np.array_equal(moves[env.present], expected)
    assert (moves[~env.present] == 4).all()
    assert np.array_equal(policy.act(env.bag()), expected)
    assert len(set(expected.tolist())) > 2
    env.step(moves)


@pytest.mark.parametrize("name", NETWORKS)
def test_moves_for_a_dictionary_are_those_of_the_network_whatever_its_order(name):
    policy = seeded_policy(name)
    for case in CASES:
        height, width = case.grid.shape
        env = parallel_env(num_agents=case.num_agents, height=height, width=width, density=0.0, **policy.env_settings())
        twin = batched(policy, [case])
        seen, _ = env.reset(seed=3, options={"instance": case})
        twin.reset(seed=3, instances=[case])
        expected = of_network(policy, twin.bag()).argmax(-1).tolist()
        for agents in (list(seen), sorted(seen), list(seen)[::-1]):
            moves = policy.act({agent: seen[agent] for agent in agents})
            assert moves == {f"agent_{i}": move for i, move in enumerate(expected)}
        env.step(moves)


@pytest.mark.parametrize("name", NETWORKS)
def test_moves_for_a_team_environment_are_those_of_the_network(name):
    policy = seeded_policy(name)
    env = TeamEnv(4, CASES, **policy.env_settings())
    twin = batched(policy, [CASES[i] for i in env.reset(seed=5)["case"].tolist()])
    env.set_seed(5)
    state = env.reset()
    twin.reset(5, instances=[CASES[i] for i in state["case"].tolist()])
    moves = policy.act(state)
    assert np.array_equal(moves.numpy()[twin.present], of_network(policy, twin.bag()).argmax(-1))
    env.step(state.set(ACTION, moves))


@pytest.mark.parametrize("shield", ["idle", "pibt", "pibt_swap"])
@pytest.mark.parametrize("name", NETWORKS)
def test_all_environments_walk_the_same_paths(name, shield):
    policy, case = seeded_policy(name, Execution(shield=shield)), CASES[0]
    height, width = case.grid.shape
    scored = shield != "idle"
    settings = {**policy.env_settings(), "max_cycles": 12}
    dictionary = parallel_env(num_agents=11, height=height, width=width, preferences=scored, **settings)
    many, dense = (BatchedEnv(1, num_agents=11, height=height, width=width, **settings) for _ in range(2))
    team = TeamEnv(1, [case], **settings)
    team.set_seed(7)
    seen, _ = dictionary.reset(seed=7, options={"instance": case})
    observation, state = dense.reset(7, instances=[case]), team.reset()
    many.reset(7, instances=[case])
    moved = 0
    while dictionary.agents:
        before = dictionary.positions
        seen, *_ = dictionary.step(policy.act(seen))
        observation = dense.step(policy.act(observation)).observation
        many.step(policy.act(many.bag()).reshape(1, 11, -1) if scored else policy.act(many.bag())[None])
        state = team.step(state.set(ACTION, policy.act(state)))["next"]
        for positions in (dense.positions[0], many.positions[0], state[POSITIONS][0].numpy()):
            assert np.array_equal(positions, dictionary.positions)
        moved += int((before != dictionary.positions).any(axis=1).sum())
    assert moved > 5


@settings(max_examples=60)
@given(
    chosen=strategies.all_settings(),
    cases=st.lists(strategies.instances(min_agents=1, max_agents=6), min_size=1, max_size=3),
    seed=strategies.seeds,
    steps=st.integers(0, 5),
)
def test_an_observation_and_the_bag_of_the_same_states_hold_the_same_facts(chosen, cases, seed, steps):
    sizes = {
        "num_agents": max(case.num_agents for case in cases),
        "height": max(case.grid.shape[0] for case in cases),
        "width": max(case.grid.shape[1] for case in cases),
    }
    env = BatchedEnv(len(cases), fill=True, **{**chosen, **sizes, "density": 0.0, "style": "empty", "max_cycles": 50})
    generator = np.random.default_rng(seed)
    observation = env.reset(seed, instances=cases)
    for _ in range(steps):
        if not env.running.all():
            break
        observation = env.step(generator.integers(5, size=(len(cases), env.num_agents))).observation
    bag, present = bag_of(observation)
    assert np.array_equal(present, env.present)
    running = env.running[bag.team]
    number = np.cumsum(running) - 1
    own = running[bag.edge_index[1]]
    expected = env.bag()
    assert np.array_equal(bag.fov[running], expected.fov)
    assert np.array_equal(bag.scalars[running], expected.scalars)
    assert np.array_equal(number[bag.edge_index[:, own]], expected.edge_index)
    assert np.array_equal(bag.edge_weight[own], expected.edge_weight)
    assert np.array_equal(bag.edge_attr[own], expected.edge_attr)
    assert np.array_equal(bag.team[running], expected.team)


class OfTeams(torch.nn.Module):
    """A network that looks at all robots of a team, which no robot could."""

    config = NETWORKS["paper"]

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.randn(3, 5, generator=torch.Generator().manual_seed(0)))

    def forward(self, bag):
        own = bag.fov.float().mean((2, 3))
        teams = int(bag.team.max()) + 1
        total = own.new_zeros(teams, 3).index_add(0, bag.team, own)
        size = torch.bincount(bag.team, minlength=teams).clamp(min=1)
        return (own + (total / size[:, None])[bag.team]) @ self.weight


@pytest.mark.parametrize("network", [seeded_policy("attention"), OfTeams()])
def test_logits_for_any_number_of_robots_are_those_of_the_network(network):
    env, _ = played(seeded_policy("attention" if network.config.robot_features else "paper"))
    for mask in ([True] * 3, [True, False, False], [False, True, True], [False, False, True]):
        bag = env.bag(np.array(mask))
        np.testing.assert_allclose(logits_of(network, bag), of_network(network, bag), rtol=1e-5, atol=1e-5)


def test_a_bag_without_robots_has_no_moves():
    policy = seeded_policy()
    env = batched(policy)
    assert policy.act(env.bag()).shape == (0,)
    assert seeded_policy(execution=Execution(shield="pibt")).act(env.bag()).shape == (0, 5)


def test_draws_follow_the_tempered_softmax_and_repeat_with_the_seed():
    execution = Execution(actions="sampled", temperature=2.0)
    policy = seeded_policy(execution=execution)
    env, observation = played(policy)
    logits = of_network(policy, env.bag()) / 2
    generator = np.random.default_rng(0)
    drawn = np.array([policy.act(observation, seed=generator)[env.present] for _ in range(2000)])
    shares = np.stack([(drawn == action).mean(axis=0) for action in range(5)], -1)
    np.testing.assert_allclose(shares, torch.softmax(torch.from_numpy(logits), -1).numpy(), atol=0.05)
    assert np.array_equal(policy.act(observation, seed=4), policy.act(observation, seed=4))
    assert not np.array_equal(policy.act(observation, seed=4), policy.act(observation, seed=5))
    assert np.array_equal(policy.act(env.bag(), seed=4), policy.act(observation, seed=4)[env.present])
    by_argmax = policy.act(observation, execution=Execution())
    assert np.array_equal(by_argmax[env.present], logits.argmax(-1))


@pytest.mark.parametrize("taps", [1, 3])
@pytest.mark.parametrize("knows", [False, True])
def test_robots_sample_when_they_or_a_neighbour_are_stuck(taps, knows):
    """A policy may read itself whether a robot is stuck; otherwise the environment adds that at the end."""
    own = ("stuck", "on_goal") if knows else ("on_goal",)
    execution = Execution(actions="stuck", temperature=1e6)
    policy = seeded_policy(execution=execution, taps=taps, robot_features=own, comm_radius=1.5)
    env, observation = played(policy, steps=1)
    bag, states = env.bag(), env.states()
    stuck = states.stuck()
    draws = [
        bool(stuck[i]) or (taps > 1 and any(stuck[j] for j, k in bag.edge_index.T.tolist() if k == i))
        for i in range(len(stuck))
    ]
    taken = np.array([policy.act(observation, seed=seed)[env.present] for seed in range(60)])
    assert [len(set(moves.tolist())) > 1 for moves in taken.T] == draws
    assert 0 < sum(draws) < len(draws)
    by_argmax = of_network(policy, bag).argmax(-1)
    still = ~np.array(draws)
    assert (taken[:, still] == by_argmax[still]).all()


@pytest.mark.parametrize("own", [(), ("stuck", "jammed", "on_goal", "greedy_moves")])
def test_robots_that_are_stuck_fall_back_on_their_shortest_way_and_those_that_hear_them_do_not(own):
    execution = Execution(actions="fallback", temperature=0.5, shield="pibt_swap")
    policy = seeded_policy(execution=execution, robot_features=own, comm_radius=1.5)
    env, observation = played(policy, steps=1)
    bag, states = env.bag(), env.states()
    stuck = states.stuck()
    assert 0 < stuck.sum() < alarmed(stuck, bag.edge_index).sum()
    scores = policy.act(observation, seed=3)[env.present]
    assert np.array_equal(scores[~stuck], of_network(policy, bag)[~stuck])
    for robot in np.flatnonzero(stuck):
        case = CASES[states.team[robot]]
        steps = np.pad(distances(case.grid, states.goals[[robot]])[0], 1, constant_values=-1)
        around = [steps[tuple(states.positions[robot] + move + 1)] for move in MOVES]
        here = around[Action.IDLE]
        shorter = [here == 0 == there or 0 <= there < here for there in around]
        tiers = np.array([2 * each for each in shorter])
        tiers[Action.IDLE] = max(tiers[Action.IDLE], 1)
        assert (np.diff(tiers[scores[robot].argsort()]) >= 0).all()


def test_stuck_robots_of_a_dictionary_sample():
    policy = seeded_policy(execution=Execution(actions="stuck", temperature=1e6), comm_radius=0.0)
    instance = Instance(np.zeros((1, 4), bool), [[0, 0], [0, 3]], [[0, 3], [0, 1]])
    env = parallel_env(num_agents=2, height=1, width=4, density=0.0, **policy.env_settings())
    env.reset(seed=0, options={"instance": instance})
    seen, *_ = env.step({"agent_0": 4, "agent_1": 1})
    taken = [policy.act(seen, seed=seed) for seed in range(60)]
    assert len({moves["agent_0"] for moves in taken}) == 5
    assert len({moves["agent_1"] for moves in taken}) == 1


@pytest.mark.parametrize("training", [False, True])
def test_the_policy_is_left_in_the_mode_that_it_was_in(training):
    policy = seeded_policy()
    _, observation = played(policy)
    expected = policy.act(observation)
    policy.train(training)
    assert np.array_equal(policy.act(observation), expected)
    assert all(module.training == training for module in policy.modules())


def test_wrong_observations_are_refused_with_the_remedy():
    policy = seeded_policy(execution=Execution(actions="stuck"))
    settings = {"num_agents": 3, "height": 6, "width": 6, "fov_radius": 2}
    seen, _ = parallel_env(**settings).reset(seed=0)
    with pytest.raises(ValueError, match=r"stuck,1 reads stuck, which .* not say: .*\*\*policy.env_settings\(\)"):
        policy.act(seen)
    policy.act(seen, execution=Execution())
    views, _ = parallel_env(**settings, observation="box").reset(seed=0)
    with pytest.raises(ValueError, match=r'agents observe views alone: .*observation="dict"'):
        policy.act(views)
    with pytest.raises(ValueError, match=r"views are \(3, 9, 9\), this policy reads \(3, 7, 7\)"):
        policy.act(BatchedEnv(2, num_agents=3, fov_radius=3, robot_features=("stuck",)).reset(seed=0))
    for wrong in (np.zeros((3, 5)), "n12", {}):
        with pytest.raises(TypeError, match=f"act takes what parallel_env, .*, got {type(wrong).__name__}"):
            policy.act(wrong)
