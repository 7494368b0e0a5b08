"""The parts of a policy that a robot needs: four functions over NumPy arrays, whichever library computes them."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gnn_policy.execution import Execution
from gnn_policy.policy_config import PolicyConfig

Features = npt.NDArray[np.float32]
State = tuple[npt.NDArray[Any], ...]
"""The memory of a robot between rounds: arrays (1, ...), as many as the policy's graph layer wants."""


class Heard(NamedTuple):
    """The E links on which a robot hears."""

    weight: Features
    """(E,) weights of the links in the communication graph."""
    attr: Features
    """(E, D) edge features of the links."""


class Parts(Protocol):
    """A policy as one robot runs it: `encode`, then `send` and `combine` in each round, then `decide`."""

    config: PolicyConfig
    """The network and what its robots perceive."""
    execution: Execution
    """The choice of actions unless a caller says otherwise."""
    rounds: int
    """Number of messages that a robot sends in a step."""

    def encode(self, view: Features, scalars: Features, links: Heard) -> State:
        """Return the first state from a view (C, S, S), robot features (K,) and all links of the step."""
        ...

    def send(self, state: State, number: int) -> Features:
        """Return the message (G,) of round `number`."""
        ...

    def combine(self, state: State, messages: Features, links: Heard, number: int) -> State:
        """Return the state after round `number`, in which messages (E, G) came over these links."""
        ...

    def decide(self, state: State) -> Features:
        """Return the logits (5,) after the last round."""
        ...


class HasParts(Protocol):
    """A policy in any form that a robot can run."""

    def parts(self) -> Parts:
        """Return what a robot runs.

        Raises:
            ValueError: If the policy cannot be run on one robot.
        """
        ...
