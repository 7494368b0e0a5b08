"""The one training loop: collect, label, aggregate, fit, validate; round after round, resumable after each.

For the objective "delay" a round collects what the policy does, and fits that; nothing is labelled or kept.

A run folder holds
    config.toml                  the settings
    demonstrations/round_*.safetensors  labelled states, one file for each round of collection
    state.pt                     all that the next round needs, replaced as a whole after each round
    best.safetensors             the policy of the best validation so far
    metrics.csv, tensorboard/    one row for each round
    learning_curve.png           their picture
A round is a function of the settings, its number and the state before it: a run that was killed and resumed ends
exactly like one that was not.

Under torchrun several processes train together: each plays and labels its share of the teams of a round, all of them
hold all demonstrations, and each fits its share of every batch, whose gradients are averaged. The first alone reads
and writes the run folder and validates.
"""

from __future__ import annotations

import csv
import math
import pickle
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.tensorboard import SummaryWriter

from experts.cluster import connect
from gnn_policy import checkpoint, metrics
from gnn_policy.cases import Task
from gnn_policy.command_line import on_device
from gnn_policy.config import TrainConfig
from gnn_policy.cores import cpu_threads
from gnn_policy.dagger import Demonstrator, teams_side_by_side
from gnn_policy.demonstrations import BatchMaker, Demonstrations, Filler, Parts
from gnn_policy.finite import require_finite
from gnn_policy.half_batches import HalfBatches
from gnn_policy.imitation import EXPERT_ACTION, ImitationLoss
from gnn_policy.labelling import Labeller
from gnn_policy.learning_curve import Round, draw_learning_curve
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.precision import autocast
from gnn_policy.processes import Process
from gnn_policy.progress import TrainingProgress
from gnn_policy.reinforcement import EPOCHS, Critic, Explorer, loss_of
from gnn_policy.rollout import rollout
from gnn_policy.run_folder import lock_run, open_run
from mapf_env.files import replacing

CRITIC_LR, CRITIC_ROUNDS = 1e-3, 3
"""The critic's learning rate, and the rounds in which it learns alone."""
References = dict[Task, metrics.ReferenceSet]
"""The validation cases of each task."""


class Training:
    """A training run in its folder; `run` goes on from the last finished round.

    `lock` keeps other processes out of the folder until `run` ends; enter it as a context manager around `run` to hold
    it longer.

    Args:
        config: The settings.
        folder: The run folder.
        progress: Shows each step of the work.
        process: This process, one of those that train together.
        clock: Measures seconds; `time.process_time` where the machine is shared.

    Raises:
        ValueError: If settings do not fit together, or a file of the run is damaged.
        FileExistsError: If the folder holds something else than an unfinished run with these settings.
    """

    def __init__(
        self,
        config: TrainConfig,
        folder: Path,
        progress: TrainingProgress,
        process: Process = Process(),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.config, self.folder, self.progress, self.process = config, folder, progress, process
        if config.objective == "delay" and process.count > 1:
            raise ValueError(
                f'the objective "delay" trains in one process, got {process.count}: start it without torchrun'
            )
        process.share("batch_size", config.batch_size)
        teams_side_by_side(config, process)
        self.threads = cpu_threads(config.threads, process.local_count)
        torch.set_num_threads(self.threads)
        torch.manual_seed(config.seed)
        self.policy = on_device(DecentralizedPolicy(config.policy, config.execution), config.device)
        if config.init is not None:
            _start_from(self.policy, config)
        self.loss = ImitationLoss(process.wrap(self.policy))
        alone = process.count == 1 and self.policy.head.weight.device.type == "cpu"
        self._halves = HalfBatches(self.policy, self.loss, config.precision, self.threads) if alone else None
        self._averaged = (
            AveragedModel(self.policy, multi_avg_fn=get_ema_multi_avg_fn(config.averaging), use_buffers=True)
            if config.averaging is not None
            else None
        )
        self._player = self.policy if self._averaged is None else cast(DecentralizedPolicy, self._averaged.module)
        self.critic = Critic(config.policy.features).to(self.policy.head.weight.device)
        optimizer = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[config.optimizer]
        parameters: list[dict[str, Any]] = [{"params": self.policy.parameters()}]
        if config.objective == "delay":
            parameters.append({"params": self.critic.parameters(), "lr": CRITIC_LR})
        self.optimizer = optimizer(
            parameters,
            lr=config.lr,
            betas=(config.beta1, 0.999),
            weight_decay=config.weight_decay,
            fused=True,
        )
        self.scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(self.optimizer, config.rounds, config.final_lr)
        self.history: list[Round] = []
        self._seconds_before = 0.0
        self._clock, self._began = clock, clock()
        self._cases = config.cases("train")
        self._validation = config.cases("validation").by_task()
        config.cases("test")  # which the final evaluation would refuse after all the work
        self._labeller = Labeller(
            self._cases.grids,
            solver=config.expert,
            w=config.w,
            robot_order=config.robot_order,
            node_limit=config.expert_nodes,
            rounds=config.expert_iterations,
            threads=self.threads,
            clock=clock,
            cluster=config.cluster,
        )
        self._shards: list[Demonstrations] = []
        found: dict[str, Any] | None = None
        self.lock: AbstractContextManager[Any] = nullcontext()
        if process.rank == 0:
            self.lock = self._lock = lock_run(folder)
            try:
                open_run(folder, config)
            except BaseException:
                self._lock.release()
                raise
            (folder / "demonstrations").mkdir(exist_ok=True)
            found = self._read_state()
        found = process.from_first(found)
        if found is not None:
            self._restore(found)
        if process.rank == 0:
            self._shards = self._kept_shards()
        self._shards = process.from_first(self._shards)

    def run(self) -> None:
        """Train all remaining rounds."""
        with nullcontext() if self.config.cluster is None else connect(self.config.cluster, workers=self.threads):
            self._run()

    def _run(self) -> None:
        config, first = self.config, self.process.rank == 0
        references = self._reference_sets() if first else None
        if config.objective == "delay":
            collector = Explorer(config, self.policy, self.critic, self._labeller, self._cases)
            collect_and_fit = partial(self._explore_and_fit, collector)
        else:
            collector = Demonstrator(config, self._player, self._labeller, self._cases, self.process)
            batches = BatchMaker(self._cases.grids, config.policy, augment=config.augment)
            collect_and_fit = partial(self._demonstrate_and_fit, collector, batches)
        torch.set_num_threads(self.threads)  # collectors in processes of their own take threads away from this one
        writer = SummaryWriter(str(self.folder / "tensorboard"), purge_step=len(self.history)) if first else None
        torch.set_flush_denormal(True)  # the weights of units that are never active decay to such numbers
        try:
            for number in range(len(self.history), config.rounds):
                row = collect_and_fit(number)
                self.scheduler.step()
                if references is not None and (
                    (number + 1) % config.validate_every == 0 or number + 1 == config.rounds
                ):
                    self.progress.phase(number, "validation")
                    self._validate(row, references)
                row.seconds = self._seconds_before + self._clock() - self._began
                self.history.append(row)
                if writer is not None:
                    for name, value in asdict(row).items():
                        if value is not None and name != "round":
                            writer.add_scalar(name, value, number)
                    writer.flush()
                    self._save()
                self.progress.finished(row)
        finally:
            torch.set_flush_denormal(False)
            collector.close()
            if self._halves is not None:
                self._halves.close()
            torch.set_num_threads(self.threads)  # and give back more than they took
            self.loss = ImitationLoss(self.policy)  # which holds on to no group of processes
            if writer is not None:
                writer.close()
                self._lock.release()

    def _reference_sets(self) -> References:
        config, sets = self.config, {}
        for task, cases in self._validation.items():
            if task == "lifelong":
                sets[task] = metrics.ReferenceSet.without_expert(cases.instances, metrics.LIFELONG_STEPS)
            else:
                sets[task] = metrics.ReferenceSet.prepare(
                    cases.instances,
                    w=config.w,
                    timeout=config.timeout,
                    threads=self.threads,
                    nodes=config.reference_nodes,
                    cluster=config.cluster,
                )
        return sets

    def _explore_and_fit(self, explorer: Explorer, number: int) -> Round:
        config, began = self.config, self._clock()
        self.progress.phase(number, "collecting")
        collected = explorer.collect(number, config.dagger_steps)
        between = self._clock()
        rng = np.random.default_rng([config.seed, number])
        learns, learned = number >= CRITIC_ROUNDS, []
        robots = 0
        updates = EPOCHS * sum(-(-len(each.states) // config.batch_size) for each in collected)
        for experience in [each for each in collected for _ in range(EPOCHS)]:
            for parts in explorer.batches(experience, rng):
                size, figures = sum(len(rows) for _, rows in parts), torch.zeros(2)
                self.optimizer.zero_grad()
                for bag, rows in parts:
                    with autocast(config.precision, self.policy.head.weight.device):
                        outcome = loss_of(self.policy, self.critic, bag, experience, rows)
                    (outcome.loss * len(rows) / size).backward()
                    figures += torch.stack(outcome).detach().cpu() * len(rows) / size
                if not learns:
                    self.policy.zero_grad()
                self._step()
                learned.append(figures.tolist())
                robots += size
                if self.progress.due() or len(learned) == updates:
                    self.progress.fitted(number, len(learned), updates, np.array(learned)[:, 0], robots)
        try:
            self._require_finite()
        except ValueError as damage:
            raise self._diverged(number, str(damage)) from damage
        states = sum(len(each.states) for each in collected)
        return self._row(
            updates=updates,
            samples=robots,
            collect_seconds=between - began,
            expert_seconds=0.0,
            fit_seconds=self._clock() - between,
            loss=sum(each.lost * len(each.states) for each in collected) / states,
            accuracy=float(np.mean(learned, axis=0)[1]),
            demonstrations=states,
            unlabelled=0,
        )

    def _row(self, *, updates: int, samples: int, **figures: Any) -> Round:
        """Return the row of the round after those of the history."""
        previous = self.history[-1] if self.history else None
        return Round(
            round=len(self.history),
            updates=updates + (previous.updates if previous else 0),
            samples=samples + (previous.samples if previous else 0),
            seconds=0.0,
            lr=float(self.scheduler.get_last_lr()[0]),
            **figures,
        )

    def _demonstrate_and_fit(self, demonstrator: Demonstrator, batches: BatchMaker, number: int) -> Round:
        config = self.config
        began, expert_seconds, unlabelled = self._clock(), self._labeller.seconds, 0
        if self._collects(number):
            self.progress.phase(number, "collecting")
            steps = config.dagger_steps if number else config.demonstration_steps
            shares = self.process.gather(demonstrator.collect(number, steps))
            collected = Demonstrations.concatenate([share for share, _ in shares])
            unlabelled = sum(count for _, count in shares)
            if self.process.rank == 0:
                collected.save(self._shard(number))
            self._shards.append(collected)
        demonstrations = Demonstrations.concatenate(self._shards)
        size = len(demonstrations)
        if config.kept_states is not None and size > config.kept_states:
            demonstrations = demonstrations.take(np.arange(size - config.kept_states, size))
        self._shards = [demonstrations]
        if len(demonstrations) == 0:
            raise ValueError("the expert solved none of the visited states: raise expert_nodes or make cases easier")
        between = self._clock()
        if self._halves is not None:
            torch.set_num_threads(self._halves.threads)
        loss, accuracy, updates, samples = self._fit(number, demonstrations, batches)
        torch.set_num_threads(self.threads)
        return self._row(
            updates=updates,
            samples=samples,
            collect_seconds=between - began,
            expert_seconds=self._labeller.seconds - expert_seconds,
            fit_seconds=self._clock() - between,
            loss=loss,
            accuracy=accuracy,
            demonstrations=len(demonstrations),
            unlabelled=unlabelled,
        )

    def _kept_shards(self) -> list[Demonstrations]:
        """Read the demonstrations of the rounds so far, as far back as they are kept."""
        shards: list[Demonstrations] = []
        limit = math.inf if self.config.kept_states is None else self.config.kept_states
        for number in reversed(range(len(self.history))):
            if self._collects(number) and sum(map(len, shards)) < limit:
                shards.insert(0, Demonstrations.load(self._shard(number)))
        return shards

    def _collects(self, number: int) -> bool:
        every = self.config.dagger_every
        if self.config.objective == "delay":
            return False
        return number == 0 or (every > 0 and number % every == 0)

    def _fit(self, number: int, demonstrations: Demonstrations, batches: BatchMaker) -> tuple[float, float, int, int]:
        """Mean loss and accuracy, and how many updates and robot states they were."""
        config = self.config
        rng = np.random.default_rng([config.seed, number])
        draws_of_network = np.random.SeedSequence([config.seed, number, self.process.rank]).generate_state(1)
        torch.manual_seed(int(draws_of_network[0]))  # as dropout makes them
        draws = self._draw(demonstrations, rng)
        updates = len(draws)
        self.policy.train()
        figures = torch.zeros(updates, 2, device=self.policy.head.weight.device)  # which stay there for a round
        robots = 0
        for update, parts in enumerate(batches.batches(demonstrations, draws, rng, ahead=figures.device.type != "cpu")):
            figures[update] = self._backward([part.to(figures.device) for part in parts])
            self._step()
            robots += sum(len(part[EXPERT_ACTION]) for part in parts)
            if self.progress.due() or update + 1 == updates:
                losses = figures[: update + 1, 0].cpu().numpy()
                if not np.isfinite(losses).all():
                    raise self._diverged(number, "the loss is not a finite number")
                self.progress.fitted(number, update + 1, updates, losses, robots)
        if self.process.count > 1:  # the last batch's statistics are each process's own
            for module in filter(None, (self.policy, self._averaged)):
                module.load_state_dict(self.process.from_first(module.state_dict()))
        try:
            self._require_finite()
        except ValueError as damage:
            raise self._diverged(number, str(damage)) from damage
        means = self.process.average(figures.mean(dim=0).cpu()).tolist()
        return means[0], means[1], updates, sum(self.process.gather(robots))

    def _backward(self, parts: list[TensorDict]) -> torch.Tensor:
        """Set the gradients; return the loss and accuracy (2,) of the batch."""
        if self._halves is not None:
            return self._halves.backward(parts)
        (batch,) = parts
        with autocast(self.config.precision, self.policy.head.weight.device):
            outcome = self.loss(batch)
        self.optimizer.zero_grad()
        outcome["loss_imitation"].backward()
        return torch.stack([outcome["loss_imitation"].detach(), outcome["accuracy"]])

    def _step(self) -> None:
        """Change the weights by their gradients."""
        if self.config.clip_norm is not None:
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.config.clip_norm)
        self.optimizer.step()
        if self._averaged is not None:
            self._averaged.update_parameters(self.policy)

    def _require_finite(self) -> None:
        """Check the weights, the batch statistics and the optimiser's moments."""
        require_finite(self.policy.state_dict())
        require_finite(self._player.state_dict())
        for number, moments in self.optimizer.state_dict()["state"].items():
            tensors = {f"{name} of parameter {number}": value for name, value in moments.items()}
            require_finite({name: value for name, value in tensors.items() if torch.is_tensor(value)}, "Adam's moments")

    def _diverged(self, number: int, why: str) -> ValueError:
        kept = f"the state after round {number} is kept in {self.folder}" if number else f"{self.folder} has no policy"
        return ValueError(
            f"training diverged in round {number + 1} with lr {self.config.lr:g}: {why.partition(':')[0]}; {kept}: "
            "choose a smaller --lr (or --weight-decay) and another folder with --run"
        )

    def _draw(self, demonstrations: Demonstrations, rng: np.random.Generator) -> list[Parts]:
        """Return this process's parts of each batch of a round.

        Without a number of steps every state is in one batch. With one, part of each batch comes from the newest states
        if any were aggregated since round 0.
        """
        config, size, parts = self.config, len(demonstrations), 1 if self._halves is None else 2
        if config.updates_per_round is None:
            order = rng.permutation(size)
            batches = np.array_split(order, -(-size // config.batch_size))
            return [self._divide(batch, parts) for batch in batches]
        aggregated = config.dagger_every > 0 and len(self.history) >= config.dagger_every
        newest = max(size - config.fresh_window, 0) if aggregated else 0
        if config.batch_robots is None:
            fresh = round(config.fresh_share * config.batch_size)
            first = np.repeat([newest, 0], [fresh, config.batch_size - fresh])
            batches = rng.integers(first, size, (config.updates_per_round, config.batch_size))
            return [self._divide(batch, parts) for batch in batches]
        fill = Filler(np.diff(demonstrations.states.offsets), newest, config.fresh_share, rng)
        pieces = parts * self.process.count
        drawn = [[fill(config.batch_robots // pieces) for _ in range(pieces)] for _ in range(config.updates_per_round)]
        return [batch[self.process.rank :: self.process.count] for batch in drawn]

    def _divide(self, batch: npt.NDArray[np.intp], parts: int) -> Parts:
        """Return this process's share of the states of a batch in parts, or as one if they are few.

        So batch norm always has several robots.
        """
        own = batch[self.process.rank :: self.process.count]
        return np.array_split(own, parts if len(own) >= 4 else 1)

    def _validate(self, row: Round, references: References) -> None:
        for task, reference in references.items():
            played = rollout(
                self._player,
                reference.instances,
                task=task,
                execution=self.config.rollout_execution,
                max_steps=reference.max_steps,
                seed=self.config.seed,
            )
            if task == "lifelong":
                row.validation_throughput = float(played.throughput.mean())
            else:
                result = metrics.score("validation", reference, played)
                row.validation_success = result.success_rate.mean
                row.validation_flowtime_increase = result.flowtime_increase.mean
        before = [each.merit for each in self.history if each.merit is not None]
        if row.merit is not None and all(row.merit > each for each in before):
            checkpoint.save(self._player, self.folder / "best.safetensors", training=self.config.to_toml())

    def _shard(self, number: int) -> Path:
        return self.folder / "demonstrations" / f"round_{number:04d}.safetensors"

    def _save(self) -> None:
        """Write the records of the round, then the state that says it is done."""
        state = {
            "processes": self.process.count,
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "averaged": None if self._averaged is None else self._averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scheduler": self.scheduler.state_dict(),
            "history": [asdict(row) for row in self.history],
        }
        with replacing(self.folder / "metrics.csv") as draft, draft.open("w", newline="") as file:
            table = csv.DictWriter(file, list(asdict(self.history[0])))
            table.writeheader()
            table.writerows(state["history"])
        if self.history[-1].merit is not None:
            with replacing(self.folder / "learning_curve.png") as draft:
                draw_learning_curve(self.history, draft)
        with replacing(self.folder / "state.pt") as draft:
            torch.save(state, draft)

    def _read_state(self) -> dict[str, Any] | None:
        file = self.folder / "state.pt"
        if not file.exists():
            return None
        try:
            return torch.load(file, weights_only=True, map_location="cpu")
        except (pickle.UnpicklingError, EOFError, KeyError, TypeError, ValueError, RuntimeError) as damage:
            raise self._damaged(damage) from damage

    def _restore(self, state: dict[str, Any]) -> None:
        try:
            processes = state["processes"]
            self.policy.load_state_dict(state["policy"])
            self.critic.load_state_dict(state["critic"])
            if self._averaged is not None:
                self._averaged.load_state_dict(state["averaged"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.scheduler.load_state_dict(state["scheduler"])
            self.history = [Round(**row) for row in state["history"]]
            self._require_finite()
            numbers = [each for row in state["history"] for each in row.values() if each is not None]
            if not np.isfinite(np.array(numbers, np.float64)).all():
                raise ValueError("a figure of a round is not a finite number")
        except (AttributeError, KeyError, TypeError, ValueError, RuntimeError, IndexError) as damage:
            raise self._damaged(damage) from damage
        if processes != self.process.count:
            raise ValueError(
                f"{self.folder} holds a run of {processes} processes, not of {self.process.count}: go on with as many, "
                "or choose another folder with --run"
            )
        self._seconds_before = self.history[-1].seconds

    def _damaged(self, damage: Exception) -> ValueError:
        why = str(damage).partition("\n")[0].partition(":")[0] or type(damage).__name__
        return ValueError(
            f"{self.folder / 'state.pt'} is damaged ({why}): choose another folder with --run, or delete this one"
        )


def _start_from(policy: DecentralizedPolicy, config: TrainConfig) -> None:
    """Give a policy the weights that the settings name.

    Raises:
        ValueError: If they belong to another network or other senses.
    """
    given = checkpoint.load(config.init or "", plugins=tuple(config.policy.plugins.values()))
    if given.config != config.policy:
        own, others = asdict(config.policy), asdict(given.config)
        differ = ", ".join(f"{name}: {others[name]!r}, not {own[name]!r}" for name in own if own[name] != others[name])
        raise ValueError(f"the policy {config.init} is another network than the one to train ({differ})")
    policy.load_state_dict(given.state_dict())
