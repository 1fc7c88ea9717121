"""How a run is trained in its folder, from its last checkpoint on: ``python -m sb3_aarl.search.training.run FOLDER``."""

import argparse
import json
import logging
import os
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import torch as th
from filelock import FileLock, Timeout
from sb3_aarl.search.training import checkpoint
from sb3_aarl.search.training.folder import (
    CURVE,
    FAILED,
    LOCK,
    MODEL,
    NORMALIZE,
    RUN,
    STOP,
    Run,
    is_finished,
    one_line,
    partial_curve,
    prepare_run,
    read_run,
)
from sb3_aarl.search.training.provenance import add_session, read_about, write_about
from sb3_aarl.search.training.setup import Setup, check_run
from stable_baselines3.common.vec_env import VecNormalize

from sb3_aarl.callbacks import Evaluation, LearningCurveCallback, write_curve
from sb3_aarl.files import replace_text, replacing

# What is needed to train a run from Python.
__all__ = ["Run", "check_run", "prepare_run", "train"]
logger = logging.getLogger(__name__)

LOCK_SECONDS = 60.0
LOCKED = 75  # exit code: another process trains the run
# The evaluations of a run have this many seeds, from this one on; runs begin with others.
EVALUATION_SEED = 10_000
EVALUATION_SEEDS = 1_000_000


def train(folder: Path, on_evaluation: Callable[[list[Evaluation]], object] = lambda curve: None) -> list[Evaluation]:
    """
    Train the run of a folder, after :func:`prepare_run`, in this process, from its last checkpoint on; that of a finished run
    is read. On a CPU, a run that was killed and resumed ends bit for bit like an undisturbed one if ``reset(seed)`` determines
    all that its environment does. A file ``stop`` in the folder ends the run at once; its last checkpoint stays.

    :param on_evaluation: Called with the curve so far after each evaluation
    :raises filelock.Timeout: when another process trains it for longer than a minute
    """
    folder = Path(folder)
    with FileLock(folder / LOCK, timeout=LOCK_SECONDS, fallback_to_soft=False):
        if not is_finished(folder):
            (folder / FAILED).unlink(missing_ok=True)
            try:
                _train(folder, read_run(folder), on_evaluation)
            except FloatingPointError:  # it would fail again from the checkpoint
                checkpoint.remove(folder)
                raise
        if is_finished(folder):
            checkpoint.remove(folder)
        return partial_curve(folder)


def _train(folder: Path, run: Run, on_evaluation: Callable[[list[Evaluation]], object]) -> None:
    th.set_num_threads(run.threads)
    setup = Setup(run, str(folder / RUN))
    state = checkpoint.read(folder)
    curve = [Evaluation(*row) for row in state["curve"]] if state else []
    trained = curve[-1].environment_steps if curve else 0
    if curve:
        logger.warning("%s is resumed at %d environment steps", folder, trained)
    with closing(setup.training_env(trained)) as env, closing(setup.evaluation_env()) as evaluation_env:
        model = setup.model(env)
        evaluations = LearningCurveCallback(
            evaluation_env,
            run.checkpoints,
            run.evaluation_episodes,
            setup.action_repeat,
            seed=(EVALUATION_SEED + EVALUATION_SEEDS * run.seed) % 2**31,
            curve=curve,
        )

        def report() -> None:
            write_curve(folder / CURVE, evaluations.curve)
            on_evaluation(evaluations.curve)

        add_session(folder, aux_loss=str(model.aux_loss), device=str(model.device), threads=run.threads)
        checkpoints = checkpoint.CheckpointCallback(folder, run.seed, evaluations.curve, report, folder / STOP, state)
        del state  # mapped from a file that will be replaced
        model.learn(setup.agent_steps, [evaluations, checkpoints])
        if not checkpoints.stopped:
            if run.keep_model:
                with replacing(folder / MODEL, folder / f"unfinished-{MODEL}") as unfinished:
                    model.save(unfinished)
                    if isinstance(env, VecNormalize):
                        env.save(str(folder / NORMALIZE))
            write_about(folder, {**read_about(folder), "seconds": evaluations.curve[-1].seconds})
            report()


def _end_with_stdin() -> None:
    """End this process when its starter ends, or closes the pipe of its standard input."""
    while os.read(0, 1024):
        pass
    os._exit(1)


def main() -> None:
    """Train the run of a folder; a failure is written to ``failed.json``."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="folder with run.json")
    parser.add_argument("--end-with-stdin", action="store_true", help="end when standard input closes")
    arguments = parser.parse_args()
    if not (arguments.folder / RUN).exists():
        parser.error(f"{arguments.folder / RUN} does not exist")
    if arguments.end_with_stdin:
        threading.Thread(target=_end_with_stdin, daemon=True).start()
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.WARNING)
    try:
        train(arguments.folder)
    except Timeout as error:  # the process that trains it writes the outcome
        logger.warning("%s", error)
        sys.exit(LOCKED)
    except Exception as error:
        outcome = {"reason": one_line(error), "retry": not isinstance(error, FloatingPointError)}
        replace_text(arguments.folder / FAILED, json.dumps(outcome) + "\n")
        raise


if __name__ == "__main__":
    main()
