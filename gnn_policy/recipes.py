"""Complete sets of settings, by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from gnn_policy.cases import Family, Task
from gnn_policy.config import TrainConfig
from gnn_policy.execution import Execution
from gnn_policy.policy_config import PolicyConfig

Recipe = Literal["quick", "full", "paper", "general", "refine"]

_QUICK = TrainConfig(
    policy=PolicyConfig(encoder="lean"),
    train_maps=2000,
    cases_per_map=10,
    validation_cases_per_map=5,
    rounds=36,
    updates_per_round=800,
    batch_size=32,
    demonstration_steps=32_768,
    dagger_every=1,
    dagger_steps=16_384,
    fresh_share=0.75,
    augment=True,
    lr=2e-3,
)

_CROWD = (12, 64)
_MAZE = Family(style="walls", density=(0.1, 0.37), segments=(3, 5), straight=(0.4, 0.6), ring=True, num_agents=_CROWD)
_GENERAL = TrainConfig(
    policy=PolicyConfig(
        encoder="lean",
        graph_layer="attention",
        extra_channels=("cost_to_go", "other_goals", "greedy_cells", "robots_on_goals", "previous_positions"),
        robot_features=("last_moves", "on_goal", "steps_to_go", "under_way", "greedy_moves", "stuck"),
        edge_features=("relative_position", "goal_direction", "greedy_moves", "last_moves", "on_goal", "priority"),
    ),
    families=(
        *(replace(_MAZE, height=(h, h), width=(w, w)) for h, w in ((17, 17), (19, 19), (21, 21), (17, 21))),
        Family(share=2.0, height=(12, 26), width=(12, 26), density=(0.05, 0.35), num_agents=_CROWD),
        Family(
            style="maze",
            share=0.75,
            height=(13, 25),
            width=(13, 25),
            corridor_width=(1, 2),
            loops=(0.1, 0.6),
            num_agents=(8, 48),
        ),
        Family(style="room", share=0.5, height=(13, 27), width=(13, 27), room_size=(4, 6), num_agents=_CROWD),
        Family(
            style="warehouse",
            share=0.5,
            height=(17, 33),
            width=(20, 40),
            corridor_width=(1, 2),
            shelf_length=(4, 10),
            shelf_depth=(1, 2),
            num_agents=(16, 96),
        ),
        Family(style="empty", share=0.25, height=(12, 24), width=(12, 24), num_agents=(16, 64)),
    ),
    train_maps=8000,
    cases_per_map=4,
    validation_maps=64,
    validation_cases_per_map=2,
    test_maps=64,
    reference_nodes=500,
    w=1.05,
    expert_nodes=500,
    expert_iterations=1000,
    rounds=600,
    updates_per_round=400,
    batch_robots=1024,
    demonstration_steps=98_304,
    aggregation="plans",
    stuck_weight=3.0,
    dagger_every=1,
    dagger_steps=8192,
    fresh_window=32_768,
    kept_states=200_000,
    rollout_teams=64,
    rollout_length=128,
    execution=Execution(actions="fallback", temperature=1.5, shield="pibt_swap"),
    rollout_actions="fallback",
    augment=True,
    optimizer="adamw",
    lr=1.2e-3,
    final_lr=5e-5,
    weight_decay=0.01,
    clip_norm=1.0,
    averaging=0.998,
    validate_every=10,
)

_TASKS: tuple[Task, ...] = ("one_shot", "lifelong")
_REFINE = replace(
    _GENERAL,
    init="general",
    objective="delay",
    families=tuple(replace(each, task=task) for each in _GENERAL.families for task in _TASKS),
    rounds=200,
    updates_per_round=None,
    batch_robots=None,
    batch_size=112,
    dagger_steps=2304,
    rollout_teams=24,
    rollout_length=96,
    augment=False,
    lr=3e-4,
    final_lr=2e-5,
    weight_decay=0.0,
    clip_norm=0.5,
    averaging=0.995,
    validate_every=20,
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
        rounds=120,
        validate_every=20,
    ),
    "paper": TrainConfig(),
    "general": _GENERAL,
    "refine": _REFINE,
}
"""A policy in about ten minutes on two CPU cores; the packaged models of the paper; the paper's own settings; and the
general policy, for any map and crowds of robots, in six or seven hours (an hour with `--rounds 90`); and its refinement
by reinforcement learning, one-shot and lifelong, in an hour and a half."""
