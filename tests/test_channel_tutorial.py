"""The tutorial's native channel, put into the sources as the page says, compiled and compared with its definition."""

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest

from mapf_env import HISTORY, random_instance

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "howto" / "channel.md").read_text(encoding="utf-8")

PROGRAM = r"""
#include <cstring>
#include <iostream>

#include "mapf_env/native/senses.hpp"

// Reads height, width, N, radius and the map, positions, goals and moves of teams; writes the planes of a channel.
template <class T>
void show(const mapf::TeamFacts& team, const std::vector<T>& obstacles, int radius, const char* channel) {
    const mapf::Senses senses(radius, 1, mapf::Weights::binary, {channel}, {}, {});
    std::vector<T> marks(team.layout.size(), T{0}), views(team.num_agents * senses.view());
    mapf::write_views(senses, team, obstacles.data(), marks.data(), views.data());
    const int plane = senses.side() * senses.side();
    for (int i = 0; i < team.num_agents; ++i)
        for (int k = 0; k < plane; ++k) std::cout << +views[i * senses.view() + 3 * plane + k] << ' ';
    for (const T mark : marks)
        if (mark != T{0}) std::cout << "marks are left";
}

int main(int, char** arguments) {
    int height, width, count, radius;
    while (std::cin >> height >> width >> count >> radius) {
        mapf::TeamFacts team;
        team.layout = {height, width, radius};
        team.num_agents = count;
        std::vector<float> obstacles(team.layout.size(), 1.0f);
        for (int row = 0; row < height; ++row)
            for (int col = 0; col < width; ++col) std::cin >> obstacles[team.layout.cell(row, col)];
        std::vector<std::int32_t> positions(2 * count), goals(2 * count);
        std::vector<std::int8_t> moves(mapf::history * count);
        for (auto* cells : {&positions, &goals})
            for (auto& each : *cells) std::cin >> each;
        for (auto& each : moves) {
            int move;
            std::cin >> move;
            each = static_cast<std::int8_t>(move);
        }
        team.positions = positions.data();
        team.goals = goals.data();
        team.moves = moves.data();
        show(team, obstacles, radius, arguments[1]);
        show(team, std::vector<std::uint8_t>(obstacles.begin(), obstacles.end()), radius, arguments[1]);
        std::cout << '\n';
    }
}
"""


def test_the_tutorials_channel_is_as_defined(tmp_path: Path) -> None:
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    kernel, row = re.findall(r"^```\{code-block\} cpp\n((?s:.*?))^```", PAGE, re.MULTILINE)
    name = re.findall(r'Channel\{"(\w+)"', row)[0]
    names: dict[str, Callable[..., bool]] = {}
    exec(
        next(block for block in re.findall(r"^```python\n((?s:.*?))^```", PAGE, re.M) if f"def {name}(" in block), names
    )

    native = tmp_path / "mapf_env" / "native"
    shutil.copytree(ROOT / "mapf_env" / "native", native)
    source = (native / "senses.cpp").read_text(encoding="utf-8")
    begin_of_features, last_row = "// ---- features of robots;", r'(    Channel\{"robots_on_goals".*\n)'
    assert source.count(begin_of_features) == len(re.findall(last_row, source)) == 1
    source = source.replace(begin_of_features, f"{kernel}\n{begin_of_features}")
    source = re.sub(last_row, lambda found: found[0] + row, source)
    (native / "senses.cpp").write_text(source, encoding="utf-8")
    (tmp_path / "show.cpp").write_text(PROGRAM, encoding="utf-8")
    sources = [tmp_path / "show.cpp", *(native / each for each in ("senses.cpp", "observe.cpp", "graph.cpp"))]
    flags = ["-std=c++20", "-Wall", "-Wextra", f"-I{tmp_path}", "-o", str(tmp_path / "show")]
    subprocess.run([compiler, *flags, *map(str, sources)], check=True, timeout=600)

    generator, worlds, text = np.random.default_rng(0), [], ""
    for seed in range(20):
        drawn = random_instance(num_agents=5, height=6, width=7, seed=seed)
        moves, radius = generator.integers(-1, 5, (5, HISTORY)), 1 + seed % 3
        worlds.append((SimpleNamespace(team=[tuple(c) for c in drawn.starts.tolist()], moves=moves.tolist()), radius))
        numbers = [6, 7, 5, radius, *drawn.grid.ravel().astype(int), *drawn.starts.ravel(), *drawn.goals.ravel()]
        text += " ".join(map(str, [*numbers, *moves.ravel()])) + "\n"
    done = subprocess.run([str(tmp_path / "show"), name], input=text, capture_output=True, text=True, check=True)
    seen = 0
    for (world, radius), line in zip(worlds, done.stdout.splitlines(), strict=True):
        floats, bytes_ = np.array(line.split(), float).reshape(2, 5, 2 * radius + 3, 2 * radius + 3)
        assert np.array_equal(floats, bytes_)
        for robot in range(5):
            assert np.array_equal(floats[robot], plane_of(names[name], world, robot, radius))
        seen += int(floats.sum())
    assert seen > 20


def plane_of(
    definition: Callable[..., bool], world: SimpleNamespace, robot: int, radius: int
) -> npt.NDArray[np.float64]:
    """The plane of a robot, cell by cell."""
    row, col = world.team[robot]
    window = range(-radius, radius + 1)
    values = [[definition(world, robot, (row + down, col + right)) for right in window] for down in window]
    return np.pad(np.array(values, float), 1)
