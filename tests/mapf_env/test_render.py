import re
from bisect import bisect_right
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapf_env import EnvConfig, Instance, Solution, animate, draw

CELL = 24
NAMESPACE = "{http://www.w3.org/2000/svg}"


@st.composite
def rollouts(draw):
    """Instances on maps up to 6x7 and any paths over them: robots wander, meet and need not arrive."""
    height, width = draw(st.integers(1, 6)), draw(st.integers(1, 7))
    cells = [(row, col) for row in range(height) for col in range(width)]
    robots = draw(st.integers(1, min(len(cells), 12)))
    instance = Instance(
        np.zeros((height, width), bool), draw(st.permutations(cells))[:robots], draw(st.permutations(cells))[:robots]
    )
    steps = draw(st.integers(0, 12))
    moves = draw(
        st.lists(st.lists(st.integers(0, 4), min_size=robots, max_size=robots), min_size=steps, max_size=steps)
    )
    change = np.array([(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)])
    paths = [instance.starts]
    for actions in moves:
        paths.append(np.clip(paths[-1] + change[actions], 0, (height - 1, width - 1)))
    return instance, Solution(np.array(paths))


def one_robot(cells, goal):
    return Instance(np.zeros((4, 5), bool), cells[:1], [goal]), Solution(np.array(cells)[:, None])


def elements(svg, tag, kind=None):
    found = ElementTree.fromstring(svg).iter(NAMESPACE + tag)
    return [element for element in found if kind is None or element.get("class") == kind]


def value_at(element, attribute, seconds):
    """Return an attribute of an element at a time, by the rules of SVG animation, as a list of numbers."""
    still = element.get(attribute, "").removeprefix("translate(").removesuffix(")")
    changes = [e for e in element if e.get("attributeName") == attribute]
    if not changes:
        return [float(number) for number in still.split(",")]
    (change,) = changes
    times = [float(time) for time in change.attrib["keyTimes"].split(";")]
    values = [[float(number) for number in value.split(",")] for value in change.attrib["values"].split(";")]
    assert times[0] == 0
    assert times == sorted(set(times))
    assert len(times) == len(values)
    now = seconds / float(change.attrib["dur"].removesuffix("s")) % 1.0 if seconds else 0.0
    index = bisect_right(times, now + 1e-6) - 1
    if change.get("calcMode") == "discrete":
        return values[index]
    assert times[-1] == 1
    index = min(index, len(times) - 2)
    share = (now - times[index]) / (times[index + 1] - times[index])
    return [before + share * (after - before) for before, after in zip(values[index], values[index + 1], strict=True)]


def shown_line(svg, anchor, seconds):
    """The text that a counter shows at a time through its window."""
    window = elements(svg, "clipPath")[0][0]
    top, height = float(window.attrib["y"]), float(window.attrib["height"])
    (counter,) = (
        e for e in elements(svg, "text") if e.get("text-anchor") == anchor and len(e.findall(NAMESPACE + "tspan"))
    )
    shift = (
        value_at(counter, "transform", seconds)[1] if counter.find(NAMESPACE + "animateTransform") is not None else 0
    )
    (line,) = (
        row.text for row in counter.findall(NAMESPACE + "tspan") if top < float(row.attrib["y"]) + shift < top + height
    )
    return line


@given(rollouts(), st.sampled_from([0.1, 0.4, 2.5]), st.integers(0, 4))
def test_every_robot_follows_its_path(rollout, step_seconds, pause_steps):
    instance, solution = rollout
    svg = animate(instance, solution, step_seconds=step_seconds, pause_steps=pause_steps)
    robots = elements(svg, "g", "robot")
    assert len(robots) == instance.num_agents
    steps = len(solution.paths) - 1
    for time in range(steps + (pause_steps > 0)):
        for robot, cell in zip(robots, solution.paths[time], strict=True):
            shown = value_at(robot, "transform", (pause_steps + time) * step_seconds)
            assert shown == pytest.approx([cell[1] * CELL, cell[0] * CELL], abs=0.1)
    for time in range(steps):
        for robot, cells in zip(robots, solution.paths[time : time + 2].transpose(1, 0, 2), strict=True):
            shown = value_at(robot, "transform", (pause_steps + time + 0.5) * step_seconds)
            assert shown == pytest.approx(list(cells.mean(axis=0)[::-1] * CELL), abs=0.1)


@given(rollouts())
def test_goals_fill_while_their_robot_rests_there_and_the_counters_count(rollout):
    instance, solution = rollout
    svg = animate(instance, solution, step_seconds=1, pause_steps=2)
    goals = elements(svg, "rect", "goal")
    for goal, cell in zip(goals, instance.goals, strict=True):
        assert (float(goal.attrib["x"]) // CELL, float(goal.attrib["y"]) // CELL) == (cell[1], cell[0])
    steps = len(solution.paths) - 1
    for time in range(steps + 1):
        later = min(time + 1, steps)
        rests = [
            (solution.paths[time, i] == goal).all() and (solution.paths[later, i] == goal).all()
            for i, goal in enumerate(instance.goals)
        ]
        assert [value_at(goal, "fill-opacity", 2 + time) for goal in goals] == [[float(rest)] for rest in rests]
        assert shown_line(svg, "start", 2 + time) == f"{sum(rests)} of {len(goals)} on goal"
        assert shown_line(svg, "end", 2 + time) == f"step {time} of {steps}"


@given(rollouts())
def test_robots_that_do_not_arrive_get_a_ring_at_the_end(rollout):
    instance, solution = rollout
    svg = animate(instance, solution, step_seconds=1)
    steps = len(solution.paths) - 1
    for robot, end, goal in zip(elements(svg, "g", "robot"), solution.paths[-1], instance.goals, strict=True):
        rings = [child for child in robot if child.get("class") == "lost"]
        assert len(rings) == (end != goal).any()
        for ring in rings:
            assert value_at(ring, "stroke-opacity", 3 + steps) == [1]
            if steps:
                assert value_at(ring, "stroke-opacity", 3 + steps - 0.5) == [0]


@given(rollouts())
def test_trails_lie_under_the_robots_and_grow_with_them(rollout):
    instance, solution = rollout
    svg = animate(instance, solution, step_seconds=1)
    driven = np.abs(np.diff(solution.paths, axis=0)).sum(axis=2)
    trails = elements(svg, "polyline", "trail")
    moving = np.flatnonzero(driven.any(axis=0))
    assert len(trails) == len(moving)
    for trail, i in zip(trails, moving, strict=True):
        points = [tuple(map(float, point.split(","))) for point in trail.attrib["points"].split()]
        assert len(points) <= len(solution.paths)
        for (x, y), cell in ((points[0], solution.paths[0, i]), (points[-1], solution.paths[-1, i])):
            assert (x // CELL, y // CELL) == (cell[1], cell[0])
        length = float(trail.attrib["pathLength"])
        assert length == driven[:, i].sum()
        for time in range(len(driven)):
            (hidden,) = value_at(trail, "stroke-dashoffset", 3 + time)
            assert length - hidden == pytest.approx(driven[:time, i].sum(), abs=0.01)


@given(st.integers(1, 7), st.integers(1, 7), st.data())
def test_obstacles_are_outlined_exactly(height, width, data):
    grid = np.array(data.draw(st.lists(st.booleans(), min_size=height * width, max_size=height * width)))
    grid = grid.reshape(height, width)
    grid[0, 0] = False
    instance = Instance(grid, [(0, 0)], [(0, 0)])
    for svg in (draw(instance), animate(instance, Solution(np.zeros((1, 1, 2), int)))):
        (walls,) = elements(svg, "path", "obstacles")
        assert np.array_equal(filled(walls.attrib["d"], height, width), grid)


def filled(data, height, width):
    """The cells inside the outlines of path data with the commands M, h, v and z, by the parity of crossings."""
    inside = np.zeros((height, width), bool)
    for outline in data.split("M")[1:]:
        assert outline.endswith("z")
        x, y = map(int, re.findall(r"\d+", outline)[:2])
        top = y
        for command, digits in re.findall(r"([hv])(-?\d+)", outline):
            length = int(digits)
            if command == "h":
                x += length
            else:
                inside[min(y, y + length) // CELL : max(y, y + length) // CELL, x // CELL :] ^= True
                y += length
        inside[top // CELL : y // CELL, x // CELL :] ^= True
    return inside


def test_only_changes_of_velocity_are_keyframes():
    instance, solution = one_robot([(0, 0), (0, 1), (0, 2), (0, 2), (0, 2), (1, 2), (2, 2)], goal=(2, 2))
    (robot,) = elements(animate(instance, solution, pause_steps=2), "g", "robot")
    motion = robot[-1]
    assert motion.attrib["values"] == "0,0;0,0;48,0;48,0;48,48;48,48"
    assert [round(float(time) * 10) for time in motion.attrib["keyTimes"].split(";")] == [0, 2, 4, 6, 8, 10]


def test_a_picture_is_self_contained_and_small():
    rng = np.random.default_rng(0)
    grid = np.zeros((20, 20), bool)
    grid[1::2, 1::2] = rng.random((10, 10)) < 0.4
    cells = rng.permutation(np.argwhere(~grid))
    instance = Instance(grid, cells[:10], cells[10:20])
    paths = [instance.starts]
    for _ in range(40):
        paths.append(np.clip(paths[-1] + rng.choice([(-1, 0), (0, 1), (0, 0), (0, 1)], size=10), 0, 19))
    svg = animate(instance, Solution(np.array(paths)))
    assert len(svg) < 40_000
    assert len(elements(svg, "path", "obstacles")) == 1
    assert svg.count("http") == 1  # the namespace
    assert not any(word in svg for word in ("<script", "href", "<image", "<style", "@import", "onload"))


def test_pictures_are_deterministic_and_written_whole(tmp_path):
    instance, solution = one_robot([(0, 0), (0, 1)], goal=(0, 1))
    path = tmp_path / "rollout.svg"
    svg = animate(instance, solution, path, title="Ünicode")
    assert path.read_text(encoding="utf-8") == svg
    assert animate(instance, solution, str(path), title="Ünicode") == svg
    assert draw(instance, solution) == draw(instance, solution)


@given(st.text(min_size=1))
def test_any_title_makes_a_well_formed_picture(title):
    instance, solution = one_robot([(0, 0)], goal=(0, 0))
    svg = animate(instance, solution, title=title)
    (name,) = elements(svg, "title")
    if title.isprintable():
        assert name.text == title
    assert svg.encode()


def test_a_title_is_text_and_never_markup():
    instance, solution = one_robot([(0, 0)], goal=(0, 0))
    title = "\"K=3\" & <script>alert('x')</script>\0"
    svg = animate(instance, solution, title=title)
    root = ElementTree.fromstring(svg)
    assert root.get("aria-label") == title.replace("\0", "\ufffd")
    assert not elements(svg, "script")
    (heading,) = (e for e in elements(svg, "text") if e.get("font-size") == "15")
    assert heading.text == title.replace("\0", "\ufffd")


def test_a_title_too_long_for_the_map_is_cut_and_its_whole_text_kept():
    instance, solution = one_robot([(0, 0)], goal=(0, 0))
    title = "A title that is longer than this map is wide"
    svg = animate(instance, solution, title=title)
    (heading,) = (e for e in elements(svg, "text") if e.get("font-size") == "15")
    assert heading.text == "A title that is longer than this ma…"
    assert elements(svg, "title")[0].text == title


@given(rollouts())
def test_a_still_shows_starts_goals_paths_and_ends(rollout):
    instance, solution = rollout
    for svg, lines in (
        (draw(instance), 0),
        (draw(instance, solution), np.ptp(solution.paths, axis=0).any(axis=1).sum()),
    ):
        robots = elements(svg, "g", "robot")
        assert [value_at(robot, "transform", 0) for robot in robots] == [
            [c * CELL, r * CELL] for r, c in instance.starts
        ]
        assert len(elements(svg, "rect", "goal")) == instance.num_agents
        assert len(elements(svg, "polyline", "trail")) == lines
        assert "animate" not in svg
    lost = (solution.paths[-1] != instance.goals).any(axis=1)
    assert len(elements(draw(instance, solution), "circle", "lost")) == lost.sum()


def test_robots_have_colours_of_their_own():
    cells = [(row, col) for row in range(6) for col in range(10)]
    for robots in (1, 10, 60):
        svg = draw(Instance(np.zeros((6, 10), bool), cells[:robots], cells[:robots]))
        assert len({goal.attrib["stroke"] for goal in elements(svg, "rect", "goal")}) == robots


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"step_seconds": 0}, "step_seconds must be a positive number, got 0"),
        ({"step_seconds": float("nan")}, "step_seconds must be a positive number, got nan"),
        ({"pause_steps": -1}, "pause_steps must be at least 0, got -1"),
    ],
)
def test_times_out_of_range(options, message):
    with pytest.raises(ValueError, match=message):
        animate(*one_robot([(0, 0)], goal=(0, 0)), **options)


@pytest.mark.parametrize("picture", [draw, animate])
def test_solutions_of_another_instance(picture):
    instance, _ = one_robot([(0, 0)], goal=(0, 0))
    with pytest.raises(ValueError, match="the solution has 2 paths, the instance 1 agents"):
        picture(instance, Solution(np.zeros((1, 2, 2), int)))
    with pytest.raises(ValueError, match=r"agent 0 is at \(0, 5\) at time 1, outside the 4x5 map"):
        picture(instance, Solution(np.array([[(0, 4)], [(0, 5)]])))


def test_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(FileNotFoundError):
        animate(*one_robot([(0, 0)], goal=(0, 0)), tmp_path / "nowhere" / "a.svg")


def test_a_watched_robot_shows_its_view_and_whom_it_hears():
    """The lines that are visible at a time lead to the robots closer than the radius, and the view goes along."""
    paths = np.array([[[2, 2], [2, 6], [9, 9]], [[2, 3], [2, 6], [9, 9]], [[2, 4], [2, 7], [9, 9]]])
    instance = Instance(np.zeros((10, 10), bool), paths[0], paths[-1])
    config = EnvConfig(fov_radius=2, comm_radius=4.0)
    drawn = ElementTree.fromstring(
        animate(instance, Solution(paths), watched=0, config=config, pause_steps=0, step_seconds=1.0)
    )
    (view,) = (each for each in drawn.iter(f"{NAMESPACE}rect") if each.get("class") == "view")
    assert [float(view.get(name, "")) for name in ("x", "y", "width")] == [0, 0, 5 * 24]
    (shift,) = view.iter(f"{NAMESPACE}animateTransform")
    assert shift.get("values") == "0,0;48,0"
    (line,) = (each for each in drawn.iter(f"{NAMESPACE}line") if each.get("class") == "link")
    assert line.get("stroke-opacity") == "0", "at time 0 the robots are exactly 4 cells apart"
    changes = {each.get("attributeName"): each for each in line.iter(f"{NAMESPACE}animate")}
    assert changes["stroke-opacity"].get("values") == "0;1"
    assert changes["stroke-opacity"].get("keyTimes") == "0;0.5"
    assert changes["x1"].get("values") == "60;108"
    assert changes["x2"].get("values") == "156;156;180"
    with pytest.raises(ValueError, match="watched must be at most 2"):
        animate(instance, Solution(paths), watched=3)
