"""What a person sees while training runs."""

from __future__ import annotations

import time
from types import TracebackType

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from gnn_policy.learning_curve import Round


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
        self._success = "-"
        self._last_update = time.monotonic()

    def __enter__(self) -> TrainingProgress:
        self._bar.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.__exit__(kind, error, trace)

    def phase(self, number: int, phase: str) -> None:
        """Say what round `number` is doing."""
        self._bar.update(self._task, completed=number, phase=phase)

    def fitted(self, number: int, update: int, updates: int, losses: npt.NDArray[np.float64], samples: int) -> None:
        """One gradient step of a round is done."""
        now = time.monotonic()
        rate, self._last_update = samples / max(now - self._last_update, 1e-9), now
        figures = f"{rate / 1e3:.0f}k states/s loss {losses[-50:].mean():.3f} success {self._success}"
        self._bar.update(self._task, completed=number + update / updates, phase="fitting", figures=figures)

    def finished(self, row: Round) -> None:
        """A round is done and saved."""
        self._bar.update(self._task, completed=row.round + 1)
        if row.validation_success is not None:
            self._success = f"{row.validation_success:.3f}"
            self._console.print(
                f"round {row.round + 1:3}  {row.seconds / 60:4.1f} min  {row.samples / 1e6:5.1f}M robot states  "
                f"loss {row.loss:.3f}  validation success {self._success}",
                highlight=False,
            )
