"""Settings of trainings that take a second."""

from dataclasses import replace
from pathlib import Path

from gnn_policy import PolicyConfig
from gnn_policy.cases import Family
from gnn_policy.config import TrainConfig

CONFIG = TrainConfig(
    policy=PolicyConfig(encoder="lean", features=8, fov_radius=2, comm_radius=3.0),
    num_agents=3,
    height=6,
    width=6,
    train_maps=6,
    cases_per_map=2,
    validation_maps=3,
    validation_cases_per_map=2,
    test_maps=2,
    rounds=3,
    updates_per_round=3,
    batch_size=8,
    demonstration_steps=64,
    dagger_every=1,
    dagger_steps=32,
    rollout_teams=4,
    rollout_length=8,
    validate_every=2,
    threads=1,
)


MIXED = replace(
    CONFIG,
    families=(
        Family(height=(6, 8), width=(6, 9), num_agents=(2, 5), density=(0.0, 0.2)),
        Family(
            style="maze", share=0.5, height=(7, 9), width=(9, 9), num_agents=(3, 4), corridor_width=(1, 2), loops=(0, 1)
        ),
    ),
    augment=True,
)
"""Two families of cases of mixed sizes."""

CROWDS = replace(
    MIXED,
    families=(MIXED.families[0], replace(MIXED.families[1], task="lifelong")),
    aggregation="plans",
    plan_steps=4,
    stuck_weight=3.0,
    batch_robots=24,
    kept_states=40,
    optimizer="adamw",
    clip_norm=1.0,
    averaging=0.9,
)
"""The settings that the recipe for crowds adds, and lifelong tasks."""


def arguments_for(config, folder):
    """Write a file of settings next to the run folder; return the command line that asks for it."""
    file = Path(folder).with_suffix(".toml")
    file.parent.mkdir(parents=True, exist_ok=True)
    config.save(file)
    return ["--config", str(file), "--run", str(folder)]
