"""What robots earn: a sum of parts, and named schemes."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from mapf_env import arguments


@dataclass(frozen=True, slots=True)
class Rewards:
    """What a robot gets in a step; all parts that apply add up.

    Raises:
        ValueError: If a part is infinite or not a number.
        TypeError: If a part is none at all.
    """

    on_goal: float = 0.0
    """It is on its goal after the step."""
    off_goal: float = 0.0
    """It is not."""
    arrival: float = 0.0
    """It has moved onto its goal in this step."""
    replaced: float = 0.0
    """The shield replaced its action."""
    solved: float = 0.0
    """All robots of the team are on their goals at once: the episode terminates."""
    closer: float = 0.0
    """For each step by which the shortest way to its goal has become shorter (negative if longer)."""

    def __post_init__(self) -> None:
        for name, part in asdict(self).items():
            arguments.finite(part, f"the part {name} of Rewards")


SCHEMES: dict[str, Rewards] = {
    "flowtime": Rewards(off_goal=-1.0),
    "shaped": Rewards(off_goal=-1.0, closer=1.0),
    "arrival": Rewards(arrival=1.0),
    "solved": Rewards(solved=1.0),
}
"""Schemes by name.

- flowtime: -1 for each step off the goal; the return is the negated flowtime but for a constant.
- shaped: the same plus what the robot came closer, the change of a potential (Ng, Harada and Russell 1999). It changes
  no optimal policy without discounting, in one-shot tasks that end before max_cycles.
- arrival: 1 for each arrival; in lifelong tasks the return is the throughput.
- solved: 1 for every robot when the whole team is on its goals, and nothing else.
"""
