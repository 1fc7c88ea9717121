"""
A search for losses on an environment of one's own, from Python, with an executor of one's own.

One sees which runs start, how far each generation is, and the best loss: four runs, one to two minutes on two cores. Scores of
so short runs mean little. The same command resumes the search.

    python examples/search_from_python.py
"""

import argparse
import os
from pathlib import Path

import gymnasium as gym
from sb3_aarl.search.execution.executors import LocalExecutor
from sb3_aarl.search.studies.config import SearchConfig
from sb3_aarl.search.studies.search import Search

HYPERPARAMETERS = {"learning_starts": 100, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}
# A pendulum on Mars. Any class of environments will do in place of Gymnasium's own.
ENVIRONMENT, ENTRY_POINT = "MarsPendulum-v0", "gymnasium.envs.classic_control:PendulumEnv"


class Announcing(LocalExecutor):
    """An executor is whatever has ``submit(fn, *args)`` and returns a future. This one says what it starts."""

    def submit(self, fn, /, *args):
        print("starts", *args)
        return super().submit(fn, *args)


def main(steps: int) -> None:
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # where runs, processes of their own, find this file
    config = SearchConfig(
        path="mars",  # the name of the study; Search.from_file reads a configuration from a file instead
        environment=ENVIRONMENT,
        imports=("search_from_python",),
        checkpoints=(steps // 2, steps),
        evaluation_episodes=3,
        overrides=HYPERPARAMETERS,
        generations=2,
        population_size=2,
        n_random=2,
        n_prior=0,
    )
    with Announcing(workers=2) as executor:
        progress = Search(config, Path("runs/examples/search")).run(executor, workers=2)
    for generation in progress.generations:
        print(generation)
    print(f"Best: {progress.best_loss}, score {progress.best:.0f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=1_000, help="steps of each run")
    main(parser.parse_args().steps)
else:
    gym.register(ENVIRONMENT, ENTRY_POINT, max_episode_steps=200, kwargs={"g": 3.7})
