"""A number that is not finite is never a result: training stops, and nothing loads, saves or plays it."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch
from rich.console import Console

from gnn_policy import (
    DecentralizedPolicy,
    Execution,
    Message,
    PolicyConfig,
    Robot,
    checkpoint,
    evaluate,
    load,
    play,
    rollout,
    save,
    train,
)
from gnn_policy.progress import TrainingProgress
from gnn_policy.training import Training
from mapf_env import random_instance, save_map
from small_training import CONFIG, arguments_for

BAD = (math.nan, math.inf, -math.inf)
SMALL = PolicyConfig(encoder="lean", features=8, fov_radius=2, comm_radius=3.0)


def quiet(config):
    return TrainingProgress(config.rounds, Console(quiet=True))


@pytest.fixture
def policy():
    torch.manual_seed(0)
    return DecentralizedPolicy(SMALL).eval()


def damaged_file(policy, path, name, value):
    """A file as `save` writes it, with one number changed."""
    save(policy, path)
    weights = safetensors.torch.load_file(path)
    weights[name].view(-1)[-1] = value
    path.write_bytes(safetensors.torch.save(weights, checkpoint.about(path)))
    return path


@pytest.mark.parametrize("settings", [{"lr": 1e20}, {"lr": 1e38}, {"weight_decay": 1e30}, {"lr": 1e12, "rounds": 2}])
def test_training_that_diverges_stops_with_one_line_and_no_policy(tmp_path, capsys, settings):
    config = replace(CONFIG, validate_every=1, **settings)
    with pytest.raises(SystemExit) as end:
        train.main(arguments_for(config, tmp_path / "run"))
    assert end.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ")
    assert told.count("\n") == 1
    assert "--lr" in told
    if (tmp_path / "run" / "best.safetensors").exists():
        load(tmp_path / "run")
    assert not (tmp_path / "run" / "results.json").exists()


@pytest.mark.parametrize("where", ["loss", "weight", "statistics", "moments"])
def test_the_last_sound_state_is_kept_and_a_damaged_one_is_not_resumed(tmp_path, monkeypatch, where):
    config = replace(CONFIG, validate_every=1)
    folder = tmp_path / "run"
    run = Training(config, folder, quiet(config))
    fit, sound = run.loss.forward, {}

    def poisoned(batch):
        outcome = fit(batch)
        if len(run.history) == 1:
            sound.update({each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()})
            tensor = {
                "loss": None,
                "weight": run.policy.head.bias,
                "statistics": next(t for n, t in run.policy.named_buffers() if n.endswith("running_var")),
                "moments": run.optimizer.state[run.policy.head.bias]["exp_avg_sq"],
            }[where]
            if tensor is None:
                outcome["loss_imitation"] = outcome["loss_imitation"] * math.nan
            else:
                tensor.data[-1] = math.inf
        return outcome

    monkeypatch.setattr(run.loss, "forward", poisoned)
    with pytest.raises(ValueError, match=r"diverged in round 2 .*the state after round 1 is kept.*--lr"):
        run.run()
    assert sound["state.pt"]
    for name, content in sound.items():
        assert (folder / name).read_bytes() == content, name
    with (folder / "metrics.csv").open(newline="") as file:
        assert [math.isfinite(float(row["loss"])) for row in csv.DictReader(file)] == [True]
    again = Training(config, folder, quiet(config))
    assert len(again.history) == 1
    again.run()
    assert len(again.history) == config.rounds

    state = torch.load(folder / "state.pt", weights_only=True)
    match where:
        case "loss":
            state["history"][0]["loss"] = math.nan
        case "weight":
            state["policy"]["head.bias"][0] = math.nan
        case "statistics":
            name = next(each for each in state["policy"] if each.endswith("running_mean"))
            state["policy"][name][0] = math.inf
        case "moments":
            state["optimizer"]["state"][0]["exp_avg"].fill_(math.nan)
    torch.save(state, folder / "state.pt")
    with pytest.raises(ValueError, match=r"state\.pt is damaged .*not .*finite"):
        Training(config, folder, quiet(config))


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("name", ["head.bias", "graph_layer.mix.weight", "encoder.1.running_var"])
def test_no_call_takes_weights_that_are_not_finite(policy, tmp_path, capsys, name, value, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = damaged_file(policy, tmp_path / "bad.safetensors", name, value)
    with pytest.raises(checkpoint.CheckpointError, match=rf"bad\.safetensors: .*not finite .*{name}"):
        load(file)
    save_map("own.map", np.zeros((4, 4), bool))
    for command, arguments in ((play, ["own.map", "--agents", "2", "--policy", str(file)]), (evaluate, [str(file)])):
        with pytest.raises(SystemExit) as end:
            command.main(arguments)
        assert end.value.code == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.glob("*.html"))
    with torch.no_grad():
        policy.state_dict()[name].view(-1)[-1] = value
    for call in (
        lambda: save(policy, tmp_path / "new.safetensors"),
        lambda: Robot(policy),
        lambda: rollout(policy, [random_instance(height=5, width=5, num_agents=2, seed=0)], max_steps=5),
    ):
        with pytest.raises(ValueError, match="not finite"):
            call()
    assert not (tmp_path / "new.safetensors").exists()


def test_a_weight_that_does_not_fit_the_networks_numbers_is_refused(policy, tmp_path):
    save(policy, tmp_path / "wide.safetensors")
    weights = safetensors.torch.load_file(tmp_path / "wide.safetensors")
    weights["head.bias"] = weights["head.bias"].double() + 1e300
    notes = checkpoint.about(tmp_path / "wide.safetensors")
    (tmp_path / "wide.safetensors").write_bytes(safetensors.torch.save(weights, notes))
    with pytest.raises(checkpoint.CheckpointError, match="not finite"):
        load(tmp_path / "wide.safetensors")


class Network(torch.nn.Module):
    """A network of the user's own whose logits are as given."""

    config = SMALL

    def __init__(self, logit):
        super().__init__()
        self.logit = logit

    def forward(self, bag):
        logits = torch.zeros(len(bag.fov), 5)
        logits[int((bag.team == 0).sum()) - 1, 2] = self.logit
        return logits


class Scores:
    def __init__(self, score):
        self.score = score

    def env_settings(self):
        return {"fov_radius": 1, "shield": "pibt"}

    def act(self, env):
        scores = np.zeros((env.num_envs, env.num_agents, 5), np.float32)
        scores[0, 0, 0] = self.score
        return scores


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("shield", ["idle", "pibt"])
def test_logits_that_are_not_finite_are_not_played(value, shield):
    cases = [random_instance(height=5, width=5, num_agents=3, seed=seed) for seed in range(2)]
    with pytest.raises(ValueError, match=r"not finite"):
        rollout(Network(value), cases, execution=Execution(shield=shield), max_steps=5)
    rollout(Network(1.0), cases, execution=Execution(shield=shield), max_steps=5)


@pytest.mark.parametrize("value", BAD)
def test_scores_of_an_actor_that_are_not_finite_are_not_played(value):
    cases = [random_instance(height=5, width=5, num_agents=3, seed=seed) for seed in range(2)]
    with pytest.raises(ValueError, match=r"Scores\.act returned values that are not finite"):
        rollout(Scores(value), cases, max_steps=5)
    rollout(Scores(1.0), cases, max_steps=5)


def test_a_temperature_that_makes_logits_infinite_is_refused():
    cases = [random_instance(height=5, width=5, num_agents=3, seed=0)]
    with pytest.raises(ValueError, match="temperature of 1e-300"):
        rollout(Network(1.0), cases, execution=Execution(actions="sampled", temperature=1e-300), max_steps=5)


def test_a_robot_refuses_views_and_messages_that_are_not_finite(policy):
    robot = Robot(policy, Execution())
    view = np.zeros((3, 7, 7), np.float32)
    with pytest.raises(ValueError, match="view"):
        robot.begin(np.full_like(view, math.nan), {}, (0, 0))
    for value in BAD:
        robot.begin(view, {"a": 1.0}, (0, 0))
        with pytest.raises(ValueError, match="'a' sent features that are not finite"):
            robot.hear({"a": Message(np.full(8, value, np.float32), False)})
