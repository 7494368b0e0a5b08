"""Any error takes one line and status 2; the traceback is shown on demand."""

import subprocess
import sys

import pytest
import torch

from gnn_policy import DecentralizedPolicy, PolicyConfig, evaluate, play, train
from gnn_policy.command_line import cli_errors, on_device, run_command


@pytest.mark.parametrize(
    "mistake", [ValueError("no"), TypeError("no"), FileNotFoundError("no"), IsADirectoryError("no")]
)
def test_mistakes_end_with_status_two(capsys, mistake):
    with pytest.raises(SystemExit) as end, cli_errors():
        raise mistake
    assert end.value.code == 2
    assert capsys.readouterr().err == "error: no\n"


def deep(levels=0):
    return deep(levels + 1)


@pytest.mark.parametrize(
    ("failure", "words"),
    [
        (lambda: 1 // 0, "ZeroDivisionError: integer division or modulo by zero"),
        (lambda: {}["seed"], "KeyError: 'seed'"),
        (lambda: bytearray(2**62), "not enough memory (MemoryError)"),
        (lambda: torch.empty(2**60), "RuntimeError: "),
        (lambda: torch.zeros(2, device="meta").numpy(), "TypeError|Error: |can't convert"),
        (deep, "too deeply nested"),
        (lambda: exec("assert False"), "AssertionError"),
        (lambda: (_ for _ in ()).throw(ValueError("two\nlines")), "error: two lines\n"),
        (lambda: (_ for _ in ()).throw(ValueError), "error: ValueError (--debug"),
    ],
)
def test_every_other_error_takes_one_line_too_and_its_traceback_on_demand(capsys, failure, words):
    def work(command):
        failure()

    for arguments in ([], ["--debug"]):
        with pytest.raises(SystemExit) as end:
            run_command(lambda given: None, work, arguments)
        assert end.value.code == 2
        told = capsys.readouterr().err
        if arguments:
            assert told.startswith("Traceback (most recent call last):")
        else:
            assert told.startswith("error: ")
            assert told.count("\n") == 1
        assert any(each in told for each in words.split("|"))


@pytest.mark.parametrize("code", [0, None])
def test_code_that_ends_the_process_quietly_is_an_error(capsys, code):
    def work(command):
        raise SystemExit(code)

    with pytest.raises(SystemExit) as end:
        run_command(lambda given: None, work, [])
    assert end.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ")
    assert "sys.exit()" in told
    assert told.count("\n") == 1


def test_help_and_other_statuses_pass(capsys):
    def end_with(code):
        raise SystemExit(code)

    for parse, work, code in ((end_with, None, 0), (lambda given: 130, end_with, 130)):
        with pytest.raises(SystemExit) as end:
            run_command((lambda given: end_with(0)) if work is None else parse, work or (lambda command: None), [])
        assert end.value.code == code
    assert capsys.readouterr().err == ""


def test_an_interrupt_ends_with_130(capsys):
    def work(command):
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as end:
        run_command(lambda given: None, work, [])
    assert end.value.code == 130
    assert capsys.readouterr().err == "stopped\n"


@pytest.mark.parametrize("device", ["abacus", "meta", "cuda:99", "cpu:x"])
def test_a_device_that_cannot_compute_is_refused_before_any_work(device):
    policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8))
    with pytest.raises(ValueError, match=f"device '{device}'"):
        on_device(policy, device)


@pytest.mark.parametrize("command", ["train", "evaluate", "play"])
@pytest.mark.parametrize("arguments", [["--help"], ["--surprise"], ["--threads", "5000"], "refused folder"])
def test_arguments_are_read_before_heavy_libraries_are_loaded(tmp_path, command, arguments):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "map.map").write_text("type octile\nheight 1\nwidth 2\nmap\n..\n")
    where = {"train": ["--run", "."], "evaluate": ["."], "play": ["map.map", "--agents", "1", "--policy", "."]}[command]
    given = where if arguments == "refused folder" else [*arguments, *where[2 * (command == "train") :]]
    program = (
        "import sys, importlib\n"
        f"command = importlib.import_module('gnn_policy.{command}')\n"
        "try:\n"
        f"    command.main({given!r})\n"
        "finally:\n"
        "    print(*{'torch', 'torchrl', 'tensordict', 'tensorboard', 'matplotlib'} & sys.modules.keys(), 'loaded')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == (0 if arguments == ["--help"] else 2), done.stderr
    assert done.stdout.splitlines()[-1].split() == ["loaded"]


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (play, "with # for obstacles and . for free cells, a scenario (.scen) next to its map"),
        (evaluate, "If not given: argmax, stuck and sampled, or fallback and argmax for a policy"),
        (train, "it also takes the network, its senses and its execution from there"),
    ],
)
def test_the_help_of_an_option_is_one_paragraph(capsys, monkeypatch, command, sentence):
    monkeypatch.setenv("COLUMNS", "2000")
    with pytest.raises(SystemExit):
        command.main(["--help"])
    assert sentence in capsys.readouterr().out
