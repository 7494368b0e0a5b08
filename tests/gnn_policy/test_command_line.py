"""A user's mistake takes one line; a bug keeps its traceback."""

import os

import pytest

from gnn_policy.command_line import cpu_threads, mistakes_in_one_line


@pytest.mark.parametrize("mistake", [ValueError("no"), FileNotFoundError("no"), IsADirectoryError("no")])
def test_mistakes_end_with_status_two(capsys, mistake):
    with pytest.raises(SystemExit) as end, mistakes_in_one_line():
        raise mistake
    assert end.value.code == 2
    assert capsys.readouterr().err == "error: no\n"


def test_bugs_are_not_hidden():
    with pytest.raises(ZeroDivisionError), mistakes_in_one_line():
        raise ZeroDivisionError


def test_threads_are_those_asked_for_or_all():
    assert cpu_threads(3) == 3
    assert 1 <= cpu_threads(0) <= (os.cpu_count() or 1)
    with pytest.raises(ValueError, match="threads"):
        cpu_threads(-1)
