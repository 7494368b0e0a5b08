"""The command `mapf-env`: the commands of all packages under one name.

A package offers a command as an entry point of the group "mapf_env.commands": a function that takes the arguments after
the command's name and, as the keyword `prog`, its name for help and errors ("mapf-env play"), and returns the exit
status (None means 0).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points, version

GROUP = "mapf_env.commands"
PURPOSES = {
    "evaluate": "measure a policy on held-out maps",
    "export": "write a policy as ONNX, for robots without PyTorch",
    "play": "run a policy on your own map and write a page that replays it",
    "report": "put training runs on one page",
    "solve": "solve an instance with a solver",
    "train": "train a policy, evaluate it and draw the results",
}
"""One line for each command of this distribution; an entry point has no room for it, and importing takes long."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that the first argument names; return its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    commands = {each.name: each for each in sorted(entry_points(group=GROUP), key=lambda each: each.name)}
    if not given or given[0] in ("-h", "--help"):
        print(_usage(commands))
        return 0 if given else 2
    if given[0] == "--version":
        print(f"mapf-env {version('mapf-env')}")
        return 0
    if given[0] not in commands:
        print(f"mapf-env: there is no command {given[0]!r}; give one of {', '.join(commands)}", file=sys.stderr)
        return 2
    try:
        command = commands[given[0]].load()
    except ImportError as missing:
        print(f"mapf-env {given[0]}: {' '.join(str(missing).split())}", file=sys.stderr)
        return 2
    return command(given[1:], prog=f"mapf-env {given[0]}") or 0


def _usage(commands: dict[str, EntryPoint]) -> str:
    width = max(map(len, commands), default=0) + 2
    return "\n".join(
        [
            "usage: mapf-env COMMAND ...",
            "",
            "Commands:",
            *(f"  {name:{width}}{PURPOSES.get(name, command.value)}" for name, command in commands.items()),
            "",
            "`mapf-env COMMAND --help` lists the options of a command, `mapf-env --version` prints the version.",
        ]
    )
