"""The progress display of training."""

from __future__ import annotations

import time
from types import TracebackType

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from gnn_policy.learning_curve import Round

_SECONDS_BETWEEN = 0.2


class TrainingProgress:
    """A bar over all rounds with phase, rate, loss, validation success and time left, and a line for each validation.

    Use it as a context manager around the training.
    """

    def __init__(self, rounds: int, console: Console) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("{task.fields[phase]:<10}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=console,
            speed_estimate_period=120,
        )
        self._task = self._bar.add_task("", total=rounds, phase="preparing", figures="")
        self._validation = "-"
        self._last_update = time.monotonic()
        self._samples = self._update = 0

    def __enter__(self) -> TrainingProgress:
        self._bar.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.__exit__(kind, error, trace)

    def phase(self, number: int, phase: str) -> None:
        """Show the current phase of round `number`."""
        self._bar.update(self._task, completed=number, phase=phase)

    def due(self) -> bool:
        """Return True if it is time to show something again."""
        return time.monotonic() - self._last_update > _SECONDS_BETWEEN

    def fitted(self, number: int, update: int, updates: int, losses: npt.NDArray[np.floating], samples: int) -> None:
        """Show the gradient steps of a round so far, which saw `samples` robot states."""
        now = time.monotonic()
        rate = (samples - self._samples if update > self._update else samples) / max(now - self._last_update, 1e-9)
        self._last_update, self._samples, self._update = now, samples, update % updates
        figures = f"{rate / 1e3:.0f}k states/s loss {losses[-50:].mean():.3f} validation {self._validation}"
        self._bar.update(self._task, completed=number + update / updates, phase="fitting", figures=figures)

    def finished(self, row: Round) -> None:
        """Show a round that is finished and saved."""
        self._bar.update(self._task, completed=row.round + 1)
        measured = {"success": row.validation_success, "throughput": row.validation_throughput}
        if row.merit is not None:
            self._validation = ", ".join(f"{kind} {value:.3f}" for kind, value in measured.items() if value is not None)
            self._console.print(
                f"round {row.round + 1:3}  {row.seconds / 60:4.1f} min  {row.samples / 1e6:5.1f}M robot states  "
                f"loss {row.loss:.3f}  validation {self._validation}",
                highlight=False,
            )
