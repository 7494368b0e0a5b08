"""POGEMA's side of `speed.py`: runs in POGEMA's own virtual environment and prints one line of JSON.

It uses the calls that POGEMA documents: `pogema_v0(GridConfig(...))` and its `integration="PettingZoo"`. Actions are
drawn beforehand. Times are CPU seconds of this process.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from itertools import cycle
from typing import Any

sys.path.append(sys.path.pop(0))  # the package comes before pogema.py in this folder

from cpu_clock import calls_per_second
from pogema import GridConfig, pogema_v0  # pyright: ignore[reportAttributeAccessIssue]


def main() -> None:
    """Measure one interface for one number of agents."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--interface", choices=["list", "pettingzoo"], required=True)
    parser.add_argument("--num-agents", type=int, required=True)
    parser.add_argument("--size", type=int, required=True)
    parser.add_argument("--density", type=float, required=True)
    parser.add_argument("--radius", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    args = parser.parse_args()
    as_dicts = args.interface == "pettingzoo"
    config = GridConfig(
        size=args.size,
        density=args.density,
        num_agents=args.num_agents,
        obs_radius=args.radius,
        on_target="nothing",
        max_episode_steps=10**9,
        auto_reset=False,
        integration="PettingZoo" if as_dicts else None,
    )
    env = pogema_v0(config)
    env.reset()
    drawn: list[Any] = [[random.randrange(5) for _ in range(args.num_agents)] for _ in range(64)]
    actions = cycle([dict(zip(env.agents, joint, strict=True)) for joint in drawn] if as_dicts else drawn)
    result = {
        "agent_steps": args.num_agents * calls_per_second(lambda: env.step(next(actions)), args.seconds),
        "resets": calls_per_second(env.reset, args.seconds),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
