"""Run folders of training: one process at a time, one set of settings, never overwritten."""

from __future__ import annotations

from pathlib import Path

from filelock import FileLock, Timeout

from gnn_policy.config import TrainConfig
from gnn_policy.results_json import read_tables, tables_of
from mapf_env.files import remove_drafts

RESULTS = "results.json"
"""The last file that a run writes: a run that has it is finished."""


class RunLockedError(FileExistsError):
    """Another process is training in the run folder."""


def lock_run(folder: Path) -> FileLock:
    """Keep other processes out of a run folder, until the lock is released or this process ends.

    Raises:
        RunLockedError: If another process has it.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder.parent / f".{folder.name}.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise RunLockedError(
            f"another process is training in {folder}: wait for its end, or choose another folder with --run"
        ) from None
    return lock


def open_run(folder: Path, config: TrainConfig) -> None:
    """Make the run folder, or accept one that holds an unfinished run with the same settings.

    Raises:
        FileExistsError: If the folder holds something else.
    """
    check_run(folder, config)
    for each in (folder, folder / "demonstrations"):
        remove_drafts(each)
    if not (folder / "config.toml").exists():
        folder.mkdir(parents=True, exist_ok=True)
        config.save(folder / "config.toml")


def check_run(folder: Path, config: TrainConfig) -> None:
    """Do what `open_run` does, except for changes to the disk.

    Raises:
        FileExistsError: If the folder holds something else.
    """
    if not folder.exists():
        return
    if folder.is_dir() and all(each.name.startswith(".") for each in folder.iterdir()):  # empty, or drafts at most
        return
    if not (folder / "config.toml").is_file():
        raise FileExistsError(f"{folder} exists and is not a training run: choose another folder with --run")
    config.require_same_settings(TrainConfig.load(folder / "config.toml"), f"{folder} holds a run with", "--run")
    if (folder / RESULTS).exists():
        raise FileExistsError(
            f"{folder} holds a finished run: evaluate it with `python -m gnn_policy.evaluate {folder}`, "
            "or choose another folder with --run"
        )


def is_finished(folder: Path, config: TrainConfig) -> bool:
    """Return True if the folder holds a run with these settings that has its table of results.

    Raises:
        FileExistsError: If the folder holds a run with other settings.
    """
    finished = read_tables(folder / RESULTS).keys()
    if not (folder / "config.toml").is_file() or not tables_of(config, ()).keys() <= finished:
        return False
    config.require_same_settings(TrainConfig.load(folder / "config.toml"), f"{folder} holds a run with", "--run")
    return True
