"""Files are written whole or not at all, and what stands at their place is respected; text is read from anywhere."""

import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from mapf_env import files
from mapf_env.files import read_text, remove_drafts, replacing, require_outputs, unused, write_whole

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="links, pipes and modes of POSIX")


def test_a_file_is_written_as_given_and_nothing_else_is_left(tmp_path: Path) -> None:
    target = tmp_path / "map"
    write_whole(target, "old\n")
    write_whole(str(target), "nåw\r\n")
    assert target.read_bytes() == "nåw\r\n".encode()
    assert list(tmp_path.iterdir()) == [target]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "map"
    write_whole(target, "old")
    with pytest.raises(UnicodeEncodeError):
        write_whole(target, "\ud800")
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere first"):
        write_whole(tmp_path / "nowhere" / "map", "text")
    with pytest.raises(IsADirectoryError, match="is a folder: give the name of a file"):
        write_whole(tmp_path, "text")


@POSIX
@pytest.mark.parametrize("relative", [True, False])
def test_links_are_followed(tmp_path: Path, relative: bool) -> None:
    (tmp_path / "data").mkdir()
    target, link, second = tmp_path / "data" / "real", tmp_path / "link", tmp_path / "second"
    link.symlink_to("data/real" if relative else target)
    second.symlink_to("link")
    write_whole(second, "first")  # the target does not exist yet
    assert target.read_text() == "first"
    write_whole(second, "second")
    assert target.read_text() == "second"
    assert link.is_symlink()
    assert second.is_symlink()
    assert sorted(each.name for each in tmp_path.rglob("*")) == ["data", "link", "real", "second"]


@POSIX
def test_links_that_lead_nowhere_are_errors(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(OSError, match=r"symbolic links.*/a'"):
        write_whole(tmp_path / "a", "text")
    (tmp_path / "c").symlink_to("nowhere/d")
    with pytest.raises(FileNotFoundError, match=r"c cannot be written: make the folder .*nowhere first"):
        write_whole(tmp_path / "c", "text")


@POSIX
def test_a_second_name_shows_the_new_text_too(tmp_path: Path) -> None:
    write_whole(tmp_path / "one", "old and longer")
    os.link(tmp_path / "one", tmp_path / "other")
    write_whole(tmp_path / "one", "new")
    assert (tmp_path / "other").read_text() == "new"
    assert len(list(tmp_path.iterdir())) == 2


@POSIX
@pytest.mark.parametrize("mode", [0o600, 0o664, 0o755])
def test_a_file_keeps_its_mode(tmp_path: Path, mode: int) -> None:
    target = tmp_path / "map"
    write_whole(target, "old")
    target.chmod(mode)
    write_whole(target, "new")
    assert stat.S_IMODE(target.stat().st_mode) == mode
    assert target.read_text() == "new"


@POSIX
def test_a_new_file_has_the_mode_of_any_new_file(tmp_path: Path) -> None:
    write_whole(tmp_path / "ours", "text")
    (tmp_path / "theirs").write_text("text")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "theirs").stat().st_mode


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="root alone gives files away")
def test_a_file_keeps_its_owner(tmp_path: Path) -> None:
    target = tmp_path / "map"
    write_whole(target, "old")
    os.chown(target, 12345, 54321)
    write_whole(target, "new")
    assert (target.stat().st_uid, target.stat().st_gid) == (12345, 54321)


@pytest.mark.skipif(not hasattr(os, "setxattr"), reason="attributes of Linux")
def test_a_file_keeps_its_attributes(tmp_path: Path) -> None:
    target = tmp_path / "map"
    write_whole(target, "old")
    try:
        os.setxattr(target, "user.origin", b"field")
    except OSError:
        pytest.skip("the file system has none")
    write_whole(target, "new")
    assert os.getxattr(target, "user.origin") == b"field"


@POSIX
def test_a_pipe_is_written_into(tmp_path: Path) -> None:
    pipe, read = tmp_path / "pipe", list[str]()
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    write_whole(pipe, "through")
    reader.join()
    assert read == ["through"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@POSIX
def test_a_device_stays_one(tmp_path: Path) -> None:
    write_whole(os.devnull, "text")
    (tmp_path / "nothing").symlink_to(os.devnull)
    write_whole(tmp_path / "nothing", "text")
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)
    assert not list(Path(os.devnull).parent.glob(f"{files._DRAFT}*"))


@POSIX
def test_standard_output_is_written_into(tmp_path: Path) -> None:
    """As a pipe, and as a file that the shell has opened, which must not get a successor."""
    program = "from mapf_env.files import write_whole; print('a', flush=True); write_whole('/dev/stdout', 'b')"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "a\nb"
    with (tmp_path / "out").open("w") as out:
        subprocess.run([sys.executable, "-c", program], stdout=out, check=True)
        assert os.path.samestat(os.fstat(out.fileno()), (tmp_path / "out").stat())
    assert (tmp_path / "out").read_text() == "a\nb"


@POSIX
def test_a_write_protected_file_or_folder_is_found_out_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "map"
    target.write_text("old")
    for guarded, path in ((target, target), (tmp_path, tmp_path / "new")):
        monkeypatch.setattr(os, "access", lambda asked, _, guarded=guarded: Path(asked) != guarded)  # root may anything
        with (
            pytest.raises(PermissionError, match=f"{path} cannot be written: {guarded} is write-protected"),
            replacing(path),
        ):
            pytest.fail("the work began")
    monkeypatch.undo()
    assert target.read_text() == "old"


@POSIX
def test_a_file_in_a_write_protected_folder_is_written_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "map"
    target.write_text("old")
    inode = target.stat().st_ino
    monkeypatch.setattr(os, "access", lambda asked, _: Path(asked) != tmp_path)
    write_whole(target, "new")
    assert (target.read_text(), target.stat().st_ino) == ("new", inode)


def test_errors_name_the_file_and_not_its_draft(tmp_path: Path) -> None:
    target = tmp_path / "map"
    with pytest.raises(OSError, match=r"No such file or directory: '[^']*/map'$") as error, replacing(target) as draft:
        (draft.parent / "part" / "of").write_text("text")
    assert files._DRAFT not in str(error.value)
    with pytest.raises(OSError, match=r"No space left on device: '[^']*/map'$"), replacing(target):
        raise OSError(28, "No space left on device")
    with pytest.raises(FileNotFoundError, match="other"), replacing(target):
        (tmp_path / "other").read_text()
    assert not list(tmp_path.iterdir())


def test_drafts_alone_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".writing-abc").mkdir()
    (tmp_path / ".writing-notes").write_text("mine")
    remove_drafts(tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == [".writing-notes"]


def test_outputs_overwrite_neither_inputs_nor_each_other(tmp_path: Path) -> None:
    problem, out = tmp_path / "a.scen", tmp_path / "out"
    problem.write_text("version 1")
    require_outputs([out, None, tmp_path / "other"], [problem, None])
    with pytest.raises(ValueError, match=r"a\.scen would overwrite the input .*a\.scen: give another name"):
        require_outputs([tmp_path / "." / "a.scen"], [problem])
    with pytest.raises(ValueError, match="would overwrite the output"):
        require_outputs([out, out], [])
    if sys.platform != "win32":
        (tmp_path / "link").symlink_to(problem)
        os.link(problem, tmp_path / "twin")
        for name in ("link", "twin"):
            with pytest.raises(ValueError, match="would overwrite the input"):
                require_outputs([tmp_path / name], [problem])
        require_outputs([os.devnull, os.devnull], [])


def test_a_name_that_is_taken_is_numbered(tmp_path: Path) -> None:
    page = tmp_path / "a.html"
    assert unused(page) == page
    page.write_text("mine")
    (tmp_path / "a-2.html").mkdir()
    assert unused(page) == tmp_path / "a-3.html"


@pytest.mark.parametrize(
    "content",
    ["ä\nb\n".encode(), "\ufeffä\r\nb\r".encode(), "\ufeffä\nb\n".encode("utf-16-le"), "ä\nb\n".encode("utf-16")],
)
def test_text_is_read_whatever_editor_saved_it(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "text").write_bytes(content)
    assert read_text(tmp_path / "text") == "ä\nb\n"


def test_files_without_an_end_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "_MOST_BYTES", 1000)
    if os.path.exists("/dev/zero"):
        with pytest.raises(ValueError, match="/dev/zero holds more than 1 GiB: split it"):
            read_text("/dev/zero")
    (tmp_path / "text").write_bytes(b"a" * 1000)
    assert len(read_text(tmp_path / "text")) == 1000
