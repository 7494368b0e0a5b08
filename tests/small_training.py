"""Settings of a training that takes a second."""

from dataclasses import asdict

from gnn_policy import PolicyConfig
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
    epochs=3,
    updates_per_epoch=3,
    batch_size=8,
    demonstration_steps=64,
    dagger_every=1,
    dagger_steps=32,
    rollout_teams=4,
    rollout_length=8,
    validate_every=2,
    threads=1,
)


def arguments_for(config, folder):
    """The command line that asks for `config`."""
    flags = ["--run", str(folder)]
    for name, value in asdict(config).items():
        for option, setting in (
            [(f"policy.{each}", v) for each, v in value.items()] if name == "policy" else [(name, value)]
        ):
            *group, last = option.replace("_", "-").split(".")
            if isinstance(setting, bool):
                flags.append("--" + ".".join([*group, last if setting else f"no-{last}"]))
            else:
                flags.append("--" + ".".join([*group, last]))
                flags += map(str, setting if isinstance(setting, tuple) else (setting,))
    return flags
