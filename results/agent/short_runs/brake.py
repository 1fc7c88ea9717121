"""
brake.py VARIANT SEED: 3,000 steps of Brake-v0, the environment of docs/guides/own.md, in ./my_package.py.

Prints the mean return of ten episodes each 500 steps, and Q values, the size of actions and the entropy coefficient.
"""

import sys
import warnings
from typing import Any

import gymnasium as gym
import torch as th

sys.path.insert(0, ".")
import my_package  # type: ignore[import-not-found]  # noqa: F401
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_aarl import SACAux

STEPS, EVERY = 3000, 500
VARIANTS: dict[str, dict[str, Any]] = {  # of the defaults before ../targets
    "ours": {"tau": 1},
    "nonorm": {"tau": 0.005, "policy_kwargs": {"critic_norm": None}},
    "n1": {"tau": 1, "n_steps": 1},
    "momentum": {"tau": 1},  # of batch norm: 0.1
    "delay1": {"tau": 1, "policy_delay": 1},
    "ent": {"tau": 1, "ent_coef": "auto", "target_entropy": "auto"},
    **{f"tau_{tau}": {"tau": tau} for tau in (0.005, 0.02, 0.05, 0.1, 0.2)},
}


def main(name: str, seed: int) -> None:
    warnings.simplefilter("ignore")
    th.set_num_threads(1)
    if name == "sac":
        model: SAC = SAC("MlpPolicy", "Brake-v0", seed=seed, device="cpu")
    else:
        settings = {"learning_starts": 300, "n_steps": 3, **VARIANTS[name]}
        model = SACAux("MlpPolicy", "Brake-v0", seed=seed, device="cpu", **settings)
    for module in model.critic.modules() if name == "momentum" else ():
        if isinstance(module, th.nn.BatchNorm1d):
            module.momentum = 0.1
    shown = []
    for _ in range(STEPS // EVERY):
        model.learn(EVERY, reset_num_timesteps=model.num_timesteps == 0)
        env = gym.make("Brake-v0")
        env.reset(seed=1000 + seed)
        text = f"{evaluate_policy(model, env, 10, warn=False)[0]:.0f}"
        if isinstance(model, SACAux) and model.replay_buffer is not None and model.log_ent_coef is not None:
            model.policy.set_training_mode(False)
            with th.no_grad():
                observations = model.replay_buffer.sample(256).observations
                actions = model.actor(observations, deterministic=True)
                q_values = th.cat(model.critic.q_values(model.critic.encode(observations), actions), 1).mean()
            text += f" (Q {q_values:.0f} |a| {actions.abs().mean():.2f} ent {model.log_ent_coef.exp().item():.3f})"
        shown.append(text)
    print(name, seed, shown, flush=True)


main(sys.argv[1], int(sys.argv[2]))
