"""SB3's identity task. python results/agent/identity/identity.py VARIANT SEED prints returns at 350, 700 and 1,050 steps."""

import sys
from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_aarl import SACAux

SETTINGS: dict[str, dict[str, Any]] = {
    "n_steps_1": {"n_steps": 1},
    "coefficient_from_1": {"ent_coef": "auto"},
    "no_loss": {"aux_loss": None},
    "policy_delay_1": {"policy_delay": 1},
    "no_norm": {"policy_kwargs": {"net_arch": [64, 64], "critic_norm": None}},
    "layer_norm": {"policy_kwargs": {"net_arch": [64, 64], "critic_norm": "layer"}},
    "rate_3e-4": {"learning_rate": 3e-4},
    "tau_0.005": {"tau": 0.005},
}


def momentum(value: float) -> Callable[[th.nn.Module], None]:
    def change(network: th.nn.Module) -> None:
        for layer in network.modules():
            if isinstance(layer, th.nn.BatchNorm1d):
                layer.momentum = value

    return change


def without(*positions: int) -> Callable[[th.nn.Module], None]:
    def change(network: th.nn.Module) -> None:
        for position in positions:
            setattr(network, str(position), th.nn.Identity())

    return change


# What is done to each Q network: norm, linear, ReLU, norm, linear, ReLU, norm, linear.
CHANGES = {
    **{f"momentum_{value}": momentum(value) for value in (0.01, 0.1, 0.3, 0.5, 1.0)},
    "nolast": without(6),
    "nofirst": without(0),
}


def main(variant: str, seed: int) -> None:
    env = DummyVecEnv([lambda: IdentityEnvBox(eps=0.5)])
    kwargs: dict[str, Any] = {"policy_kwargs": {"net_arch": [64, 64]}, "seed": seed, "gamma": 0.95, "learning_starts": 100}
    if variant == "sac":
        model: SAC = SAC("MlpPolicy", env, **kwargs)
    else:
        model = SACAux("MlpPolicy", env, **kwargs | {"n_steps": 3} | SETTINGS.get(variant, {}))
    for critic in (model.critic, model.critic_target) if variant in CHANGES else ():
        for network in critic.q_networks:
            CHANGES[variant](network)
    for i in range(3):
        model.learn(350, reset_num_timesteps=i == 0)
        print(variant, seed, model.num_timesteps, evaluate_policy(model, env, 20, warn=False)[0], flush=True)


if __name__ == "__main__":
    th.set_num_threads(1)
    main(sys.argv[1], int(sys.argv[2]))
