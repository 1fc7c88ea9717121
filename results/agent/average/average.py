"""
Evaluate the actor of a run, and moving averages of its weights, on the same episodes; training is that of `aarl benchmark`.

    python results/agent/average/average.py Hopper-v4 --seed 0 --steps 60000 --every 10000 --out looks/Hopper-v4-0.jsonl
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch as th
from sb3_aarl.search.training.config import load_hyperparameters, resolve_env_id
from sb3_aarl.search.training.run import EVALUATION_SEED, EVALUATION_SEEDS, Run
from sb3_aarl.search.training.setup import Setup
from sb3_aarl.search.training.shipped import find_file
from stable_baselines3.common.callbacks import BaseCallback
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from sb3_aarl import SACAux
from sb3_aarl.callbacks import Evaluation, LearningCurveCallback

DECAYS = (0.99, 0.997, 0.999)  # of each update of the actor, which is every third agent step


class Averages(BaseCallback):
    """Averages of the actor and of the encoder that it reads."""

    model: SACAux
    averages: dict[float, AveragedModel]

    def _on_training_start(self) -> None:
        self.averages = {decay: AveragedModel(self.model.actor, multi_avg_fn=get_ema_multi_avg_fn(decay)) for decay in DECAYS}
        self.n_updates = 0

    def _on_step(self) -> bool:
        if self.model._n_updates // self.model.policy_delay > self.n_updates:
            self.n_updates = self.model._n_updates // self.model.policy_delay
            for average in self.averages.values():
                average.update_parameters(self.model.actor)
        return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("env")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--steps", type=int, required=True, help="environment steps")
    parser.add_argument("--learning-starts", type=int, default=5000, help="random agent steps, as in a run of 100,000")
    parser.add_argument("--every", type=int, default=10000)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    th.set_num_threads(1)
    env_id = resolve_env_id(args.env)
    values = load_hyperparameters(find_file(Path("sac_aux")), env_id)
    values |= {"n_steps": 3, "learning_starts": args.learning_starts}
    values.pop("policy", None)
    checkpoints = tuple(range(args.every, args.steps + 1, args.every))
    run = Run(environment=env_id, aux_loss="auto", hyperparameters=values, seed=args.seed, checkpoints=checkpoints)
    setup = Setup(run, "average")
    model = setup.model(setup.training_env())
    averages = Averages()
    seed = (EVALUATION_SEED + EVALUATION_SEEDS * run.seed) % 2**31
    args.out.parent.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()

    def evaluate(evaluation: Evaluation) -> None:
        row = {"env": args.env, "seed": args.seed, "steps": evaluation.environment_steps}
        row |= {"actor": round(evaluation.mean, 2), "actor_std": round(evaluation.std, 2)}
        for decay, average in averages.averages.items():
            model.policy.actor = average.module  # type: ignore[assignment]
            returns = callback._episode_returns(seed + 1000 * (len(callback.curve) - 1))
            row |= {str(decay): round(float(np.mean(returns)), 2), f"{decay}_std": round(float(np.std(returns)), 2)}
        model.policy.actor = model.actor
        row["seconds"] = round(time.monotonic() - started)
        with args.out.open("a") as file:
            file.write(json.dumps(row) + "\n")

    evaluation_env = setup.evaluation_env()
    callback = LearningCurveCallback(
        evaluation_env, checkpoints, run.evaluation_episodes, setup.action_repeat, seed, on_evaluation=evaluate
    )
    model.learn(setup.agent_steps, [averages, callback])


if __name__ == "__main__":
    main()
