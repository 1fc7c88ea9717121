"""
Learning from pictures of 24 x 24 grey pixels, stacked by SB3's VecFrameStack, because no single one shows the speed.

A dot is pushed left and right and should stay in the middle. One sees the mean return before and after 1,000 steps: about 10
and 45 of at most 50, after a minute on one core.

    python examples/pixels.py
"""

import argparse

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_aarl import SACAux

SIZE = 24


class Dot(gym.Env):
    """A dot on a line; the reward of a step is 1 where it is in the middle, and 0 at both ends."""

    observation_space = gym.spaces.Box(0, 255, (SIZE, SIZE, 1), np.uint8)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.speed, self.position = 0, 0.0, self.np_random.uniform(-1, 1)
        return self.picture(), {}

    def step(self, action):
        self.steps += 1
        self.speed = 0.9 * self.speed + 0.05 * float(action[0])
        self.position = float(np.clip(self.position + self.speed, -1, 1))
        return self.picture(), 1 - abs(self.position), False, self.steps == 50, {}

    def picture(self):
        image = np.zeros((SIZE, SIZE, 1), np.uint8)
        column = round((self.position + 1) / 2 * (SIZE - 4))
        image[SIZE // 2 - 2 : SIZE // 2 + 2, column : column + 4] = 255
        return image


def main(steps: int) -> None:
    env = VecFrameStack(make_vec_env(Dot, seed=0), n_stack=3)
    model = SACAux("CnnPolicy", env, learning_starts=200, batch_size=64, policy_kwargs={"net_arch": [64, 64]}, seed=0)
    print(f"before: {evaluate_policy(model, env, 20)[0]:.1f} of 50")
    model.learn(steps)
    print(f"after {steps:,} steps: {evaluate_policy(model, env, 20)[0]:.1f} of 50")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=1_000)
    main(parser.parse_args().steps)
