"""The paper's experiment: train its models, test them on held-out maps, and draw its figures next to its numbers.

    python benchmarks/paper.py          everything; resumes after an interruption
    python benchmarks/paper.py plan     what is still to do, and how long that takes here
    python benchmarks/paper.py train    the models alone, one run folder of gnn_policy.train each
    python benchmarks/paper.py test     the finished models on the test maps
    python benchmarks/paper.py draw     figures and tables of what has been tested

Figure 2 is success and flowtime increase of models tested on teams of the size they were trained on, for K = 1, 2 and
3; figure 3 tests every model with K = 3 on every size, and the one of 12 robots that does not communicate. All models
see equally many robot states. Beyond the paper there are models for teams whose radius grows until they are connected,
and one that knows the map and is trained under the PIBT shield on denser maps. Each finished model
and each tested pair is a file; existing files are kept.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
import tyro
from rich.console import Console
from rich.progress import Progress

from gnn_policy import checkpoint, metrics
from gnn_policy.acting import tensors
from gnn_policy.command_line import run_command
from gnn_policy.failures import Failure, count_failures
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.policy_config import PolicyConfig
from gnn_policy.precision import autocast, resolved
from gnn_policy.progress import TrainingProgress
from gnn_policy.recipes import RECIPES
from gnn_policy.results_json import refuse_other_settings
from gnn_policy.rollout import rollout
from gnn_policy.run_folder import RunLockedError
from gnn_policy.training import Training
from mapf_env import Bag, BatchedEnv
from mapf_env.files import write_whole
from paper_experiment import Experiment, Model, Options, Scene, W
from paper_figures import draw

STEPS = {20: 36, 50: 90}
"""Approximate steps of an episode on a map of this side, to estimate the duration of the tests."""


def plan(experiment: Experiment, console: Console) -> None:
    """Print the remaining work and its duration on this machine."""
    torch.set_num_threads(experiment.threads)
    policies, untrained = _policies(experiment), experiment.untrained()
    untested = [
        (scene, model)
        for scene, model in _untested(experiment, policies)
        if model is None or model in policies or model in untrained
    ]
    hours = sum(map(_training_seconds, untrained)) / 3600
    threads = experiment.threads
    console.print(f"to train: {len(untrained)} models, about {hours:.1f} hours with {threads} thread(s)")
    hours = sum(_test_seconds(experiment, scene, model) for scene, model in untested if model) / 3600
    console.print(f"to test: {len(untested)} models and baselines, about {hours:.1f} hours for the models")


def train(experiment: Experiment, console: Console) -> None:
    """Train what is not trained and not being trained by another process; each model resumes by itself."""
    for model in experiment.untrained():
        console.rule(f"training {model.name}")
        config = replace(model.config, threads=experiment.threads)
        with TrainingProgress(config.rounds, console) as progress:
            try:
                training = Training(config, experiment.run_of(model), progress)
            except RunLockedError:
                console.print("another process is training it")
                continue
            training.run()


def test(experiment: Experiment, console: Console) -> None:
    """Play every trained model on the test cases; results that exist are kept."""
    torch.set_num_threads(experiment.threads)
    policies = _policies(experiment)
    todo: dict[Scene, list[Model | None]] = {}
    for scene, model in _untested(experiment, policies):
        if model is None or model in policies:
            todo.setdefault(scene, []).append(model)
    with Progress(console=console) as progress:
        task = progress.add_task("", total=sum(map(len, todo.values())))
        for scene, models in todo.items():
            progress.update(task, description=f"{scene.name}: expert")
            reference = _reference_set(experiment, scene)
            for model in models:
                path = experiment.result(scene, _name(model))
                if path.exists():  # another process was faster
                    progress.advance(task)
                    continue
                progress.update(task, description=f"{scene.name}: {_name(model)}")
                rows, failures = (
                    (metrics.baselines(reference), {})
                    if model is None
                    else _play(experiment, scene, model, policies[model], reference)
                )
                result = {
                    "settings": _settings(experiment, scene, model, policies),
                    **metrics.as_json(rows, reference),
                    "failures": failures,
                }
                path.parent.mkdir(parents=True, exist_ok=True)
                write_whole(path, json.dumps(result, indent=2) + "\n")
                progress.advance(task)


Policies = dict[Model, DecentralizedPolicy]
"""The models of the experiment that exist."""


def _policies(experiment: Experiment) -> Policies:
    return {model: checkpoint.load(path) for model in experiment.models if (path := experiment.policy_of(model))}


def _untested(experiment: Experiment, policies: Policies) -> Iterator[tuple[Scene, Model | None]]:
    """Return the scenes on which baselines (None) and models are still to be played.

    Raises:
        FileExistsError: If existing results have other settings.
    """
    for scene, model in [*((scene, None) for scene in experiment.scenes), *experiment.pairs()]:
        path = experiment.result(scene, _name(model))
        if not path.exists():
            yield scene, model
        elif model is None or model in policies:  # results that came without their model are taken as they are
            refuse_other_settings(path, _settings(experiment, scene, model, policies), "--folder")


def _settings(experiment: Experiment, scene: Scene, model: Model | None, policies: Policies) -> dict[str, object]:
    """Return everything that a result depends on except for the scene; baselines have no policy."""
    settings: dict[str, object] = {
        "cases_per_map": experiment.cases_per_map(scene),
        "w": W,
        "timeout": RECIPES["full"].timeout,
    }
    if model is not None:
        settings["rows"] = [each.name for each in experiment.executions(model, model.trained_for(scene))]
        settings["precision"] = resolved(experiment.options.precision, torch.device("cpu"))
        settings["policy"] = checkpoint.fingerprint(policies[model])
    return settings


def _name(model: Model | None) -> str:
    return model.name if model else "baselines"


def _reference_set(experiment: Experiment, scene: Scene) -> metrics.ReferenceSet:
    config = replace(
        RECIPES["full"],
        styles=(scene.style,),
        height=scene.size,
        width=scene.size,
        num_agents=scene.num_agents,
        cases_per_map=experiment.cases_per_map(scene),
    )
    return metrics.ReferenceSet.prepare(
        config.cases("test").instances, w=W, timeout=config.timeout, threads=experiment.threads
    )


def _play(
    experiment: Experiment, scene: Scene, model: Model, policy: DecentralizedPolicy, reference: metrics.ReferenceSet
) -> tuple[list[metrics.Score], dict[str, dict[Failure, int]]]:
    """Return a row for each execution of the model, and the failures of its teams."""
    rows, failures = [], {}
    for execution in experiment.executions(model, model.trained_for(scene)):
        with autocast(experiment.options.precision, torch.device("cpu")):
            played = rollout(policy, reference.instances, execution=execution, max_steps=reference.max_steps)
        rows.append(metrics.score(execution.name, reference, played))
        failures[execution.name] = count_failures(played)
    return rows, failures


def _training_seconds(model: Model) -> float:
    """Estimate the duration of a training: its gradient steps, and two fifths more for everything else."""
    config = model.config
    policy = DecentralizedPolicy(config.policy)
    optimizer = torch.optim.Adam(policy.parameters(), fused=True)
    bag = _bag(config.policy, config.batch_size, model.num_agents)

    def step() -> None:
        optimizer.zero_grad()
        with autocast(config.precision, bag.fov.device):
            logits = policy(bag)
        logits.float().square().mean().backward()
        optimizer.step()

    return 1.4 * config.rounds * (config.updates_per_round or 0) * _seconds(step)


def _test_seconds(experiment: Experiment, scene: Scene, model: Model) -> float:
    """Estimate the duration of a test: the network's forward passes, and a quarter more for everything else."""
    policy = DecentralizedPolicy(model.config.policy).eval()
    bag = _bag(model.config.policy, 64, scene.num_agents)
    with torch.inference_mode(), autocast(experiment.options.precision, bag.fov.device):
        each = _seconds(lambda: policy(bag), times=2) / 64
    cases = model.config.test_maps * experiment.cases_per_map(scene)
    return 1.25 * each * cases * STEPS[scene.size] * len(experiment.executions(model, model.trained_for(scene)))


def _bag(policy: PolicyConfig, teams: int, num_agents: int) -> Bag:
    """Return what the robots of some teams perceive at the start, as tensors."""
    env = BatchedEnv(teams, num_agents=num_agents, **policy.senses())
    env.reset(0, observe=False)
    return tensors(env.bag())


def _seconds(action: Callable[[], object], times: int = 20) -> float:
    """Return the seconds of one call, after a warm-up."""
    action()
    began = time.perf_counter()
    for _ in range(times):
        action()
    return (time.perf_counter() - began) / times


def main(options: Options) -> None:
    """Do the chosen part."""
    experiment, console = Experiment(options), Console()
    if options.step in ("all", "plan"):
        plan(experiment, console)
    if options.step in ("all", "train"):
        train(experiment, console)
    if options.step in ("all", "test"):
        test(experiment, console)
    if options.step in ("all", "draw"):
        for path in draw(experiment):
            console.print(path, highlight=False)


if __name__ == "__main__":
    run_command(lambda arguments: tyro.cli(Options, args=arguments, description=__doc__), main)
