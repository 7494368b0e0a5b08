"""Demonstrations: what training sees is what play sees, and files are whole or say so."""

import os
from dataclasses import fields, replace

import numpy as np
import pytest
import safetensors.numpy
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gnn_policy.cases import Family, make_cases
from gnn_policy.demonstrations import BatchMaker, Demonstrations, Filler
from gnn_policy.imitation import EXPERT_ACTION
from gnn_policy.network import DecentralizedPolicy, PolicyConfig
from mapf_env import HISTORY, Bag, Instance, States, parallel_env

SIZES = {
    "square": [Family(height=(7, 7), width=(7, 7), num_agents=(3, 3), density=(0.15, 0.15))],
    "mixed": [
        Family(height=(4, 9), width=(4, 9), num_agents=(1, 6), density=(0.0, 0.2)),
        Family(style="warehouse", height=(9, 9), width=(12, 16), num_agents=(2, 8)),
    ],
}
PERCEIVED = PolicyConfig(encoder="lean", fov_radius=2, comm_radius=3.0)
RICH = replace(
    PERCEIVED,
    extra_channels=("cost_to_go", "other_goals"),
    robot_features=("on_goal", "steps_to_go"),
    edge_features=("relative_position", "goal_direction", "greedy_moves"),
    comm_weights="distance",
)
STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]


def turned_by_numpy(array, g):
    """The last two axes under symmetry g: a reflection of the columns for g >= 4, then g % 4 quarter turns."""
    return np.rot90(np.flip(array, -1) if g >= 4 else array, g % 4, axes=(-2, -1))


def turned_action(action, g):
    step = np.zeros((3, 3))
    step[1 + STEPS[action][0], 1 + STEPS[action][1]] = 1
    row, col = np.argwhere(turned_by_numpy(step, g))[0] - 1
    return STEPS.index((row, col))


def random_states(sizes="square", count=40, seed=0, comm_radius=3.0):
    """Maps, and random states and moves of teams on them, with goals and histories of their own."""
    generator = np.random.default_rng(seed)
    cases = make_cases("train", seed=seed, maps=6, cases_per_map=2, families=SIZES[sizes])
    chosen = generator.integers(len(cases), size=count)
    teams = [cases.instances[i].num_agents for i in chosen]
    free = [np.argwhere(~cases.instances[i].grid) for i in chosen]
    positions, goals = (
        np.concatenate([generator.permutation(cells)[:n] for cells, n in zip(free, teams, strict=True)])
        for _ in range(2)
    )
    robots = sum(teams)
    ages = generator.integers(0, HISTORY + 1, (robots, 1))
    moves = np.where(np.arange(HISTORY) < ages, generator.integers(5, size=(robots, HISTORY)), -1)
    states = States(
        maps=cases.map_of[chosen],
        offsets=np.cumsum([0, *teams]),
        positions=positions.astype(np.int16),
        goals=goals.astype(np.int16),
        moves=moves.astype(np.int8),
        under_way=generator.integers(0, 30, robots).astype(np.int32),
        seeds=generator.integers(2**63, size=count, dtype=np.uint64),
        times=generator.integers(0, 20, count).astype(np.int32),
        limits=np.full(count, 30, np.int32),
        comm_radius=np.full(count, comm_radius) + generator.integers(0, 2, count),  # pyright: ignore[reportArgumentType]
    )
    return cases.grids, Demonstrations(states, generator.integers(5, size=robots).astype(np.int8))


def rows_of(states, t):
    return slice(states.offsets[t], states.offsets[t + 1])


def seen_in_play(grids, states, t, config):
    """Return the observation of the PettingZoo environment in state t, by agent."""
    rows, grid = rows_of(states, t), grids[states.maps[t]]
    case = Instance(grid, states.positions[rows].astype(np.int32), states.goals[rows].astype(np.int32))
    senses = {**config.senses(), "comm_radius": float(states.comm_radius[t])}
    env = parallel_env(num_agents=case.num_agents, height=grid.shape[0], width=grid.shape[1], density=0.0, **senses)
    seen, _ = env.reset(seed=0, options={"instance": case})
    return {name: np.stack([each[name] for each in seen.values()]) for name in next(iter(seen.values()))}


def graph_of(batch, row, attr=False):
    """The dense graph (N, N), or features of edges (N, N, D), of one team of a batch."""
    team, (sender, receiver) = batch["team"].numpy(), batch["edge_index"].numpy()
    first, size = np.flatnonzero(team == row)[0], (team == row).sum()
    own = team[receiver] == row
    assert (team[sender[own]] == row).all()
    values = batch["edge_attr" if attr else "edge_weight"].numpy()[own]
    dense = np.zeros((size, size, *values.shape[1:]), np.float32)
    dense[receiver[own] - first, sender[own] - first] = values
    return dense


@pytest.mark.parametrize("config", [PERCEIVED, replace(PERCEIVED, comm_weights="distance"), RICH])
@pytest.mark.parametrize("sizes", SIZES)
def test_without_augmentation_a_batch_equals_the_observation_in_play(sizes, config):
    grids, demonstrations = random_states(sizes)
    states = demonstrations.states
    batches = BatchMaker(grids, config, augment=False)
    chosen = np.array([5, 0, 39, 5, 17])
    batch = batches.batch(demonstrations, chosen, np.random.default_rng(0))
    assert set(batch.keys()) == {*Bag._fields, EXPERT_ACTION}
    assert batch["fov"].dtype == torch.uint8
    read = []
    policy = DecentralizedPolicy(config)
    policy.encoder.register_forward_pre_hook(lambda module, inputs: read.append(inputs[0].clone()))
    policy(Bag(*(batch[name] for name in Bag._fields)))
    for row, index in enumerate(chosen):
        seen, own = seen_in_play(grids, states, index, config), batch["team"] == row
        np.testing.assert_allclose(read[0][own], seen["fov"], atol=1e-6)
        assert np.array_equal(graph_of(batch, row), seen["graph"])
        assert np.array_equal(batch[EXPERT_ACTION][own], demonstrations.actions[rows_of(states, index)])
        if config is RICH:
            assert np.array_equal(batch["scalars"][own], seen["scalars"])
            assert np.array_equal(graph_of(batch, row, attr=True), seen["edge_attr"])


@pytest.mark.parametrize("sizes", SIZES)
def test_augmentation_turns_views_and_labels_together_and_uses_every_symmetry(sizes):
    grids, demonstrations = random_states(sizes)
    states, index = demonstrations.states, 11
    batches = BatchMaker(grids, PERCEIVED, augment=True)
    batch = batches.batch(demonstrations, np.full(200, index), np.random.default_rng(0))
    seen = seen_in_play(grids, states, index, PERCEIVED)
    labels = demonstrations.actions[rows_of(states, index)].tolist()
    used = set()
    for row in range(200):
        own = batch["team"] == row
        matching = [g for g in range(8) if np.array_equal(batch["fov"][own], turned_by_numpy(seen["fov"], g))]
        assert len(matching) == 1
        assert batch[EXPERT_ACTION][own].tolist() == [turned_action(label, matching[0]) for label in labels]
        assert np.array_equal(graph_of(batch, row), seen["graph"])
        used.add(matching[0])
    assert used == set(range(8))


def test_history_and_directions_of_neighbours_turn_with_the_labels():
    config = replace(PERCEIVED, robot_features=("last_moves",), edge_features=("relative_position",), memory=HISTORY)
    grids, demonstrations = random_states("mixed")
    states = demonstrations.states
    batch = BatchMaker(grids, config, augment=True).batch(demonstrations, np.arange(40), np.random.default_rng(1))
    plain = BatchMaker(grids, config, augment=False).batch(demonstrations, np.arange(40), np.random.default_rng(1))
    for row in range(40):
        own, rows = (batch["team"] == row).numpy(), rows_of(states, row)
        views = plain["fov"][own].numpy()  # pyright: ignore[reportArgumentType]
        labels, moves = demonstrations.actions[rows], states.moves[rows]
        past = batch["scalars"][own].reshape(-1, HISTORY, 5).numpy()  # pyright: ignore[reportArgumentType]
        known = [[int(each.argmax()) if each.any() else -1 for each in robot] for robot in past]  # pyright: ignore[reportAttributeAccessIssue]
        fitting = []
        for g in range(8):
            if not np.array_equal(batch["fov"][own], turned_by_numpy(views, g)):  # pyright: ignore[reportArgumentType]
                continue
            becomes = [*(turned_action(action, g) for action in range(5)), -1]
            down, right = STEPS[becomes[2]], STEPS[becomes[3]]
            attr = graph_of(plain, row, attr=True) @ np.array([down, right])
            fitting.append(
                [becomes[label] for label in labels] == batch[EXPERT_ACTION][own].tolist()  # pyright: ignore[reportArgumentType]
                and [[becomes[move] for move in robot] for robot in moves.tolist()] == known
                and np.allclose(attr, graph_of(batch, row, attr=True), atol=1e-6)
            )
        assert any(fitting)


def test_equal_generators_give_equal_batches():
    grids, demonstrations = random_states("mixed")
    batches = BatchMaker(grids, RICH, augment=True)
    one, two, three = (batches.batch(demonstrations, np.arange(20), np.random.default_rng(s)) for s in (5, 5, 6))
    assert all(torch.equal(one[name], two[name]) for name in one.keys())  # noqa: SIM118 (a TensorDict)
    assert not torch.equal(one["fov"], three["fov"])
    threaded = BatchMaker(grids, RICH, augment=True, threads=3)
    again = threaded.batch(demonstrations, np.arange(20), np.random.default_rng(5))
    assert all(torch.equal(one[name], again[name]) for name in one.keys())  # noqa: SIM118


@pytest.mark.parametrize("ahead", [False, True])
def test_batches_of_several_parts_are_made_in_turn_or_ahead(ahead):
    grids, demonstrations = random_states("mixed")
    maker = BatchMaker(grids, RICH, augment=True)
    draws = [np.array_split(np.arange(size), parts) for size, parts in ((7, 1), (1, 1), (20, 3))]
    made = list(maker.batches(demonstrations, draws, np.random.default_rng(3), ahead=ahead))
    generator = np.random.default_rng(3)
    for parts, pieces in zip(draws, made, strict=True):
        for chosen, piece in zip(parts, pieces, strict=True):
            expected = maker.batch(demonstrations, chosen, generator)
            assert all(torch.equal(piece[name], expected[name]) for name in expected.keys())  # noqa: SIM118
    assert list(maker.batches(demonstrations, [], generator, ahead=ahead)) == []


def test_an_error_while_batches_are_made_ahead_is_raised():
    grids, demonstrations = random_states()
    batches = BatchMaker(grids, PERCEIVED, augment=False)
    draws = [[np.arange(3)], [np.array([99])]]
    made = batches.batches(demonstrations, draws, np.random.default_rng(0), ahead=True)
    assert len(next(made)) == 1
    with pytest.raises(IndexError):
        next(made)


def test_batches_are_filled_to_the_robot():
    rng = np.random.default_rng(0)
    sizes = rng.integers(8, 65, 500)
    fill = Filler(sizes, newest=400, fresh_share=0.75, rng=rng)
    drawn = [fill(512) for _ in range(200)]
    assert all(sizes[chosen].sum() == 512 for chosen in drawn)
    fresh = np.concatenate([chosen[:-1] >= 400 for chosen in drawn]).mean()
    assert abs(fresh - (0.75 + 0.25 / 5)) < 0.03  # a draw among all states is a new one at times
    assert len(np.unique(np.concatenate(drawn))) > 300


@pytest.mark.parametrize(("sizes", "robots", "filled"), [([10, 10], 64, 60), ([7], 7, 7), ([50, 40], 30, 40)])
def test_batches_that_no_teams_fill_are_close_to_it(sizes, robots, filled):
    fill = Filler(np.array(sizes), newest=0, fresh_share=0.5, rng=np.random.default_rng(1))
    totals = {int(np.array(sizes)[fill(robots)].sum()) for _ in range(50)}
    assert filled in totals
    assert all(total in (filled, max(sizes)) for total in totals)


def assert_equal(one, other):
    assert np.array_equal(one.actions, other.actions)
    assert one.actions.dtype == other.actions.dtype
    for each in fields(States):
        first, second = getattr(one.states, each.name), getattr(other.states, each.name)
        assert np.array_equal(first, second), each.name
        assert first.dtype == second.dtype, each.name


@settings(max_examples=20)
@given(counts=st.lists(st.integers(1, 8), min_size=1, max_size=4), sizes=st.sampled_from(list(SIZES)))
def test_files_round_trip_and_concatenation_keeps_the_order(tmp_path_factory, counts, sizes):
    parts = [random_states(sizes, count, seed=count)[1] for count in counts]
    whole = Demonstrations.concatenate(parts)
    assert len(whole) == sum(counts)
    folder = tmp_path_factory.mktemp("states")
    whole.save(folder / "states.safetensors")
    again = Demonstrations.load(folder / "states.safetensors")
    assert_equal(again, whole)
    assert os.listdir(folder) == ["states.safetensors"]
    first = 0
    for part in parts:
        assert_equal(again.take(np.arange(first, first + len(part))), part)
        first += len(part)


def test_states_are_taken_in_the_order_asked_for():
    _, demonstrations = random_states("mixed")
    states, chosen = demonstrations.states, np.array([7, 2, 7, 30])
    taken = demonstrations.take(chosen)
    assert np.array_equal(taken.states.maps, states.maps[chosen])
    rows = [rows_of(states, t) for t in chosen]
    assert np.array_equal(taken.states.positions, np.concatenate([states.positions[each] for each in rows]))
    assert np.array_equal(taken.actions, np.concatenate([demonstrations.actions[each] for each in rows]))
    none = demonstrations.take(np.empty(0, np.intp))
    assert (len(none), len(none.actions)) == (0, 0)
    assert_equal(Demonstrations.concatenate([none, taken]), taken)


def test_damaged_files_say_so(tmp_path):
    file = tmp_path / "states.safetensors"
    _, demonstrations = random_states()
    demonstrations.save(file)
    content = file.read_bytes()
    foreign = safetensors.numpy.save({"weights": np.zeros(3)})
    some = safetensors.numpy.save({"actions": demonstrations.actions, "positions": demonstrations.states.positions})
    for damaged in (b"", content[:5], content[:100], content[:-1], b"\xff" * len(content), foreign, some):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"states\.safetensors is damaged"):
            Demonstrations.load(file)


def test_a_crash_in_the_middle_of_writing_leaves_the_old_file(tmp_path, monkeypatch):
    file = tmp_path / "states.safetensors"
    old, new = random_states(count=3)[1], random_states(count=5)[1]
    old.save(file)

    def power_cut(*_):
        raise OSError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", power_cut)
        with pytest.raises(OSError, match="power cut"):
            new.save(file)
    assert len(Demonstrations.load(file)) == 3
    assert os.listdir(tmp_path) == ["states.safetensors"]
