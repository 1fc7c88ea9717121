"""Runs that take a second: SACAux with tiny networks on Pendulum."""

from pathlib import Path
from typing import Any

import yaml
from sb3_aarl.search.training.run import Run

HYPERPARAMETERS: dict[str, Any] = {
    "policy": "MlpPolicy",
    # An evaluation takes as long as its episodes.
    "env_wrapper": {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 20}},
    "learning_starts": 40,
    "batch_size": 8,
    "aux_kwargs": {"predictor_width": 8},
    "policy_kwargs": {"net_arch": [8], "features_extractor_class": "mlp", "features_extractor_kwargs": {"features_dim": 4}},
}
YAML = yaml.safe_dump({"default": HYPERPARAMETERS})
# With a checkpoint that is small.
DENSE: dict[str, Any] = {
    "buffer_size": 1000,
    "learning_starts": 20,
    "batch_size": 16,
    "aux_kwargs": {"predictor_width": 8},
    "policy_kwargs": {
        "net_arch": [8],
        "features_extractor_class": "dense_mlp",
        "features_extractor_kwargs": {"features_dim": 8, "width": 8},
    },
    "device": "cpu",
}
SEARCH = """\
environment: Pendulum-v1
hyperparameters: hyperparameters.yml
checkpoints: [200, 400]
evaluation_episodes: 1
generations: 2
n_random: 2
n_prior: 1
population_size: 3
parents: 0.5
max_horizon: 3
evolution_seed: 3
retries: 50
"""


def tiny_run(**changes: Any) -> Run:
    """A run of 400 steps with two evaluations."""
    values: dict[str, Any] = {
        "environment": "Pendulum-v1",
        "aux_loss": "{s_t, a_t} -> {s_t+1}",
        "hyperparameters": HYPERPARAMETERS,
        "seed": 0,
        "checkpoints": (200, 400),
        "evaluation_episodes": 1,
    }
    return Run(**values | changes)


def write_search(folder: Path, text: str = SEARCH) -> Path:
    """The files of a tiny search; returns the configuration's."""
    (folder / "hyperparameters.yml").write_text(YAML)
    path = folder / "small.yml"
    path.write_text(text)
    return path
