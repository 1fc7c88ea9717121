"""A training run: a value, ``Run``, and a folder with ``run.json``, from which it is trained, and ``curve.csv``."""

import argparse
import functools
import inspect
import json
import logging
import math
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import gymnasium as gym
import pydantic
import torch as th
from filelock import FileLock, Timeout
from gymnasium import spaces
from sb3_aarl.search.training import checkpoint
from sb3_aarl.search.training.config import (
    VEC_ENVS,
    ConfigError,
    action_repeat,
    check_hyperparameters,
    env_wrappers,
    import_modules,
    validated,
)
from sb3_aarl.search.training.provenance import add_session, read_about, write_about
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_aarl import AuxLoss, SACAux
from sb3_aarl.callbacks import Evaluation, LearningCurveCallback, SingleEpisodes, read_curve, write_curve
from sb3_aarl.envs import EPISODE_LENGTH, PREFIX, make_dmc_env, wrap_env
from sb3_aarl.files import replace_text

logger = logging.getLogger(__name__)

RUN = "run.json"
CURVE = "curve.csv"
MODEL = "model.zip"
NORMALIZE = "vecnormalize.pkl"
FAILED = "failed.json"
STOP = "stop"
LOCK = "lock"
LOCK_SECONDS = 60.0
LOCKED = 75  # exit code: another process trains the run
# The evaluations of a run have this many seeds, from this one on; runs begin with others.
EVALUATION_SEED = 10_000
EVALUATION_SEEDS = 1_000_000
# Evaluations are normalized with the statistics of training, and have the task's own rewards.
FIXED = {"training": False, "norm_reward": False}
# Agent steps of the shortest run that is compiled: it takes two minutes, and saves at most 15 ms of a gradient step, from
# pixels (benchmarks/README.md).
COMPILED_STEPS = 8_000
# Agent steps of a run that is tried out: so that there are windows.
TRIED_STEPS = 20
# Hyper-parameters that do not change what is trained: the checkpoints say how long, and any device will do.
FREE = ("n_timesteps", "device")


class Run(pydantic.BaseModel, frozen=True, extra="forbid"):
    """
    One training run.

    :param environment: Id of the environment
    :param aux_loss: Notation, name of the catalogue, or ``"auto"``; None for no auxiliary loss
    :param hyperparameters: As returned by ``load_hyperparameters``
    :param seed: Seed of the run
    :param checkpoints: Environment steps of the evaluations, ascending; the run is resumed from there
    :param evaluation_episodes: Episodes of each evaluation
    :param threads: Threads that PyTorch uses; they change the last bits
    :param imports: Modules that are imported first, such as those that register environments
    :param keep_model: Whether to leave the trained model as ``model.zip``
    """

    environment: str
    aux_loss: str | None
    hyperparameters: dict[str, Any]
    seed: int
    checkpoints: tuple[int, ...]
    evaluation_episodes: int = 10
    threads: int = 1
    imports: tuple[str, ...] = ()
    keep_model: bool = False


class Outcome(NamedTuple):
    """How a run ended: its curve so far, the reason in one line if it failed, and whether a repetition may succeed."""

    curve: list[Evaluation]
    failure: str | None
    retry: bool


def prepare_run(folder: Path, run: Run) -> None:
    """
    Make the folder of a run, or take the one that it has already. Files that ended it before are deleted.

    :raises ValueError: when the folder has another run, naming the key that differs
    """
    folder.mkdir(parents=True, exist_ok=True)
    values = run.model_dump(mode="json")
    if (folder / RUN).exists():
        stored = read_run(folder).model_dump(mode="json")
        for key, ours, theirs in differences(values, stored):
            if key not in [f"hyperparameters.{name}" for name in FREE]:
                there, here = ("not set" if value is None else repr(value) for value in (theirs, ours))
                raise ValueError(
                    f"{folder} has another run: {key} is {there} there, {here} here. Choose another folder (--folder)"
                )
    replace_text(folder / RUN, json.dumps(values, indent=1) + "\n")
    for name in (STOP, FAILED):
        (folder / name).unlink(missing_ok=True)


def read_outcome(folder: Path) -> Outcome | None:
    """How a run ended, None as long as it did not: it runs, waits, or was killed or told to stop."""
    curve = partial_curve(folder)
    if is_finished(folder):
        return Outcome(curve, None, False)
    if not (folder / FAILED).exists():
        return None
    failed = json.loads((folder / FAILED).read_text(encoding="utf-8"))
    return Outcome(curve, failed["reason"], failed["retry"])


def partial_curve(folder: Path) -> list[Evaluation]:
    """The learning curve of a run so far."""
    return read_curve(folder / CURVE) if (folder / CURVE).exists() else []


def is_finished(folder: Path) -> bool:
    """Whether a run has its complete curve, and its model if that is kept."""
    if not (folder / RUN).exists():
        return False
    run = read_run(folder)
    steps = tuple(evaluation.environment_steps for evaluation in partial_curve(folder))
    return steps == run.checkpoints and (not run.keep_model or (folder / MODEL).exists())


def read_run(folder: Path) -> Run:
    """The run of a folder."""
    path = folder / RUN
    return validated(Run, json.loads(path.read_text(encoding="utf-8")), str(path))


def differences(one: Any, other: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Keys with dots, and both values, where two plain values differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in {**one, **other}:
            yield from differences(one.get(name), other.get(name), f"{key}.{name}" if key else name)
    elif one != other:
        yield key, one, other


def make_env(env_id: str, env_kwargs: Mapping[str, Any], env_wrapper: Any = None, renders: bool = False) -> gym.Env:
    """The environment of a configuration. ``renders`` has it render if it observes no pixels, too."""
    if env_id.startswith(PREFIX):
        env = make_dmc_env(env_id, **env_kwargs)
    else:
        arguments: dict[str, Any] = {"render_mode": "rgb_array"} if renders or env_kwargs.get("pixels") else {}
        env = wrap_env(gym.make(env_id, **arguments), **env_kwargs)
    for wrapper, wrapper_arguments in env_wrappers(env_wrapper):
        env = wrapper(env, **wrapper_arguments)
    return env


def checkpoint_interval(hyperparameters: Mapping[str, Any]) -> int:
    """Environment steps of one rollout with these hyper-parameters: every checkpoint is a multiple of them."""
    train_freq = hyperparameters.get("train_freq", 1)
    rollout = train_freq if isinstance(train_freq, int) else 1 if train_freq[1] == "episode" else train_freq[0]
    return max(1, rollout) * hyperparameters.get("n_envs", 1) * action_repeat(hyperparameters)


def check_checkpoints(checkpoints: Iterable[int], hyperparameters: Mapping[str, Any], source: str) -> None:
    """Every checkpoint has to be the end of a rollout."""
    interval = checkpoint_interval(hyperparameters)
    if between := [steps for steps in sorted(checkpoints) if steps % interval]:
        of_what = f"{interval} (train_freq x n_envs x action repeat)"
        raise ConfigError(f"{source}: checkpoints must be multiples of {of_what}, {between} are not")


def spread_checkpoints(environment_steps: int, n_evaluations: int, interval: int = 1) -> tuple[int, ...]:
    """Equally spaced checkpoints, multiples of an interval; the last is a little early where they do not divide the run."""
    if n_evaluations < 1 or environment_steps < n_evaluations * interval:
        raise ValueError(
            f"{environment_steps} environment steps, {interval} at a time, are too few for {n_evaluations} evaluations"
        )
    every = environment_steps // n_evaluations // interval * interval
    return tuple(every * (i + 1) for i in range(n_evaluations))


def _make_in_process(
    imports: Sequence[str], env_id: str, env_kwargs: Mapping[str, Any], env_wrapper: Any, steps: Sequence[int]
) -> gym.Env:
    import_modules(imports)  # the process may be one of the environment alone
    return checkpoint.TruncateAt(make_env(env_id, env_kwargs, env_wrapper), steps)


class Setup:
    """What a run is trained with; its settings are from ``source``, in messages."""

    def __init__(self, run: Run, source: str):
        self.run = run
        import_modules(run.imports)
        settings = check_hyperparameters(run.hyperparameters, run.environment, source)
        self.action_repeat = action_repeat(settings)
        check_checkpoints(run.checkpoints, settings, source)
        train_freq = settings.get("train_freq")
        if isinstance(train_freq, tuple) and train_freq[1] == "episode" and train_freq[0] > 1:
            raise ConfigError(f"{source}: train_freq must be 1 episode at most: a rollout has to end at each checkpoint")
        settings.pop("n_timesteps", None)
        self.env_kwargs: dict[str, Any] = settings.pop("env_kwargs", None) or {}
        self.env_wrapper = settings.pop("env_wrapper", None)
        self.pixels = self.env_kwargs.get("pixels", False)
        self.policy = settings.pop("policy", None)
        self.n_envs, self.vec_env = settings.pop("n_envs", 1), VEC_ENVS[settings.pop("vec_env", "dummy")]
        normalize = settings.pop("normalize", False)
        self.normalize: dict[str, Any] | None = {} if normalize is True else normalize if normalize is not False else None
        if self.normalize is not None and "gamma" in settings:  # as in RL-Zoo
            self.normalize = {"gamma": settings["gamma"], **self.normalize}
        self.agent_steps = run.checkpoints[-1] // self.action_repeat
        # The same run with less memory and a smaller checkpoint; each environment has an equal share of the buffer.
        default = inspect.signature(SACAux).parameters["buffer_size"].default
        needed = math.ceil(self.agent_steps / self.n_envs) * self.n_envs
        settings["buffer_size"] = min(settings.get("buffer_size", default), needed)
        if settings.get("compile") and self.agent_steps < COMPILED_STEPS:
            settings["compile"] = False
        self.settings = _with_schedules(settings) | {"aux_loss": run.aux_loss, "seed": run.seed}

        of_dmc = run.environment.startswith(PREFIX)
        limits = [EPISODE_LENGTH if of_dmc else gym.spec(run.environment).max_episode_steps]
        for wrapper, arguments in env_wrappers(self.env_wrapper):
            limits += [arguments["max_episode_steps"] * self.action_repeat] if wrapper is gym.wrappers.TimeLimit else []
        self.episode_steps = min((limit for limit in limits if limit is not None), default=None)

    def _make(self, steps: Sequence[int] = ()) -> Callable[[], gym.Env]:
        run = self.run
        return functools.partial(_make_in_process, run.imports, run.environment, self.env_kwargs, self.env_wrapper, steps)

    def training_env(self, trained: int = 0) -> VecEnv:
        """Environments that are truncated at the checkpoints after so many environment steps of training."""
        steps = [(steps - trained) // self.action_repeat // self.n_envs for steps in self.run.checkpoints]
        env = make_vec_env(self._make(steps), self.n_envs, seed=self.run.seed, vec_env_cls=self.vec_env)
        return env if self.normalize is None else VecNormalize(env, **self.normalize)

    def evaluation_env(self) -> VecEnv:
        # From states a prediction takes as long as a step of an environment: one for all episodes. A picture takes much
        # longer than the prediction from it, and each environment that renders has tens of megabytes for it.
        episodes = self.run.evaluation_episodes
        n_envs, vec_env = (min(self.n_envs, episodes), self.vec_env) if self.pixels else (episodes, DummyVecEnv)
        env = make_vec_env(self._make(), n_envs, seed=0, vec_env_cls=vec_env, wrapper_class=SingleEpisodes)
        return env if self.normalize is None else VecNormalize(env, **{**self.normalize, **FIXED})

    def model(self, env: VecEnv) -> SACAux:
        fitting = "CnnPolicy" if is_image_space(env.observation_space) else "MlpPolicy"
        if isinstance(env.observation_space, spaces.Dict):
            fitting = "MultiInputPolicy"
        return SACAux(self.policy or fitting, env, **self.settings)


def _with_schedules(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings, and those in their mappings, with functions for learning rates such as ``lin_3e-4``."""
    read: dict[str, Any] = {}
    for key, value in settings.items():
        is_schedule = isinstance(value, str) and value.startswith("lin_")
        read[key] = LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0) if is_schedule else value
        if isinstance(value, Mapping):
            read[key] = _with_schedules(value)
    return read


def check_run(run: Run, source: str | None = None) -> Setup:
    """
    Try a run out, before it is submitted: make its environment and model, train for some steps. Warn of what a user may not
    have meant.

    :param run: The run
    :param source: The file with its settings, for messages; None for the environment alone
    :return: What it is trained with
    :raises ConfigError: with the reason in one line, when it cannot be trained
    """
    what = f"{source or ''}: {run.environment} cannot be trained with these settings".removeprefix(": ")
    try:
        setup = Setup(run, source or run.environment)
        setup.settings["compile"] = False  # it takes minutes
        with closing(setup.training_env()) as env, TemporaryDirectory() as folder:
            model = setup.model(env)
            learning_starts = model.learning_starts
            model.tensorboard_log = None if model.tensorboard_log is None else folder
            try_out(model)
    except ConfigError:
        raise
    except Exception as error:  # Gymnasium, SB3 and PyTorch have errors of all kinds
        raise ConfigError(f"{what}: {_one_line(error)}") from error
    horizon = model.aux_loss.horizon * setup.action_repeat if isinstance(model.aux_loss, AuxLoss) else 0
    if setup.episode_steps is not None and setup.episode_steps < horizon:
        problem = f"have {setup.episode_steps} environment steps, the horizon of {model.aux_loss} {horizon}"
        raise ConfigError(f"{what}: episodes {problem}")
    if setup.agent_steps <= learning_starts:
        message = "%d agent steps are all random actions, nothing is learnt: learning_starts is %d"
        logger.warning(message, setup.agent_steps, learning_starts)
    apart = min(after - before for before, after in zip((0, *run.checkpoints), run.checkpoints, strict=False))
    if setup.episode_steps is None:
        logger.warning("%s has no time limit: an evaluation waits until its episodes end", run.environment)
    elif apart < setup.episode_steps * setup.n_envs:
        message = "evaluating every %d environment steps truncates episodes, which may have %d"
        logger.warning(message, apart // setup.n_envs, setup.episode_steps)
    return setup


def try_out(model: SACAux) -> None:
    """Make some steps with a model, with its own actions, and gradient steps of all its parts."""

    def step(*_: Any) -> bool:
        if model.num_timesteps < TRIED_STEPS * model.n_envs:
            return True
        model.train(2, model.batch_size)  # the actor is not trained at each
        return False  # whatever the length of a rollout is

    model.verbose = model.learning_starts = 0
    model.learn(TRIED_STEPS * model.n_envs, step)


def _one_line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def train(
    folder: Path,
    progress_bar: bool = False,
    on_evaluation: Callable[[list[Evaluation]], object] | None = None,
) -> list[Evaluation]:
    """
    Train the run of a folder in this process, from its last checkpoint on. On a CPU, a run that was killed and resumed ends
    bit for bit like an undisturbed one if ``reset(seed)`` determines all that its environment does.

    :param folder: Folder that :func:`prepare_run` has prepared
    :param on_evaluation: Called with the curve so far after each evaluation; a file ``stop`` in the folder ends the run there
    :return: The learning curve; that of a finished run is read, not trained again
    :raises filelock.Timeout: when another process trains it for longer than a minute
    """
    folder = Path(folder)
    with FileLock(folder / LOCK, timeout=LOCK_SECONDS, fallback_to_soft=False):
        if not is_finished(folder):
            (folder / FAILED).unlink(missing_ok=True)
            try:
                _train(folder, read_run(folder), progress_bar, on_evaluation)
            except FloatingPointError:  # and so it would be from the checkpoint on
                checkpoint.remove(folder)
                raise
        checkpoint.remove(folder)
        return read_curve(folder / CURVE)


def _train(folder: Path, run: Run, progress_bar: bool, on_evaluation: Callable[[list[Evaluation]], object] | None) -> None:
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

        def report() -> bool:
            model.dump_logs()  # as SB3 does every fourth episode: TensorBoard has a point for each evaluation, the last too
            write_curve(folder / CURVE, evaluations.curve)
            if on_evaluation is not None:
                on_evaluation(evaluations.curve)
            return not (folder / STOP).exists()

        add_session(folder, aux_loss=str(model.aux_loss), device=str(model.device), threads=run.threads)
        checkpoints = checkpoint.CheckpointCallback(folder, run.seed, evaluations.curve, report, state)
        del state  # mapped from a file that will be replaced
        model.learn(setup.agent_steps, [evaluations, checkpoints], progress_bar=progress_bar)
        if not checkpoints.stopped:
            if run.keep_model:
                unfinished = folder / f"unfinished-{MODEL}"
                model.save(unfinished)
                if isinstance(env, VecNormalize):
                    env.save(str(folder / NORMALIZE))
                unfinished.replace(folder / MODEL)
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
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    try:
        train(arguments.folder)
    except Timeout as error:  # the process that trains it writes the outcome
        logger.warning("%s", error)
        sys.exit(LOCKED)
    except Exception as error:
        outcome = {"reason": _one_line(error), "retry": not isinstance(error, FloatingPointError)}
        replace_text(arguments.folder / FAILED, json.dumps(outcome) + "\n")
        raise


if __name__ == "__main__":
    main()
