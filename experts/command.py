"""Solve an instance, or check a file of paths, from a shell."""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import NoReturn

from experts import arguments
from experts.many import SOLVER_NAMES, solver_named
from experts.paths import load_paths, save_paths
from mapf_env import Instance, animate
from mapf_env.files import require_outputs
from mapf_env.problem_file import load_problem

_EXIT_CODES = """exit status: 0 solved or valid, 1 not solved (even with a plan, if it is not proved) or invalid, 2 an
error in the arguments or a file"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Prints one line on standard error instead of the whole usage."""
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(arguments_given: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = _Parser(prog="python -m experts", description=__doc__, epilog=_EXIT_CODES)
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    _define_solve(commands.add_parser("solve", help="solve an instance"))
    _define_check(commands.add_parser("check", help="check a file of paths"))
    return _run(parser, arguments_given)


def solve(arguments_given: Sequence[str] | None = None, *, prog: str) -> int:
    """Run the part "solve" under another name and return its exit status."""
    parser = _Parser(prog=prog)
    _define_solve(parser)
    return _run(parser, arguments_given)


def _run(parser: _Parser, arguments_given: Sequence[str] | None) -> int:
    options = parser.parse_args(arguments_given)
    try:
        status = options.run(options)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # the reader of the output has gone, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 2
    except Exception as error:
        if options.debug:
            traceback.print_exc()
        print(f"{options.prog}: {_in_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{options.prog}: interrupted", file=sys.stderr)
        return 130


def _in_one_line(error: Exception) -> str:
    """Return the message of an error; errors that are not about the input also show their type."""
    text = " ".join(str(error).split())
    if isinstance(error, ValueError | TypeError | OSError):
        return text
    kind = type(error).__name__
    advice = "there is not enough memory" if isinstance(error, MemoryError) else "--debug shows where"
    return f"{kind}: {text} ({advice})" if text else f"{kind} ({advice})"


def _define_solve(solve: _Parser) -> None:
    solve.description = (
        "Solve the first robots of a MovingAI scenario or of an instance of a set, or robots placed at random on a "
        "map, and print cost, bound and time. At a limit, ecbs gives the cheapest plan it has found and says that it "
        "is not proved."
    )
    _add_problem(solve, "problem")
    solve.add_argument("--solver", choices=SOLVER_NAMES, default="ecbs", help="default: ecbs")
    solve.add_argument(
        "--w",
        type=float,
        help="for ecbs: bound on cost / optimum, at least 1 "
        f"(default: {arguments.DEFAULT_W}); of lacam: where improvement stops (default: its first plan)",
    )
    solve.add_argument(
        "--time-limit",
        type=float,
        default=arguments.DEFAULT_TIME_LIMIT,
        metavar="SECONDS",
        help=f"default: {arguments.DEFAULT_TIME_LIMIT:g}",
    )
    solve.add_argument(
        "--node-limit",
        type=int,
        default=arguments.DEFAULT_NODE_LIMIT,
        metavar="NODES",
        help=f"for ecbs and lacam: maximum number of nodes (default: {arguments.DEFAULT_NODE_LIMIT})",
    )
    solve.add_argument("--paths", metavar="OUT", help="write the paths to this file, a line for each robot")
    solve.add_argument("--animation", metavar="OUT.svg", help="write an animation of the plan to this file")
    _define_end(solve, _solve)


def _define_check(check: _Parser) -> None:
    check.description = (
        "Check that the paths of a file solve an instance: all begin at their starts, end on their goals, move a cell "
        "at a time over free cells, and no two robots meet or swap."
    )
    check.add_argument("paths", metavar="PATHS", help="the file of paths, as `solve --paths` writes it")
    _add_problem(check, "--scen")
    _define_end(check, _check)


def _define_end(parser: _Parser, run: Callable[[argparse.Namespace], int]) -> None:
    parser.epilog = _EXIT_CODES
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.set_defaults(run=run, prog=parser.prog)


def _add_problem(parser: argparse.ArgumentParser, name: str) -> None:
    action = parser.add_argument(
        name,
        metavar="FILE",
        help="a scenario (.scen), whose map is next to it, a map (.map) for random robots, a set of "
        "instances (.json), as mapf_env.save_instances writes it, or maps of POGEMA (.yaml)",
    )
    action.required = True
    parser.add_argument("--map", metavar="FILE.map", help="the map of the scenario, if it is elsewhere")
    parser.add_argument(
        "--agents", type=int, metavar="N", help="the number of robots, the first of a file (default: all)"
    )
    parser.add_argument("--index", type=int, metavar="I", help="index of the instance or map (default: 0)")
    parser.add_argument("--seed", type=int, default=0, help="seed of random robots and of the solver (default: 0)")


def _load(file: str, options: argparse.Namespace, agents: int | None) -> Instance:
    return load_problem(file, agents=agents, map=options.map, index=options.index, seed=options.seed)


def _solve(options: argparse.Namespace) -> int:
    require_outputs([options.paths, options.animation], [options.problem, options.map])
    instance = _load(options.problem, options, options.agents)
    solver = solver_named(
        options.solver,
        w=options.w,
        time_limit=options.time_limit,
        node_limit=options.node_limit,
        seed=options.seed,
    )
    result = solver(instance)
    print(f"status       {result.status}")
    if result.solution is not None and not result.solved:
        print("proof        none, the cost is above w times the lower bound")
    if result.solution is not None:
        print(f"cost         {result.cost}")
    print(f"lower bound  {result.lower_bound}")
    if result.cost and result.lower_bound:
        print(f"ratio        {result.cost / result.lower_bound:.4f}")
    if result.solution is not None:
        print(f"makespan     {result.solution.makespan}")
        print(f"found by     {result.found_by}")
    print(f"expansions   {result.expansions}")
    print(f"seconds      {result.seconds:.6f}")
    if result.solution is None:
        return 1
    if options.paths is not None:
        save_paths(options.paths, result.solution)
    if options.animation is not None:
        title = f"{options.solver}, {instance.num_agents} robots, cost {result.cost}"
        animate(instance, result.solution, options.animation, title=title)
    return 0 if result.solved else 1


def _check(options: argparse.Namespace) -> int:
    solution = load_paths(options.paths)
    found = solution.paths.shape[1]
    instance = _load(options.scen, options, found if options.agents is None else options.agents)
    violations = solution.violations(instance)
    if violations:
        print(*violations, f"invalid: {solution.count_violations(instance)} violations", sep="\n")
        return 1
    print(f"valid: {found} robots, cost {solution.sum_of_costs}, makespan {solution.makespan}")
    return 0
