"""The command `mapf-env`: the commands of all packages under one name.

A package offers its commands as entry points of the group "mapf_env.commands"; this module knows none of them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points, version

GROUP = "mapf_env.commands"


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
    return command(given[1:]) or 0


def _usage(commands: dict[str, EntryPoint]) -> str:
    width = max(map(len, commands), default=0) + 2
    return "\n".join(
        [
            "usage: mapf-env COMMAND ...",
            "",
            "Commands, each with the function that it runs:",
            *(f"  {name:{width}}{command.value}" for name, command in commands.items()),
            "",
            "`mapf-env COMMAND --help` lists the options of a command, `mapf-env --version` prints the version.",
        ]
    )
