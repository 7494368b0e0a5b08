"""Every setting of training, each default written once."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from gnn_policy.cases import Split
from gnn_policy.execution import Shield
from gnn_policy.policy_config import PolicyConfig
from gnn_policy.settings import check_types
from mapf_env.arguments import share
from mapf_env.files import write_whole
from mapf_env.generation import MapStyle

Recipe = Literal["quick", "full", "paper"]
RobotOrder = Literal["index", "random", "farthest", "nearest"]
Aggregation = Literal["visited", "stuck"]
Backend = Literal["direct", "process"]
Precision = Literal["auto", "float32", "bfloat16"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """The settings of a training run; as written here they are those of the paper's setup section."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """The network and what it perceives."""

    num_agents: int = 10
    """Robots N in a training team."""
    height: int = 20
    """Rows of a map."""
    width: int = 20
    """Columns of a map."""
    density: float = 0.1
    """Share of obstacles on a map."""
    styles: tuple[MapStyle, ...] = ("cells",)
    """Obstacles: independent "cells", short "walls" as the paper's released generator makes them, or "maze", "room",
    "warehouse" and "empty", which heed no density; the maps of a split take turns among the styles."""
    train_maps: int = 420
    """Maps for training."""
    validation_maps: int = 90
    """Maps for the selection of the best checkpoint."""
    test_maps: int = 90
    """Maps for the final table."""
    cases_per_map: int = 50
    """Cases on each training and test map."""
    validation_cases_per_map: int = 50
    """Cases on each validation map."""
    timeout: float = 3.0
    """T_max in makespans of the expert's solution."""

    teacher: str = "ecbs"
    """The solver that shows the moves: "ecbs", "lacam", "prioritised", "pibt", or one of your own as
    "module:function"."""
    w: float = 1.05
    """ECBS's cost is at most w times the lower bound of the optimum, where it teaches and where its plans set T_max;
    other teachers are asked without a w."""
    robot_order: RobotOrder = "index"
    """The order in which the teacher is given the robots of a state, by which solvers break ties: that of their
    numbers, "random" in each state, or by the Manhattan distance to their goals, "farthest" or "nearest" first."""
    expert_nodes: int = 2000
    """Nodes that ECBS or LaCAM may generate to label a state; unlabelled states are counted and left out."""

    epochs: int = 150
    """Rounds of collecting and fitting; round 0 imitates the expert, the others aggregate what the policy visits."""
    updates_per_epoch: int | None = None
    """Gradient steps in a round; without a number, one pass in which every demonstrated state is seen once."""
    batch_size: int = 64
    """Team states in a gradient step."""
    demonstration_steps: int = 524_288
    """Team steps played in round 0, by the expert."""
    aggregation: Aggregation = "visited"
    """What is aggregated: every "visited" state, or plans from where teams are "stuck" at the end of their time, as the
    released code does."""
    dagger_every: int = 4
    """Rounds from one aggregation to the next; 0 for plain imitation."""
    dagger_steps: int = 32_768
    """Team steps played in each aggregation, at least: as many times rollout_teams x rollout_length as that takes."""
    beta_decay: float = 0.0
    """In round r a team step follows the expert with probability beta_decay ** r (DAgger's beta), else the policy."""
    fresh_share: float = 0.5
    """With a number of steps: share of a batch drawn from the newest states; the rest comes from all of them."""
    fresh_window: int = 65_536
    """How many states count as the newest."""
    rollout_length: int = 64
    """Steps that a team plays in a round."""
    rollout_teams: int = 128
    """Teams that play side by side."""
    backend: Backend = "direct"
    """Where TorchRL's collector plays: "direct" in this process, or "process", in as many others as `collectors`."""
    collectors: int = 1
    """How many of them share a process's rollout_teams; each has a seed of its own."""
    hard_case_mining: int = 1
    """Team steps played for each one that is labelled; teams that did not arrive in the round are labelled first."""
    shield: Shield = "idle"
    """Under which aggregated rollouts and validation play: the paper's "idle", or "pibt", which takes the logits as
    preferences."""
    sample_rollouts: bool = False
    """Draw the moves of aggregated rollouts from the softmax in place of the most probable ones."""
    augment: bool = False
    """Turn and reflect every demonstrated state at random."""

    lr: float = 1e-3
    """Adam's first learning rate."""
    final_lr: float = 1e-6
    """The learning rate at the end of the cosine decay."""
    beta1: float = 0.9
    """Adam's momentum."""
    weight_decay: float = 1e-5
    """L2 regularisation."""

    validate_every: int = 5
    """Rounds from one validation to the next."""
    seed: int = 0
    """Random seed for weights, batches and rollouts."""
    data_seed: int = 0
    """Random seed for the maps and cases of all three splits."""
    threads: int = 0
    """CPU threads; 0 takes as many as affinity, cgroup quota and OMP_NUM_THREADS allow."""
    precision: Precision = "auto"
    """In which numbers the network computes in training: "bfloat16", "float32", or "auto", the first where the
    hardware has it."""
    device: str = "cpu"
    """Where the network lives."""

    def __post_init__(self) -> None:
        check_types(self)
        positive = (
            "num_agents train_maps validation_maps test_maps cases_per_map validation_cases_per_map timeout "
            "expert_nodes epochs batch_size demonstration_steps dagger_steps fresh_window rollout_length "
            "rollout_teams hard_case_mining collectors lr final_lr validate_every"
        )
        for name in positive.split():
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        for name in ("dagger_every", "weight_decay", "seed", "data_seed", "threads"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {getattr(self, name)}")
        for name in ("density", "beta_decay", "fresh_share"):
            share(getattr(self, name), name)
        if not 0 <= self.beta1 < 1:
            raise ValueError(f"beta1 must lie in [0, 1), got {self.beta1}")
        for name in ("seed", "data_seed"):
            if getattr(self, name) >= 2**64:
                raise ValueError(f"{name} must be below 2**64, got {getattr(self, name)}")
        if self.backend == "direct" and self.collectors > 1:
            raise ValueError(f'{self.collectors} collectors need processes of their own: backend "process"')
        if not 1 <= self.w < math.inf:
            raise ValueError(f"w must be at least 1 and finite, got {self.w}")
        if self.updates_per_epoch is not None and self.updates_per_epoch < 1:
            raise ValueError(f"updates_per_epoch must be at least 1, got {self.updates_per_epoch}")

    def size_of(self, split: Split) -> tuple[int, int]:
        """The number of maps of a split, and of cases on each."""
        return {
            "train": (self.train_maps, self.cases_per_map),
            "validation": (self.validation_maps, self.validation_cases_per_map),
            "test": (self.test_maps, self.cases_per_map),
        }[split]

    def refuse_other(self, found: TrainConfig, what: str, option: str) -> None:
        """Accept found settings only if they are these, except for `threads` and `device`.

        Args:
            found: The settings of what is there.
            what: The place and what it holds, as "runs/quick holds a run with".
            option: That of the command which names the folder.

        Raises:
            FileExistsError: If others differ; it names them.
        """
        own, others = asdict(self), asdict(found)
        differ = [name for name in own if own[name] != others[name] and name not in ("threads", "device")]
        if differ:
            raise FileExistsError(f"{what} other settings ({', '.join(differ)}): choose another folder with {option}")

    def save(self, path: Path) -> None:
        """Write the settings as JSON."""
        write_whole(path, self.to_json())

    @staticmethod
    def load(path: Path) -> TrainConfig:
        """Read what `save` wrote.

        Raises:
            ValueError: If the file is damaged or has settings that this version does not know.
        """
        try:
            return TrainConfig.from_json(path.read_text(encoding="utf-8"))
        except ValueError as damage:
            raise ValueError(f"{path}: {damage}") from damage

    @staticmethod
    def from_json(text: str, *, ignore_unknown: bool = False) -> TrainConfig:
        """Return the settings that `to_json` wrote.

        Args:
            text: The settings.
            ignore_unknown: Leave out settings that this version does not know, such as those of a newer one.

        Raises:
            ValueError: If the text is damaged, a value has the wrong type or lies out of range, or a setting is unknown
                and not left out.
        """
        try:
            settings = _table(json.loads(text), TrainConfig, ignore_unknown)
            policy = PolicyConfig(**_table(settings.pop("policy"), PolicyConfig, ignore_unknown))
            styles = settings.pop("styles")
            return TrainConfig(policy=policy, styles=tuple(styles) if isinstance(styles, list) else styles, **settings)
        except (ValueError, KeyError, TypeError, RecursionError) as damage:
            raise ValueError(f"no settings of this version of mapf-env ({damage})") from damage

    def to_json(self) -> str:
        """The settings as text."""
        return json.dumps(asdict(self), indent=2) + "\n"


def _table(found: Any, kind: type, ignore_unknown: bool) -> dict[str, Any]:
    """Return a JSON object as arguments of a dataclass."""
    if not isinstance(found, dict):
        raise TypeError(f"expected an object of settings, got {type(found).__name__}")
    known = {each.name for each in fields(kind)}
    return {name: value for name, value in found.items() if name in known or not ignore_unknown}


_QUICK = TrainConfig(
    policy=PolicyConfig(encoder="lean"),
    train_maps=2000,
    cases_per_map=10,
    validation_cases_per_map=5,
    epochs=36,
    updates_per_epoch=800,
    batch_size=32,
    demonstration_steps=32_768,
    dagger_every=1,
    dagger_steps=16_384,
    fresh_share=0.75,
    augment=True,
    lr=2e-3,
)

RECIPES: dict[Recipe, TrainConfig] = {
    "quick": _QUICK,
    "full": replace(
        _QUICK,
        num_agents=12,
        styles=("cells", "walls"),
        train_maps=4000,
        cases_per_map=20,
        validation_cases_per_map=10,
        w=1.0,
        epochs=120,
        validate_every=20,
    ),
    "paper": TrainConfig(),
}
"""Complete sets of settings: one that takes about ten minutes on two CPU cores, that of the policy that comes with the
package, and the paper's."""
