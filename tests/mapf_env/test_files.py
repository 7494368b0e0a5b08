import pytest

from mapf_env.files import write_whole


def test_a_file_is_written_as_given_and_nothing_else_is_left(tmp_path):
    target = tmp_path / "map"
    write_whole(target, "old\n")
    write_whole(str(target), "nåw\r\n")
    assert target.read_bytes() == "nåw\r\n".encode()
    assert list(tmp_path.iterdir()) == [target]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    target = tmp_path / "map"
    write_whole(target, "old")
    with pytest.raises(UnicodeEncodeError):
        write_whole(target, "\ud800")
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_missing_folder_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "nowhere" / "map", "text")
