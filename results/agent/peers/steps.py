"""
What a step of each algorithm takes beside SACAux's, environment and gradient, on one thread; writes steps.json.

    python results/agent/peers/steps.py
"""

import json
import statistics
import time
from pathlib import Path

import gymnasium as gym
import torch as th
from sb3_aarl.search.training.provenance import provenance
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import SAC

from sb3_aarl import SACAux

STEPS, ROUNDS, START = 60, 15, 500


def main() -> None:
    th.set_num_threads(1)
    kwargs = {"buffer_size": 10_000, "learning_starts": START}
    models = {
        name: algorithm("MlpPolicy", gym.make("Walker2d-v5"), **kwargs)
        for name, algorithm in {"sac_aux": SACAux, "sac": SAC, "tqc": TQC, "crossq": CrossQ}.items()
    }

    def milliseconds(model: SAC | TQC) -> float:
        started = time.perf_counter()
        model.learn(STEPS, reset_num_timesteps=False)
        return 1e3 * (time.perf_counter() - started) / STEPS

    for model in models.values():
        model.learn(START + STEPS)
    rounds = [{name: milliseconds(model) for name, model in models.items()} for _ in range(ROUNDS)]
    result = {
        "ms": {name: statistics.median(times[name] for times in rounds) for name in models},
        "ratio": {name: statistics.median(times[name] / times["sac_aux"] for times in rounds) for name in models},
    }
    print(result)
    Path(__file__).with_name("steps.json").write_text(json.dumps({**provenance(), **result}, indent=1) + "\n")


if __name__ == "__main__":
    main()
