"""Reading text in any encoding, and writing files so that a reader never sees half of one."""

from __future__ import annotations

import codecs
import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

PathLike = str | os.PathLike[str]
_DRAFT = ".writing-"
_MOST_BYTES = 1 << 30
_MOST_LINKS = 40


def as_path(path: PathLike, name: str = "path") -> Path:
    """Return `path`, which messages call `name`; raises TypeError if it is not a path."""
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"{name} must be a str or os.PathLike, got {type(path).__name__}")
    return Path(path)


def read_bytes(path: PathLike) -> bytes:
    """Read a whole file.

    Raises:
        ValueError: If it holds more than 1 GiB, or never ends.
        OSError: If it cannot be read.
    """
    content = bytearray()
    with as_path(path).open("rb") as file:
        while part := file.read(1 << 20):
            content += part
            if len(content) > _MOST_BYTES:
                raise ValueError(f"{path} holds more than 1 GiB: split it")
    return bytes(content)


def decoded(content: bytes) -> str:
    """Decode UTF-8, or UTF-16 that a byte order mark announces.

    Byte order marks are removed, lines end with a line feed, and bytes that cannot be decoded become U+FFFD.
    """
    marked = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if marked else "utf-8", errors="replace")
    return text.replace("\ufeff", "").replace("\r\n", "\n").replace("\r", "\n")


def read_text(path: PathLike) -> str:
    """Read a text file with `decoded`.

    Raises:
        ValueError: If it holds more than 1 GiB.
        OSError: If it cannot be read.
    """
    return decoded(read_bytes(path))


@contextmanager
def replacing(path: PathLike) -> Iterator[Path]:
    """Yield a draft that replaces `path` if the block ends without an error: a crash leaves the old file or the new.

    Links are followed, and the new file gets the mode, owner and attributes of the replaced one. A path that is not a
    plain file (a device, a pipe), or has a second name or another owner, is not replaced: the draft is copied into it.

    Raises:
        OSError: As `require_writable`, or if the disk is full; the message names `path`.
    """
    target = require_writable(path)
    into = _must_stay(target)
    try:
        with tempfile.TemporaryDirectory(dir=None if into else target.parent, prefix=_DRAFT) as folder:
            draft = Path(folder, target.name)
            yield draft
            if into or not _inherits(draft, target):
                with draft.open("rb") as source, target.open("ab" if _is_open_file(target) else "wb") as sink:
                    shutil.copyfileobj(source, sink)
            else:
                os.replace(draft, target)
    except OSError as error:
        if error.errno is None or (error.filename is not None and _DRAFT not in os.fsdecode(error.filename)):
            raise
        raise type(error)(error.errno, error.strerror, os.fspath(path)) from error


def require_writable(path: PathLike) -> Path:
    """Return the file that `path` leads to over links, if it can be written; nothing is changed.

    Raises:
        OSError: If it is a folder, lies in no folder, or is write-protected.
    """
    target = _followed(as_path(path))
    if target.is_dir():
        raise IsADirectoryError(f"{path} is a folder: give the name of a file")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written: make the folder {target.parent} first")
    guarded = target if target.exists() else target.parent
    if not os.access(guarded, os.W_OK):
        raise PermissionError(f"{path} cannot be written: {guarded} is write-protected")
    return target


def require_outputs(outputs: Iterable[PathLike | None], inputs: Iterable[PathLike | None]) -> None:
    """Check that a command can write its outputs, and that none of them overwrites another of its files.

    Raises:
        ValueError: If two outputs are one file, or an output is an input.
        OSError: As `require_writable`.
    """
    taken = {_followed(as_path(path)): f"the input {path}" for path in inputs if path is not None}
    for path in outputs:
        if path is None:
            continue
        target = require_writable(path)
        if target.exists() and not target.is_file():
            continue  # a device or a pipe takes several
        for other, role in taken.items():
            if target == other or (target.exists() and other.exists() and target.samefile(other)):
                raise ValueError(f"{path} would overwrite {role}: give another name")
        taken[target] = f"the output {path}"


def unused(path: Path) -> Path:
    """Return `path`, or if it exists the first of `name-2`, `name-3`, ... that does not."""
    names = (path if k == 1 else path.with_name(f"{path.stem}-{k}{path.suffix}") for k in count(1))
    return next(name for name in names if not os.path.lexists(name))


def remove_drafts(folder: PathLike) -> None:
    """Remove the drafts that killed writers left in `folder`."""
    for draft in Path(folder).glob(f"{_DRAFT}*"):
        if draft.is_dir() and not draft.is_symlink():
            shutil.rmtree(draft)


def write_whole(path: PathLike, text: str) -> None:
    """Write `text` as UTF-8 to `path`, as a whole or not at all."""
    with replacing(path) as draft:
        draft.write_bytes(text.encode())


def _followed(path: Path) -> Path:
    """Return the end of a chain of symbolic links; a system link to an open file, as behind /dev/stdout, ends it."""
    here = path
    for _ in range(_MOST_LINKS):
        here = Path(os.path.realpath(here.parent), here.name)
        if not here.is_symlink() or _is_open_file(here):
            return here
        here = here.parent / os.readlink(here)
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), os.fspath(path))


def _is_open_file(path: Path) -> bool:
    return path.parts[:2] == ("/", "proc") or path.parts[:3] == ("/", "dev", "fd")


def _must_stay(target: Path) -> bool:
    """True if the file may be written into but not replaced."""
    if not target.exists():
        return False
    status = target.stat()
    special = not stat.S_ISREG(status.st_mode) or _is_open_file(target)
    return special or status.st_nlink > 1 or not os.access(target.parent, os.W_OK)


def _inherits(draft: Path, target: Path) -> bool:
    """Give the draft the mode, owner and attributes of the file that it replaces; False if it cannot have the owner."""
    if not target.exists():
        return True
    old, new = target.stat(), draft.stat()
    if (old.st_uid, old.st_gid) != (new.st_uid, new.st_gid):
        try:
            os.chown(draft, old.st_uid, old.st_gid)
        except PermissionError:
            return False
    shutil.copystat(target, draft)
    os.utime(draft)
    return True
