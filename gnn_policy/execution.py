"""The execution of a trained policy: choice of actions from logits, collision shield and communication."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from gnn_policy.policy_config import PolicyConfig
from mapf_env import Action, Instance, Senses
from mapf_env.arguments import lists_settings, number
from mapf_env.config import Shield
from mapf_env.hashing import mix
from mapf_env.senses import CommRange, CommWeights, robot_features

Actions = Literal["argmax", "sampled", "stuck", "fallback"]
Seeds = npt.NDArray[np.uint64]
Flags = npt.NDArray[np.bool_]
Logits = npt.NDArray[np.float32]

_MOVES = np.uint64(2**32)  # what the draws are used for; the native core's uses are small numbers


@lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class Execution:
    """An execution of a policy; the defaults are the paper's.

    Raises:
        ValueError: If a field has an unknown value.
    """

    actions: Actions = "argmax"
    """The choice of a robot's action. "argmax" takes the most probable one, "sampled" samples from the softmax. "stuck"
    samples only while the robot or a neighbour is stuck, that is, off its goal and back on a cell of its last 16 steps.
    "fallback": a robot that is stuck itself prefers actions that shorten its path, then staying, as PIBT does, and
    breaks ties at random; a robot that is jammed (on at most three cells in its last 16 steps) samples among all
    actions, with those preferred. "fallback" needs the map and works best with the shield "pibt_swap"."""
    temperature: float = 1.0
    """Divides the logits of robots that sample."""
    shield: Shield = "idle"
    """Collision shielding: "idle" is the paper's; "pibt" moves robots aside by priority and takes the logits as
    preferences."""
    comm_range: CommRange | None = None
    """"fixed" r_COMM, or "connected": grown by 10 % at the start of an episode until the team is connected, as in the
    authors' code; as the policy was trained if None."""
    comm_weights: CommWeights | None = None
    """Weights of the communication graph: "binary", or "distance" for 1 / distance; as trained if None."""

    def __post_init__(self) -> None:
        for name, known in (
            ("actions", get_args(Actions)),
            ("shield", get_args(Shield)),
            ("comm_range", (*get_args(CommRange), None)),
            ("comm_weights", (*get_args(CommWeights), None)),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(map(str, known))}, got {getattr(self, name)!r}")
        if not 0 < number(self.temperature, "temperature") < np.inf:
            raise ValueError(
                f"temperature must be positive and finite, got {self.temperature}; "
                'for the most probable action give actions="argmax"'
            )

    def scores(
        self,
        logits: Logits,
        alarmed: Flags,
        noise: Callable[[Flags], Logits],
        greedy: Flags | None = None,
        jammed: Flags | None = None,
        *,
        exploration: float | None = None,
    ) -> Logits:
        """Return a score for each move; the greatest is taken, and PIBT takes their order.

        A robot that samples adds Gumbel noise to its logits over the temperature: the greatest score is then a sample
        from the softmax, and the order samples one move after another without replacement.

        Args:
            logits: (M, 5) of robots.
            alarmed: (M,) robots that are stuck or, except for "fallback", hear a robot that is.
            noise: Returns Gumbel noise (m, 5) for the m robots that a mask (M,) selects.
            greedy: (M, 5) the moves that shorten each robot's path, which "fallback" reads.
            jammed: (M,) robots that made no progress for many steps, which "fallback" reads.
            exploration: If given, all other robots sample, too, at this temperature, as in reinforcement learning.

        Raises:
            ValueError: If a logit, or a logit over the temperature, is not finite, or "fallback" lacks its inputs.
        """
        if not np.isfinite(logits).all():
            raise ValueError(
                "the policy's logits are not finite: its weights or what it observes are damaged, or its training "
                "diverged; train it again with a smaller lr"
            )
        draws = self.draws(alarmed)
        if exploration is None and not draws.any():
            return logits
        scores = logits.copy()
        with np.errstate(all="ignore"):
            scores[draws] = logits[draws] / self.temperature + noise(draws)
            if exploration is not None:
                scores[~draws] = logits[~draws] / exploration + noise(~draws)
        if not np.isfinite(scores).all():
            raise ValueError(f"the logits over a temperature of {self.temperature} are not finite: give a higher one")
        if self.actions == "fallback":
            if greedy is None or jammed is None:
                raise ValueError("the fallback needs each robot's greedy moves (M, 5) and which robots are jammed (M,)")
            tier = 2 * greedy[draws].astype(np.float32)
            tier[:, Action.IDLE] = np.maximum(tier[:, Action.IDLE], 1)
            weight = np.where(jammed[draws], _JAMMED, _TIER)[:, None]
            scores[draws] = scores[draws].clip(-_TIER / 3, _TIER / 3) + weight * tier
        return scores

    def draws(self, alarmed: Flags) -> Flags:
        """Return which of M robots sample; `alarmed` is that of `scores`."""
        return {"argmax": np.zeros_like(alarmed), "sampled": np.ones_like(alarmed)}.get(self.actions, alarmed)

    @property
    def features(self) -> tuple[str, ...]:
        """The robot features that this execution reads itself."""
        return {"stuck": ("stuck",), "fallback": ("greedy_moves", "jammed", "stuck")}.get(self.actions, ())

    def robot_features(self, policy: PolicyConfig) -> tuple[str, ...]:
        """Return the robot features of `policy`, then those that only the execution reads."""
        return (*policy.robot_features, *(each for each in self.features if each not in policy.robot_features))

    def facts(self, scalars: npt.NDArray[np.floating], policy: PolicyConfig) -> dict[str, Flags]:
        """Return the robot features (M, width) that this way of execution reads itself, by name.

        Args:
            scalars: (M, K) what robots know about themselves.
            policy: Says which columns these are.

        Raises:
            ValueError: If they are not among the scalars.
        """
        if not self.features:
            return {}
        names, known = self.robot_features(policy), robot_features(policy.memory)
        ends = np.cumsum([known[name].width for name in names])
        if ends[-1] > scalars.shape[1]:
            raise ValueError(
                f"the execution {self.name} reads {' and '.join(self.features)}, which the observation does not "
                "say: make the environment with **policy.env_settings(), or pass execution=Execution()"
            )
        columns = dict(zip(names, np.split(scalars[:, : ends[-1]], ends[:-1], axis=1), strict=True))
        return {name: columns[name] > 0 for name in self.features}

    def senses(self, policy: PolicyConfig) -> Senses:
        """Return what robots of `policy` perceive under this execution."""
        perceived: dict[str, Any] = policy.senses() | {"robot_features": self.robot_features(policy)}
        if self.comm_range is not None:
            perceived["comm_range"] = self.comm_range
        if self.comm_weights is not None:
            perceived["comm_weights"] = self.comm_weights
        return Senses(**perceived)

    def env_settings(self, policy: PolicyConfig) -> dict[str, Any]:
        """Return the environment settings for `policy` under this execution: senses and shield."""
        return self.senses(policy).senses() | {"shield": self.shield}

    @property
    def name(self) -> str:
        """The execution in words that `parse` reads, such as "argmax" or "sampled,0.5,pibt"; no shield means "idle"."""
        words: list[str] = [self.actions]
        if self.actions != "argmax":
            words.append(f"{self.temperature:g}")
        words += [self.shield] if self.shield != "idle" else []
        return ",".join([*words, *(each for each in (self.comm_range, self.comm_weights) if each)])

    @staticmethod
    def parse(text: str, base: Execution | None = None) -> Execution:
        """Return the execution of the given name, its words in any order.

        Args:
            text: The words.
            base: Gives the shield, the radio and the temperature where no word does; the defaults if not given.

        Raises:
            ValueError: If a word is unknown or contradicts another.
        """
        given: dict[str, Any] = {}
        for word in text.split(","):
            option, value = _OPTION_OF_WORD.get(word) or ("temperature", _number(word, text))
            if option in given:
                raise ValueError(f"the execution {text!r} says {option} twice: {given[option]} and {value}")
            given[option] = value
        if "temperature" in given and given.get("actions", "argmax") == "argmax":
            raise ValueError(
                f"the execution {text!r} has a temperature but samples nothing: add sampled, stuck or fallback"
            )
        return replace(Execution() if base is None else base, **{"actions": "argmax", **given})


_TIER, _JAMMED = np.float32(1000.0), np.float32(2.0)
"""Differences between the scores of a move that shortens the path, of staying, and of other moves. The first is so
large that no noise changes their order; the second, for jammed robots, is small enough that noise does."""
_OPTION_OF_WORD = {
    word: (option, word)
    for option, words in (
        ("actions", Actions),
        ("shield", Shield),
        ("comm_range", CommRange),
        ("comm_weights", CommWeights),
    )
    for word in get_args(words)
}


def _number(word: str, text: str) -> float:
    try:
        return float(word)
    except ValueError:
        known = ", ".join(_OPTION_OF_WORD)
        raise ValueError(f"unknown word {word!r} in the execution {text!r}: give {known} or a temperature") from None


def alarmed(stuck: Flags, edge_index: npt.NDArray[np.int64]) -> Flags:
    """Return which of M robots are stuck or hear a robot that is: one bit in the first message of a step.

    Args:
        stuck: (M,) stuck robots.
        edge_index: (2, E) senders and receivers.
    """
    alarm = stuck.copy()
    sender, receiver = edge_index
    alarm[receiver[stuck[sender]]] = True
    return alarm


def episode_seeds(instances: Sequence[Instance], seeds: Sequence[int]) -> Seeds:
    """Return the seeds (C,) with which `rollout` resets its environments: a hash of each instance and its seed.

    Raises:
        ValueError: If a seed is out of range.
    """
    wrong = [seed for seed in seeds if not 0 <= seed < 2**64]
    if wrong:
        raise ValueError(f"seed must lie in 0..2**64 - 1, got {wrong[0]}")
    prints = [
        blake2b(repr(each.grid.shape).encode() + each.grid.tobytes() + each.starts.tobytes() + each.goals.tobytes())
        for each in instances
    ]
    counters = np.array([int.from_bytes(each.digest()[:8], "little") for each in prints], np.uint64)
    return mix(np.array(seeds, np.uint64), counters)


def robot_seeds(seeds: Seeds, robots: npt.NDArray[np.integer]) -> Seeds:
    """Return the seeds (M,) from which robots with numbers (M,) in teams with seeds (M,) draw their moves."""
    return mix(mix(seeds, np.full_like(seeds, _MOVES)), robots.astype(np.uint64))


def gumbel(seeds: Seeds, times: npt.NDArray[np.integer]) -> Logits:
    """Return Gumbel noise (M, 5) that depends only on each robot's seed and time, both (M,)."""
    return -np.log(-np.log(uniform(seeds, times, len(Action)).clip(1e-12, 1 - 1e-12))).astype(np.float32)


def episode_noise(
    seeds: Seeds, times: npt.NDArray[np.integer], robots: npt.NDArray[np.integer]
) -> Callable[[Flags], Logits]:
    """Return the noise that `Execution.scores` takes, as each robot draws it in its episode.

    Args:
        seeds: (M,) the seed of each robot's episode.
        times: (M,) steps since its start.
        robots: (M,) the robot's number in its team.
    """
    return lambda drawn: gumbel(robot_seeds(seeds[drawn], robots[drawn]), times[drawn])


def uniform(seeds: Seeds, times: npt.NDArray[np.integer], count: int) -> npt.NDArray[np.float64]:
    """Return draws (M, count) from [0, 1) that depend only on each seed and time, both (M,)."""
    counters = times.astype(np.uint64)[:, None] * np.uint64(count) + np.arange(count, dtype=np.uint64)
    words = mix(np.repeat(seeds, count), counters.ravel())
    return ((words >> np.uint64(11)).astype(np.float64) * 2.0**-53).reshape(len(seeds), count)
