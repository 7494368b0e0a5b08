"""Reinforcement learning from lost steps: what imitation has taught is improved by proximal policy optimisation.

A robot loses a step when it is off its goal and does not come closer to it (the reward "shaped" of the environment).
It loses some more when it has to leave its goal. A loss counts for the robot and, in part, for the robots next to it,
which may be its cause. Robots that would take their most probable move draw it instead; the shield, and robots that
draw anyway (stuck ones), belong to the environment. Under a PIBT shield a robot's choice is an order of moves, of which
it learns the places down to the move that was executed.

Sources: Schulman et al. 2017 (proximal policy optimization) and 2016 (generalized advantage estimation); Plackett 1975
and Luce 1959 (probabilities of orders).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives.value.functional import generalized_advantage_estimate

from gnn_policy.acting import facts_of, tensors
from gnn_policy.cases import Cases
from gnn_policy.config import TrainConfig
from gnn_policy.dagger import Player, split_teams
from gnn_policy.labelling import Labeller
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.precision import autocast
from gnn_policy.team_env import ACTION, GOALS, MOVES, POSITIONS, REWARD, states_of
from mapf_env import Action, Bag, States

EXPLORATION = 0.5
"""Temperature of the draws of exploring robots."""
TRACE = 0.9
"""The lambda of generalized advantage estimation."""
CLIP = 0.2
"""A batch may change the probability of a choice by this share of it."""
EPOCHS = 2
"""Times that the states of a round are used."""
DISPLACEMENT = 10.0
"""Steps that count as lost when a robot of a one-shot task leaves its goal: it has rested there in vain."""
_NEAR = 2
"""Manhattan distance of the robots that share a loss."""
_LEAST_SPREAD = 0.3
"""A team's advantages are divided by their deviation, or this share of that of all if it is more."""
_ROBOTS_AT_ONCE = 2048
"""Robots that the network computes for at a time, which bounds the memory."""


class Critic(nn.Module):
    """Predicts the discounted sum of rewards of each robot (M,) from the features (M, F) that the policy decides by."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(features, 128), nn.ReLU(), nn.Linear(128, 1))

    def forward(self, features: Float[Tensor, "M F"]) -> Float[Tensor, " M"]:
        """Return the predictions; they change no features."""
        return self.layers(features.detach()).squeeze(-1)


@dataclass(frozen=True, slots=True)
class Experience:
    """S states with R robots, what these chose, and how that turned out."""

    states: States
    order: Int[Tensor, "R 5"]
    """The moves by descending score."""
    places: Int[Tensor, " R"]
    """Number of them, from the first on, that decided the executed move."""
    explored: Bool[Tensor, " R"]
    """The robots that explored; the others are not learned from."""
    log_prob: Float[Tensor, " R"]
    """Log-probability of these places when they were chosen."""
    advantage: Float[Tensor, " R"]
    """Their deviation is about 1 in each team."""
    value: Float[Tensor, " R"]
    """The target of the critic."""
    lost: float
    """Mean number of steps that a robot lost in a step."""


class Outcome(NamedTuple):
    """The loss of a batch of experience, and figures on it."""

    loss: Float[Tensor, ""]
    kept: Float[Tensor, ""]
    """Share of the robots whose most probable move is the first of their order."""


def log_probability(
    logits: Float[Tensor, "M 5"], order: Int[Tensor, "M 5"], places: Int[Tensor, " M"]
) -> Float[Tensor, " M"]:
    """Return the log-probability of the first `places` moves of each order, drawn one after another."""
    ordered = logits.gather(1, order) / EXPLORATION
    rest = ordered.flip(1).logcumsumexp(1).flip(1)
    decided = torch.arange(len(Action), device=order.device) < places[:, None]
    return ((ordered - rest) * decided).sum(1)


def evaluate(policy: DecentralizedPolicy, critic: Critic, bag: Bag) -> tuple[Float[Tensor, "M 5"], Float[Tensor, " M"]]:
    """Return the logits of a bag's robots and the critic's predictions."""
    features = policy.graph_layer(policy.extract(bag.fov, bag.scalars), bag)
    return policy.decide(features).float(), critic(torch.relu(features)).float()


def loss_of(
    policy: DecentralizedPolicy, critic: Critic, bag: Bag, experience: Experience, rows: Int[Tensor, " M"]
) -> Outcome:
    """Return the clipped loss of the robots in `rows` of the experience, whose bag is given, plus the critic's."""
    logits, value = evaluate(policy, critic, bag)
    device, known = logits.device, experience
    order, places, explored = (each[rows].to(device) for each in (known.order, known.places, known.explored))
    before, advantage, target = (each[rows].to(device) for each in (known.log_prob, known.advantage, known.value))
    ratio = (log_probability(logits, order, places) - before).exp()
    gain = torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage)
    surprise = (value - target).square().mean() / known.value.var().clamp(min=1.0).item()
    kept = (logits.argmax(1) == order[:, 0]).float().mean()
    return Outcome(0.5 * surprise - (gain * explored).sum() / explored.sum().clamp(min=1), kept)


class Explorer:
    """Collects experience round by round: teams of each task, as many as its share of the cases."""

    def __init__(
        self, config: TrainConfig, policy: DecentralizedPolicy, critic: Critic, labeller: Labeller, cases: Cases
    ) -> None:
        self._config, self._policy, self._critic = config, policy, critic
        self._execution = config.rollout_execution
        by_task = cases.by_task()
        teams = split_teams(config.rollout_teams, by_task, config.collectors)
        self._players = [
            Player(config, policy, labeller, task, own, teams[task], exploration=EXPLORATION, reward="shaped")
            for task, own in by_task.items()
        ]

    def collect(self, round_number: int, steps: int) -> list[Experience]:
        """Play at least `steps` team steps and return the experience of each task."""
        seed = int(np.random.SeedSequence([self._config.seed, round_number]).generate_state(1)[0])
        times = -(-steps // (self._config.rollout_teams * self._config.rollout_length))
        collected = []
        for player in self._players:
            player.begin(beta=0.0, seed=seed)
            collected += [self._experience(player.visit(), player) for _ in range(times)]
        return collected

    def perceive(self, states: States) -> Bag:
        """Return the bag of states as tensors on the policy's device."""
        return self._on_device(self._players[0].perceive(states))

    def _on_device(self, bag: Bag) -> Bag:
        return tensors(bag, self._policy.head.weight.device)

    def _experience(self, visited: TensorDictBase, player: Player) -> Experience:
        """Return the experience of B teams over T steps.

        The collector keeps no state after a team's last step, so nothing is learned from the choice in that step, and a
        team that did not arrive counts on as the critic predicts.
        """
        done, terminated = (visited["next", key][..., 0].clone() for key in ("done", "terminated"))
        last = done.clone()
        last[:, -1] = True
        states = states_of(visited.reshape(-1), player.cases.map_of)
        there = torch.arange(visited[POSITIONS].shape[2]) < visited["team_size"][..., None]  # (B, T, N)
        order, places = self._choices(visited, there)
        reward = visited["next", REWARD][..., 0][there]
        lost = -reward.mean().item()
        if player.task == "one_shot":
            on_goal = torch.eq(visited.get(POSITIONS), visited.get(GOALS)).all(-1)
            left = on_goal & ~on_goal.roll(-1, 1) & ~last[..., None]
            reward = reward - DISPLACEMENT * left[there]
        log_prob, value, explored, shared = [], [], [], []
        for part, rows in _in_parts(states):
            bag = player.perceive(part)
            logits, predicted = self._evaluate(self._on_device(bag))
            log_prob.append(log_probability(logits, order[rows], places[rows]))
            value.append(predicted)
            facts = facts_of(bag, self._execution, self._config.policy)
            explored.append(torch.from_numpy(~self._execution.draws(facts.alarmed)))
            shared.append(self._shared(bag, part, reward[rows]))
        learned = torch.zeros_like(there)
        learned[there] = torch.cat(explored)
        learned[last] = False
        values, rewards = torch.zeros(there.shape), torch.zeros(there.shape)
        values[there], rewards[there] = torch.cat(value), torch.cat(shared)
        advantage, target = generalized_advantage_estimate(
            self._config.discount,
            TRACE,
            values,
            torch.where(last[..., None], values, values.roll(-1, 1)),
            rewards,
            last[..., None].expand_as(there),
            terminated[..., None].expand_as(there),
        )
        return Experience(
            states,
            order,
            places,
            learned[there],
            torch.cat(log_prob),
            _scaled(advantage, learned)[there],
            target[there],
            lost,
        )

    def _choices(self, visited: TensorDictBase, there: Tensor) -> tuple[Tensor, Tensor]:
        """Return the orders of moves (R, 5), and how many places of each decided what was executed (R,)."""
        action: Tensor = visited[ACTION]  # pyright: ignore[reportAssignmentType]
        if self._execution.shield == "idle":
            chosen = torch.nn.functional.one_hot(action[there], len(Action))
            return chosen.argsort(dim=1, descending=True, stable=True), torch.ones(len(chosen), dtype=torch.int64)
        order = action[there].argsort(dim=1, descending=True, stable=True)
        executed = visited.get(MOVES)[..., 0].roll(-1, 1)[there]  # the newest move that the next state remembers
        return order, (order == executed[:, None]).int().argmax(dim=1) + 1

    def _evaluate(self, bag: Bag) -> tuple[Tensor, Tensor]:
        with torch.inference_mode(), autocast(self._config.precision, self._policy.head.weight.device):
            logits, value = evaluate(self._policy.eval(), self._critic, bag)
        return logits.cpu(), value.cpu()

    def _shared(self, bag: Bag, states: States, reward: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
        sender, receiver = torch.from_numpy(bag.edge_index)
        positions = torch.from_numpy(states.positions)
        near = (positions[sender] - positions[receiver]).abs().sum(1) <= _NEAR
        share = self._config.neighbour_share * reward[sender[near]]
        return reward.index_add(0, receiver[near], share)

    def batches(
        self, experience: Experience, rng: np.random.Generator
    ) -> Iterator[list[tuple[Bag, Int[Tensor, " M"]]]]:
        """Yield random batches that have each state once, in parts: bags, and the rows of their robots."""
        states = experience.states
        for chosen in np.array_split(rng.permutation(len(states)), -(-len(states) // self._config.batch_size)):
            rows = torch.from_numpy(states.rows(chosen))
            yield [(self.perceive(part), rows[own]) for part, own in _in_parts(states.take(chosen))]

    def close(self) -> None:
        """Shut the collectors down."""
        for player in self._players:
            player.close()


def _in_parts(states: States) -> Iterator[tuple[States, slice]]:
    """Yield the states a few at a time, and the rows of their robots."""
    part_of = states.offsets[1:] // _ROBOTS_AT_ONCE
    for number in np.unique(part_of):
        chosen = np.flatnonzero(part_of == number)
        yield states.take(chosen), slice(int(states.offsets[chosen[0]]), int(states.offsets[chosen[-1] + 1]))


def _scaled(advantage: Float[Tensor, "B T N"], learned: Bool[Tensor, "B T N"]) -> Float[Tensor, "B T N"]:
    """Centre the advantages of each team and divide them by their deviation, so that crowds do not outweigh others."""
    weight = learned.float()
    robots = weight.sum((1, 2), keepdim=True).clamp(min=1.0)
    centred = advantage - (advantage * weight).sum((1, 2), keepdim=True) / robots
    variance = (centred.square() * weight).sum((1, 2), keepdim=True) / robots
    of_all = ((centred.square() * weight).sum() / weight.sum().clamp(min=1.0)).sqrt()
    return centred / torch.maximum(variance.sqrt(), _LEAST_SPREAD * of_all).clamp(min=1e-6)
