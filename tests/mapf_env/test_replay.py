"""The page of a replay, in a real headless Chromium where there is one."""

import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import oracles
from mapf_env import BatchedEnv, EnvConfig, Instance, Scene, Solution, animate, random_instance, replay, replay_scenes

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

ACTIONS = """
<script>{
window.onerror = (message) => { document.body.dataset.said = JSON.stringify({error: message}); };
const {canvas, pen, status, side, W, H, last, here} = state.panels[0];
const said = [], box = canvas.getBoundingClientRect();
const scale = Math.max(W * side / box.width, H * side / box.height);
const click = (row, col) => canvas.dispatchEvent(new MouseEvent("click", {
  clientX: box.left + (col + 0.5) * side / scale, clientY: box.top + (row + 0.5) * side / scale}));
said.push(status.textContent);
click(here.rows[0], here.cols[0]);
said.push(status.textContent);
slider.value = last; slider.oninput();
said.push(status.textContent);
let clock = 0, wanted = [];
performance.now = () => clock;
window.requestAnimationFrame = (frame) => wanted.push(frame);
const pass = (milliseconds) => {
  for (const end = clock + milliseconds; clock < end;) {
    clock += 20;
    const frames = wanted;
    wanted = [];
    frames.forEach((frame) => frame(clock));
  }
};
speed.value = 5;
button.click();
pass(1000);
const played = state.time, frames = state.frames;
button.click();
pass(1000);
document.body.dataset.said = JSON.stringify({said, played, frames, paused: state.time});
}</script></body>"""

STROKES = """
<script>{
const strokes = {}, {pen} = state.panels[0];
for (const name of ["arc", "drawImage", "fill", "fillRect", "fillText", "lineTo", "rect", "stroke", "strokeRect"]) {
  const draws = pen[name].bind(pen);
  pen[name] = (...where) => { strokes[name] = (strokes[name] ?? 0) + 1; draws(...where); };
}
state.time = 1.5; state.chosen = 0;
draw();
document.body.dataset.said = JSON.stringify({strokes});
}</script></body>"""

SCENES = """
<script>{
const said = [], tell = () => said.push(state.panels.map(({status}) => status.textContent));
const red = ({pen, side}, row, col) => {
  const [r, g, b] = pen.getImageData((col + 0.5) * side, (row + 0.5 - 0.38) * side, 1, 1).data;
  return r > 200 && g < 60 && b < 60;
};
const canvas = ({canvas}) => canvas.getBoundingClientRect();
said.push([...choice.options].map((option) => option.text), choice.hidden);
tell();
choice.value = 1; choice.onchange();
tell();
slider.value = 4; slider.oninput();
tell();
said.push(state.panels.map((panel) => red(panel, 0, 1)));
said.push([...document.querySelectorAll("h2")].map((heading) => heading.textContent));
const [left, right] = state.panels.map(canvas);
said.push(left.right < right.left && left.top === right.top);
document.body.dataset.said = JSON.stringify({said});
}</script></body>"""

KEYS = """
<script>{
const said = [], press = (key, target = document.body) => {
  target.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true, cancelable: true}));
  said.push([state.time, state.playing, state.chosen]);
};
window.requestAnimationFrame = () => {};
press("ArrowRight"); press("ArrowRight"); press("ArrowLeft");
state.time = 1.4;
press("ArrowLeft"); press("ArrowRight", slider);
press(" "); press(" ");
state.chosen = 0;
press("Escape"); press("x");
const box = state.panels[0].canvas.getBoundingClientRect();
const fits = [box.right <= innerWidth, box.bottom <= innerHeight, Math.abs(box.width / box.height - 3) < 0.02];
document.body.dataset.said = JSON.stringify({said, fits, wide: document.documentElement.scrollWidth <= innerWidth});
}</script></body>"""

CROWD = """
<script>{
window.onerror = (message) => { document.body.dataset.said = JSON.stringify({error: message}); };
const [once, always] = state.panels, pictures = [], {pen, side} = once;
let strokes = {};
for (const name of ["arc", "drawImage", "fill", "fillRect", "fillText", "lineTo", "rect", "stroke", "strokeRect"]) {
  const draws = pen[name].bind(pen);
  pen[name] = (...where) => { strokes[name] = (strokes[name] ?? 0) + 1; draws(...where); };
}
const sum = (values) => values.reduce((total, value, i) => total + value * ((i + 1) % 97), 0);
for (const time of [0, 200, 3, 120.75, 119.5, 49.5, 0.25, 60]) {
  strokes = {};
  slider.value = time; slider.oninput();
  const sums = [always.here, always.there, always.goals].map(({rows, cols}) => [sum(rows), sum(cols)]);
  pictures.push([time, sums.flat(), strokes]);
}
const {rows, cols} = once.here;
const [x, y] = [cols[9999], rows[9999]].map((cell) => Math.floor((cell + 0.5) * side));
const [r, g, b] = pen.getImageData(x, y, 1, 1).data;
const painted = "#" + [r, g, b].map((each) => each.toString(16).padStart(2, "0")).join("");
const [first, second] = state.panels.map(({status}) => status.textContent);
document.body.dataset.said = JSON.stringify({pictures, painted, first, second});
}</script></body>"""


def browse(page: str, script: str, folder: Path) -> dict[str, object]:
    path = folder / "page.html"
    path.write_text(page.replace("</body>", script), encoding="utf-8")
    command = [str(BROWSER), "--headless=new", "--no-sandbox", "--disable-gpu"]
    command += [f"--user-data-dir={folder / 'profile'}", "--dump-dom", path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    found = re.search('data-said="([^"]*)"', done.stdout)
    assert found, done.stderr[-2000:]
    return json.loads(found.group(1).replace("&quot;", '"'))


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium to show the page")
def test_the_page_plays_pauses_scrubs_and_shows_what_a_robot_knows(tmp_path: Path) -> None:
    instance = Instance(np.zeros((4, 9), bool), [[0, 0], [0, 4], [3, 8]], [[0, 2], [0, 4], [3, 8]])
    paths = np.repeat(instance.starts[None], 41, axis=0)
    paths[20:, 0], paths[40:, 0] = (0, 1), (0, 2)
    page = replay(instance, Solution(paths), config=EnvConfig(comm_radius=4.5))
    told = browse(page, ACTIONS, tmp_path)
    assert told["said"] == [
        "step 0 of 40, 2 of 3 on goal",
        "step 0 of 40, 2 of 3 on goal; robot 0 at (0,0), goal (0,2), hears 1",
        "step 40 of 40, 3 of 3 on goal; robot 0 at (0,2), goal (0,2), hears 1",
    ]
    assert told["played"] == pytest.approx(5), "it has started again and plays five steps per second"
    assert told["frames"] == 50
    assert told["paused"] == told["played"]


def test_a_radius_that_grows_is_that_of_the_case() -> None:
    apart = Instance(np.zeros((1, 9), bool), [[0, 0], [0, 8]], [[0, 0], [0, 7]])
    near = Instance(np.zeros((1, 9), bool), [[0, 0], [0, 1]], [[0, 0], [0, 2]])
    scenes = [Scene(name, each, {"": Solution(each.starts[None])}) for name, each in (("far", apart), ("near", near))]
    page = replay_scenes(scenes, title="two", config=EnvConfig(comm_radius=2.0, comm_range="connected"))
    radii = [float(found) for found in re.findall(r'"comm_radius":([0-9.]+)', page)]
    assert radii == [pytest.approx(2.0 * 1.1**15), 2.0]


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium to show the page")
def test_scenes_are_chosen_and_their_solutions_share_a_clock(tmp_path: Path) -> None:
    alone = Instance(np.zeros((1, 3), bool), [[0, 0]], [[0, 2]])
    drive, rest = (Solution(np.array([[[0, col]] for col in cols])) for cols in ([0, 1, 2], [0, 1, 1, 1, 1]))
    scenes = [
        Scene("first", alone, {"policy": rest}),
        Scene("second", alone, {"policy": rest, "expert": drive}),
    ]
    told = browse(replay_scenes(scenes, title="two"), SCENES, tmp_path)
    assert told["said"] == [
        ["first", "second"],
        False,
        ["step 0 of 4, 0 of 1 on goal"],
        ["step 0 of 4, 0 of 1 on goal", "step 0 of 2, 0 of 1 on goal"],
        ["step 4 of 4, 0 of 1 on goal; not there (red rings): 0", "step 2 of 2, 1 of 1 on goal"],
        [True, False],  # who is late at the end wears a red ring
        ["policy", "expert"],
        True,
    ]


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium to show the page")
def test_keys_step_play_and_let_go_and_the_map_fits_its_canvas(tmp_path: Path) -> None:
    alone = Instance(np.zeros((20, 60), bool), [[0, 0]], [[0, 3]])
    drive = Solution(np.array([[[0, col]] for col in (0, 1, 2, 3)]))
    told = browse(replay(alone, drive), KEYS, tmp_path)
    assert told["said"] == [
        [1, False, -1],
        [2, False, -1],
        [1, False, -1],
        [1, False, -1],  # back from the middle of a step
        [2, False, -1],
        [2, True, -1],
        [2, False, -1],
        [2, False, -1],
        [2, False, -1],  # other keys do nothing
    ]
    assert told["fits"] == [True, True, True]
    assert told["wide"]


def test_a_page_shows_something() -> None:
    with pytest.raises(ValueError, match="no scenes"):
        replay_scenes([], title="none")
    with pytest.raises(ValueError, match="'empty' has no solution"):
        replay_scenes([Scene("empty", random_instance(num_agents=2, seed=0), {})], title="none")


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium to show the page")
@pytest.mark.parametrize(("side", "strokes_a_robot"), [(60, 2), (150, 1), (300, 1)])
def test_a_picture_costs_one_stroke_a_robot_and_its_number_if_it_has_one(
    tmp_path: Path, side: int, strokes_a_robot: int
) -> None:
    instance = random_instance(height=side, width=side, num_agents=500, seed=0)
    page = replay(instance, Solution(np.repeat(instance.starts[None], 30, axis=0)))
    strokes = browse(page, STROKES, tmp_path)["strokes"]
    assert isinstance(strokes, dict)
    assert strokes["drawImage"] == 2, "the floor, and the goals"
    assert strokes["fill"] == 256, "a path for each colour"
    outlines = sum(strokes.get(name, 0) for name in ("arc", "fillText", "rect", "strokeRect"))
    most = 500 * strokes_a_robot + 100
    assert 500 * strokes_a_robot < outlines < most, "the robots, and what the chosen one knows"


def test_the_page_is_self_contained_and_no_text_ends_its_script(tmp_path: Path) -> None:
    instance = random_instance(num_agents=2, seed=0)
    path = tmp_path / "page.html"
    page = replay(instance, Solution(instance.starts[None]), path, title="</script><b>")
    assert path.read_text(encoding="utf-8") == page
    assert page.count("</script>") == 1
    assert "http" not in page
    with pytest.raises(ValueError, match="the solution has 1 paths, the instance 2 agents"):
        replay(instance, Solution(np.zeros((1, 1, 2), int)))


def lifelong_episode() -> tuple[Instance, Solution, np.ndarray, int]:
    """An episode with its goals at each time, and how often robots arrived."""
    env = BatchedEnv(1, num_agents=3, height=4, width=5, density=0.0, task="lifelong", max_cycles=60)
    env.reset(seed=4)
    instance = Instance(env.grids[0], env.positions[0], env.goals[0])
    paths, goals, arrivals, generator = [env.positions[0]], [env.goals[0]], 0, np.random.default_rng(0)
    for _ in range(60):
        step = env.step(generator.integers(0, 5, (1, 3)))
        arrivals += int(step.arrived.sum())
        paths.append(env.positions[0])
        goals.append(env.goals[0])
    return instance, Solution(np.stack(paths)), np.stack(goals), arrivals


NODE = shutil.which("node")


def test_lifelong_episodes_show_the_goals_of_each_time() -> None:
    instance, solution, goals, arrivals = lifelong_episode()
    assert arrivals > 3
    page = replay(instance, solution, goals=goals)
    (panel,) = json.loads(re.findall(r"^const data = (.*);$", page, re.MULTILINE)[0])["scenes"][0]["panels"]
    assert oracles.track_of_a_replay(panel["paths"]) == solution.paths.tolist()
    assert oracles.track_of_a_replay(panel["goals"]) == goals.tolist()
    if NODE:
        parts = re.findall(r"^(?:class Track|function arrivals|for \(const \[letter).*?^}$", page, re.M | re.S)
        assert len(parts) == 3
        program = "\n".join(
            [
                *parts,
                f"const paths = {json.dumps(panel['paths'])}, goals = {json.dumps(panel['goals'])};",
                "console.log(JSON.stringify(arrivals(paths, goals)));",
            ]
        )
        done = subprocess.run([NODE, "-e", program], capture_output=True, text=True, check=True)
        counts = json.loads(done.stdout)
        assert (len(counts), counts[0], counts[-1]) == (61, 0, arrivals)
    picture = animate(instance, solution, goals=goals)
    assert f">{arrivals} arrivals</tspan>" in picture
    assert picture.count('<animateTransform attributeName="transform" type="translate" calcMode="discrete"') > 3
    assert 'class="lost"' not in picture, "nobody is late where goals go on"


def test_scenes_may_have_goals_that_change_for_some_of_their_solutions() -> None:
    instance, solution, goals, _ = lifelong_episode()
    scene = Scene("both", instance, {"still": solution, "going on": solution}, {"going on": goals})
    page = replay_scenes([scene], title="two")
    panels = json.loads(re.findall(r"^const data = (.*);$", page, re.MULTILINE)[0])["scenes"][0]["panels"]
    assert panels[0]["goals"] is None
    assert panels[1]["goals"]["starts"] == instance.goals.tolist()


@settings(max_examples=50, deadline=None)
@given(
    paths=arrays(
        np.int64,
        st.tuples(st.integers(1, 6), st.integers(1, 4), st.just(2)),
        elements=st.integers(0, 3) | st.integers(0, 89),
    )
)
def test_paths_are_sent_move_by_move_with_their_jumps(paths: np.ndarray) -> None:
    robots = paths.shape[1]
    rest = np.column_stack([np.zeros(robots, int), np.arange(robots)])
    page = replay(Instance(np.zeros((90, 90), bool), rest, rest), Solution(paths))
    (panel,) = json.loads(re.findall(r"^const data = (.*);$", page, re.MULTILINE)[0])["scenes"][0]["panels"]
    assert oracles.track_of_a_replay(panel["paths"]) == paths.tolist()


def crowd() -> tuple[Instance, Solution, np.ndarray]:
    """Random moves and jumps of 10,000 robots over 200 steps with goals that change, and these goals."""
    generator, robots, side = np.random.default_rng(0), 10_000, 512
    cells = generator.permutation(side * side)[: 2 * robots].reshape(2, robots)
    starts, aims = (np.stack(np.divmod(each, side), axis=-1) for each in cells)
    moves = np.array([(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)])[generator.integers(0, 5, (200, robots))]
    paths = np.clip(starts + np.concatenate([np.zeros((1, robots, 2), int), np.cumsum(moves, axis=0)]), 0, side - 1)
    paths[50:, 7] = paths[:-50, 8]
    goals = np.repeat(aims[None], 201, axis=0)
    goals[100:] = paths[::-1][100:]
    return Instance(np.zeros((side, side), bool), starts, aims), Solution(paths), goals


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium to show the page")
def test_ten_thousand_robots_are_sought_and_played_from_a_small_page(tmp_path: Path) -> None:
    instance, solution, goals = crowd()
    scene = Scene("", instance, {"once": solution, "forever": solution}, {"forever": goals})
    page = replay_scenes([scene], title="many")
    assert len(page) < 30e6 / 3, "three strings of moves"
    told = browse(page, CROWD, tmp_path)
    paths, weights = solution.paths.astype(np.int64), np.arange(1, 10_001)[:, None] % 97
    pictures = told["pictures"]
    assert isinstance(pictures, list)
    assert [time for time, *_ in pictures] == [0, 200, 3, 120.75, 119.5, 49.5, 0.25, 60]
    for time, sums, strokes in pictures:
        whole, nearest = math.floor(time), math.floor(time + 0.5)
        cells = (paths[whole], paths[min(whole + 1, 200)], goals[nearest])
        assert sums == [int(total) for each in cells for total in (each * weights).sum(axis=0)], time
        if time < 200:  # then late robots wear rings
            assert strokes == {"drawImage": 2, "rect": 10_000, "fill": 256, "stroke": 1}, "goals are painted already"
    page_data = json.loads(re.findall(r"^const data = (.*);$", page, re.MULTILINE)[0])
    colours = page_data["scenes"][0]["colours"]
    assert told["painted"] == colours[9999 % len(colours)]
    home = int((paths[60] == instance.goals).all(axis=1).sum())
    arrived = (paths[1:] == goals[:-1]).all(axis=2) & ~(paths[:-1] == goals[:-1]).all(axis=2)
    assert told["first"] == f"step 60 of 200, {home} of 10000 on goal"
    assert told["second"] == f"step 60 of 200, {arrived[:60].sum()} arrivals"


def test_goals_of_another_episode_are_refused() -> None:
    instance, solution, goals, _ = lifelong_episode()
    outside = goals.copy()
    outside[3, 1] = 4, 0
    for wrong, said in (
        (goals[:-1], r"goals must have the shape of the paths, \(61, 3, 2\), got \(60, 3, 2\)"),
        (goals[::-1], "goals must begin with those of the instance"),
        (outside, "goals must lie on the map"),
    ):
        for show in (replay, animate):
            with pytest.raises(ValueError, match=said):
                show(instance, solution, goals=wrong)
    with pytest.raises(TypeError, match="goals must be integers"):
        replay(instance, solution, goals=goals.astype(float))
    with pytest.raises(ValueError, match="has goals but no solution of the name 'b'"):
        replay_scenes([Scene("x", instance, {"a": solution}, {"b": goals})], title="x")
