"""The report shows what the run folders hold, and nothing is fetched."""

import json
import re
import subprocess
import sys
from html import escape, unescape
from pathlib import Path

import pytest

from gnn_policy.config import TrainConfig


def estimate(mean: float) -> dict[str, float]:
    return {"mean": mean, "low": mean, "high": mean}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder as training and evaluation leave it."""
    folder = tmp_path / "run<1>"
    (folder / "evaluation").mkdir(parents=True)
    TrainConfig(num_agents=10).save(folder / "config.toml")
    (folder / "metrics.csv").write_text(
        "round,samples,loss,validation_success\n0,1000000,1.5,\n1,2000000,0.9,0.61\n2,3000000,0.7,0.83\n"
    )
    tables = {
        str(size): {
            "cases": 90,
            "rows": [
                {
                    "name": name + "*",
                    "success_rate": estimate(success),
                    "flowtime_increase": estimate(0.1),
                }
                for name, success in (("argmax", 0.876 - size / 1000), ("stuck,1", 0.99))
            ],
            "failures": {"argmax": {"deadlock": 11, "livelock": 3}, "stuck,1": {}},
        }
        for size in (4, 10)
    }
    settings = {"maps": 3, "split": "test", "styles": ["cells", "walls"], "height": 20, "width": 20}
    settings |= {"cases_per_map": 30, "w": 1.1, "timeout": 3.0}
    (folder / "evaluation" / "results.json").write_text(json.dumps({"settings": settings, "tables": tables}))
    (folder / "evaluation" / "failures.html").write_text("<!doctype html><p>\"worst\" & 'cases'</p>")
    return folder


def report(*arguments: object, folder: Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "gnn_policy.report", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600, check=False)


def test_the_page_has_curves_tables_replays_and_speed(run: Path, tmp_path: Path) -> None:
    (tmp_path / "speed.txt").write_text("9 million <steps>")
    done = report(run, "--speed", "speed.txt", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 8
    for text in ("run<1>, argmax", "run<1>, stuck,1", "deadlock", "livelock", "failed of 90 cases", "14"):
        assert f"<!-- {escape(text)} -->" in page
    (replays,) = re.findall('srcdoc="([^"]*)"', page)
    assert unescape(replays) == "<!doctype html><p>\"worst\" & 'cases'</p>"
    assert "9 million &lt;steps&gt;" in page
    assert "3 test maps of cells and walls, 20 x 20, 30 cases each, w = 1.1, T_max 3.0 makespans" in page
    assert not re.findall(r'(?:src|href)="(?!#|data:)', page), "the page fetches something"


def test_a_model_of_the_papers_experiment_shows_its_test_maps(run: Path, tmp_path: Path) -> None:
    tables = json.loads((run / "evaluation" / "results.json").read_text())["tables"]
    for N, success in ((6, 0.625), (14, 0.375)):
        table = tables["10"]
        table["rows"][0]["success_rate"] = estimate(success)
        file = tmp_path / f"results/20x20-cells-n{N}/{run.name}.json"
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps(table))
    assert report(run, folder=tmp_path).returncode == 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for tested in (".625", ".375"):
        assert f"<!-- {tested} -->" in page
    assert "<!-- .866 -->" not in page, "what the evaluation of ten robots found"


def test_a_run_that_was_not_evaluated_has_its_curves(run: Path, tmp_path: Path) -> None:
    (run / "evaluation" / "results.json").unlink()
    assert report(run, "--out", "other.html", folder=tmp_path).returncode == 0
    assert (tmp_path / "other.html").read_text(encoding="utf-8").count("<svg") == 2
    assert "python -m gnn_policy.evaluate RUN" in (tmp_path / "other.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(("arguments", "words"), [(["none"], "none is not a run folder"), ([], "at least one run")])
def test_a_mistake_takes_one_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    done = report(*arguments, folder=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
