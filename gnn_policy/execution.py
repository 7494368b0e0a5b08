"""How a trained policy is executed: how its logits become moves, who keeps robots apart, and who hears whom."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from gnn_policy.policy_config import CommRange, CommWeights, PolicyConfig
from mapf_env import EnvConfig, _native
from mapf_env.arguments import number
from mapf_env.rules import Positions

Sample = Literal[False, True, "stuck"]
Shield = Literal["idle", "pibt"]
Seeds = npt.NDArray[np.uint64]

_MOVES = np.uint64(2**32)  # what the draws are used for; the native core's uses are small numbers

STUCK_MEMORY = 16
"""How many earlier cells a robot remembers to know that it is stuck."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Execution:
    """One way to execute a policy; the defaults are the paper's.

    Raises:
        ValueError: If a field is none of its values.
    """

    sample: Sample = False
    """Draw a robot's move from the softmax in place of the most probable one: never, always, or while it or a neighbour
    is "stuck", see `is_stuck` and `hears_of`."""
    temperature: float = 1.0
    """Divides the logits where moves are drawn."""
    shield: Shield = "idle"
    """Collision shielding: "idle" is the paper's; "pibt" moves robots aside by priority and takes the logits as
    preferences."""
    comm_range: CommRange | None = None
    """"fixed" r_COMM, or "connected": grown by 10 % at the start of a case until the team is connected, as in the
    released code; as the policy was trained if None."""
    comm_weights: CommWeights | None = None
    """Weights of the communication graph: "binary", or "distance" for 1 / distance; as trained if None."""

    def __post_init__(self) -> None:
        for name, known in (
            ("sample", get_args(Sample)),
            ("shield", get_args(Shield)),
            ("comm_range", (*get_args(CommRange), None)),
            ("comm_weights", (*get_args(CommWeights), None)),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(map(str, known))}, got {getattr(self, name)!r}")
        if not 0 < number(self.temperature, "temperature") < np.inf:
            raise ValueError(
                f"temperature must be positive and finite, got {self.temperature}; "
                "for the most probable move: sample=False"
            )

    def values(
        self, logits: npt.NDArray[np.float32], alarmed: npt.NDArray[np.bool_], seeds: Seeds, time: int
    ) -> npt.NDArray[np.float32]:
        """What each move is worth at `time`; the greatest is taken, and PIBT takes their order.

        A robot that draws adds Gumbel noise to its logits over the temperature: the greatest value is then a draw from
        the softmax, and the order one move after another without replacement. The noise is a function of the robot's
        seed and the time.

        Args:
            logits: (..., 5) of robots.
            alarmed: (...) who is stuck or hears a robot that is.
            seeds: (...) the robots' seeds.
            time: Steps since the start.

        Raises:
            ValueError: If a logit, or a logit over the temperature, is not finite.
        """
        if not np.isfinite(logits).all():
            raise ValueError(
                "the policy's logits are not finite: its weights or what it observes are damaged, or its training "
                "diverged; train it again with a smaller lr"
            )
        draws = alarmed if self.sample == "stuck" else np.full_like(alarmed, self.sample)
        if not draws.any():
            return logits
        noise = -np.log(-np.log(uniform(seeds[draws], time, logits.shape[-1]).clip(1e-12, 1 - 1e-12)))
        values = logits.copy()
        with np.errstate(all="ignore"):
            values[draws] = logits[draws] / self.temperature + noise
        if not np.isfinite(values).all():
            raise ValueError(f"the logits over a temperature of {self.temperature} are not finite: give a higher one")
        return values

    def perceived(self, policy: PolicyConfig) -> EnvConfig:
        """What the robots of a policy see and hear when it is executed so; all else is the default's."""
        return EnvConfig(
            fov_radius=policy.fov_radius,
            comm_radius=policy.comm_radius,
            comm_range=self.comm_range or policy.comm_range,
        )

    @property
    def name(self) -> str:
        """Words that tell variants apart, as `parse` reads them: "argmax", "sampled,0.5,pibt"; no word means "idle"."""
        words = [_WORD_OF_SAMPLE[self.sample]]
        if self.sample:
            words.append(f"{self.temperature:g}")
        words += [self.shield] if self.shield != "idle" else []
        return ",".join([*words, *(each for each in (self.comm_range, self.comm_weights) if each)])

    @staticmethod
    def parse(text: str, shield: str = "idle") -> Execution:
        """The variant of the given name, its words in any order.

        Args:
            text: The words.
            shield: Which shield it has if no word names one.

        Raises:
            ValueError: If a word is unknown or contradicts another.
        """
        given: dict[str, Any] = {}
        for word in text.split(","):
            option, value = _OPTION_OF_WORD.get(word) or ("temperature", _number(word, text))
            if option in given:
                raise ValueError(f"the variant {text!r} says {option} twice: {given[option]} and {value}")
            given[option] = value
        if "temperature" in given and not given.get("sample"):
            raise ValueError(f"the variant {text!r} has a temperature but draws nothing: say sampled or stuck")
        return Execution(**{"shield": shield, **given})


_WORD_OF_SAMPLE = {False: "argmax", True: "sampled", "stuck": "stuck"}
_OPTION_OF_WORD = {word: ("sample", sample) for sample, word in _WORD_OF_SAMPLE.items()} | {
    word: (option, word)
    for option, words in (("shield", Shield), ("comm_range", CommRange), ("comm_weights", CommWeights))
    for word in get_args(words)
}


def _number(word: str, text: str) -> float:
    try:
        return float(word)
    except ValueError:
        known = ", ".join(_OPTION_OF_WORD)
        raise ValueError(f"unknown word {word!r} in the variant {text!r}: give {known} or a temperature") from None


def is_stuck(positions: Positions, goals: Positions, past: Positions) -> npt.NDArray[np.bool_]:
    """(B, N) which robots are stuck: off their goal, on a cell where they stood at one of the last steps.

    So a robot that was stopped is stuck in the next step, and one that goes to and fro or in a circle as soon as it
    comes back; one on its way never is. A robot knows it by itself, from its odometry: no map, no messages.

    Args:
        positions: (B, N, 2) now.
        goals: (B, N, 2)
        past: (T, B, N, 2) at the T steps before; `STUCK_MEMORY` of them in play, fewer in the beginning.
    """
    return np.logical_and((past == positions).all(-1).any(0), (positions != goals).any(-1))


def hears_of(stuck: npt.NDArray[np.bool_], graph: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """(B, N) who hears of a stuck robot (B, N) over the graph (B, N, N): one bit in the first message of a step."""
    return np.any((graph > 0) & stuck[:, None, :], axis=-1)


def robot_seeds(seeds: Seeds, num_agents: int) -> Seeds:
    """The seeds (B, N) from which the robots of teams with seeds (B,) draw their moves."""
    robots = np.tile(np.arange(num_agents, dtype=np.uint64), len(seeds))
    streams = _native.mix(seeds, np.full_like(seeds, _MOVES))
    return _native.mix(np.repeat(streams, num_agents), robots).reshape(-1, num_agents)


def uniform(seeds: Seeds, time: int, count: int) -> npt.NDArray[np.float64]:
    """Draws (*S, count) from [0, 1) at a time for seeds of any shape S, a function of the arguments alone."""
    counters = np.uint64(time * count) + np.arange(count, dtype=np.uint64)
    words = _native.mix(np.repeat(seeds.ravel(), count), np.tile(counters, seeds.size))
    return ((words >> np.uint64(11)).astype(np.float64) * 2.0**-53).reshape(*seeds.shape, count)
