"""The promises of an installed package."""

import ast
import importlib.metadata
import importlib.util
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import mapf_env

ROOT = Path(__file__).parents[1]
LEARNING_LIBRARIES = ("torch", "torchrl", "tensordict", "safetensors", "matplotlib", "tyro", "rich")


def run_python(code: str) -> str:
    """The output of a fresh interpreter that treats warnings as errors."""
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()


def test_no_package_reaches_into_the_native_core_of_another() -> None:
    for package in ("mapf_env", "experts", "gnn_policy", "benchmarks"):
        for file in sorted((ROOT / package).rglob("*.py")):
            imported = set()
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module:
                    imported |= {f"{node.module}.{name.name}" for name in node.names} | {node.module}
                elif isinstance(node, ast.Import):
                    imported |= {name.name for name in node.names}
            native = {name.split(".")[0] for name in imported if "._native" in name}
            assert native <= {package}, f"{file} imports the native core of {native}"


@pytest.mark.parametrize("package", ["mapf_env", "experts"])
def test_mapf_env_and_experts_import_no_learning_library(package: str) -> None:
    loaded = run_python(f"import sys, {package}; print(*{{name.split('.')[0] for name in sys.modules}})").split()
    assert package in loaded
    assert not set(LEARNING_LIBRARIES) & set(loaded)


def test_an_environment_runs_without_a_learning_library() -> None:
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('torch', 'torchrl'), None)); import mapf_env\n"
        "env = mapf_env.parallel_env(num_agents=2); env.reset(seed=0)\n"
        "print(len(env.step(dict.fromkeys(env.agents, 4))))"
    )
    assert run_python(code) == "5"


def test_importing_again_registers_nothing_twice() -> None:
    code = (
        "import importlib, sys, mapf_env, pettingzoo; importlib.reload(mapf_env)\n"
        "for name in [n for n in sys.modules if n.startswith('mapf_env') and n != 'mapf_env._native']:\n"
        "    del sys.modules[name]\n"
        "import mapf_env; print(*(r['mapf/grid-v0'].id for r in "
        "(pettingzoo.parallel_registry, pettingzoo.aec_registry)))"
    )
    assert run_python(code) == "mapf/grid-v0 mapf/grid-v0"


def test_the_error_of_a_source_tree_that_is_not_built_says_so(tmp_path: Path) -> None:
    package = tmp_path / "mapf_env"
    package.mkdir()
    (package / "__init__.py").write_text((ROOT / "mapf_env" / "__init__.py").read_text())
    command = [sys.executable, "-S", "-c", "import mapf_env"]  # -S: without the packages that are installed
    failed = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert failed.returncode == 1
    assert f"ImportError: {package} has no compiled extension" in failed.stderr
    assert "`pip install -e .`" in failed.stderr


@pytest.mark.parametrize("package", ["mapf_env", "experts", "gnn_policy"])
def test_type_checkers_find_our_types(package: str) -> None:
    spec = importlib.util.find_spec(package)  # without importing: gnn_policy needs its extra
    assert spec is not None
    assert any((Path(folder) / "py.typed").is_file() for folder in spec.submodule_search_locations or [])


def test_the_installed_version_is_the_sources() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert importlib.metadata.version("mapf-env") == project["version"]


def test_a_citation_names_the_sources_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"\nversion: {project['version']}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_the_world_needs_three_libraries() -> None:
    needed = [line for line in importlib.metadata.requires("mapf-env") or [] if "extra ==" not in line]
    names = {line.split(">")[0].split("=")[0].split(" ")[0] for line in needed}
    assert names == {"numpy", "gymnasium", "pettingzoo"}


def test_every_public_name_exists() -> None:
    assert sorted(mapf_env.__all__, key=str.lower) == sorted(set(mapf_env.__all__), key=str.lower)
    for name in mapf_env.__all__:
        assert getattr(mapf_env, name) is not None
