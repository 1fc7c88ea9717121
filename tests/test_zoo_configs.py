"""The variants in zoo_configs: the paper's tables 7 and 8 typed in again, read as we and as RL-Zoo do, built and trained."""

import copy
import functools
import json
import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
import yaml
from sb3_aarl.search.training.config import load_hyperparameters, merge
from stable_baselines3.common.logger import Logger

from sb3_aarl import SACAux, catalog, encoders
from sb3_aarl.envs import env_ids, make_dmc_env

ZOO = Path(__file__).parent.parent / "zoo_configs"
FILES = sorted(path for path in ZOO.rglob("*.yml") if path.parent.name != "search")

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
    "ent_coef_betas": (0.5, 0.999),
    "ent_coef_learning_rate": 1e-4,
    "tau": 0.01,
    "target_update_interval": 2,
    "gamma": 0.99,
    "ent_coef": "auto_0.1",
    "policy_delay": 2,
}
ADAM = {"net_arch": [1024, 1024], "optimizer_kwargs": {"betas": [0.9, 0.999]}}
# How the public code starts actor and critic.
PUBLIC_START = {"ortho_init": True, "squash_log_std": [-10, 2]}


def with_loss(aux_loss: str | None, auxiliary: dict[str, Any]) -> dict[str, Any]:
    """The loss, and the keys that only runs with a loss have."""
    if aux_loss == "auto":
        return auxiliary
    return {"aux_loss": aux_loss} if aux_loss is None else {"aux_loss": aux_loss, **auxiliary}


def table_8(variant: str, task: str) -> dict[str, Any]:
    encoder, n_layers, aux_loss = STATE_VARIANTS[variant]
    repeat = {"cartpole": 8, "walker": 2, "finger": 2}.get(task.partition("-")[0], 4)  # the public code's; 4 in table 8
    kwargs = {"features_extractor_kwargs": {"features_dim": 40, "n_layers": n_layers, "width": 40}}  # width: not in the paper
    return {
        **COMMON,
        **with_loss(aux_loss, {"predictor_width": 256}),
        "policy": "MlpPolicy",
        "n_timesteps": (1_000_000 if task in DIFFICULT else 100_000) // repeat,
        "env_kwargs": {"action_repeat": repeat},
        "learning_rate": 2e-4 if task == "cheetah-run" else 1e-3,
        "batch_size": 512,
        **({} if encoder == "identity" else {"encoder_tau": 0.05}),
        "policy_kwargs": {**ADAM, "features_extractor_class": encoder, **(PUBLIC_START if encoder == "identity" else kwargs)},
    }


def table_7(variant: str, task: str) -> dict[str, Any]:
    aux_loss, crop, column = PIXEL_VARIANTS[variant]
    repeat = {"cartpole-swingup": 8, "walker-walk": 2, "finger-spin": 2}.get(task, 4)
    final = {
        "encoder_learning_rate": 3e-3 if task in ("cheetah-run", "finger-spin", "walker-walk") else 1e-3,
        "aux_batch_size": {"walker-walk": 128, "cheetah-run": 256, "finger-spin": 256}.get(task, 512),
    }
    auxiliary = final if column else {"encoder_learning_rate": 1e-3, "aux_batch_size": 128}
    return {
        **COMMON,
        **with_loss(aux_loss, {"predictor_width": 256, **auxiliary}),
        "policy": "CnnPolicy",
        "n_timesteps": 500_000 // repeat,
        "env_kwargs": {"pixels": True, "image_size": 100 if crop else 84, "frame_stack": 3, "action_repeat": repeat},
        **({"augmentation": "random_crop", "crop_size": 84} if crop else {"augmentation": "none"}),
        "learning_rate": 2e-4 if column and task == "cheetah-run" else 1e-3,
        "batch_size": 512 if column else 128,
        "encoder_tau": 0.05,
        "policy_kwargs": {
            **ADAM,
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
    assert {path.stem for path in (ZOO / "paper").glob("*.yml")} == {*VARIANTS}


@pytest.mark.parametrize("variant", VARIANTS)
def test_tables_7_and_8(variant: str) -> None:
    path = ZOO / "paper" / f"{variant}.yml"
    ids = {f"dm_control/{task}-v0": task for task in tasks_of(variant)}
    assert yaml.safe_load(path.read_text()).keys() == {"default", *ids}
    assert ids.keys() <= set(env_ids())
    # The last one is in no table: "Others" there.
    for env_id, task in {**ids, "dm_control/swimmer-swimmer6-v0": "swimmer-swimmer6"}.items():
        assert load_hyperparameters(path, env_id) == expected(variant, task), task


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_rl_zoo_reads_the_same(path: Path) -> None:
    """RL-Zoo takes an environment's entry or the default, merges nothing, and reads 1e-3 as text, as YAML 1.1 has it."""
    entries = yaml.safe_load(path.read_text())
    for env_id in [*entries.keys() - {"default"}, "dm_control/swimmer-swimmer6-v0"]:
        entry = entries.get(env_id, entries["default"])
        assert entry == json.loads(json.dumps(load_hyperparameters(path, env_id))), env_id  # lists for tuples


# Batch and hidden layers of SB3's SAC.
SMALL: dict[str, Any] = {"batch_size": 256, "policy_kwargs": {"net_arch": [256, 256]}}
# Choices from states but those of the action repeat have table 8's.
REPEAT_2, REPEAT_4 = ({"n_timesteps": 100_000 // n, "env_kwargs": {"action_repeat": n}} for n in (2, 4))
PUBLIC: dict[str, Any] = {"policy_kwargs": PUBLIC_START}
# What each file of choices/ changes, and of which variant.
CHOICES: dict[str, tuple[str, dict[str, Any]]] = {
    "aarl_state_bf16": ("aarl_state", {"precision": "bf16"}),
    "curl_state_bf16": ("curl_state", {"precision": "bf16"}),
    "sac_dense_mlp_bf16": ("sac_dense_mlp", {"precision": "bf16"}),
    "sac_identity_bf16": ("sac_identity", {"precision": "bf16"}),
    "published_state": ("aarl_state", {"aux_loss": "cheetah-run-state-7-3"}),
    "aarl_state_small": ("aarl_state", SMALL),
    "aarl_state_small_bf16": ("aarl_state", {**SMALL, "precision": "bf16"}),
    "aarl_state_small_joint": ("aarl_state", {**SMALL, "joint_optimizer": True}),
    "aarl_state_small_orthogonal": ("aarl_state", merge(SMALL, {"policy_kwargs": {"ortho_init": True}})),
    "aarl_state_small_predictor": ("aarl_state", {**SMALL, "predictor_width": None, "predictor_batch_norm": True}),
    "aarl_state_small_separate": ("aarl_state", merge(SMALL, {"policy_kwargs": {"share_features_extractor": False}})),
    "curl_state_small": ("curl_state", SMALL),
    "sac_dense_mlp_small": ("sac_dense_mlp", SMALL),
    "sac_dense_mlp_small_orthogonal": ("sac_dense_mlp", merge(SMALL, {"policy_kwargs": {"ortho_init": True}})),
    "sac_identity_small": ("sac_identity", SMALL),
    "sac_identity_small_orthogonal": ("sac_identity", merge(SMALL, {"policy_kwargs": {"ortho_init": True}})),
    "sac_identity_small_orthogonal_squashed": ("sac_identity", merge(SMALL, PUBLIC)),
}
for name in ("aarl_state", "sac_dense_mlp", "sac_identity"):
    CHOICES[f"{name}_small_repeat_2"] = (name, {**SMALL, **REPEAT_2})
    CHOICES[f"{name}_small_orthogonal_squashed_repeat_2"] = (name, {**merge(SMALL, PUBLIC), **REPEAT_2})
CHOICES["sac_identity_orthogonal_squashed_bf16"] = ("sac_identity", {**PUBLIC, "precision": "bf16"})
CHOICES["sac_identity_orthogonal_squashed_repeat_2_bf16"] = ("sac_identity", {**PUBLIC, **REPEAT_2, "precision": "bf16"})
EVOLUTION: dict[str, Any] = {"batch_size": 128, "learning_rate": 1e-3, "n_timesteps": 25_000, "precision": "bf16"}
EVOLUTION["env_kwargs"] = {"fast_rendering": True}
CHOICES["sac_pixel_128_bf16"] = ("sac_pixel", EVOLUTION)
for name in ("aarl_pixel", "curl_pixel"):
    CHOICES[f"{name}_128_bf16"] = (name, {**EVOLUTION, "encoder_learning_rate": 1e-3, "aux_batch_size": 128})


def test_choices_differ_in_nothing_else() -> None:
    assert {path.stem for path in (ZOO / "choices").glob("*.yml")} == CHOICES.keys()
    for choice, (variant, changes) in CHOICES.items():
        path = ZOO / "choices" / f"{choice}.yml"
        for env_id in yaml.safe_load(path.read_text()).keys() - {"default"}:
            repeat = REPEAT_4 if variant in STATE_VARIANTS else {}
            values = merge(load_hyperparameters(ZOO / "paper" / f"{variant}.yml", env_id), repeat)
            for name in PUBLIC_START:  # sac_identity has it, its choices are from before
                values["policy_kwargs"].pop(name, None)
            assert load_hyperparameters(path, env_id) == merge(values, changes)


def simba(width: int) -> dict[str, Any]:
    extractor = {"features_extractor_class": "simba", "features_extractor_kwargs": {"features_dim": width}}
    return {"precision": "bf16", "policy_kwargs": extractor}


def with_policy(values: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
    return merge(values, {"policy_kwargs": kwargs})


ENTROPY = {"ent_coef": "auto_0.1"}
DENSE_MLP = {"precision": "bf16", "policy_kwargs": {"features_extractor_class": "dense_mlp"}}
PAPERS, FINALIST = DENSE_MLP | ENTROPY, simba(64) | ENTROPY
PAPERS_FP32, FINALIST_FP32 = ({"policy_kwargs": body["policy_kwargs"]} | ENTROPY for body in (PAPERS, FINALIST))
BLOCKS: dict[str, Any] = {"net_arch": [128], "network": "simba"}
EVOLVED = (
    "{s_t, a_t, a_t+1, a_t+2, r_t+2, a_t+3, r_t+3, r_t+4, s_t+5, a_t+5, a_t+6, a_t+7, a_t+8, r_t+8} "
    "-> {s_t+1, s_t+2, a_t+2, s_t+3, a_t+3, a_t+4, s_t+6, s_t+8, s_t+9}"
)
# How files differ from SACAux's defaults: bodies that were compared, the finalist, its parts, and what it is compared with.
BODIES: dict[str, dict[str, Any]] = {
    "body/default_dense_mlp_bf16": DENSE_MLP,
    "body/default_simba_bf16": simba(128),
    "body/default_simba_entropy_bf16": simba(128) | ENTROPY,
    "body/default_simba_64_bf16": simba(64),
    "body/default_simba_64_entropy_bf16": FINALIST,
    "body/default_simba_64_entropy_no_aux_bf16": FINALIST | {"aux_loss": None},
    "body/default_simba_32_entropy_bf16": simba(32) | ENTROPY,
    "simba/aarl_simba": FINALIST,
    "simba/forward_simba_repeat_4": FINALIST | {"aux_loss": "forward-dynamics"},
    "forward_simba": simba(64)
    | {"aux_loss": "forward-dynamics", "learning_starts": 5000, "ent_coef": "auto", "ent_coef_learning_rate": 6e-4},
    "simba/published_simba": FINALIST | {"aux_loss": "cheetah-run-state-7-3"},
    "simba/aarl_simba_fp32": FINALIST_FP32,
    "simba/published_simba_fp32": FINALIST_FP32 | {"aux_loss": "cheetah-run-state-7-3"},
    "simba/evolved_simba": FINALIST | {"aux_loss": EVOLVED},
    "simba/evolved_simba_fp32": FINALIST_FP32 | {"aux_loss": EVOLVED},
    "simba/sac_simba": FINALIST | {"aux_loss": None},
    "simba/sac_simba_fp32": FINALIST_FP32 | {"aux_loss": None},
    "simba/sac_states": {"aux_loss": None, "policy_delay": 1, "policy_kwargs": {"features_extractor_class": "identity"}},
    "simba/aarl_dense_mlp": PAPERS,
    "simba/aarl_dense_mlp_fp32": PAPERS_FP32,
    "simba/published_dense_mlp_fp32": PAPERS_FP32 | {"aux_loss": "cheetah-run-state-7-3"},
    "simba/forward_dense_mlp": PAPERS | {"aux_loss": "forward-dynamics"},
    "simba/dense_mlp_alone": PAPERS | {"aux_loss": None},
    "simba/aarl_simba_heads": with_policy(FINALIST, **BLOCKS),
    "simba/aarl_dense_mlp_heads": with_policy(PAPERS, **BLOCKS),
    "simba/aarl_simba_critic_norm": with_policy(FINALIST, network={"pi": "mlp", "qf": "layer_norm"}),
    "simba/aarl_simba_unnormalized": with_policy(FINALIST, features_extractor_kwargs={"normalize": False}),
    "simba/aarl_dense_mlp_normalized": PAPERS | {"normalize": {"norm_reward": False}},
    "simba/aarl_simba_two_steps": FINALIST | {"gradient_steps": 2},
    "simba/aarl_simba_one_critic": with_policy(FINALIST, n_critics=1),
    "simba/aarl_simba_weight_decay": with_policy(
        FINALIST, optimizer_kwargs={"weight_decay": 0.01, "decoupled_weight_decay": True}
    ),
}


def test_bodies_differ_from_the_defaults_in_nothing_else() -> None:
    # They ran when SAC's coefficient and AARL-State were the defaults.
    changed = {"ent_coef": "auto", "ent_coef_learning_rate": 3e-4, "aux_loss": "aarl-state"}
    defaults = load_hyperparameters(ZOO / "default.yml", "MyEnv-v0") | changed
    folders = [path.relative_to(ZOO).with_suffix("").as_posix() for path in ZOO.glob("*/*.yml")]
    assert {name for name in folders if name.startswith(("body/", "simba/"))} | {"forward_simba"} == BODIES.keys()
    for name, changes in BODIES.items():
        path = ZOO / f"{name}.yml"
        for env_id in yaml.safe_load(path.read_text()).keys() - {"default"}:
            often = env_id.startswith(("dm_control/walker", "dm_control/finger")) and not name.endswith("repeat_4")
            repeat = 2 if often else 4
            steps = {"n_timesteps": 100_000 // repeat, "env_kwargs": {"action_repeat": repeat}}
            if name == "forward_simba":
                steps |= {"learning_starts": 100, "ent_coef": "auto_0.1", "ent_coef_learning_rate": 3e-4}
            assert load_hyperparameters(path, env_id) == {**defaults, **changes, **steps}
        assert load_hyperparameters(path, "MyEnv-v0") == {**defaults, **changes}


@functools.cache
def shared_env(env_id: str, env_kwargs: tuple[tuple[str, Any], ...]) -> gym.Env:
    """One environment for all variants that see the same: making them is slow."""
    return make_dmc_env(env_id, **dict(env_kwargs), fast_rendering=True, seed=0)


@pytest.mark.parametrize(
    ("variant", "task"),
    [
        *((variant, task) for variant in STATE_VARIANTS for task in ("cheetah-run", "hopper-stand")),
        *((variant, "cheetah-run") for variant in PIXEL_VARIANTS),
    ],
)
def test_builds_and_trains(variant: str, task: str) -> None:
    values = load_hyperparameters(ZOO / "paper" / f"{variant}.yml", f"dm_control/{task}-v0")
    env = shared_env(f"dm_control/{task}-v0", tuple(values.pop("env_kwargs").items()))
    small = {"buffer_size": 30, **({"aux_batch_size": 4} if "aux_batch_size" in values else {})}
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
    extractor = model.critic.features_extractor
    assert type(extractor) is encoders.ENCODERS[expected(variant, task)["policy_kwargs"]["features_extractor_class"]]
    layers = [module for module in extractor.modules() if isinstance(module, (th.nn.Linear, th.nn.Conv2d))]
    n_layers = STATE_VARIANTS[variant][1] if variant in STATE_VARIANTS else 4
    assert len(layers) == (n_layers and n_layers + 1)  # and the projection
    for key, value in model.policy.state_dict().items():
        assert th.isfinite(value).all()
        assert not th.equal(value, before[key]), key
