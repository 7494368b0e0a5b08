"""The metrics of each round of training, and their plot."""

from __future__ import annotations

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
    """Mean cross-entropy of this round."""
    accuracy: float
    """Share of the expert's moves that the policy would make; it falls as aggregation adds hard states."""
    lr: float
    """Learning rate of this round."""
    demonstrations: int
    """Labelled team states so far."""
    unlabelled: int
    """States of this round that the expert did not solve."""
    validation_success: float | None = None
    """Success rate on the validation cases, executed as in the rollouts of training."""
    validation_flowtime_increase: float | None = None
    """Flowtime increase on the validation cases, over all cases."""
    validation_throughput: float | None = None
    """Arrivals per step on the validation cases of a lifelong training."""

    @property
    def validation(self) -> float | None:
        """The success rate or the throughput on the validation cases, if they were played in this round."""
        return self.validation_success if self.validation_throughput is None else self.validation_throughput


def draw_learning_curve(rounds: Sequence[Round], path: Path) -> None:
    """Draw validation success, or throughput, and training loss against the robot states trained on, as PNG."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    validated = [row for row in rounds if row.validation is not None]
    left.plot([row.samples / 1e6 for row in validated], [row.validation for row in validated], "o-", color="#1f6feb")
    if any(row.validation_throughput is not None for row in validated):
        left.set(title="validation throughput", ylim=(0, None), ylabel="arrivals per step")
    else:
        left.set(title="validation success", ylim=(0, 1), ylabel="success rate")
    samples = [row.samples / 1e6 for row in rounds]
    right.plot(samples, [row.loss for row in rounds], color="#d1570b", label="loss")
    right.plot(samples, [row.accuracy for row in rounds], color="#57606a", label="accuracy")
    right.set(title="training", ylim=(0, None))
    right.legend(frameon=False)
    for axes in (left, right):
        axes.set(xlabel="robot states trained on, millions")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120, format="png")
