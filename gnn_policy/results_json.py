"""results.json: the tables of an evaluation, written size by size, and the settings that they belong to."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from gnn_policy.cases import Split
from gnn_policy.config import TrainConfig
from gnn_policy.execution import Actions, Execution
from mapf_env.files import write_whole


def default_executions(execution: Execution) -> list[Execution]:
    """Return the executions that are evaluated by default.

    They are "argmax", "stuck" and "sampled", or "fallback" and "argmax" for a policy with "fallback".
    """
    chosen: tuple[Actions, ...] = ("argmax", "stuck", "sampled")
    if execution.actions == "fallback":
        chosen = ("fallback", "argmax")
    return [replace(execution, actions=actions) for actions in chosen]


def settings_of(
    config: TrainConfig,
    num_agents: Sequence[int],
    executions: Sequence[Execution],
    split: Split,
) -> dict[str, Any]:
    """Return everything that the numbers depend on, except for the policy."""
    maps, cases_per_map = config.size_of(split)
    names = ("height", "width", "density", "data_seed", "w", "timeout", "reference_nodes", "seed")
    return {
        "executions": [execution.name for execution in executions],
        "tables": list(tables_of(config, num_agents)),
        "split": split,
        "task": config.task,
        "maps": maps,
        "cases_per_map": cases_per_map,
        "styles": list(config.styles),
        "families": json.loads(json.dumps([asdict(family) for family in config.families])),
        "files": list(config.files),
        **{name: getattr(config, name) for name in names},
    }


def tables_of(config: TrainConfig, num_agents: Sequence[int]) -> dict[str, TrainConfig]:
    """Return the names of the tables of an evaluation, each with the settings of its cases.

    There is one for each size of the team, and for each family of cases if there are families. If no sizes are given,
    they are those of the settings. The name of a table for a size alone is its number of robots.
    """
    if config.files:
        chosen = {f"{N} robots, your maps": replace(config, num_agents=N) for N in num_agents}
        return chosen or {"your maps": config}
    if not config.families:
        return {str(N): replace(config, num_agents=N) for N in num_agents or (config.num_agents,)}
    titles: dict[str, TrainConfig] = {}
    for number, family in enumerate(config.families, 1):
        sizes = [(N, N) for N in num_agents] or [family.num_agents]
        for least, most in sizes:
            robots = f"{least} robots" if least == most else f"{least} to {most} robots"
            chosen = replace(family, num_agents=(least, most))
            titles[f"{robots}, family {number} ({family.style})"] = replace(config, families=(chosen,))
    return titles


def refuse_other_settings(path: Path, settings: dict[str, Any], option: str) -> None:
    """Check that a file of results is missing or has these settings.

    Args:
        path: The file.
        settings: Everything that its numbers depend on, or a part.
        option: The option of the command that names the folder.

    Raises:
        FileExistsError: If it has results of other settings.
    """
    if not path.exists():
        return
    try:
        known = json.loads(path.read_text(encoding="utf-8"))["settings"]
        differ = [name for name in settings if known.get(name) != settings[name]]
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError):
        differ = ["unknown"]
    if differ:
        raise FileExistsError(
            f"{path} has results of other settings ({', '.join(differ)}): choose another folder with {option}, "
            "or delete the file"
        )


def read_tables(path: Path) -> dict[str, dict[str, Any]]:
    """Return the tables that a file holds, by title; none if it is missing or holds something else."""
    try:
        tables = json.loads(path.read_text(encoding="utf-8"))["tables"]
        return dict(tables.items())
    except (FileNotFoundError, ValueError, KeyError, AttributeError, TypeError, RecursionError):
        return {}


def write_tables(path: Path, settings: dict[str, Any], tables: dict[str, dict[str, Any]]) -> None:
    """Write the settings and the tables that are finished, as a whole or not at all."""
    finished = {title: tables[title] for title in settings["tables"] if title in tables}
    write_whole(path, json.dumps({"settings": settings, "tables": finished}, indent=2) + "\n")


def table_title(name: str, settings: dict[str, Any]) -> str:
    """Return the heading of a table."""
    if settings["files"]:
        return name
    cases = f"{name} robots" if name.isdigit() else name
    return f"{cases}, {settings['maps']} {settings['split']} maps"
