"""Size of a replay page, time to write it, and how smoothly a headless Chromium plays it.

    python benchmarks/replay.py                  10,000 robots, 200 steps, a map of 512 x 512
    python benchmarks/replay.py --robots 1000 --side 160

The episode is one of random moves under the paper's shield. Chromium draws on the processor, without a graphics card.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from mapf_env import BatchedEnv, Instance, Solution, random_instance, replay

PLAYER = """
<script>{
const median = (values) => values.sort((a, b) => a - b)[values.length >> 1];
const measure = async () => {
  speed.value = SPEED;
  await fetch("/start", {method: "POST", body: "{}"});
  button.click();
  const began = performance.now();
  await new Promise((done) => setTimeout(done, 1000 * SECONDS));
  const played = {seconds: (performance.now() - began) / 1000, frames: state.frames, steps: state.time};
  await fetch("/stop", {method: "POST", body: JSON.stringify(played)});
  button.click();
  const script = [], whole = [], sought = [];
  for (let k = 0; k < 60; k++) {
    state.time = 100 + k / 15;
    const start = performance.now();
    draw();
    script.push(performance.now() - start);
    state.panels[0].pen.getImageData(0, 0, 1, 1);  // waits until the picture is painted
    whole.push(performance.now() - start);
  }
  for (let k = 0; k < 20; k++) {
    state.time = k % 2 ? 0 : state.last;
    const start = performance.now();
    state.panels[0].here.go(state.time);
    sought.push(performance.now() - start);
  }
  const told = {script: median(script), whole: median(whole), sought: median(sought)};
  await fetch("/end", {method: "POST", body: JSON.stringify(told)});
};
addEventListener("load", () => setTimeout(measure, 1000));
}</script></body>"""


@dataclass(frozen=True)
class Options:
    """The page to write, and how to play it."""

    robots: int = 10_000
    """Team size."""
    steps: int = 200
    """Length of the episode."""
    side: int = 512
    """Rows and columns of the map, a tenth of which are obstacles."""
    speed: int = 8
    """Steps per second at which the page plays."""
    seconds: float = 10.0
    """Seconds that it plays; at most as long as the episode."""
    seed: int = 0
    """Seed of map, team and moves."""


def episode(options: Options) -> tuple[Instance, Solution]:
    """Return an episode of random moves under the shield of the paper."""
    side, robots = options.side, options.robots
    instance = random_instance(height=side, width=side, density=0.1, num_agents=robots, seed=options.seed)
    env = BatchedEnv(1, num_agents=robots, height=side, width=side, density=0.0, style="empty", max_cycles=10**9)
    env.reset(0, instances=[instance], observe=False)
    generator = np.random.default_rng(options.seed)
    paths = [env.positions[0]]
    for _ in range(options.steps):
        env.step(generator.integers(0, 5, (1, robots)), observe=False)
        paths.append(env.positions[0])
    return instance, Solution(np.stack(paths))


def cpu_seconds(session: int) -> float:
    """Return the CPU time of all processes of a session; Chromium draws in several."""
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has ended meanwhile
        if int(fields[3]) == session:
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def played(page: str, options: Options) -> dict[str, float]:
    """Play the page in Chromium and return what it measured.

    Raises:
        FileNotFoundError: If there is no Chromium.
        TimeoutError: If the page does not answer within two minutes.
    """
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        raise FileNotFoundError("no Chromium or Chrome was found: install one to play the page")
    script = PLAYER.replace("SPEED", str(options.speed)).replace("SECONDS", str(options.seconds))
    content, answer, answered = page.replace("</body>", script).encode(), dict[str, float](), threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(content if self.path == "/" else b"")

        def do_POST(self) -> None:
            told = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            answer.update(told, **{f"cpu{self.path}": cpu_seconds(process.pid)})
            self.send_response(204)
            self.end_headers()
            if self.path == "/end":
                answered.set()

        def log_message(self, format: str, *values: Any) -> None:
            """Print nothing but the measurements."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server, tempfile.TemporaryDirectory() as folder:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        command = [browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1400,1000"]
        command += [f"--user-data-dir={folder}/profile", "--remote-debugging-port=0"]  # else it ends at once
        command += [f"http://127.0.0.1:{server.server_port}/"]
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        try:
            if not answered.wait(120 + options.seconds):
                raise TimeoutError("the page did not answer; give a smaller team")
        finally:
            process.terminate()
            process.wait()
            server.shutdown()
            time.sleep(1)  # its helper processes leave the folder
    return answer


def main(options: Options) -> None:
    """Write the page, play it, and print what was measured."""
    instance, solution = episode(options)
    with tempfile.TemporaryDirectory() as folder:
        path, began, used = Path(folder) / "replay.html", time.perf_counter(), time.process_time()
        page = replay(instance, solution, path)
        wall, used = time.perf_counter() - began, time.process_time() - used
        size = path.stat().st_size
    told = played(page, options)
    print(f"{options.robots:,} robots, {options.steps} steps, a map of {options.side} x {options.side}")
    print(f"page: {size / 1e6:.2f} MB, written in {wall:.2f} s ({used:.2f} CPU seconds)")
    frames, cpu = told["frames"], told["cpu/stop"] - told["cpu/start"]
    print(f"playing: {frames / told['seconds']:.1f} frames per second over {told['steps']:.0f} steps")
    print(f"CPU: {cpu / frames * 1000:.1f} ms a frame in all processes of the browser")
    print(f"a picture: {told['whole']:.1f} ms by the clock until painted, of which the script {told['script']:.1f} ms")
    print(f"from one end of the episode to the other: {told['sought']:.1f} ms")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
