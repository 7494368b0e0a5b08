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


@contextmanager
def replacing(path: PathLike) -> Iterator[Path]:
    """A draft to write, in the place of `path` once the block ends well: a crash leaves the old file or the new."""
    target = Path(path)
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
