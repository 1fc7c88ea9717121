"""
Does it learn? Train SACAux on a DeepMind Control task with several seeds, compare with random actions, keep the curves.

    python benchmarks/learning.py --env reacher-easy --steps 20000 --seeds 0 1 2
    python benchmarks/learning.py --env cheetah-run --pixels --steps 8000 --batch-size 128 --seeds 0
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from sb3_aarl.search.training.provenance import provenance
from stable_baselines3.common.callbacks import BaseCallback

from sb3_aarl import SACAux
from sb3_aarl.callbacks import LearningCurveCallback
from sb3_aarl.envs import make_dmc_env


class AuxLossRecorder(BaseCallback):
    """Keeps the auxiliary loss of every training step, one for each agent step."""

    def __init__(self) -> None:
        super().__init__()
        self.losses: list[float] = []

    def _on_step(self) -> bool:
        # What train() recorded after the agent step before; the logger is emptied only when it is dumped.
        loss = self.logger.name_to_value.get("train/aux_loss")
        if loss is not None:
            self.losses.append(float(loss))
        return True


def random_returns(env_kwargs: dict[str, Any], episodes: int = 10) -> list[float]:
    """Returns of uniformly random actions."""
    env = make_dmc_env(**env_kwargs, seed=0)
    returns = []
    for _ in range(episodes):
        env.reset()
        total, over = 0.0, False
        while not over:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return returns


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="reacher-easy")
    parser.add_argument("--pixels", action="store_true", help="images, three stacked, instead of state vectors")
    parser.add_argument("--fast-rendering", action="store_true", help="no shadows (software rendering is slow)")
    parser.add_argument("--action-repeat", type=int, default=4)
    parser.add_argument("--steps", type=int, default=20_000, help="environment steps")
    parser.add_argument("--evaluations", type=int, default=4)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--aux-loss", default="auto")
    parser.add_argument("--batch-size", type=int, default=512)
    parser.add_argument("--learning-rate", type=float, default=1e-3)
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    arguments = parser.parse_args()

    env_kwargs: dict[str, Any] = {"env_id": arguments.env, "action_repeat": arguments.action_repeat}
    if arguments.pixels:
        env_kwargs |= {"pixels": True, "frame_stack": 3, "fast_rendering": arguments.fast_rendering}
    agent_steps = arguments.steps // arguments.action_repeat
    every = agent_steps // arguments.evaluations * arguments.action_repeat
    checkpoints = [every * (i + 1) for i in range(arguments.evaluations)]
    untrained = random_returns(env_kwargs | {"pixels": False, "frame_stack": 1})
    runs = []
    for seed in arguments.seeds:
        started = time.perf_counter()
        model = SACAux(
            "CnnPolicy" if arguments.pixels else "MlpPolicy",
            make_dmc_env(**env_kwargs),
            learning_rate=arguments.learning_rate,
            batch_size=arguments.batch_size,
            buffer_size=agent_steps,
            aux_loss=None if arguments.aux_loss == "none" else arguments.aux_loss,
            seed=seed,
        )
        recorder = AuxLossRecorder()
        curve = LearningCurveCallback(make_dmc_env(**env_kwargs), checkpoints, seed=10_000 + seed, verbose=1)
        model.learn(agent_steps, callback=[recorder, curve], log_interval=10**9)
        tenths = [float(np.mean(part)) for part in np.array_split(recorder.losses, 10)] if recorder.losses else []
        runs.append(
            {
                "seed": seed,
                "curve": [evaluation._asdict() for evaluation in curve.curve],
                "aulc": curve.aulc,
                "aux_loss_by_tenth": tenths,
                "gradient_steps": model._n_updates,
                "aux_skipped": model._n_aux_skipped,
                "wall_seconds": round(time.perf_counter() - started, 1),
            }
        )
        print(f"seed {seed}: {curve.curve[-1].mean:.1f} after {runs[-1]['wall_seconds']} s; auxiliary loss by tenth: {tenths}")
    finals = [run["curve"][-1]["mean"] for run in runs]
    print(f"random {np.mean(untrained):.1f}, trained {np.mean(finals):.1f} ({', '.join(f'{final:.1f}' for final in finals)})")
    if arguments.out is not None:
        settings = {key: value for key, value in vars(arguments).items() if key != "out"}
        result = {"provenance": provenance(), "settings": settings, "random_returns": untrained, "runs": runs}
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
