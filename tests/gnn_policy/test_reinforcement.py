"""Reinforcement learning from lost steps, checked against plain Python."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from rich.console import Console

import bags
import oracles
from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig
from gnn_policy.cases import Family, make_cases
from gnn_policy.config import TrainConfig
from gnn_policy.labelling import Labeller
from gnn_policy.processes import Process
from gnn_policy.progress import TrainingProgress
from gnn_policy.reinforcement import (
    CLIP,
    DISPLACEMENT,
    EXPLORATION,
    TRACE,
    Critic,
    Explorer,
    evaluate,
    log_probability,
    loss_of,
)
from gnn_policy.training import Training

CONFIG = TrainConfig(
    policy=PolicyConfig(encoder="lean", features=8, fov_radius=2, comm_radius=3.0),
    objective="delay",
    execution=Execution(actions="stuck", shield="pibt"),
    rollout_actions="stuck",
    rollout_teams=4,
    rollout_length=12,
    batch_size=10,
    precision="float32",
    threads=1,
    seed=3,
)
STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]
CROWD = Family(num_agents=(4, 5), height=(4, 4), width=(3, 4), density=(0.1, 0.2))
FAMILIES = {"one-shot": [CROWD], "lifelong": [replace(CROWD, task="lifelong")]}


def explored(config, kind="one-shot"):
    """A policy, its critic and its experience of a round, and the cases."""
    cases = make_cases("train", seed=0, maps=4, cases_per_map=2, families=FAMILIES[kind])
    torch.manual_seed(0)
    policy, critic = DecentralizedPolicy(config.policy, config.execution), Critic(config.policy.features)
    bags.spread_preferences(policy, cases.instances)
    explorer = Explorer(config, policy, critic, Labeller(cases.grids, w=1.05, node_limit=100, threads=1), cases)
    try:
        (experience,) = explorer.collect(0, config.rollout_teams * config.rollout_length)
    finally:
        explorer.close()
    return policy, critic, explorer, experience, cases


def plackett_luce(logits, order, places):
    left, probability = list(range(5)), 1.0
    for move in order[:places]:
        probability *= math.exp(logits[move]) / sum(math.exp(logits[other]) for other in left)
        left.remove(move)
    return math.log(probability)


def test_places_of_an_order_are_drawn_one_after_another_from_the_softmax_of_the_rest():
    logits = torch.randn(30, 5, generator=torch.Generator().manual_seed(0))
    order = torch.stack([torch.randperm(5, generator=torch.Generator().manual_seed(k)) for k in range(30)])
    places = torch.arange(30) % 5 + 1
    found = log_probability(logits, order, places)
    for k in range(30):
        expected = plackett_luce((logits[k] / EXPLORATION).tolist(), order[k].tolist(), int(places[k]))
        assert found[k].item() == pytest.approx(expected, abs=1e-5)
    orders = torch.tensor(list(itertools.permutations(range(5))))
    every = log_probability(logits[:1].expand(120, 5), orders, torch.full((120,), 5))
    assert every.exp().sum().item() == pytest.approx(1.0, abs=1e-5)


def near(one, two):
    return abs(one[0] - two[0]) + abs(one[1] - two[1]) <= 2


def cells(array):
    return [tuple(cell) for cell in array.tolist()]


@pytest.mark.parametrize("kind", FAMILIES)
@pytest.mark.parametrize("shield", ["pibt", "idle"])
def test_choices_and_targets_are_those_of_plain_python(kind, shield):
    """Losses from breadth-first distances; each target from the next by generalized advantage estimation."""
    config = replace(CONFIG, execution=replace(CONFIG.execution, shield=shield), neighbour_share=0.7, discount=0.9)
    policy, critic, explorer, experience, cases = explored(config, kind)
    states, steps = experience.states, config.rollout_teams * config.rollout_length
    assert len(states) == steps
    rows = [slice(int(first), int(last)) for first, last in itertools.pairwise(states.offsets)]
    with torch.no_grad():
        value = torch.cat(
            [evaluate(policy.eval(), critic, explorer.perceive(states.take([t])))[1] for t in range(steps)]
        )
    ahead = experience.value - value
    stuck, followed, learned, left = states.stuck(), 0, 0, 0
    for t in range(steps):
        here, goals = cells(states.positions[rows[t]]), cells(states.goals[rows[t]])
        robots, begin = range(len(here)), rows[t].start
        last = (t + 1) % config.rollout_length == 0 or states.times[t + 1] != states.times[t] + 1
        if last:
            assert not experience.explored[rows[t]].any(), "what came of it is not known"
            continue
        then, later = cells(states.positions[rows[t + 1]]), rows[t + 1].start
        ways = [oracles.distances(cases.grids[states.maps[t]], goal) for goal in goals]
        leaves = [kind == "one-shot" and here[i] == goals[i] != then[i] for i in robots]
        reward = [
            ways[i][here[i]] - ways[i][then[i]] - (then[i] != goals[i]) - DISPLACEMENT * leaves[i] for i in robots
        ]
        left += sum(leaves)
        for i in robots:
            row, following = begin + i, later + i
            shared = reward[i] + 0.7 * sum(reward[j] for j in robots if j != i and near(here[i], here[j]))
            expected = shared + 0.9 * (value[following] + TRACE * ahead[following]).item()
            assert experience.value[row].item() == pytest.approx(expected, abs=1e-3)
            executed = STEPS.index((then[i][0] - here[i][0], then[i][1] - here[i][1]))
            if shield == "pibt":
                assert experience.order[row, experience.places[row] - 1] == executed
            else:
                assert (experience.places[row], executed in (experience.order[row, 0].item(), 4)) == (1, True)
            assert not (stuck[row] and experience.explored[row]), "stuck robots draw by themselves"
            followed += 1
            learned += int(experience.explored[row])
    assert 0.05 * followed < learned <= followed
    assert (left > 0) == (kind == "one-shot")


def test_probabilities_are_those_of_the_choice_and_advantages_are_scaled_by_team():
    policy, critic, explorer, experience, _ = explored(CONFIG)
    with torch.no_grad():
        logits, _ = evaluate(policy.eval(), critic, explorer.perceive(experience.states))
    for row in range(0, len(logits), 7):
        order, places = experience.order[row].tolist(), int(experience.places[row])
        expected = plackett_luce((logits[row] / EXPLORATION).tolist(), order, places)
        assert experience.log_prob[row].item() == pytest.approx(expected, abs=1e-3)
    states, spreads = experience.states, []
    for team in range(CONFIG.rollout_teams):
        own = slice(*states.offsets[[team * CONFIG.rollout_length, (team + 1) * CONFIG.rollout_length]].tolist())
        advantage = experience.advantage[own][experience.explored[own]]
        assert advantage.mean().item() == pytest.approx(0.0, abs=1e-4)
        spreads.append(advantage.std(correction=0).item())
    assert max(spreads) == pytest.approx(1.0, abs=1e-3)
    assert min(spreads) > 0.1


def test_the_loss_is_clipped_and_leaves_out_robots_that_did_not_explore():
    policy, critic, explorer, experience, _ = explored(CONFIG)
    rows = torch.arange(experience.states.num_robots)
    bag = explorer.perceive(experience.states)
    explored_rows = experience.explored

    def gradient(of=policy.head.weight, **changes):
        changed = replace(experience, value=torch.zeros(len(rows)), **changes)
        loss = loss_of(policy.eval(), critic, bag, changed, rows).loss
        return torch.autograd.grad(loss, of)[0].abs().sum().item()

    likelier = experience.log_prob - math.log(1 + 2 * CLIP)  # as if the choices had become so much more likely
    ones = torch.ones(len(rows))
    assert gradient(advantage=ones) > 0
    assert gradient(advantage=ones, log_prob=likelier) == 0
    assert gradient(advantage=-ones, log_prob=likelier) > 0
    assert gradient(advantage=torch.where(explored_rows, 0.0, 1.0)) == 0
    assert gradient(advantage=ones, explored=torch.zeros_like(explored_rows)) == 0
    assert gradient(next(policy.encoder.parameters()), advantage=0 * ones) == 0, "the critic changes no feature"
    assert gradient(next(critic.parameters()), advantage=0 * ones) > 0


def test_an_untrained_policy_learns_to_lose_fewer_steps(tmp_path):
    """On small maps, from random weights: what it loses falls by half in a few rounds."""
    config = replace(
        CONFIG,
        policy=PolicyConfig(
            encoder="lean", features=32, fov_radius=2, comm_radius=3.0, robot_features=("greedy_moves",)
        ),
        rollout_actions="argmax",
        families=(Family(num_agents=(2, 2), height=(5, 5), width=(5, 5), task="lifelong"),),
        train_maps=20,
        validation_maps=10,
        validation_cases_per_map=2,
        test_maps=1,
        cases_per_map=2,
        rollout_teams=16,
        rollout_length=20,
        dagger_steps=320,
        batch_size=40,
        rounds=20,
        validate_every=20,
        lr=1e-2,
    )
    training = Training(config, tmp_path, TrainingProgress(config.rounds, Console(quiet=True)))
    training.run()
    lost = [row.loss for row in training.history]
    assert np.mean(lost[-3:]) < 0.5 * np.mean(lost[:3])
    assert (training.history[-1].validation_throughput or 0.0) > 0.3
    assert training.history[-1].expert_seconds == 0.0


def test_several_processes_are_refused(tmp_path):
    config = replace(CONFIG, train_maps=3, validation_maps=1, test_maps=1, cases_per_map=1)
    with pytest.raises(ValueError, match="trains in one process, got 2"):
        Training(config, tmp_path, TrainingProgress(1, Console(quiet=True)), Process(count=2, local_count=2))


def test_settings_that_it_cannot_use_are_refused():
    with pytest.raises(ValueError, match="robots that do not sample"):
        replace(CONFIG, rollout_actions="sampled")
    for name, value in (("discount", 1.5), ("neighbour_share", -1.0), ("neighbour_share", math.inf)):
        with pytest.raises(ValueError, match=name):
            replace(CONFIG, **{name: value})
