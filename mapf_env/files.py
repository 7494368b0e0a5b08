"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PathLike = str | os.PathLike[str]
_DRAFT = ".writing-"


def as_path(path: PathLike, name: str = "path") -> Path:
    """`path`, of which messages say `name`; raises TypeError where it is none."""
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"{name} must be a str or os.PathLike, got {type(path).__name__}")
    return Path(path)


@contextmanager
def replacing(path: PathLike) -> Iterator[Path]:
    """A draft to write, in the place of `path` once the block ends well: a crash leaves the old file or the new.

    Raises:
        OSError: If `path` is a folder or lies in none.
    """
    target = as_path(path)
    if target.is_dir():
        raise IsADirectoryError(f"{target} is a folder: give the name of a file")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target} cannot be written: make the folder {target.parent} first")
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=_DRAFT) as folder:
        draft = Path(folder, target.name)
        yield draft
        os.replace(draft, target)


def remove_drafts(folder: PathLike) -> None:
    """Remove what writers that were killed left in `folder`."""
    for draft in Path(folder).glob(f"{_DRAFT}*"):
        shutil.rmtree(draft)


def write_whole(path: PathLike, text: str) -> None:
    """Write `text` as UTF-8 to `path`, as a whole or not at all."""
    with replacing(path) as draft:
        draft.write_bytes(text.encode())
