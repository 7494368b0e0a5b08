"""results.json: the tables of an evaluation, written size by size, and the settings that they belong to."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gnn_policy.cases import Split
from gnn_policy.config import TrainConfig
from gnn_policy.execution import Execution
from mapf_env.files import write_whole


def variants_of_training(config: TrainConfig) -> list[Execution]:
    """The rows that are evaluated by default: argmax, stuck robots draw, and all draw, under the shield of training."""
    return [Execution(sample=sample, shield=config.shield) for sample in (False, "stuck", True)]


def settings_of(
    config: TrainConfig, num_agents: Sequence[int], variants: Sequence[Execution], split: Split
) -> dict[str, Any]:
    """Everything that the numbers depend on, except for the policy."""
    maps, cases_per_map = config.size_of(split)
    names = ("height", "width", "density", "data_seed", "w", "timeout", "seed")
    return {
        "variants": [variant.name for variant in variants],
        "num_agents": list(num_agents) or [config.num_agents],
        "split": split,
        "maps": maps,
        "cases_per_map": cases_per_map,
        "styles": list(config.styles),
        **{name: getattr(config, name) for name in names},
    }


def refuse_other_settings(path: Path, settings: dict[str, Any], option: str) -> None:
    """Accept a file of results only if it is missing, or has these settings.

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


def read_tables(path: Path) -> dict[int, dict[str, Any]]:
    """Return the tables that a file holds, by the team's size; none if it is missing or holds something else."""
    try:
        tables = json.loads(path.read_text(encoding="utf-8"))["num_agents"]
        return {int(size): table for size, table in tables.items()}
    except (FileNotFoundError, ValueError, KeyError, AttributeError, TypeError, RecursionError):
        return {}


def write_tables(path: Path, settings: dict[str, Any], tables: dict[int, dict[str, Any]]) -> None:
    """Write the settings and the tables of the sizes that are finished, as a whole or not at all."""
    finished = {str(size): tables[size] for size in settings["num_agents"] if size in tables}
    write_whole(path, json.dumps({"settings": settings, "num_agents": finished}, indent=2) + "\n")


def table_title(num_agents: int, settings: dict[str, Any]) -> str:
    """The heading of the table of a team size."""
    return f"{num_agents} robots, {settings['maps']} {settings['split']} maps"
