"""The Python of README and docs runs as it stands there, block after block of a page.

The pages of docs/frameworks need packages that can't stand beside each other. Each runs in an interpreter of its own
where its packages are, and is skipped elsewhere; `pytest tests/test_pages.py -k PAGE -s` shows what it measures.
"""

import ast
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").glob("*.md"))]


def blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)])
def test_the_code_blocks_run_one_after_another(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in blocks(page):
        exec(compile(block, page, "exec"), names)
    if page == "docs/environment.md":
        assert "ask for fewer agents or a lower density" in capsys.readouterr().out
    if page == "README.md":
        assert (tmp_path / "expert.svg").read_text().startswith("<svg")


@pytest.mark.parametrize("page", sorted(page.stem for page in (ROOT / "docs" / "frameworks").glob("*.md")))
def test_a_frameworks_page_runs_where_its_packages_are(page: str, tmp_path: Path) -> None:
    code = "\n".join(blocks(f"docs/frameworks/{page}.md"))
    missing = sorted(name for name in imported(code) if importlib.util.find_spec(name) is None)
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    (tmp_path / "page.py").write_text(code, encoding="utf-8")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "page.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr[-3000:]
    print(done.stdout)


def imported(code: str) -> set[str]:
    """The packages that a program imports."""
    names = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module).split(".")[0])
    return names
