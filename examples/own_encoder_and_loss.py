"""
An encoder and an auxiliary loss of one's own, on Gymnasium's Pendulum-v1.

The encoder is a features extractor as in SB3, the loss predicts two later states and a reward from a state and two
actions. One sees SB3's log every 20 episodes, with train/aux_loss among its values, and the mean return at the end: near
-150 after 5,000 steps, which take two minutes on one core.

    python examples/own_encoder_and_loss.py
"""

import argparse

import torch
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_aarl import AuxLoss, SACAux


class Waves(BaseFeaturesExtractor):
    """Sines of learnt directions, then a linear layer and layer norm."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 32, n_waves: int = 64):
        super().__init__(observation_space, features_dim)
        self.directions = nn.Linear(observation_space.shape[0], n_waves)
        self.output = nn.Sequential(nn.Linear(n_waves, features_dim), nn.LayerNorm(features_dim))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return self.output(torch.sin(self.directions(observations)))


def main(steps: int) -> None:
    loss = AuxLoss.parse("{s_t, a_t, a_t+1} -> {s_t+1, r_t+1, s_t+2}")
    print(f"{loss}: horizon {loss.horizon}, operator {loss.operator}")
    policy_kwargs = {"features_extractor_class": Waves, "features_extractor_kwargs": {"n_waves": 48}}
    model = SACAux("MlpPolicy", "Pendulum-v1", aux_loss=loss, policy_kwargs=policy_kwargs, verbose=1, seed=0)
    model.learn(steps, log_interval=20)
    print(f"mean return: {evaluate_policy(model, model.get_env(), 10)[0]:.0f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=5_000)
    main(parser.parse_args().steps)
