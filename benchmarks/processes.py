"""`python benchmarks/processes.py`: how fast training fits with threads, and with processes under torchrun."""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
from pathlib import Path

UPDATES = 200
SETTINGS = f"""
    --epochs 1 --updates-per-epoch {UPDATES} --train-maps 100 --validation-maps 1 --validation-cases-per-map 1
    --test-maps 1 --cases-per-map 1 --demonstration-steps 8192 --dagger-every 0
"""


def fitted(run: Path, processes: int, threads: int) -> float:
    """Robot states a second in the gradient steps of the quick recipe's batch."""
    start = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes), "-m"]
    command = [*(start if processes > 1 else ["-m"]), "gnn_policy.train", *(["--"] if processes > 1 else [])]
    arguments = ["--run", str(run), "--threads", str(threads), *SETTINGS.split()]
    done = subprocess.run(
        [sys.executable, *command, *arguments],
        env={**os.environ, "OMP_NUM_THREADS": str(threads)},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    with (run / "metrics.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    return int(row["samples"]) / float(row["fit_seconds"])


def main() -> None:
    """Print a line for each way."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for processes, threads in ((1, 1), (1, 2), (2, 1)):
            rate = fitted(Path(folder, f"{processes}-{threads}"), processes, threads)
            print(f"{processes} processes, {threads} threads each: {rate:,.0f} robot states a second", flush=True)


if __name__ == "__main__":
    main()
