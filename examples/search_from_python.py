"""
A search for losses on an environment of one's own, from Python, with an executor of one's own.

One sees which runs start, how far each generation is, and the best loss: four runs, one to two minutes on two cores. Scores of
so short runs mean little. The same command resumes the search; `aarl dashboard runs/examples/search` shows it.

    python examples/search_from_python.py
"""

import argparse
import os
from pathlib import Path

import gymnasium as gym
import optuna
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.execution.driver import Driver
from sb3_aarl.search.execution.executors import LocalExecutor
from sb3_aarl.search.execution.storage import open_storage
from sb3_aarl.search.training.run import Run

FOLDER = Path("runs/examples/search")
HYPERPARAMETERS = {"learning_starts": 100, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}
# A pendulum on Mars. Any class of environments will do in place of Gymnasium's own.
ENVIRONMENT, ENTRY_POINT = "MarsPendulum-v0", "gymnasium.envs.classic_control:PendulumEnv"


class Announcing(LocalExecutor):
    """An executor is whatever has ``submit(fn, *args)`` and returns a future. This one says what it starts."""

    def submit(self, fn, /, *args):
        print("starts", *args)
        return super().submit(fn, *args)


def main(steps: int) -> None:
    def make_runs(loss):
        settings = {"environment": ENVIRONMENT, "hyperparameters": HYPERPARAMETERS, "imports": ("search_from_python",)}
        checkpoints = (steps // 2, steps)
        return [Run(aux_loss=str(loss), seed=0, checkpoints=checkpoints, evaluation_episodes=3, **settings)]

    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # where runs, processes of their own, find this file
    sampler = AuxLossSampler(population_size=2, n_random=2, n_prior=0, n_generations=2, seed=0)
    storage = open_storage(FOLDER)
    study = optuna.create_study(study_name="mars", storage=storage, sampler=sampler, direction="maximize", load_if_exists=True)
    with Announcing(workers=2) as executor:
        *_, progress = Driver(study, storage, make_runs, executor, FOLDER, workers=2)
    for generation in progress.generations:
        print(generation)
    print(f"Best: {progress.best_loss}, score {progress.best:.0f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=1_000, help="steps of each run")
    main(parser.parse_args().steps)
else:
    gym.register(ENVIRONMENT, ENTRY_POINT, max_episode_steps=200, kwargs={"g": 3.7})
