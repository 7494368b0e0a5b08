"""The progress display of training."""

import io

import numpy as np
from rich.console import Console

from gnn_policy.learning_curve import Round
from gnn_policy.progress import TrainingProgress


def test_phase_rate_loss_success_and_time_are_shown():
    shown = io.StringIO()
    progress = TrainingProgress(2, Console(file=shown, width=120, force_terminal=True))
    row = Round(
        round=0,
        updates=2,
        samples=3_000_000,
        seconds=90.0,
        collect_seconds=1.0,
        expert_seconds=0.1,
        fit_seconds=1.0,
        loss=0.321,
        accuracy=0.9,
        lr=1e-3,
        demonstrations=10,
        unlabelled=0,
        validation_success=0.875,
    )
    with progress:
        progress.phase(0, "collecting")
        progress.fitted(0, 1, 2, np.array([0.5]), 640)
        progress.fitted(0, 2, 2, np.array([0.5, 0.25]), 640)
        progress.finished(row)
        progress.phase(1, "collecting")
        progress.fitted(1, 1, 2, np.array([0.125]), 640)
    text = shown.getvalue()
    assert "round   1   1.5 min    3.0M robot states  loss 0.321  validation success 0.875" in text
    for words in ("fitting", "k states/s", "loss 0.125", "success 0.875", "left"):
        assert words in text
