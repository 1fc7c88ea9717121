"""The variants in zoo_configs: the paper's tables 7 and 8 typed in again, read as we and as RL-Zoo do, built and trained."""

import copy
import functools
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
import yaml
from sb3_aarl.search.studies.benchmark import read_variants
from sb3_aarl.search.training.config import load_hyperparameters
from stable_baselines3.common.logger import Logger

from sb3_aarl import AuxLoss, SACAux, catalog
from sb3_aarl.aux_loss import OPERATORS
from sb3_aarl.envs import env_ids, make_dmc_env

ZOO = Path(__file__).parent.parent / "zoo_configs"
FILES = sorted(path for path in ZOO.rglob("*.yml") if path.parent.name != "search" and path.stem != "operators")

# Table 4: 100K steps above, 1000K below.
EASY = (
    *("finger-spin", "finger-turn_hard", "cartpole-swingup", "cartpole-swingup_sparse", "reacher-easy", "cheetah-run"),
    *("walker-stand", "walker-walk", "walker-run", "ball_in_cup-catch", "fish-upright", "hopper-stand"),
)
DIFFICULT = ("quadruped-run", "pendulum-swingup", "hopper-hop", "humanoid-stand", "humanoid-walk", "humanoid-run")
# Table 3.
PIXEL = ("finger-spin", "cartpole-swingup", "reacher-easy", "cheetah-run", "walker-walk", "ball_in_cup-catch")

# Encoder, its layers, and the loss of each variant from states.
STATE_VARIANTS: dict[str, tuple[str, int, str | None]] = {
    "aarl_state": ("dense_mlp", 1, "aarl-state"),
    "sac_dense_mlp": ("dense_mlp", 1, None),
    "sac_identity": ("identity", 0, None),
    "curl_state": ("dense_mlp", 1, "curl"),
    "aarl_mlp_1": ("mlp", 1, "aarl-state"),
    "aarl_mlp_4": ("mlp", 4, "aarl-state"),
    "aarl_dense_mlp_4": ("dense_mlp", 4, "aarl-state"),
}
# Loss ("auto" is SACAux's own, which the file leaves out), whether images are cropped, and the column of table 7.
PIXEL_VARIANTS: dict[str, tuple[str | None, bool, int]] = {
    "aarl_pixel_evolution": ("auto", True, 0),
    "aarl_pixel": ("aarl-pixel", True, 1),
    "curl_pixel": ("curl", True, 1),
    "sac_pixel": (None, True, 1),
    "sac_pixel_no_aug": (None, False, 1),
}
VARIANTS = [*STATE_VARIANTS, *PIXEL_VARIANTS]

# What both tables have in common, and what neither has: two hidden layers and the delay of the actor are CURL's.
COMMON: dict[str, Any] = {
    "buffer_size": 100_000,
    "learning_starts": 1000,
    "ent_coef_optimizer_kwargs": {"lr": 1e-4, "betas": [0.5, 0.999]},
    "tau": 0.01,
    "target_update_interval": 2,
    "gamma": 0.99,
    "ent_coef": "auto_0.1",
    "policy_delay": 2,
    "target_entropy": "auto",
}
ADAM = {"net_arch": [1024, 1024], "optimizer_kwargs": {"betas": [0.9, 0.999]}, "critic_norm": None}
# How the public code starts actor and critic.
PUBLIC_START = {"ortho_init": True, "squash_log_std": [-10, 2]}


SB3_SAC: dict[str, Any] = {
    "aux_loss": None,
    "learning_rate": 3e-4,
    "learning_starts": 100,
    "ent_coef": "auto",
    "target_entropy": "auto",
    "tau": 0.005,
    "policy_delay": 1,
    "policy_kwargs": {
        "features_extractor_class": "identity",
        "critic_norm": None,
        "optimizer_kwargs": {"betas": [0.9, 0.999]},
    },
}


def action_repeat(task: str) -> int:
    """The public code's; table 8 has 4 for all tasks."""
    return {"cartpole": 8, "walker": 2, "finger": 2}.get(task.partition("-")[0], 4)


def with_loss(aux_loss: str | None, auxiliary: dict[str, Any]) -> dict[str, Any]:
    """The loss, and what only runs with a loss have in aux_kwargs."""
    loss = {} if aux_loss == "auto" else {"aux_loss": aux_loss}
    return {**loss, "aux_kwargs": {"tau": 0.05, **({} if aux_loss is None else auxiliary)}}


def table_8(variant: str, task: str) -> dict[str, Any]:
    encoder, n_layers, aux_loss = STATE_VARIANTS[variant]
    repeat = action_repeat(task)
    kwargs = {"features_extractor_kwargs": {"features_dim": 40, "n_layers": n_layers, "width": 40}}  # width: not in the paper
    return {
        **COMMON,
        **({"aux_loss": None} if encoder == "identity" else with_loss(aux_loss, {"predictor_width": 256})),
        "policy": "MlpPolicy",
        "n_timesteps": (1_000_000 if task in DIFFICULT else 100_000) // repeat,
        "env_kwargs": {"action_repeat": repeat},
        "learning_rate": 2e-4 if task == "cheetah-run" else 1e-3,
        "batch_size": 512,
        "policy_kwargs": {**ADAM, "features_extractor_class": encoder, **(PUBLIC_START if encoder == "identity" else kwargs)},
    }


def table_7(variant: str, task: str) -> dict[str, Any]:
    aux_loss, crop, column = PIXEL_VARIANTS[variant]
    repeat = action_repeat(task)
    final = {
        "learning_rate": 3e-3 if task in ("cheetah-run", "finger-spin", "walker-walk") else 1e-3,
        "batch_size": {"walker-walk": 128, "cheetah-run": 256, "finger-spin": 256}.get(task, 512),
    }
    auxiliary = final if column else {"learning_rate": 1e-3, "batch_size": 128}
    return {
        **COMMON,
        **with_loss(aux_loss, {"predictor_width": 256, **auxiliary}),
        "policy": "CnnPolicy",
        "n_timesteps": 500_000 // repeat,
        "env_kwargs": {"pixels": True, "image_size": 100 if crop else 84, "frame_stack": 3, "action_repeat": repeat},
        "learning_rate": 2e-4 if column and task == "cheetah-run" else 1e-3,
        "batch_size": 512 if column else 128,
        "policy_kwargs": {
            **ADAM,
            **({"augmentation": "random_crop", "crop_size": 84} if crop else {"augmentation": "none"}),
            "features_extractor_class": "pixel",
            "features_extractor_kwargs": {"features_dim": 50, "n_layers": 4, "n_filters": 32},
        },
    }


def expected(variant: str, task: str) -> dict[str, Any]:
    return table_8(variant, task) if variant in STATE_VARIANTS else table_7(variant, task)


def tasks_of(variant: str) -> tuple[str, ...]:
    ablation = STATE_VARIANTS.get(variant, ("", 0, ""))[:2] in (("mlp", 1), ("mlp", 4), ("dense_mlp", 4))
    return PIXEL if variant in PIXEL_VARIANTS else EASY if ablation else EASY + DIFFICULT


def test_the_variants_are_all_there() -> None:
    assert {path.stem for path in (ZOO / "paper").glob("*.yml")} == {*VARIANTS, "operators"}
    readme = (ZOO / "README.md").read_text(encoding="utf-8")
    assert all(path.name in readme or path.stem.endswith("-small") for path in ZOO.rglob("*.yml"))
    assert all((ZOO / link).exists() for link in re.findall(r"\]\((.*?)\)", readme))


@pytest.mark.parametrize("variant", VARIANTS)
def test_tables_7_and_8(variant: str) -> None:
    path = ZOO / "paper" / f"{variant}.yml"
    ids = {f"dm_control/{task}-v0": task for task in tasks_of(variant)}
    assert yaml.safe_load(path.read_text()).keys() == {"default", *ids}
    assert ids.keys() <= set(env_ids())
    # The last one is in no table: "Others" there.
    for env_id, task in {**ids, "dm_control/swimmer-swimmer6-v0": "swimmer-swimmer6"}.items():
        assert load_hyperparameters(path, env_id) == expected(variant, task), task


def test_ten_operators_on_forward_dynamics() -> None:
    variants = read_variants(ZOO / "paper" / "operators.yml")
    losses = {variant.name: AuxLoss.parse(variant.entries["default"]["aux_loss"]) for variant in variants}
    forward = catalog.load("forward-dynamics")
    assert losses == {
        f"forward_{operator}{'_negatives' * negatives}": replace(forward, operator=operator, negatives=negatives)
        for operator in OPERATORS
        for negatives in (True, False)
    }


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_rl_zoo_reads_the_same(path: Path) -> None:
    """RL-Zoo takes an environment's entry or the default, merges nothing, and reads 1e-3 as text, as YAML 1.1 has it."""
    entries = yaml.safe_load(path.read_text())
    for env_id in [*entries.keys() - {"default"}, "dm_control/swimmer-swimmer6-v0"]:
        entry = entries.get(env_id, entries["default"])
        assert entry == json.loads(json.dumps(load_hyperparameters(path, env_id))), env_id  # lists for tuples


@pytest.mark.parametrize(("name", "own"), [("sac_aux", {}), ("sac", SB3_SAC)])
def test_the_defaults_are_those_of_the_class(name: str, own: dict[str, Any]) -> None:
    """Only Gymnasium's MuJoCo tasks have exceptions; DeepMind Control's have the action repeats of the public code."""
    path, own = ZOO / f"{name}.yml", {"policy": "MlpPolicy", "n_timesteps": 100_000, **own}
    assert load_hyperparameters(path, "MyEnv-v0") == own
    exceptions = {} if name == "sac_aux" else {"learning_starts": 5000}
    for env_id in ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5"):
        assert load_hyperparameters(path, env_id) == own | exceptions
    for env_id in env_ids():
        steps = {"n_timesteps": 50_000, "env_kwargs": {"action_repeat": 2}}
        assert load_hyperparameters(path, env_id) == own | steps


@functools.cache
def shared_env(env_id: str, env_kwargs: tuple[tuple[str, Any], ...]) -> gym.Env:
    """One environment for all variants that see the same: making them is slow."""
    return make_dmc_env(env_id, **dict(env_kwargs), fast_rendering=True, seed=0)


@pytest.mark.parametrize("variant", VARIANTS)
def test_builds_and_trains(variant: str) -> None:
    task = "cheetah-run"
    values = load_hyperparameters(ZOO / "paper" / f"{variant}.yml", f"dm_control/{task}-v0")
    env = shared_env(f"dm_control/{task}-v0", tuple(values.pop("env_kwargs").items()))
    small = {"buffer_size": 30}
    if "batch_size" in values.get("aux_kwargs", {}):
        values["aux_kwargs"]["batch_size"] = 4
    values["policy_kwargs"]["net_arch"] = [8]
    del values["n_timesteps"]
    model = SACAux(values.pop("policy"), env, **{**values, **small}, seed=0, device="cpu")
    model.learn(20)
    model.set_logger(Logger(None, []))
    before = copy.deepcopy(model.policy.state_dict())

    model.train(gradient_steps=2, batch_size=4)  # the second one is the actor's

    name = expected(variant, task).get("aux_loss", "aarl-pixel")
    assert model.aux_loss == (None if name is None else catalog.load(name))
    logged = model.logger.name_to_value
    assert logged["train/aux_skipped"] == 0 and ("train/aux_loss" in logged) is (name is not None)
    assert all(math.isfinite(value) for value in logged.values())
    for key, value in model.policy.state_dict().items():
        assert th.isfinite(value).all()
        assert not th.equal(value, before[key]), key
