"""Pictures: an instance and its solution as one self-contained SVG, still or moving.

The moving picture is plain SVG animation (SMIL) without scripts, so it also plays where a page shows it by `<img>`.
Cell (row, col) is the square of side 24 at (24 col, 24 row) in the frame of the group `map`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import numpy.typing as npt

from mapf_env import arguments, rules, svg
from mapf_env.config import EnvConfig
from mapf_env.files import PathLike, write_whole
from mapf_env.instance import Cells, Instance
from mapf_env.solution import Solution

_CELL = 24
_MARGIN = 16
_HEADER = 30
_FOOTER = 26
_LEAST_WIDTH = 288
_GREATEST_WIDTH = 1080
_FONT = "system-ui,-apple-system,Segoe UI,Roboto,Helvetica,Arial,sans-serif"

_PAPER, _FLOOR, _WALL, _LINE, _FRAME = "#f6f7f9", "#ffffff", "#3b4252", "#e8ebef", "#cbd2da"
_INK, _FAINT_INK, _WARNING = "#1f2530", "#667085", "#e60012"
_SEEN, _HEARD = "#ffc400", "#d08700"


def animate(
    instance: Instance,
    solution: Solution,
    path: PathLike | None = None,
    *,
    title: str | None = None,
    step_seconds: float = 0.4,
    pause_steps: int = 3,
    goals: npt.ArrayLike | None = None,
    watched: int | None = None,
    config: EnvConfig | None = None,
) -> str:
    """Return the robots driving along their paths, as an SVG that plays in a loop.

    Goals are hollow squares in their robot's colour, filled while the robot rests there; robots that are not on their
    goals at the end get a red ring. The paths need not solve the instance, so a failed rollout can be watched too.

    Args:
        instance: The map and the goals.
        solution: The paths (T + 1, N, 2).
        path: A file to write the SVG to, if given.
        title: A line above the map.
        step_seconds: Duration of a step.
        pause_steps: Pause on the first and on the last state, in steps.
        goals: The goals (T + 1, N, 2) at each time, `env.goals` after the reset and each step of a lifelong task; those
            of the instance at all times if not given.
        watched: A robot whose field of view is shown, with lines to the robots that it hears.
        config: The settings whose fov_radius, comm_radius and comm_range are shown; the paper's if not given.

    Raises:
        ValueError: If the paths are of another number of agents or leave the map, a time is out of range, the goals
            do not belong to the paths, or there is no robot `watched`.
        TypeError: If an argument has the wrong type.
        OSError: If the file cannot be written.
    """
    require_drawable(instance, solution)
    require_title(title)
    if not (math.isfinite(arguments.number(step_seconds, "step_seconds")) and step_seconds > 0):
        raise ValueError(f"step_seconds must be a positive number, got {step_seconds}")
    arguments.integer(pause_steps, "pause_steps", 0, arguments.MOST_INT)
    changing = None if goals is None else goals_over_time(instance, solution, goals)
    if watched is not None:
        arguments.integer(watched, "watched", 0, instance.num_agents - 1)
    config = EnvConfig() if config is None else arguments.instance_of(config, EnvConfig, "config")
    picture = _page(instance, title, _moving(instance, solution, changing, step_seconds, pause_steps, watched, config))
    if path is not None:
        write_whole(path, picture)
    return picture


def draw(instance: Instance, solution: Solution | None = None) -> str:
    """Return the robots on their starts and their goals as a still SVG, with the paths if a solution is given.

    A path that does not end on the robot's goal gets a red ring at its end.

    Raises:
        ValueError: If the paths are of another number of agents or leave the map.
        TypeError: If an argument has the wrong type.
    """
    arguments.instance_of(instance, Instance, "instance")
    colours = svg.colours(instance.num_agents)
    trails, rings, caption = [], [], []
    if solution is not None:
        require_drawable(instance, solution)
        arrived = (solution.paths[-1] == instance.goals).all(axis=1)
        trails = [_trail(i, solution.paths[:, i], colours) for i in range(instance.num_agents)]
        rings = [_ring(*_corner(end)) for end in solution.paths[-1, ~arrived]]
        cost = f"flowtime {solution.sum_of_costs}, makespan {solution.makespan}"
        (left, right), line = _span(instance), _caption_line(instance)
        caption = [
            _text(f"{arrived.sum()} of {len(arrived)} on goal", left, line, "start"),
            _text(cost if arrived.all() else f"{len(solution.paths) - 1} steps", right, line, "end"),
        ]
    goals = [_goal(i, goal, colour) for i, (goal, colour) in enumerate(zip(instance.goals, colours, strict=True))]
    robots = [_robot(i, start, colour) for i, (start, colour) in enumerate(zip(instance.starts, colours, strict=True))]
    return _page(instance, None, [*trails, *goals, *robots, *rings, *caption])


def _moving(
    instance: Instance,
    solution: Solution,
    changing: Cells | None,
    step_seconds: float,
    pause_steps: int,
    watched: int | None,
    config: EnvConfig,
) -> list[str]:
    """All that changes with time: goals, trails, robots, and below the map a line of progress and two counters."""
    loop = np.pad(solution.paths, ((pause_steps, pause_steps), (0, 0), (0, 0)), mode="edge")
    clock = svg.Clock(len(loop) - 1, step_seconds)
    steps = len(solution.paths) - 1
    step = np.clip(np.arange(len(loop)) - pause_steps, 0, steps)
    aims = np.broadcast_to(instance.goals, loop.shape)
    if changing is not None:
        aims = np.pad(changing, ((pause_steps, pause_steps), (0, 0), (0, 0)), mode="edge")
    on_goal = (loop == aims).all(axis=2)
    resting = on_goal & np.concatenate([on_goal[1:], on_goal[-1:]])  # driving across a goal does not count
    over = [int(now == steps) for now in step]
    warning = _ring(0, 0, over[0], clock.sudden("stroke-opacity", over))

    goals, trails, robots = [], [], []
    colours = svg.colours(instance.num_agents)
    for i, colour in enumerate(colours):
        fill = resting[:, i].astype(int).tolist()
        goal = _goal(i, instance.goals[i], colour, fill[0], clock.sudden("fill-opacity", fill))
        shifts = [f"{x},{y}" for y, x in ((aims[:, i] - aims[0, i]) * _CELL).tolist()]
        change = clock.sudden("transform", shifts, "animateTransform")
        goals.append(f"<g>{goal}{change}</g>" if change else goal)
        trails.append(_trail(i, loop[:, i], colours, clock))
        drive = clock.smooth("transform", loop[:, i, ::-1] * _CELL, "animateTransform")
        robots.append(
            _robot(i, loop[0, i], colour, drive if changing is not None or on_goal[-1, i] else warning + drive)
        )

    captions = [f"{count} of {len(robots)} on goal" for count in resting.sum(axis=1)]
    if changing is not None:
        reached, there = (loop[1:] == aims[:-1]).all(axis=2), (loop[:-1] == aims[:-1]).all(axis=2)
        captions = [f"{count} arrivals" for count in np.cumsum([0, *(reached & ~there).sum(axis=1)])]
    left, right = _span(instance)
    line = _caption_line(instance)
    bar = f'x="{left}" y="{line - 19}" height="3" rx="1.5"'
    window = f"line-{left}-{right}-{line}"  # pictures on one page may share it, then it is the same for them
    growth = clock.smooth("width", step[:, None] * ((right - left) / max(steps, 1)))
    return [
        *trails,
        *goals,
        *([] if watched is None else _senses(instance, loop, watched, config, clock)),
        *robots,
        f'<rect {bar} width="{right - left}" fill="{_LINE}"/>',
        f'<rect {bar} width="0" fill="{_FAINT_INK}">{growth}</rect>',
        f'<clipPath id="{window}"><rect x="{left}" y="{line - 15}" width="{right - left}" height="20"/></clipPath>',
        f'<g clip-path="url(#{window})">',
        _counter(clock, captions, instance, "start"),
        _counter(clock, [f"step {now} of {steps}" for now in step], instance, "end"),
        "</g>",
    ]


def _senses(instance: Instance, loop: Cells, robot: int, config: EnvConfig, clock: svg.Clock) -> list[str]:
    """The field of view that moves with a robot, and a line to each other robot while the robot hears it."""
    radius, side = config.comm_radius, (2 * config.fov_radius + 1) * _CELL
    if config.comm_range == "connected":
        radius = rules.connecting_radius(instance.starts, radius)
    x, y = (value - config.fov_radius * _CELL for value in _corner(loop[0, robot]))
    shift = clock.smooth("transform", (loop[:, robot] - loop[0, robot])[:, ::-1] * _CELL, "animateTransform")
    height, width = (cells * _CELL for cells in instance.grid.shape)
    parts = [
        f'<clipPath id="view-{width}-{height}"><rect width="{width}" height="{height}"/></clipPath>',
        f'<g clip-path="url(#view-{width}-{height})"><rect class="view" x="{x}" y="{y}" width="{side}" height="{side}" '
        f'fill="{_SEEN}" fill-opacity=".22" stroke="{_HEARD}">{shift}</rect></g>',
    ]
    hears = np.stack([rules.communication_graph(cells, radius)[robot] > 0 for cells in loop])
    centres = loop * _CELL + _CELL / 2
    for other in np.flatnonzero(hears.any(axis=0)):
        ends = {"x1": (robot, 1), "y1": (robot, 0), "x2": (other, 1), "y2": (other, 0)}
        where = " ".join(f'{name}="{centres[0, i, axis]:g}"' for name, (i, axis) in ends.items())
        moves = "".join(clock.smooth(name, centres[:, i, axis, None]) for name, (i, axis) in ends.items())
        shown = hears[:, other].astype(int).tolist()
        parts.append(
            f'<line class="link" {where} stroke="{_HEARD}" stroke-width="3" stroke-opacity="{shown[0]}">{moves}'
            f"{clock.sudden('stroke-opacity', shown)}</line>"
        )
    return parts


def _page(instance: Instance, title: str | None, parts: Iterable[str]) -> str:
    """The SVG document: the paper, the title, the map and on it the given elements."""
    rows, cols = instance.grid.shape
    height, width = rows * _CELL, cols * _CELL
    left, right = _span(instance)
    top = _MARGIN + (_HEADER if title else 0)
    page_width, page_height = right - left + 2 * _MARGIN, top + height + _FOOTER + _MARGIN
    scale = min(1.0, _GREATEST_WIDTH / page_width)
    name = svg.printable(title or f"{instance.num_agents} robots on a map of {rows} x {cols} cells")
    lines = "".join(f"M0 {y}h{width}" for y in range(_CELL, height, _CELL))
    lines += "".join(f"M{x} 0v{height}" for x in range(_CELL, width, _CELL))
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {page_width} {page_height}" '
            f'width="{page_width * scale:.6g}" height="{page_height * scale:.6g}" '
            f'role="img" aria-label={quoteattr(name)} font-family="{_FONT}">',
            f"<title>{escape(name)}</title>",
            f'<rect x=".5" y=".5" width="{page_width - 1}" height="{page_height - 1}" rx="10" fill="{_PAPER}" '
            f'stroke="{_FRAME}"/>',
            _heading(svg.printable(title), right - left) if title else "",
            f'<g class="map" transform="translate({_MARGIN - left},{top})">',
            f'<rect width="{width}" height="{height}" fill="{_FLOOR}" stroke="{_FRAME}" stroke-width="2"/>',
            f'<path d="{lines}" stroke="{_LINE}"/>',
            f'<path class="obstacles" d="{svg.outline(instance.grid, _CELL)}" fill="{_WALL}" stroke="{_WALL}" '
            'stroke-linejoin="round"/>',
            *parts,
            "</g>",
            "</svg>",
            "",
        ]
    )


def _heading(title: str, width: int) -> str:
    most = width // 8
    shown = title if len(title) <= most else title[: most - 1].rstrip() + "…"
    return (
        f'<text x="{_MARGIN}" y="{_MARGIN + 15}" font-size="15" font-weight="600" fill="{_INK}">{escape(shown)}</text>'
    )


def _text(text: str, x: int, y: int, anchor: str) -> str:
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}" font-size="13" fill="{_FAINT_INK}">{escape(text)}</text>'


def _counter(clock: svg.Clock, texts: Sequence[str], instance: Instance, anchor: str) -> str:
    """A caption that changes with time: all its texts in a column that jumps behind a window of one line."""
    changes = [t for t in range(len(texts)) if t == 0 or texts[t] != texts[t - 1]]
    row_at = np.searchsorted(changes, np.arange(len(texts)), side="right") - 1
    jumps = clock.sudden("transform", [f"0,{-20 * row}" for row in row_at], "animateTransform")
    x, y = _span(instance)[anchor == "end"], _caption_line(instance)
    column = "".join(f'<tspan x="{x}" y="{y + 20 * row}">{escape(texts[t])}</tspan>' for row, t in enumerate(changes))
    return f'<text text-anchor="{anchor}" font-size="13" fill="{_FAINT_INK}">{column}{jumps}</text>'


def _goal(agent: int, cell: npt.NDArray[np.int32], colour: str, fill: int = 0, change: str = "") -> str:
    x, y = _corner(cell)
    return (
        f'<rect class="goal" x="{x + 3}" y="{y + 3}" width="{_CELL - 6}" height="{_CELL - 6}" rx="4" '
        f'fill="{colour}" fill-opacity="{fill}" stroke="{colour}" stroke-width="2.5">{change}</rect>'
        + _number(agent, x, y, colour, 0.8)
    )


def _robot(agent: int, cell: npt.NDArray[np.int32], colour: str, change: str = "") -> str:
    x, y = _corner(cell)
    return (
        f'<g class="robot" transform="translate({x},{y})"><circle cx="12" cy="12" r="9" fill="{colour}" stroke="#fff" '
        f'stroke-width="1.5"/>{_number(agent, 0, 0, "#fff")}{change}</g>'
    )


def _number(agent: int, x: int, y: int, colour: str, scale: float = 1.0) -> str:
    size = scale * {1: 12, 2: 11, 3: 8.5}.get(len(str(agent)), 7)
    return (
        f'<text x="{x + 12}" y="{y + 12 + 0.36 * size:.4g}" text-anchor="middle" font-size="{size:.3g}" '
        f'font-weight="600" fill="{colour}">{agent}</text>'
    )


def _ring(x: int, y: int, opacity: int = 1, change: str = "") -> str:
    """The mark of a robot that is not on its goal at the end."""
    return (
        f'<circle class="lost" cx="{x + 12}" cy="{y + 12}" r="11" fill="none" stroke="{_WARNING}" stroke-width="3" '
        f'stroke-opacity="{opacity}">{change}</circle>'
    )


def _trail(agent: int, track: npt.NDArray[np.int32], colours: Sequence[str], clock: svg.Clock | None = None) -> str:
    """The line along the cells of `track` (T + 1, 2); with a clock it grows behind the robot."""
    moves = np.diff(track, axis=0)
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(moves[:, 0], moves[:, 1]))])
    if driven[-1] == 0:
        return ""
    moved = track[np.concatenate([[True], moves.any(axis=1)])]
    aside = 8 * (agent * 0.618 % 1 - 0.5)  # trails along one corridor lie side by side
    line = " ".join(f"{x:.4g},{y:.4g}" for y, x in moved[svg.bends(moved)] * _CELL + _CELL / 2 + aside)
    opacity = 0.4 * min(1.0, math.sqrt(12 / len(colours)))  # the more robots, the quieter
    dashes, growth = "", ""
    if clock is not None:
        length = f"{driven[-1]:.6g}"
        dashes = f' pathLength="{length}" stroke-dasharray="{length} {2 * driven[-1]:.6g}" stroke-dashoffset="{length}"'
        growth = clock.smooth("stroke-dashoffset", (driven[-1] - driven)[:, None])
    return (
        f'<polyline class="trail" points="{line}" fill="none" stroke="{colours[agent]}" stroke-width="3" '
        f'stroke-opacity="{opacity:.2g}" stroke-linejoin="round"{dashes}>{growth}</polyline>'
    )


def _corner(cell: npt.NDArray[np.int32]) -> tuple[int, int]:
    """The x and y of a cell's upper left corner."""
    return int(cell[1]) * _CELL, int(cell[0]) * _CELL


def _span(instance: Instance) -> tuple[int, int]:
    """Left and right end of the captions; a small map is narrower than they are and stands in their middle."""
    width = instance.grid.shape[1] * _CELL
    spare = max(0, _LEAST_WIDTH - width) // 2
    return -spare, width + spare


def _caption_line(instance: Instance) -> int:
    return instance.grid.shape[0] * _CELL + _FOOTER + 2


def require_title(title: str | None) -> None:
    """Raise TypeError if the title is not text."""
    if title is not None:
        arguments.instance_of(title, str, "title")


def goals_over_time(instance: Instance, solution: Solution, goals: npt.ArrayLike) -> Cells:
    """`goals` as cells (T + 1, N, 2) of the map, one for each cell of the solution's paths, the instance's goals first.

    Raises:
        ValueError: If they do not fit the paths, leave the map, or begin with other goals.
        TypeError: If they are not integers.
    """
    found = arguments.cells(goals, "goals", "(T + 1, N, 2)", ": a goal of each agent at each time", filled=True)
    if found.shape != solution.paths.shape:
        raise ValueError(f"goals must have the shape of the paths, {solution.paths.shape}, got {found.shape}")
    if not np.array_equal(found[0], instance.goals):
        raise ValueError("goals must begin with those of the instance: give the instance that the episode began with")
    if ((found < 0) | (found >= instance.grid.shape)).any():
        raise ValueError("goals must lie on the map: give the instance that they are of")
    return found


def require_drawable(instance: Instance, solution: Solution) -> None:
    """Raise ValueError if the paths are of another number of agents or leave the map, TypeError if there are none."""
    arguments.instance_of(instance, Instance, "instance")
    paths = arguments.instance_of(solution, Solution, "solution").paths
    if paths.shape[1] != instance.num_agents:
        raise ValueError(
            f"the solution has {paths.shape[1]} paths, the instance {instance.num_agents} agents; "
            "give the instance that the solution is for"
        )
    outside = np.argwhere(((paths < 0) | (paths >= instance.grid.shape)).any(axis=2))
    if len(outside):
        time, agent = outside[0]
        row, col = paths[time, agent]
        height, width = instance.grid.shape
        raise ValueError(
            f"agent {agent} is at ({row}, {col}) at time {time}, outside the {height}x{width} map; "
            "give the instance that the solution is for"
        )
