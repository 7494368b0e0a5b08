"""Every setting of training, each default written once."""

from __future__ import annotations

import math
import tomllib
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import tomli_w

from gnn_policy.cases import Cases, Family, Split, Task, cases_of_files, make_cases
from gnn_policy.execution import Actions, Execution
from gnn_policy.policy_config import PolicyConfig
from gnn_policy.settings import check_types
from mapf_env.arguments import known_settings, lists_settings, share
from mapf_env.files import write_whole
from mapf_env.generation import MapStyle

Objective = Literal["imitation", "delay"]
RobotOrder = Literal["index", "random", "farthest", "nearest"]
Aggregation = Literal["visited", "failed", "plans"]
Backend = Literal["direct", "process"]
Precision = Literal["auto", "float32", "bfloat16"]
Optimizer = Literal["adam", "adamw"]


@lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """The settings of a training run; as written here they are those of the paper's setup section."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """The network and what it perceives."""
    init: str | None = None
    """Start from the weights of a policy: a run folder, a .safetensors file, or the name of a packaged policy. As an
    option it also takes the network, its senses and its execution from there. Random weights if not given."""

    num_agents: int = 10
    """Robots N in a training team."""
    height: int = 20
    """Rows of a map."""
    width: int = 20
    """Columns of a map."""
    density: float = 0.1
    """Share of obstacles on a map."""
    styles: tuple[MapStyle, ...] = ("cells",)
    """Obstacles: independent "cells", short "walls" as the authors' generator makes them, or "maze", "room",
    "warehouse" and "empty", which ignore the density; the maps of a split take turns among the styles."""
    task: Task = "one_shot"
    """"lifelong": a robot that arrives gets a new goal, and validation and evaluation measure throughput. Families
    have tasks of their own."""
    families: tuple[Family, ...] = ()
    """Families of random cases with ranges of sizes, densities and team sizes, instead of the five settings above; in a
    configuration file, one [[families]] table for each."""
    files: tuple[str, ...] = ()
    """Your own maps (.map, .yaml), scenarios (.scen) and sets of instances (.json), or folders of them, instead of
    random maps. The splits share no map if there are three or more; otherwise they share maps, but neither starts nor
    goals."""
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
    reference_nodes: int = 200_000
    """Nodes that ECBS may generate for a validation or test case before LaCAM plans it; take fewer for crowds."""

    expert: str = "ecbs"
    """The solver that shows the moves: "ecbs" (in lifelong tasks the planner with a rolling horizon takes its place),
    "lacam", "prioritised", "pibt", or one of your own as "module:function"."""
    w: float = 1.05
    """ECBS's cost is at most w times the lower bound of the optimum, both for labels and for the plans that set T_max;
    other solvers are called without a w."""
    robot_order: RobotOrder = "index"
    """The order in which the expert is given the robots of a state, by which solvers break ties: that of their
    numbers, "random" in each state, or by the Manhattan distance to their goals, "farthest" or "nearest" first."""
    expert_nodes: int = 2000
    """Nodes that ECBS or LaCAM may generate to label a state; unlabelled states are counted and left out."""
    expert_iterations: int = 400
    """Rounds of the neighbourhood search that improves LaCAM's plans in an aggregation of "plans"; more rounds give
    cheaper plans and take longer."""

    objective: Objective = "imitation"
    """"imitation" of the expert; or "delay", for a policy that has learned to imitate (`init`): reinforcement learning
    from the steps that robots lose, with no expert. A round then plays `dagger_steps` team steps and fits them twice in
    batches of `batch_size` states."""
    discount: float = 0.95
    """Weight of what is lost one step later, for the objective "delay"."""
    neighbour_share: float = 0.5
    """Weight of what a robot next to oneself loses, for the objective "delay"."""

    rounds: int = 150
    """Rounds of collecting and fitting; round 0 imitates the expert, the others aggregate what the policy visits."""
    updates_per_round: int | None = None
    """Gradient steps in a round; if not given, one pass over all demonstrated states."""
    batch_size: int = 64
    """Team states in a gradient step."""
    batch_robots: int | None = None
    """Robot states in a gradient step, for teams of mixed sizes: so many teams are drawn as have this number of robots
    together, where their sizes allow it. Needs `updates_per_round`; `batch_size` is then not used."""
    demonstration_steps: int = 524_288
    """Team steps played in round 0, by the expert."""
    aggregation: Aggregation = "visited"
    """States to aggregate: every "visited" state; plans from where teams that "failed" stood at the end, as in the
    authors' code; or the first steps of "plans" from some of the visited states, which costs the expert least."""
    plan_steps: int = 24
    """Steps of each plan that are labelled in an aggregation of "plans"."""
    stuck_weight: float = 1.0
    """Weight of states with a stuck robot when the starts of such plans are drawn; other states have weight 1."""
    dagger_every: int = 4
    """Rounds from one aggregation to the next; 0 for plain imitation."""
    dagger_steps: int = 32_768
    """Team steps played in each aggregation, at least: as many times rollout_teams x rollout_length as that takes."""
    beta_decay: float = 0.0
    """DAgger's beta in round r is beta_decay ** r: the probability that a team step follows the expert, not the
    policy."""
    fresh_share: float = 0.5
    """Share of a batch drawn from the newest states if `updates_per_round` is given; the rest comes from all of
    them."""
    fresh_window: int = 65_536
    """Number of states that count as the newest."""
    kept_states: int | None = None
    """Number of newest states to keep; older ones are dropped. All are kept if not given."""
    rollout_length: int = 64
    """Steps that a team plays in a round."""
    rollout_teams: int = 128
    """Teams that are played at the same time."""
    backend: Backend = "direct"
    """Process of the rollouts: "direct" for this one, "process" for as many others as `collectors`."""
    collectors: int = 1
    """Collectors that share the rollout_teams of one process; each has its own seed."""
    hard_case_mining: int = 1
    """Team steps played for each labelled one; teams that did not arrive in the round are labelled first."""
    execution: Execution = Execution(actions="stuck")
    """Execution of the policy, saved with the weights. Rollouts in training and validation use it too, except for
    `rollout_actions`."""
    rollout_actions: Actions = "argmax"
    """Choice of actions in rollouts of training and validation: "argmax", "sampled", "stuck" or
    "fallback", as in `Execution.actions`."""
    augment: bool = False
    """Rotate and reflect every demonstrated state at random."""

    optimizer: Optimizer = "adam"
    """"adamw" applies the weight decay to the weights, "adam" adds it to their gradients."""
    lr: float = 1e-3
    """The first learning rate."""
    final_lr: float = 1e-6
    """The learning rate at the end of the cosine decay."""
    beta1: float = 0.9
    """Adam's momentum."""
    weight_decay: float = 1e-5
    """Strength of the weight decay."""
    clip_norm: float | None = None
    """Scale gradients down to this norm; not clipped if not given."""
    averaging: float | None = None
    """Keep an exponential moving average of the weights with this decay per gradient step. The average plays in the
    rollouts, is validated and is saved; if not given, the weights themselves."""

    validate_every: int = 5
    """Rounds from one validation to the next."""
    seed: int = 0
    """Random seed for weights, batches and rollouts."""
    data_seed: int = 0
    """Random seed for the maps and cases of all three splits."""
    threads: int = 0
    """CPU threads; 0 takes as many as affinity, cgroup quota and OMP_NUM_THREADS allow."""
    cluster: str | None = None
    """Address of a Ray cluster that labels the states and evaluates the policy, "auto" for the cluster of this machine
    or "local" for processes here; the results are the same. Needs the extra `cluster`."""
    precision: Precision = "auto"
    """Number format of the network in training: "bfloat16", "float32", or "auto" for bfloat16 where the hardware has
    it."""
    device: str = "auto"
    """Device of the network: "cpu", "cuda", "mps", or "auto" for the fastest one available."""

    def __post_init__(self) -> None:
        check_types(self)
        positive = (
            "num_agents train_maps validation_maps test_maps cases_per_map validation_cases_per_map timeout "
            "reference_nodes expert_nodes rounds batch_size demonstration_steps dagger_steps fresh_window "
            "rollout_length rollout_teams plan_steps hard_case_mining collectors lr final_lr validate_every "
            "expert_iterations stuck_weight"
        )
        for name in positive.split():
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        for name in ("dagger_every", "weight_decay", "seed", "data_seed", "threads"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {getattr(self, name)}")
        for name in ("density", "beta_decay", "fresh_share", "discount"):
            share(getattr(self, name), name)
        for name in ("beta1", "averaging"):
            if (value := getattr(self, name)) is not None and not 0 <= value < 1:
                raise ValueError(f"{name} must lie in [0, 1), got {value}")
        if self.clip_norm is not None and not 0 < self.clip_norm < math.inf:
            raise ValueError(f"clip_norm must be positive and finite, got {self.clip_norm}")
        if self.kept_states is not None and self.kept_states < 1:
            raise ValueError(f"kept_states must be at least 1, got {self.kept_states}")
        if self.batch_robots is not None and (self.batch_robots < 1 or self.updates_per_round is None):
            raise ValueError(
                f"batch_robots must be at least 1 and needs updates_per_round, got {self.batch_robots} and "
                f"{self.updates_per_round}"
            )
        for name in ("seed", "data_seed"):
            if getattr(self, name) >= 2**64:
                raise ValueError(f"{name} must be below 2**64, got {getattr(self, name)}")
        if not 0 <= self.neighbour_share < math.inf:
            raise ValueError(f"neighbour_share must be finite and not negative, got {self.neighbour_share}")
        if self.objective == "delay" and self.rollout_actions == "sampled":
            raise ValueError(
                'the objective "delay" needs robots that do not sample: rollout_actions "argmax", "stuck" or "fallback"'
            )
        if self.backend == "direct" and self.collectors > 1:
            raise ValueError(f'{self.collectors} collectors need processes of their own: backend "process"')
        if not 1 <= self.w < math.inf:
            raise ValueError(f"w must be at least 1 and finite, got {self.w}")
        if self.updates_per_round is not None and self.updates_per_round < 1:
            raise ValueError(f"updates_per_round must be at least 1, got {self.updates_per_round}")

    @property
    def rollout_execution(self) -> Execution:
        """The execution in rollouts of training and validation."""
        return replace(self.execution, actions=self.rollout_actions)

    @property
    def case_families(self) -> tuple[Family, ...]:
        """The families of random cases."""
        alike = Family(
            height=(self.height, self.height),
            width=(self.width, self.width),
            density=(self.density, self.density),
            num_agents=(self.num_agents, self.num_agents),
            task=self.task,
        )
        return self.families or tuple(replace(alike, style=style) for style in self.styles)

    @property
    def tasks(self) -> set[Task]:
        """The tasks of the cases."""
        return {self.task} if self.files else {family.task for family in self.case_families}

    def cases(self, split: Split, *, whole: bool = False) -> Cases:
        """Return the cases of a split; with `whole` all cases of the files, if there are files.

        Raises:
            ValueError: If a family has no map or no room for its robots, or a file does not fit.
            OSError: If a file cannot be read.
        """
        maps, cases_per_map = self.size_of(split)
        if self.files:
            return cases_of_files(
                split,
                self.files,
                seed=self.data_seed,
                cases_per_map=cases_per_map,
                num_agents=self.num_agents,
                task=self.task,
                whole=whole,
            )
        families = self.case_families
        cases = make_cases(split, seed=self.data_seed, maps=maps, cases_per_map=cases_per_map, families=families)
        missing = {*range(len(families))} - {*cases.family_of.tolist()}
        if missing:
            first = families[min(missing)]
            raise ValueError(
                f"{split}_maps = {maps} leaves {len(missing)} of {len(families)} families without a map, the first of "
                f'them style "{first.style}" with share {first.share:g}: give more maps, or fewer families'
            )
        return cases

    def size_of(self, split: Split) -> tuple[int, int]:
        """Return the number of maps of a split, and of cases on each."""
        return {
            "train": (self.train_maps, self.cases_per_map),
            "validation": (self.validation_maps, self.validation_cases_per_map),
            "test": (self.test_maps, self.cases_per_map),
        }[split]

    def require_same_settings(self, found: TrainConfig, what: str, option: str) -> None:
        """Check that found settings equal these, except for `threads`, `cluster` and `device`.

        Args:
            found: The settings of the existing run or model.
            what: Beginning of the message: the place and what it holds, as "runs/quick holds a run with".
            option: The option of the command that names the folder.

        Raises:
            FileExistsError: If other settings differ; the message names them.
        """
        own, others = asdict(self), asdict(found)
        differ = [name for name in own if own[name] != others[name] and name not in ("threads", "cluster", "device")]
        if differ:
            raise FileExistsError(f"{what} other settings ({', '.join(differ)}): choose another folder with {option}")

    def save(self, path: Path) -> None:
        """Write the settings as TOML."""
        write_whole(path, self.to_toml())

    @staticmethod
    def load(path: Path) -> TrainConfig:
        """Read settings from a TOML file; those that are missing have their defaults.

        Raises:
            ValueError: If the file is damaged or has settings that this version does not know.
        """
        try:
            return TrainConfig.from_toml(path.read_text(encoding="utf-8"))
        except ValueError as damage:
            raise ValueError(f"{path}: {damage}") from damage

    @staticmethod
    def from_toml(text: str, *, ignore_unknown: bool = False) -> TrainConfig:
        """Return the settings that `to_toml` wrote.

        Args:
            text: The settings.
            ignore_unknown: Leave out settings that this version does not know, such as those of a newer one.

        Raises:
            ValueError: If the text is damaged, a value has the wrong type or lies out of range, or a setting is unknown
                and not left out.
        """
        try:
            settings = _settings(tomllib.loads(text), TrainConfig, ignore_unknown)
            defaults = TrainConfig()
            for name, default in (("policy", defaults.policy), ("execution", defaults.execution)):
                if name in settings:
                    settings[name] = replace(default, **_settings(settings[name], type(default), ignore_unknown))
            if "families" in settings:
                settings["families"] = tuple(
                    Family(**_settings(each, Family, ignore_unknown)) for each in settings["families"]
                )
            return TrainConfig(**settings)
        except (ValueError, KeyError, TypeError, RecursionError) as damage:
            raise ValueError(f"not the settings of a training of this version of mapf-env ({damage})") from damage

    def to_toml(self) -> str:
        """Return the settings as text; `None` is the default of every setting that can have it, and is left out."""
        return tomli_w.dumps(_written(asdict(self)))


def _settings(found: Any, kind: type, ignore_unknown: bool) -> dict[str, Any]:
    """Convert a TOML table to the arguments of a dataclass, with tuples for its arrays."""
    if not isinstance(found, dict):
        raise TypeError(f"expected a table of settings, got {type(found).__name__}")
    known = {each.name for each in fields(kind)}
    if not ignore_unknown:
        known_settings(found, known)
    return {name: tuple(value) if isinstance(value, list) else value for name, value in found.items() if name in known}


def _written(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _written(each) for name, each in value.items() if each is not None}
    return [_written(each) for each in value] if isinstance(value, tuple | list) else value
