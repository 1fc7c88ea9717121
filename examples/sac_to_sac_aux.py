"""
From SAC to SACAux: the same lines with another class, on Gymnasium's Pendulum-v1, with SB3's EvalCallback.

One sees the mean return of ten episodes after every 1,000 steps of SB3's SAC, then of SACAux, and the seconds that each
took: both get to about -150, in four minutes of one core together. Pendulum is easy; what an auxiliary loss is worth shows on
harder tasks, see results/.

    python examples/sac_to_sac_aux.py
"""

import argparse
import time

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor

from sb3_aarl import SACAux


def main(steps: int) -> None:
    for algorithm in (SAC, SACAux):
        print(algorithm.__name__)
        evaluation = EvalCallback(
            Monitor(gym.make("Pendulum-v1")),
            n_eval_episodes=10,
            eval_freq=min(1_000, steps),
            best_model_save_path=f"runs/examples/{algorithm.__name__}",
        )
        model = algorithm("MlpPolicy", "Pendulum-v1", seed=0)
        started = time.monotonic()
        model.learn(steps, callback=evaluation)
        print(f"{algorithm.__name__}: {evaluation.last_mean_reward:.0f} after {time.monotonic() - started:.0f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=5_000, help="steps of each run")
    main(parser.parse_args().steps)
