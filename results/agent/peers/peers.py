"""
Train an algorithm of sb3-contrib as `aarl benchmark` trains SACAux; the same command resumes it from its last evaluation.

    python results/agent/peers/peers.py tqc Hopper-v5 --seed 30 --steps 120000
"""

import argparse
from pathlib import Path
from typing import Any

import torch as th
from sb3_aarl.search.training.provenance import add_session, read_about, write_about
from sb3_aarl.search.training.run import EVALUATION_SEED, EVALUATION_SEEDS
from sb3_contrib import TQC, CrossQ
from stable_baselines3.common.env_util import make_vec_env

from sb3_aarl.callbacks import Evaluation, LearningCurveCallback, read_curve

# RL-Zoo's for MuJoCo's tasks, but CrossQ has sb3-contrib's default width: 1024 instead of 2048, a third of the time.
SETTINGS: dict[str, dict[str, Any]] = {"tqc": {"learning_starts": 10_000}, "crossq": {"learning_starts": 5_000}}
TQC_ON_HOPPER = {"top_quantiles_to_drop_per_net": 5}
ALGORITHMS: dict[str, type[TQC] | type[CrossQ]] = {"tqc": TQC, "crossq": CrossQ}
FOLDER = Path(__file__).resolve().parent / "runs"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("algorithm", choices=ALGORITHMS)
    parser.add_argument("env", help="id of a task of Gymnasium")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--every", type=int, default=10_000)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    args = parser.parse_args()
    th.set_num_threads(1)
    algorithm, settings = ALGORITHMS[args.algorithm], SETTINGS[args.algorithm]
    if (args.algorithm, args.env) == ("tqc", "Hopper-v5"):
        settings = settings | TQC_ON_HOPPER
    folder = args.folder / args.algorithm / args.env / f"seed-{args.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    curve_file, model_file, buffer_file = (folder / name for name in ("curve.csv", "checkpoint.zip", "buffer.pkl"))
    env = make_vec_env(args.env, seed=args.seed)
    if model_file.exists():
        model, curve = algorithm.load(model_file, env), read_curve(curve_file)
        model.load_replay_buffer(buffer_file)
        model.set_random_seed(args.seed + model.num_timesteps)
    else:
        buffer_size = min(args.steps, 1_000_000)
        model, curve = algorithm("MlpPolicy", env, buffer_size=buffer_size, seed=args.seed, **settings), []
    about = {"variant": args.algorithm, "environment": args.env, "seed": args.seed, "hyperparameters": settings}
    command = f"python results/agent/peers/peers.py {args.algorithm} {args.env} --seed {args.seed} --steps {args.steps}"
    write_about(folder, {**about, **read_about(folder), "command": command})
    add_session(folder, device=str(model.device), threads=1)

    def save(_: Evaluation) -> None:
        model.save_replay_buffer(buffer_file)
        model.save(model_file)

    callback = LearningCurveCallback(
        make_vec_env(args.env, 10, seed=0),
        range(args.every, args.steps + 1, args.every),
        seed=(EVALUATION_SEED + EVALUATION_SEEDS * args.seed) % 2**31,
        path=curve_file,
        on_evaluation=save,
        curve=curve,
    )
    model.learn(args.steps - model.num_timesteps, callback, reset_num_timesteps=not curve)
    write_about(folder, {**read_about(folder), "seconds": callback.curve[-1].seconds})
    for file in (model_file, buffer_file):
        file.unlink()


if __name__ == "__main__":
    main()
