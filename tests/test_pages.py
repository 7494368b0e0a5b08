"""The code of README and docs runs as it stands there, block after block of a page.

Long commands are parsed but not carried out, and commands of installation are looked up. A block that begins with the
name of a file, as `# my_layers.py`, is also saved as that.

The pages of docs/frameworks need packages that can't be installed together. Each runs in an interpreter of its own
where its packages are, and is skipped elsewhere; `pytest tests/test_pages.py -k PAGE -s` shows what it measures.
"""

import ast
import importlib
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

import experts
import gnn_policy
import mapf_env
from experts import command as experts_command
from gnn_policy import evaluate, play, report, train
from mapf_env import random_instance, save_instances, save_map, save_scen

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PAGES = [
    str(page.relative_to(ROOT))
    for page in [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
    if "frameworks" not in page.parts
]


COMMANDS = {
    "solve": ["python", "-m", "experts", "solve"],
    **{name: ["python", "-m", f"gnn_policy.{name}"] for name in ("play", "train", "evaluate", "report")},
}


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of the fenced blocks of a page."""
    return re.findall(r"^```(.*)\n((?s:.*?))^```", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)


def carry_out(line: str) -> None:
    """Run a line of a shell, or check that what it calls exists."""
    words = shlex.split(line, comments=True)
    if "&&" in words:
        for part in line.split("&&"):
            carry_out(part)
        return
    match words:
        case ["." | "source", _] | ["python" | "python3", "-m", "venv", _] | [".venv/bin/pip", "install", "uv"]:
            return
        case ["pip", "install", *options]:
            (target,) = [each for each in options if each != "-e"]
            extras = re.fullmatch(r"\.(?:\[([\w,]+)\])?", target)
            assert extras, target
            assert set((extras[1] or "train").split(",")) <= set(PROJECT["optional-dependencies"])
        case [".venv/bin/uv", "run", "--extra", extra, *rest]:
            assert extra in PROJECT["optional-dependencies"]
            carry_out(shlex.join(rest))
        case ["python", "-m", "experts", *options]:
            assert experts_command.main(options) == 0
        case ["python", "-m", "gnn_policy.play", *options]:
            play.main([*options, "--threads", "1"])
        case ["python", "-m", "gnn_policy.evaluate", *options]:
            evaluate.main([*options, "--threads", "1"])
        case ["python", "-m", "gnn_policy.train", *options]:
            if train.parse(options).config.rounds <= 2:
                train.main([*options, "--threads", "1"])
        case ["python", "-m", "gnn_policy.report", *options]:
            report.main(options)
        case ["mapf-env", command, *options] if command in COMMANDS:
            carry_out(shlex.join([*COMMANDS[command], *options]))
        case ["python", script, *_] if (ROOT / script).is_file():
            return
        case ["sphinx-build", "--fail-on-warning", source, _]:  # of the extra "docs"
            assert (ROOT / source / "conf.py").is_file()
        case ["bash", script]:
            assert (ROOT / script).is_file()
        case [tool, *_]:
            assert shutil.which(tool), f"{tool} of {line!r} is not a command of this project"


@pytest.mark.parametrize(
    "page", [page for page in PAGES if {"python", "sh", "bash"} & {each[0] for each in blocks(page)}]
)
def test_the_code_blocks_run_one_after_another(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    instance = random_instance(height=16, width=16, num_agents=50, seed=0)
    save_map("FILE.map", instance.grid)
    save_scen("FILE.scen", instance, "FILE.map")
    save_instances("SET.json", [random_instance(num_agents=4, seed=seed) for seed in range(4)])
    names: dict[str, object] = {}
    for language, block in blocks(page):
        if language == "python":
            if named := re.match(r"# (\w+\.py)\n", block):
                Path(named[1]).write_text(block)
            exec(compile(block, page, "exec"), names)
        elif language in ("sh", "bash"):
            for line in block.splitlines():
                carry_out(line)
        else:
            assert language == "" or language.startswith("{"), f"how to run a block of {language}?"
    if page == "docs/environment.md":
        assert "ask for fewer agents or a lower density" in capsys.readouterr().out
    if page == "README.md":
        assert (tmp_path / "replay.html").read_text().startswith("<!doctype html>")
    if page == "docs/tutorials/own_map.md":
        assert {"depot.html", "depot.svg", "again.html", "expert.svg"} <= {each.name for each in tmp_path.iterdir()}
    if page == "docs/tutorials/train_and_evaluate.md":
        assert (tmp_path / "runs" / "look" / "evaluation" / "failures.html").is_file()


COMMAND = re.compile(r"`(python (?:-m [\w.]+|benchmarks/\w+\.py)(?:\s[^`]*)?)`")


@pytest.mark.parametrize("page", [*PAGES, "gnn_policy/weights/README.md"])
def test_commands_in_the_text_name_scripts_and_options_that_exist(page: str) -> None:
    """An option stands in the script's own text, or in that of the settings it takes."""
    for line in COMMAND.findall((ROOT / page).read_text(encoding="utf-8")):
        words = shlex.split(line)
        script, *options = words[1:] if words[1] != "-m" else [words[2].replace(".", "/") + ".py", *words[3:]]
        package = script.removesuffix(".py")
        script = next(s for s in (script, f"{package}/command.py", f"{package}/__main__.py") if (ROOT / s).is_file())
        neighbours = [
            (ROOT / script).with_name(f"{name}.py") for name in imported((ROOT / script).read_text(encoding="utf-8"))
        ]
        settings = (
            "gnn_policy/config.py",
            "gnn_policy/policy_config.py",
            "gnn_policy/execution.py",
            "mapf_env/senses.py",
        )
        sources = [ROOT / script, *(ROOT / file for file in settings)]
        sources += [each for each in neighbours if each.is_file()]
        text = "".join(source.read_text(encoding="utf-8") for source in sources)
        for option in options:
            if option.startswith("--") and option != "--help":
                name = option[2:].split("=")[0].rpartition(".")[2].removeprefix("no-")
                assert f'"--{name}"' in text or re.search(rf"\b{name.replace('-', '_')}\b", text), f"{line!r}: {option}"


@pytest.mark.parametrize("page", sorted(page.stem for page in (ROOT / "docs" / "frameworks").glob("*.md")))
def test_a_frameworks_page_runs_where_its_packages_are(page: str, tmp_path: Path) -> None:
    code = "\n".join(text for language, text in blocks(f"docs/frameworks/{page}.md") if language == "python")
    needed = imported(code) | ({"tree"} if "ray.rllib" in code else set())  # which comes with ray[rllib], not with ray
    missing = sorted(name for name in needed if importlib.util.find_spec(name) is None)
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    (tmp_path / "page.py").write_text(code, encoding="utf-8")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "page.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr[-3000:]
    print(done.stdout)


@pytest.mark.parametrize("package", [mapf_env, experts, gnn_policy], ids=lambda package: package.__name__)
def test_the_reference_has_every_public_name(package: ModuleType) -> None:
    page = (ROOT / "docs" / "reference" / f"{package.__name__}.md").read_text(encoding="utf-8")
    documented: list[object] = []
    for module, name in re.findall(r"^\.\. auto(?:class|data|function):: ([\w.]+)\.(\w+)", page, re.M):
        documented.append(getattr(importlib.import_module(module), name))
    for module in re.findall(r"^\.\. automodule:: ([\w.]+)\n(?!   :no-members:)", page, re.M):
        values = vars(importlib.import_module(module)).values()
        documented += [each for each in values if getattr(each, "__module__", "") == module]
    missing = [name for name in package.__all__ if not any(getattr(package, name) is each for each in documented)]
    assert not missing


def imported(code: str) -> set[str]:
    """The packages that a program imports."""
    names = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module).split(".")[0])
    return names
