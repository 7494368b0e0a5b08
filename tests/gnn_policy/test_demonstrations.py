"""Demonstrations: what training sees is what play sees, and files are whole or say so."""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy
import torch

from gnn_policy.cases import make_cases
from gnn_policy.demonstrations import EXPERT_ACTION, BatchMaker, Demonstrations
from gnn_policy.network import DecentralizedPolicy, PolicyConfig
from gnn_policy.team_env import FOV, GRAPH
from mapf_env import parallel_env

SHAPES = [(7, 7), (5, 9)]
PERCEIVED = PolicyConfig(encoder="lean", fov_radius=2, comm_radius=3.0)
STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]


def turned_by_numpy(array, g):
    """The last two axes under symmetry g: a reflection of the columns for g >= 4, then g % 4 quarter turns."""
    return np.rot90(np.flip(array, -1) if g >= 4 else array, g % 4, axes=(-2, -1))


def random_states(shape, count=40, seed=0):
    """Cases on three maps, and random states and moves of them."""
    generator = np.random.default_rng(seed)
    cases = make_cases(
        "train",
        seed=seed,
        maps=3,
        cases_per_map=2,
        num_agents=3,
        height=shape[0],
        width=shape[1],
        density=0.15,
        styles=["cells"],
    )
    chosen = generator.integers(len(cases), size=count)
    positions = np.stack([generator.permutation(np.argwhere(~cases[i].grid))[:3] for i in chosen])
    moves = generator.integers(5, size=(count, 3))
    return cases, Demonstrations(chosen.astype(np.int32), positions.astype(np.int16), moves.astype(np.int8))


def connects(positions, radius):
    """Whether all robots reach each other over robots closer than `radius`."""
    reached, rest = [positions[0]], list(positions[1:])
    for here in reached:
        near = [there for there in rest if math.dist(here, there) < radius]
        rest = [there for there in rest if math.dist(here, there) >= radius]
        reached += near
    return not rest


def seen_in_play(case, positions, config):
    """What the PettingZoo environment shows in a state: (N, C, F, F) and (N, N)."""
    height, width = case.grid.shape
    radius = config.comm_radius
    while config.comm_range == "connected" and not connects(case.starts.tolist(), radius):
        radius *= 1.1
    env = parallel_env(
        num_agents=3,
        height=height,
        width=width,
        fov_radius=config.fov_radius,
        extra_channels=("cost_to_go",) if config.cost_to_go else (),
        comm_radius=radius,
        comm_weights=config.comm_weights,
    )
    seen, _ = env.reset(seed=0, options={"instance": case.at(positions)})
    return np.stack([each["fov"] for each in seen.values()]), np.stack([each["graph"] for each in seen.values()])


@pytest.mark.parametrize(
    "config",
    [
        PERCEIVED,
        replace(PERCEIVED, comm_range="connected"),
        replace(PERCEIVED, comm_weights="distance"),
        replace(PERCEIVED, cost_to_go=True, comm_range="connected", comm_weights="distance"),
    ],
)
@pytest.mark.parametrize("shape", SHAPES)
def test_without_augmentation_a_batch_is_what_play_shows(shape, config):
    cases, states = random_states(shape)
    batches = BatchMaker(cases, config, augment=False)
    chosen = np.array([5, 0, 39, 5, 17])
    batch = batches.batch(states, chosen, np.random.default_rng(0))
    assert batch.batch_size == (5,)
    read = []
    policy = DecentralizedPolicy(config)
    policy.encoder.register_forward_pre_hook(lambda module, inputs: read.append(inputs[0].clone()))
    policy(batch[FOV], batch[GRAPH])
    for row, index in enumerate(chosen):
        views, graph = seen_in_play(cases[states.cases[index]], states.positions[index], config)
        assert batch[FOV].dtype == torch.uint8
        np.testing.assert_allclose(read[0].unflatten(0, (5, 3))[row], views, atol=1e-6)
        assert np.array_equal(np.asarray(batch[GRAPH])[row], graph)
        assert np.array_equal(np.asarray(batch[EXPERT_ACTION])[row], states.actions[index])


@pytest.mark.parametrize("shape", SHAPES)
def test_augmentation_turns_views_and_labels_together_and_uses_every_symmetry(shape):
    cases, states = random_states(shape)
    batches = BatchMaker(cases, PERCEIVED, augment=True)
    index = 11
    batch = batches.batch(states, np.full(200, index), np.random.default_rng(0))
    views, graph = seen_in_play(cases[states.cases[index]], states.positions[index], PERCEIVED)
    used = set()
    for row in range(200):
        matching = [g for g in range(8) if np.array_equal(np.asarray(batch[FOV])[row], turned_by_numpy(views, g))]
        assert len(matching) == 1
        labels = np.asarray(batch[EXPERT_ACTION])[row].tolist()
        for robot, label in enumerate(labels):
            step = np.zeros((3, 3))
            down, right = STEPS[states.actions[index, robot]]
            step[1 + down, 1 + right] = 1
            down, right = STEPS[label]
            assert turned_by_numpy(step, matching[0])[1 + down, 1 + right] == 1
        assert np.array_equal(np.asarray(batch[GRAPH])[row], graph)
        used.add(matching[0])
    assert used == (set(range(8)) if shape[0] == shape[1] else {0, 2, 4, 6})


def test_equal_generators_give_equal_batches():
    cases, states = random_states((7, 7))
    batches = BatchMaker(cases, PERCEIVED, augment=True)
    one, two = (batches.batch(states, np.arange(20), np.random.default_rng(5)) for _ in range(2))
    assert (one == two).all()


def test_files_round_trip_and_concatenation_keeps_the_order(tmp_path):
    parts = [random_states((7, 7), count, seed=count)[1] for count in (3, 1, 20)]
    whole = Demonstrations.concatenate(parts)
    whole.save(tmp_path / "states.safetensors")
    again = Demonstrations.load(tmp_path / "states.safetensors")
    assert len(again) == 24
    for name in ("cases", "positions", "actions"):
        stored = getattr(again, name)
        assert stored.dtype == getattr(whole, name).dtype
        assert np.array_equal(stored, np.concatenate([getattr(part, name) for part in parts]))
    assert os.listdir(tmp_path) == ["states.safetensors"]


def test_damaged_files_say_so(tmp_path):
    file = tmp_path / "states.safetensors"
    random_states((7, 7))[1].save(file)
    content = file.read_bytes()
    foreign = safetensors.numpy.save({"weights": np.zeros(3)})
    for damaged in (b"", content[:5], content[:100], content[:-1], b"\xff" * len(content), foreign):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"states\.safetensors is damaged"):
            Demonstrations.load(file)


def test_a_crash_in_the_middle_of_writing_leaves_the_old_file(tmp_path, monkeypatch):
    file = tmp_path / "states.safetensors"
    old, new = random_states((7, 7), 3)[1], random_states((7, 7), 5)[1]
    old.save(file)

    def power_cut(*_):
        raise OSError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", power_cut)
        with pytest.raises(OSError, match="power cut"):
            new.save(file)
    assert len(Demonstrations.load(file)) == 3
    assert os.listdir(tmp_path) == ["states.safetensors"]
