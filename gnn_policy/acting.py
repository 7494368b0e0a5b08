"""From what robots perceive to what they do: the bag of an observation, its logits, and the moves chosen from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from torch import nn

from gnn_policy.execution import Execution, Flags, alarmed
from gnn_policy.policy_config import PolicyConfig
from mapf_env import Action, Bag, Observation

Scores = npt.NDArray[np.float32]


def tensors(bag: Bag, device: torch.device | str = "cpu") -> Bag:
    """Return a bag whose arrays are tensors on a device; on the CPU they share the memory of the arrays."""
    return Bag(*(torch.as_tensor(part).to(device) for part in bag))


def bag_of(observation: Observation) -> tuple[Bag, npt.NDArray[np.bool_]]:
    """Return the bag of the robots in a dense observation, and which (B, N) they are.

    Robots that are absent see nothing, not even their goal, and are left out.
    """
    fov, graph = np.asarray(observation.fov), np.asarray(observation.graph)
    present: npt.NDArray[np.bool_] = np.asarray(fov[:, :, 1].any(axis=(-2, -1)))
    number = np.cumsum(present).reshape(present.shape) - 1
    team, receiver, sender = np.nonzero(graph)
    bag = Bag(
        fov=fov[present],
        scalars=np.asarray(observation.scalars)[present],
        edge_index=np.stack([number[team, sender], number[team, receiver]]),
        edge_weight=graph[team, receiver, sender],
        edge_attr=np.asarray(observation.edge_attr)[team, receiver, sender],
        team=np.nonzero(present)[0],
    )
    return bag, present


def logits_of(policy: nn.Module, bag: Bag) -> Scores:
    """Return the logits (M, 5) of a policy for a bag of arrays.

    The views are padded to one of few numbers of robots: libraries prepare their kernels again for each new shape. The
    added robots hear nobody, nobody hears them, and they are a team of their own. For very many robots that takes less
    time than a copy of their views.
    """
    device = next((each.device for each in policy.parameters()), torch.device("cpu"))
    count = len(bag.team)
    if extra := _padded_size(count) - count:
        bag = bag._replace(
            fov=np.pad(bag.fov, ((0, extra), (0, 0), (0, 0), (0, 0))),
            scalars=np.pad(bag.scalars, ((0, extra), (0, 0))),
            team=np.pad(bag.team, (0, extra), constant_values=bag.team.max(initial=-1) + 1),
        )
    with torch.inference_mode():
        return policy(tensors(bag, device))[:count].float().cpu().numpy()


class Facts(NamedTuple):
    """Facts about M robots that an execution reads itself."""

    alarmed: Flags
    """(M,) they are stuck or, except for "fallback", hear a robot that is; nobody for executions that do not ask."""
    greedy: Flags | None
    """(M, 5) the moves that shorten each robot's path, for "fallback"."""
    jammed: Flags | None
    """(M,) they made no progress for many steps, for "fallback"."""


def facts_of(bag: Bag, execution: Execution, config: PolicyConfig) -> Facts:
    """Return the facts about a bag's robots that an execution reads.

    Raises:
        ValueError: If the bag does not say them.
    """
    facts = execution.facts(bag.scalars, config)
    alarm = np.zeros(len(bag.team), np.bool_)
    if "stuck" in facts:
        alarm = facts["stuck"][:, 0]
        if execution.actions == "stuck" and config.taps > 1:  # with one tap robots do not communicate
            alarm = alarmed(alarm, bag.edge_index)
    return Facts(alarm, facts.get("greedy_moves"), facts["jammed"][:, 0] if "jammed" in facts else None)


def scores_of(
    policy: nn.Module, bag: Bag, execution: Execution, noise: Any, exploration: float | None = None
) -> Scores:
    """Return the scores (M, 5) of the moves of a bag's robots; `Execution.scores` says what the last two are.

    Raises:
        ValueError: If the bag does not say what the execution reads, such as which robots are stuck.
    """
    config: PolicyConfig = policy.config  # pyright: ignore[reportAssignmentType]
    facts = facts_of(bag, execution, config)
    return execution.scores(
        logits_of(policy, bag), facts.alarmed, noise, facts.greedy, facts.jammed, exploration=exploration
    )


def act(policy: nn.Module, observation: Any, execution: Execution, rng: np.random.Generator) -> Any:
    """Choose actions as `DecentralizedPolicy.act` documents."""
    scored = execution.shield != "idle"

    def choose(bag: Bag) -> npt.NDArray[Any]:
        was_training = policy.training
        try:
            scores = scores_of(policy.eval(), bag, execution, lambda drawn: _noise(rng, int(drawn.sum())))
        finally:
            policy.train(was_training)
        return scores if scored else scores.argmax(-1)

    def dense(parts: Observation) -> npt.NDArray[Any]:
        bag, present = bag_of(parts)
        chosen = np.zeros((*present.shape, len(Action)), np.float32) if scored else np.full(present.shape, Action.IDLE)
        chosen[present] = choose(bag)
        return chosen

    if isinstance(observation, Bag):
        return choose(observation)
    if isinstance(observation, Observation):
        return dense(observation)
    if isinstance(observation, TensorDictBase):
        return torch.from_numpy(dense(_stacked(observation["agents"], lambda part: part.cpu().numpy())))
    if isinstance(observation, Mapping) and observation:
        if not all(isinstance(name, str) and name.rpartition("_")[2].isdigit() for name in observation):
            raise TypeError(
                "act takes the observations of parallel_env by agent, not those of joint_env or of one agent: make the "
                "environment with parallel_env"
            )
        agents = sorted(observation, key=lambda name: int(name.rpartition("_")[2]))  # rows of the graph are by number
        if not all(isinstance(observation[agent], Mapping) for agent in agents):
            raise ValueError('the agents observe views alone: make the environment with observation="dict"')
        rows = {key: np.stack([observation[agent][key] for agent in agents])[None] for key in observation[agents[0]]}
        chosen = dense(_stacked(rows, np.asarray))[0]
        return {agent: row if scored else int(row) for agent, row in zip(agents, chosen, strict=True)}
    raise TypeError(
        "act takes what parallel_env, BatchedEnv or TeamEnv returned (a dictionary by agent, an Observation, a Bag or "
        f"a TensorDict), got {type(observation).__name__}"
    )


def _stacked(parts: Any, array: Any) -> Observation:
    fov, graph = array(parts["fov"]), array(parts["graph"])
    none = np.zeros((*graph.shape, 0), np.float32)
    return Observation(
        fov,
        graph,
        array(parts["scalars"]) if "scalars" in parts.keys() else none[:, :, 0],  # noqa: SIM118 (a TensorDict)
        array(parts["edge_attr"]) if "edge_attr" in parts.keys() else none,  # noqa: SIM118
    )


def _noise(rng: np.random.Generator, count: int) -> Scores:
    return rng.gumbel(size=(count, len(Action))).astype(np.float32)


_MOST_PADDED = 2**15


def _padded_size(robots: int) -> int:
    if robots > _MOST_PADDED:
        return robots
    return 1 << (robots - 1).bit_length() if robots < 256 else -(-robots // 256) * 256
