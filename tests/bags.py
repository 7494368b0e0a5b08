"""Bags of robots drawn at random, taken apart and put together, in plain NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from mapf_env import Bag, Instance, MapSet, Senses, States, perceive


def random_bag(
    generator: np.random.Generator,
    sizes: Sequence[int],
    senses: Senses,
    *,
    share: float = 0.4,
    weighted: bool = False,
    directed: bool = False,
) -> Bag:
    """A bag of tensors of teams of these sizes, with byte views and a share of all possible links."""
    robots, side = sum(sizes), senses.fov_side
    links = []
    for first, size in zip(np.cumsum([0, *sizes[:-1]]).tolist(), sizes, strict=True):
        hears = np.triu(generator.random((size, size)) < share, 1)
        hears = hears | (np.tril(generator.random((size, size)) < share, -1) if directed else hears.T)
        links.append(np.argwhere(hears) + first)
    receiver, sender = np.concatenate(links).T
    weight = np.ones((robots, robots), np.float32)
    if weighted:
        weight = generator.uniform(0.2, 1, (robots, robots)).astype(np.float32)
        weight = weight if directed else np.maximum(weight, weight.T)
    parts = Bag(
        fov=generator.integers(0, 2, (robots, senses.num_channels, side, side), dtype=np.uint8),
        scalars=generator.random((robots, senses.num_robot_features), dtype=np.float32),
        edge_index=np.stack([sender, receiver]).astype(np.int64),
        edge_weight=weight[receiver, sender],
        edge_attr=generator.uniform(-1, 1, (len(sender), senses.num_edge_features)).astype(np.float32),
        team=np.repeat(np.arange(len(sizes)), sizes),
    )
    return Bag(*(torch.from_numpy(np.ascontiguousarray(each)) for each in parts))


def adjacency(bag: Bag) -> npt.NDArray[np.float64]:
    """(M, M) weights; row i says whom robot i hears."""
    dense = np.zeros((len(bag.team), len(bag.team)))
    for sender, receiver, weight in zip(*np.asarray(bag.edge_index).tolist(), bag.edge_weight.tolist(), strict=True):
        dense[receiver, sender] = weight
    return dense


def split(bag: Bag) -> list[Bag]:
    """One bag for each team."""
    parts = []
    for team in np.unique(bag.team):
        rows = np.flatnonzero(np.asarray(bag.team) == team)
        own = torch.from_numpy(np.isin(bag.edge_index[1], rows))
        parts.append(
            Bag(
                fov=bag.fov[rows],
                scalars=bag.scalars[rows],
                edge_index=bag.edge_index[:, own] - int(rows[0]),
                edge_weight=bag.edge_weight[own],
                edge_attr=bag.edge_attr[own],
                team=bag.team[rows] * 0,
            )
        )
    return parts


def permuted(bag: Bag, order: npt.NDArray[np.integer], generator: np.random.Generator) -> Bag:
    """The same robots in another order, their links in any order."""
    place = torch.from_numpy(np.argsort(order))
    links = torch.from_numpy(generator.permutation(len(bag.edge_weight)))
    rows = torch.from_numpy(np.asarray(order))
    return Bag(
        fov=bag.fov[rows],
        scalars=bag.scalars[rows],
        edge_index=place[bag.edge_index[:, links]],
        edge_weight=bag.edge_weight[links],
        edge_attr=bag.edge_attr[links],
        team=bag.team[rows],
    )


def at_start(instances: Sequence[Instance], senses: Senses) -> Bag:
    """Return the observations of all instances at the start, as tensors."""
    maps = MapSet([each.grid for each in instances], senses.fov_radius, "uint8")
    bag = perceive(States.start_of(instances, senses, maps.index), maps, senses)
    return Bag(*(torch.from_numpy(each) for each in bag))  # pyright: ignore[reportArgumentType]


def spread_preferences(policy: Any, instances: Sequence[Instance]) -> None:
    """Make the moves that a fresh policy prefers differ: its logits at the starts get mean 0 and deviation 2."""
    head = policy.head
    with torch.no_grad():
        logits = policy.eval()(at_start(instances, policy.config))
        scale = 2 / logits.std(0).clamp(min=1e-3)
        head.bias.copy_((head.bias - logits.mean(0)) * scale)
        head.weight.mul_(scale[:, None])
