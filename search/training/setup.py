"""The environments and the model of a run, a check that it can be trained, and what it would cost."""

import functools
import inspect
import logging
import math
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from sb3_aarl.search.training.checkpoint import TruncateAt
from sb3_aarl.search.training.config import (
    VEC_ENVS,
    ConfigError,
    action_repeat,
    check_checkpoints,
    check_hyperparameters,
    env_wrappers,
    import_modules,
)
from sb3_aarl.search.training.folder import MODEL, NORMALIZE, Run, one_line, read_run
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_aarl import AuxLoss, SACAux
from sb3_aarl.envs import EPISODE_LENGTH, PREFIX, make_dmc_env, wrap_env
from sb3_aarl.sac_aux import default_learning_starts

logger = logging.getLogger(__name__)

# Evaluations are normalized with the statistics of training, and have the task's own rewards.
FIXED = {"training": False, "norm_reward": False}
VIDEO_SIZE = 320  # pixels of a film, height and width
TRIED_STEPS = 20  # agent steps of a run that is tried out, so that there are windows
MEASURED_SECONDS = 3.0


def make_env(env_id: str, env_kwargs: Mapping[str, Any], env_wrapper: Any = None, renders: bool = False) -> gym.Env:
    """The environment of a configuration. With ``renders``, it renders even if it does not observe pixels."""
    if env_id.startswith(PREFIX):
        env = make_dmc_env(env_id, **env_kwargs)
    else:
        arguments: dict[str, Any] = {"render_mode": "rgb_array"} if renders or env_kwargs.get("pixels") else {}
        env = wrap_env(gym.make(env_id, **arguments), **env_kwargs)
    for wrapper, wrapper_arguments in env_wrappers(env_wrapper):
        env = wrapper(env, **wrapper_arguments)
    return env


def _make_in_process(
    imports: Sequence[str], env_id: str, env_kwargs: Mapping[str, Any], env_wrapper: Any, steps: Sequence[int]
) -> gym.Env:
    import_modules(imports)  # the process may be one of the environment alone
    return TruncateAt(make_env(env_id, env_kwargs, env_wrapper), steps)


class Setup:
    """Environments and model of a run. Messages name ``source`` as the origin of its settings."""

    def __init__(self, run: Run, source: str):
        self.run = run
        import_modules(run.imports)
        settings = check_hyperparameters(run.hyperparameters, run.environment, source)
        self.action_repeat = action_repeat(settings)
        check_checkpoints(run.checkpoints, settings, source)
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
        self.settings = _with_schedules(settings) | {"aux_loss": run.aux_loss, "seed": run.seed}

        is_dmc = run.environment.startswith(PREFIX)
        limits = [EPISODE_LENGTH if is_dmc else gym.spec(run.environment).max_episode_steps]
        for wrapper, arguments in env_wrappers(self.env_wrapper):
            if wrapper is gym.wrappers.TimeLimit and "max_episode_steps" in arguments:
                limits.append(arguments["max_episode_steps"] * self.action_repeat)
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
        env = make_vec_env(self._make(), n_envs, seed=0, vec_env_cls=vec_env)
        return env if self.normalize is None else VecNormalize(env, **{**self.normalize, **FIXED})

    def model(self, env: VecEnv) -> SACAux:
        policy = self.policy or ("CnnPolicy" if is_image_space(env.observation_space) else "MlpPolicy")
        if isinstance(env.observation_space, spaces.Dict):  # for which there is one policy only
            policy = "MultiInputPolicy"
        learning_starts = default_learning_starts(self.agent_steps)
        return SACAux(policy, env, **{"learning_starts": learning_starts, **self.settings})


def _with_schedules(value: Any) -> Any:
    """Settings, and the mappings in them, with functions for learning rates such as ``lin_3e-4``."""
    if isinstance(value, Mapping):
        return {key: _with_schedules(item) for key, item in value.items()}
    is_schedule = isinstance(value, str) and value.startswith("lin_")
    return LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0) if is_schedule else value


def check_run(run: Run, source: str | None = None) -> Setup:
    """
    Make a run's environment and model, and train for some steps. Warn about settings that are probably not intended.

    :param source: The file with its settings, for messages
    :raises ConfigError: with the reason in one line, when it cannot be trained
    """
    what = f"{source or ''}: {run.environment} cannot be trained with these settings".removeprefix(": ")
    try:
        setup = Setup(run, source or run.environment)
        setup.settings.pop("compile", None)  # it takes minutes
        with closing(setup.training_env()) as env, TemporaryDirectory() as folder:
            model = setup.model(env)
            learning_starts = model.learning_starts
            model.tensorboard_log = None if model.tensorboard_log is None else folder
            try_out(model)
    except ConfigError:
        raise
    except Exception as error:  # Gymnasium, SB3 and PyTorch have errors of all kinds
        if place := _place(error, run.imports):
            raise ConfigError(f"{run.environment} raised {one_line(error)} ({place})") from error
        raise ConfigError(f"{what}: {one_line(error)}") from error
    horizon = model.aux_loss.horizon * setup.action_repeat if isinstance(model.aux_loss, AuxLoss) else 0
    if setup.episode_steps is not None and setup.episode_steps < horizon:
        problem = f"have {setup.episode_steps} environment steps, the horizon of {model.aux_loss} {horizon}"
        raise ConfigError(f"{what}: episodes {problem}")
    if setup.agent_steps <= learning_starts:
        message = "%s: all %d agent steps are random actions, and nothing is learnt: learning_starts is %d"
        logger.warning(message, run.environment, setup.agent_steps, learning_starts)
    interval = min(after - before for before, after in zip((0, *run.checkpoints), run.checkpoints, strict=False))
    if setup.episode_steps is None:
        logger.warning("%s has no time limit: an evaluation may take very long", run.environment)
    elif interval < setup.episode_steps * setup.n_envs:
        message = "%s: evaluations every %d environment steps truncate episodes, which have up to %d steps"
        logger.warning(message, run.environment, interval // setup.n_envs, setup.episode_steps)
    return setup


def _place(error: Exception, imports: Sequence[str]) -> str:
    """File and line of a user's own modules at which an error was raised, or nothing."""
    own = {name.partition(".")[0] for name in imports}
    frames = traceback.walk_tb(error.__traceback__)
    lines = [(frame, line) for frame, line in frames if str(frame.f_globals.get("__name__")).partition(".")[0] in own]
    return f"{lines[-1][0].f_code.co_filename}, line {lines[-1][1]}" if lines else ""


def try_out(model: SACAux) -> None:
    """Make some steps with the actions of a model, and the gradient steps up to the first of its actor."""

    def step(*_: Any) -> bool:
        if model.num_timesteps < TRIED_STEPS * model.n_envs:
            return True
        model.train(model.policy_delay, model.batch_size)  # the actor is not trained at each
        return False  # whatever the length of a rollout is

    model.verbose = model.learning_starts = 0
    model.learn(TRIED_STEPS * model.n_envs, step)


def measure(run: Run) -> float:
    """Train a run for some seconds, and return the hours that all of its training would take here."""
    th.set_num_threads(run.threads)
    setup = Setup(run, run.environment)
    with closing(setup.training_env()) as env:
        model = setup.model(env)
        n_steps = max(0, setup.agent_steps - model.learning_starts)
        try_out(model)  # the first of everything is slow
        started = time.monotonic()
        model.learn(10**9, lambda *_: time.monotonic() - started < MEASURED_SECONDS)  # type: ignore[arg-type]
        return n_steps * (time.monotonic() - started) / model.num_timesteps / 3600


def load_trained(folder: Path, renders: bool = False) -> tuple[SACAux, VecEnv]:
    """The model of a run's folder (or the model's own path in it), and an environment for it, as that of the run."""
    folder = folder.parent if folder.name == MODEL else folder
    if not (folder / MODEL).is_file():
        raise ValueError(f"{folder / MODEL} does not exist: name the folder of a run that has one, such as of aarl train")
    run = read_run(folder)
    import_modules(run.imports)
    settings = run.hyperparameters
    env_kwargs = settings.get("env_kwargs") or {}
    if renders and run.environment.startswith(PREFIX) and not env_kwargs.get("pixels"):
        env_kwargs = {"image_size": VIDEO_SIZE, **env_kwargs}
    try:
        env: VecEnv = make_vec_env(lambda: make_env(run.environment, env_kwargs, settings.get("env_wrapper"), renders))
    except TypeError as error:  # Gymnasium's, for an environment that takes no render_mode
        raise ValueError(f"{run.environment} cannot be made: {error}") from error
    if renders and "rgb_array" not in env.get_attr("metadata")[0].get("render_modes", ()):
        raise ValueError(f"{run.environment} has no pictures: its metadata's render_modes are without rgb_array")
    if (folder / NORMALIZE).exists():
        env = VecNormalize.load(str(folder / NORMALIZE), env)
        env.training = env.norm_reward = False
    return SACAux.load(folder / MODEL, env), env
