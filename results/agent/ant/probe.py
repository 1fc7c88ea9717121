"""Train SACAux with one setting on one task, and record what its networks do at each evaluation, as JSON lines (about.md)."""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_aarl import SACAux
from sb3_aarl.envs import make_dmc_env

LAYER_NORM = {
    "learning_rate": 3e-4,
    "policy_delay": 2,
    "policy_kwargs": {"critic_norm": "layer", "optimizer_kwargs": {"betas": (0.9, 0.999)}},
}
DECAY: dict[str, Any] = {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.1}}
VARIANTS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "decay": {"policy_kwargs": DECAY},
    "decay_one_critic": {"policy_kwargs": {**DECAY, "n_critics": 1}},
    "one_step": {"n_steps": 1},
    "layer_norm": LAYER_NORM,
    "layer_norm_one_step": {**LAYER_NORM, "n_steps": 1},
}


def make(task: str) -> tuple[gym.Env, int]:
    """The environment of a task, and its action repeat."""
    return (gym.make(task), 1) if task in gym.registry else (make_dmc_env(task, action_repeat=2), 2)


def hidden_units(network: nn.Sequential, x: th.Tensor) -> list[th.Tensor]:
    """The outputs of all ReLUs."""
    outputs = []
    for layer in network:
        x = layer(x)
        if isinstance(layer, nn.ReLU):
            outputs.append(x)
    return outputs


def share_dead(outputs: list[th.Tensor]) -> float:
    return float(np.mean([float((units <= 0).all(dim=0).float().mean()) for units in outputs]))


class Probe(BaseCallback):
    """
    Evaluate every ``every`` agent steps, and look at a batch of the replay buffer.

    :param episodes: Episodes of each evaluation; they have the same seeds every time
    :param out: File that gets one line for each evaluation
    """

    model: SACAux

    def __init__(self, task: str, every: int, episodes: int, out: Path) -> None:
        super().__init__()
        self.env, self.repeat = make(task)
        self.every, self.episodes, self.out, self.start = every, episodes, out, time.time()

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every == 0:
            self.model.policy.set_training_mode(False)
            seconds = round(time.time() - self.start)
            values = {"env_steps": self.num_timesteps * self.repeat, **self.evaluate(), **self.networks(), "seconds": seconds}
            with self.out.open("a") as file:
                file.write(json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in values.items()}) + "\n")
        return True

    def evaluate(self) -> dict[str, float]:
        """Mean and deviation of the return, and how far the Q values are above the discounted returns."""
        episodes = [self._episode(10_000 + i) for i in range(self.episodes)]
        returns, lengths, q, bias = (np.array(values) for values in zip(*episodes, strict=True))
        return {
            "return": float(returns.mean()),
            "deviation": float(returns.std()),
            "length": float(lengths.mean()),
            "q": float(q.mean()),
            "q_bias": float(bias.mean()),
        }

    @th.no_grad()
    def _episode(self, seed: int) -> tuple[float, int, float, float]:
        model, (obs, _), ended = self.model, self.env.reset(seed=seed), False
        observations, actions, rewards = [], [], []
        while not ended:
            action, _ = model.predict(obs, deterministic=True)
            observations.append(obs)
            actions.append(model.policy.scale_action(action))
            obs, reward, terminated, truncated, _ = self.env.step(action)
            rewards.append(float(reward))
            ended = terminated or truncated
        discounted = np.zeros(len(rewards) + 1)
        for i in reversed(range(len(rewards))):
            discounted[i] = rewards[i] + model.gamma * discounted[i + 1]
        # Of an episode that was cut off, not the end: what comes after it is not known.
        last = len(rewards) if terminated else max(1, len(rewards) - 300)
        at = np.linspace(0, last - 1, min(last, 50)).astype(int)
        latent = model.critic.encode(th.as_tensor(np.array(observations)[at], dtype=th.float32))
        q_values = model.critic.q_values(latent, th.as_tensor(np.array(actions)[at], dtype=th.float32))
        q = th.cat(q_values, dim=1).amin(dim=1).numpy()
        return sum(rewards), len(rewards), float(q.mean()), float((q - discounted[at]).mean())

    @th.no_grad()
    def networks(self) -> dict[str, float]:
        """Norm and effective rank of the latent states, distance to the momentum encoder, entropy, and dead units."""
        model = self.model
        states = np.random.get_state(), th.get_rng_state()
        observations, actions = model.replay_buffer.sample(1024)[:2]  # type: ignore[union-attr]
        np.random.set_state(states[0])
        latent, momentum = model.critic.encode(observations), model.critic_target.encode(observations)
        shares = th.linalg.svdvals(latent - latent.mean(dim=0))
        shares /= shares.sum()
        _, log_prob = model.actor.action_log_prob(observations)
        th.set_rng_state(states[1])
        q_inputs = th.cat([latent, actions], dim=1)
        pi_inputs = model.actor.extract_features(observations, model.actor.features_extractor)
        values = {
            "norm": latent.norm(dim=1).mean(),
            "rank": th.exp(-(shares * (shares + 1e-12).log()).sum()),
            "target_gap": (latent - momentum).norm(dim=1).mean() / latent.norm(dim=1).mean(),
            "entropy": -log_prob.mean(),
            "dead_q": share_dead([u for q in model.critic.q_networks for u in hidden_units(q, q_inputs)]),  # type: ignore[arg-type]
            "dead_pi": share_dead(hidden_units(model.actor.latent_pi, pi_inputs)),  # type: ignore[arg-type]
        }
        logged = model.logger.name_to_value
        names = ("ent_coef", "critic_loss", "aux_loss", "actor_loss")
        values |= {name: logged[f"train/{name}"] for name in names if f"train/{name}" in logged}
        return {name: float(value) for name, value in values.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("variant", choices=VARIANTS)
    parser.add_argument("task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000, help="environment steps")
    parser.add_argument("--every", type=int, default=5_000, help="environment steps between evaluations")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("looks"))
    args = parser.parse_args()
    th.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    env, repeat = make(args.task)
    file = args.out / f"{args.variant}_{args.task}_{args.seed}.jsonl"
    file.unlink(missing_ok=True)
    settings = {"n_steps": 3, "learning_starts": 5000, "buffer_size": 200_000, **VARIANTS[args.variant]}
    model = SACAux("MlpPolicy", env, seed=args.seed, device="cpu", **settings)
    model.learn(args.steps // repeat, callback=Probe(args.task, args.every // repeat, args.episodes, file), log_interval=10**9)


if __name__ == "__main__":
    main()
