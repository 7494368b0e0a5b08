"""Rewards: a sum of parts, and named schemes."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from mapf_env import arguments


@arguments.lists_settings
@dataclass(frozen=True, slots=True)
class Rewards:
    """The reward of a robot in a step, as the sum of the parts that apply.

    Raises:
        ValueError: If a part is infinite or not a number.
        TypeError: If a part is not a number.
    """

    on_goal: float = 0.0
    """The robot is on its goal after the step."""
    off_goal: float = 0.0
    """The robot is off its goal after the step."""
    arrival: float = 0.0
    """The robot has moved onto its goal in this step."""
    replaced: float = 0.0
    """The shield replaced the robot's action."""
    solved: float = 0.0
    """All robots of the team are on their goals at once: the episode terminates."""
    closer: float = 0.0
    """For each step by which the shortest path to the goal has become shorter (negative if longer)."""

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

- flowtime: -1 for each step off the goal; the return is a constant minus the flowtime.
- shaped: the same plus the change of the distance, a potential (Ng, Harada and Russell 1999). It does not change the
  optimal policy without discounting, in one-shot tasks that end before max_cycles.
- arrival: 1 for each arrival; in lifelong tasks the return is the throughput.
- solved: 1 for every robot when the whole team is on its goals, and nothing else.
"""
