"""The metrics of each round of training, and their plot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure


@dataclass(slots=True)
class Round:
    """One row of the metrics."""

    round: int
    updates: int
    """Gradient steps so far."""
    samples: int
    """Robot states trained on so far."""
    seconds: float
    """Time spent so far, over all sessions."""
    collect_seconds: float
    """Time of this round's rollouts and labels."""
    expert_seconds: float
    """The part of it that the expert took."""
    fit_seconds: float
    """Time of this round's gradient steps."""
    loss: float
    """Mean cross-entropy of this round; for the objective "delay" the steps that a robot lost in a step."""
    accuracy: float
    """Share of the expert's moves, or of those that were drawn in rollouts, that the policy would make; it falls as
    aggregation adds hard states."""
    lr: float
    """Learning rate of this round."""
    demonstrations: int
    """Labelled team states so far; for the objective "delay" those of this round."""
    unlabelled: int
    """States of this round that the expert did not solve."""
    validation_success: float | None = None
    """Success rate on the validation cases, executed as in the rollouts of training."""
    validation_flowtime_increase: float | None = None
    """Flowtime increase on the validation cases, over all cases."""
    validation_throughput: float | None = None
    """Arrivals per step on the validation cases of lifelong tasks."""

    @property
    def merit(self) -> tuple[float, float] | None:
        """The measure that selects the best policy, if validation cases were played in this round.

        The success rate times the throughput, or the one that was measured, then the smaller flowtime increase.
        """
        measured = [each for each in (self.validation_success, self.validation_throughput) if each is not None]
        return (math.prod(measured), -(self.validation_flowtime_increase or 0.0)) if measured else None


def draw_learning_curve(rounds: Sequence[Round], path: Path) -> None:
    """Draw validation success, throughput and training loss against the robot states trained on, as PNG."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    judged = [row for row in rounds if row.merit is not None]
    measured = [
        ("success rate", "#1f6feb", 1.0, [row.validation_success for row in judged]),
        ("arrivals per step", "#1a7f37", None, [row.validation_throughput for row in judged]),
    ]
    shown = [each for each in measured if each[-1] and None not in each[-1]]
    for number, (label, colour, top, values) in enumerate(shown):
        axes = left.twinx() if number else left
        axes.plot([row.samples / 1e6 for row in judged], values, "o-", color=colour)
        axes.set(ylim=(0, top))
        axes.set_ylabel(label, color=colour)
    left.set(title="validation")
    samples = [row.samples / 1e6 for row in rounds]
    right.plot(samples, [row.loss for row in rounds], color="#d1570b", label="loss")
    right.plot(samples, [row.accuracy for row in rounds], color="#57606a", label="accuracy")
    right.set(title="training", ylim=(0, None))
    right.legend(frameon=False)
    for axes in (left, right):
        axes.set(xlabel="robot states trained on, millions")
        axes.locator_params(axis="x", nbins=5)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120, format="png")
