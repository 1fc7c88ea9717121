"""Train one candidate: environment, model, learning curve, and checkpoints from which a killed training goes on."""

import contextlib
import errno
import functools
import hashlib
import io
import json
import logging
import math
import os
import pickle
import re
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_aarl import SACAux, catalog
from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.callbacks import Evaluation, LearningCurveCallback, SingleEpisodes, aulc, read_curve, write_curve
from sb3_aarl.envs import PREFIX, make_dmc_env, wrap_env
from search.training.checkpoint import (
    CheckpointError,
    ResumableEnv,
    is_disk_error,
    key_path,
    opened,
    seal,
    sync_folder,
    user_key,
)
from search.training.config import VEC_ENVS, ConfigError, action_repeat, load_aux_loss, load_hyperparameters, resolve_env_id
from search.training.provenance import provenance, read_about, write_about

logger = logging.getLogger(__name__)

# Evaluations begin neither where trainings did nor where those of another run do: the evaluations of a run have this many
# seeds, from this one on. Below the half of the seeds that numpy knows; trainings that go on have the other.
EVALUATION_SEED = 10_000
EVALUATION_SEEDS = 1_000_000
HALF = 2**31
MODEL = "model.zip"
UNFINISHED = "unfinished-"  # name of a checkpoint that is being written
# How PyTorch says it, which has no exception of its own for the CPU.
MEMORY_MESSAGES = ("can't allocate memory", "not enough memory", "out of memory", "ALLOC_FAILED")


class TrainingError(RuntimeError):
    """A training failed while it ran; the message is the reason in one line."""


class EnvironmentLost(TrainingError):
    """The process of an environment died; the checkpoint stays, as after the death of a worker."""


class DeviceError(TrainingError):
    """
    This process cannot train any more, whatever the candidate: its GPU failed, or has no memory left for a checkpoint.

    The checkpoint stays, as after the death of a worker. After an error of CUDA all further calls of a process fail.
    """


class _Unrelated(BaseException):
    """
    What ``on_evaluation`` or a file raised, on its way out past all that takes exceptions for the training's own.

    :param error: The exception
    """

    def __init__(self, error: Exception):
        self.error = error


class TrainingRun(NamedTuple):
    """
    What a training gave.

    :param curve: Its learning curve
    :param aulc: Area under it
    :param aux_loss: The auxiliary loss that it was trained with, "" for ``auto`` where nothing was left to train
    """

    curve: list[Evaluation]
    aulc: float
    aux_loss: str = ""


def make_env(env_id: str, env_kwargs: Mapping[str, Any]) -> gym.Env:
    """
    An environment of a configuration.

    :param env_id: Id of a DeepMind Control task, or of any other Gymnasium environment
    :param env_kwargs: Arguments of ``make_dmc_env``, or of ``wrap_env``
    """
    if env_id.startswith(PREFIX):
        return make_dmc_env(env_id, **env_kwargs)
    return wrap_env(gym.make(env_id, render_mode="rgb_array" if env_kwargs.get("pixels") else None), **env_kwargs)


def check_actions(env_id: str) -> None:
    """
    Refuse an environment that cannot be made, or whose actions are not continuous. Those of DeepMind Control all are.

    :param env_id: Id of the environment
    :raises ConfigError: saying why
    """
    if env_id.startswith(PREFIX):
        return
    try:
        env = make_env(env_id, {})
    except Exception as error:  # whatever an environment of somebody's own does
        raise ConfigError(f"{env_id} cannot be made: {type(error).__name__}: {' '.join(str(error).split())}") from None
    with env:
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ConfigError(f"{env_id} has no continuous actions, which SACAux needs, but {env.action_space}")


def spread_checkpoints(environment_steps: int, n_evaluations: int, action_repeat: int = 1) -> tuple[int, ...]:
    """
    Equally spaced checkpoints, each a multiple of the action repeat; the last is at most an interval early.

    :param environment_steps: Environment steps of the training
    :param n_evaluations: Number of checkpoints
    :param action_repeat: Environment steps of one agent step
    :raises ValueError: when there are fewer agent steps than checkpoints
    """
    if n_evaluations < 1 or environment_steps < n_evaluations * action_repeat:
        raise ValueError(
            f"{environment_steps} environment steps at an action repeat of {action_repeat} are too few for "
            f"{n_evaluations} evaluations"
        )
    every = environment_steps // n_evaluations // action_repeat * action_repeat
    return tuple(every * (i + 1) for i in range(n_evaluations))


def train_candidate(
    environment: str,
    aux_loss: AuxLoss | str | None,
    hyperparameters: Mapping[str, Any],
    seed: int,
    checkpoints: Sequence[int],
    evaluation_episodes: int = 10,
    folder: str | Path | None = None,
    on_evaluation: Callable[[Evaluation], bool | None] | None = None,
    keep_model: bool = False,
    progress_bar: bool = False,
) -> TrainingRun:
    """
    Train SACAux with an auxiliary loss up to the last checkpoint, and evaluate it at each.

    With a folder, a training that was killed goes on from its last evaluation: model, optimizers, replay buffer, random
    generators and simulation are as they were, and on a CPU it ends bit for bit like one that was not killed. Where the
    simulation cannot be saved (an environment that does not pickle, or without its state as Gymnasium's MuJoCo tasks), the
    episode that ran is cut off (the buffer takes it for truncated) and one with another seed begins; a line of log says so.
    Checkpoints are signed with a key of the user's, see ``search.training.checkpoint``: one that is torn, of another user or
    of other settings is refused before anything of it is unpickled, and the training begins anew. When it is over, for
    whatever reason but an interruption, the death of an environment's process or an error of the disk, the checkpoint is
    removed and ``curve.csv`` stays; a training whose curve is complete is not repeated.

    With ``n_envs`` environments in the hyper-parameters, all of their steps count, and a checkpoint that lies between two
    steps of them is evaluated after the second. ``gradient_steps: -1`` keeps one update for each transition.

    :param environment: Id of the environment
    :param aux_loss: The auxiliary loss as SACAux takes it
    :param hyperparameters: As ``load_hyperparameters`` gives them
    :param seed: Seed of the training
    :param checkpoints: Environment steps of the evaluations, ascending
    :param evaluation_episodes: Episodes of each evaluation
    :param folder: Where checkpoint and curve are kept, None to keep nothing. One training at a time in a folder
    :param on_evaluation: Called after every evaluation, and after those of a run that goes on again. Training ends early
        if it returns False. An exception of its own is raised as it is, and the last checkpoint stays
    :param keep_model: Whether to leave the trained model as ``model.zip`` in the folder
    :param progress_bar: Whether to show a progress bar
    :raises TrainingError: when the training fails while it runs, the cause being its ``__cause__``
    :raises EnvironmentLost: when the process of an environment was killed (``vec_env="subproc"``); the last checkpoint stays
    :raises DeviceError: when the GPU failed, or there is no memory to go on with a checkpoint; the last checkpoint stays
    :raises OSError: when the disk is full or broken, or there is a checkpoint but no key to read it with; the last checkpoint
        stays, and the same call goes on from it
    :raises FileExistsError: when the folder has the model of another training
    :raises ValueError: when environment or model cannot be made of these settings
    """
    settings = dict(hyperparameters)
    settings.pop("n_timesteps", None)
    env_kwargs = settings.pop("env_kwargs", None) or {}
    n_envs, vec_env_cls = settings.pop("n_envs", 1), VEC_ENVS[settings.pop("vec_env", "dummy")]
    pixels = env_kwargs.get("pixels", False)
    policy = settings.pop("policy", "CnnPolicy" if pixels else "MlpPolicy")
    agent_steps = checkpoints[-1] // action_repeat(hyperparameters)
    if "buffer_size" in settings:
        # The same run, with smaller checkpoints; the buffer has as many places for each environment.
        settings["buffer_size"] = min(settings["buffer_size"], math.ceil(agent_steps / n_envs) * n_envs)
    settings |= {"aux_loss": aux_loss, "seed": seed}

    store, curve, trained_with = None, None, "" if aux_loss == "auto" else str(aux_loss)
    if folder is not None:
        asked_for = [environment, policy, env_kwargs, n_envs, settings, list(checkpoints), evaluation_episodes]
        store = _RunFolder(Path(folder), str(aux_loss), seed, asked_for)
        curve = store.finished_curve(checkpoints, keep_model)
    if curve is None:
        make = functools.partial(make_vec_env, make_env, env_kwargs={"env_id": environment, "env_kwargs": env_kwargs})
        made = functools.partial(_made, environment)
        # From states a prediction takes as long as a step of an environment: one for all episodes. A picture takes much
        # longer than the prediction from it, and each environment that renders has tens of megabytes for it.
        n_eval, eval_cls = (min(n_envs, evaluation_episodes), vec_env_cls) if pixels else (evaluation_episodes, DummyVecEnv)
        with (
            _closed(made(make, n_envs, seed=seed, vec_env_cls=vec_env_cls, wrapper_class=ResumableEnv)) as env,
            _closed(made(make, n_eval, seed=0, vec_env_cls=eval_cls, wrapper_class=SingleEpisodes)) as eval_env,
        ):
            try:
                model, curve = store.load(env, settings.get("device", "auto")) if store is not None else (None, [])

                def tell(evaluation: Evaluation, anew: bool = True) -> bool | None:
                    try:
                        if store is not None and anew:
                            write_curve(store.curve_path, curve_callback.curve)
                        return on_evaluation is None or on_evaluation(evaluation)
                    except Exception as error:
                        raise _Unrelated(error) from error

                if _repeat(curve, functools.partial(tell, anew=False)):
                    model = model or made(SACAux, policy, env, **settings)
                    trained_with = str(model.aux_loss)
                    curve_callback = LearningCurveCallback(
                        eval_env,
                        checkpoints,
                        evaluation_episodes,
                        seed=(EVALUATION_SEED + EVALUATION_SEEDS * seed) % HALF,
                        on_evaluation=tell,
                        curve=curve,
                    )
                    curve = curve_callback.curve
                    saving = [] if store is None else [_CheckpointCallback(store, curve)]
                    _learn(model, agent_steps, [curve_callback, *saving], progress_bar)
                    if store is not None and keep_model:
                        store.save_model(model)
            except _Unrelated as unrelated:
                raise unrelated.error from unrelated.error.__cause__
            except Exception as error:  # an interruption is none
                if _was_killed(error, env, eval_env):
                    raise EnvironmentLost("the process of an environment was killed") from error
                if not isinstance(error, DeviceError) and (problem := device_problem(error)):
                    raise DeviceError(problem) from error
                # The checkpoint waits for a better disk, or a process that has room for it.
                if store is not None and not isinstance(error, OSError | DeviceError):
                    store.remove_checkpoint()
                raise
    else:
        _repeat(curve, on_evaluation)
    if store is not None:
        store.remove_checkpoint()
    return TrainingRun(curve, aulc(curve), trained_with)


def train_and_keep(
    environment: str,
    aux_loss: str | None,
    config: str | Path,
    environment_steps: int | None = None,
    n_evaluations: int = 5,
    evaluation_episodes: int = 10,
    seed: int = 0,
    folder: str | Path | None = None,
) -> tuple[TrainingRun, Path, bool]:
    """
    Train with one loss and keep the model, the curve and ``provenance.json``, with a progress bar.

    :param environment: Id of the environment, or the short form of a DeepMind Control task
    :param aux_loss: Notation, name, or YAML file of ``load_aux_loss``; ``"none"`` for none; None for what the file of
        hyper-parameters says, or ``"auto"``
    :param config: File of hyper-parameters
    :param environment_steps: Environment steps of the training, None for the file's ``n_timesteps``
    :param n_evaluations: Number of evaluations
    :param evaluation_episodes: Episodes of each
    :param seed: Seed of the training
    :param folder: Where model and curve are kept, None for a folder in ``runs`` named after environment, loss and seed
    :return: The training, its folder, and whether it was finished before and read from there
    :raises ValueError: when something is unknown or does not fit
    :raises TrainingError: when the training fails while it runs
    """
    environment = resolve_env_id(environment)
    hyperparameters = load_hyperparameters(config, environment)
    loss = hyperparameters.get("aux_loss", "auto") if aux_loss is None else aux_loss
    if isinstance(loss, str) and Path(loss).suffix in (".yml", ".yaml"):
        loss = load_aux_loss(loss)
    loss = None if loss in (None, "none") else loss if loss == "auto" else catalog.resolve(loss)
    repeat = action_repeat(hyperparameters)
    if environment_steps is None:
        if "n_timesteps" not in hyperparameters:
            raise ValueError(f"how many steps? {config} has no n_timesteps for {environment}")
        environment_steps = hyperparameters["n_timesteps"] * repeat
    checkpoints = spread_checkpoints(environment_steps, n_evaluations, repeat)
    check_actions(environment)
    if folder is None:
        # A notation may be longer than a file's name may be.
        label = re.sub(r"[^a-z0-9]+", "-", f"{environment.removeprefix(PREFIX)} {aux_loss or 'auto'}".lower())[:80].strip("-")
        settings = f"{loss} {hyperparameters} {checkpoints} {evaluation_episodes}"
        folder = Path("runs") / f"{label}-{hashlib.sha256(settings.encode()).hexdigest()[:8]}-seed-{seed}"
    folder = Path(folder)
    was_finished = (folder / MODEL).exists()  # of another training: train_candidate refuses the folder
    about = {"environment": environment, "aux_loss": str(loss), "seed": seed, "hyperparameters": hyperparameters}
    about |= {"evaluations": checkpoints, "evaluation_episodes": evaluation_episodes}
    about = json.loads(json.dumps(about, default=str))
    before = read_about(folder)
    goes_on = all(before.get(key) == value for key, value in about.items())
    about["sessions"] = [*(before["sessions"] if goes_on else ()), provenance()]
    run = train_candidate(
        environment,
        loss,
        hyperparameters,
        seed,
        checkpoints,
        evaluation_episodes,
        folder,
        on_evaluation=None if was_finished else lambda _: write_about(folder, about),
        keep_model=True,
        progress_bar=True,
    )
    if not was_finished:
        about["sessions"][-1]["aux_loss"] = run.aux_loss
        write_about(folder, {**about, "seconds": run.curve[-1].seconds})
    return run, folder, was_finished


@contextlib.contextmanager
def _closed(env: VecEnv) -> Iterator[VecEnv]:
    """Close environments in the end. Their processes may be gone before: they failed, or Ctrl-C has reached them too."""
    try:
        yield env
    finally:
        with contextlib.suppress(EOFError, OSError):
            env.close()


def _made(environment: str, make: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """What is made of settings. Where they do not fit, Gymnasium, SB3 and PyTorch have errors of all kinds."""
    try:
        return make(*args, **kwargs)
    except (ValueError, OSError, EOFError, TrainingError):
        raise
    except Exception as error:
        if memory_problem(error) or "CUDA error" in str(error):
            raise
        text = f"{type(error).__name__}: {' '.join(str(error).split())}"
        last = traceback.extract_tb(error.__traceback__)[-1]  # it may be an environment of the user's that is at fault
        raise ConfigError(
            f"{environment} cannot be trained with these settings: {text} ({last.filename}, line {last.lineno})"
        ) from error


def _was_killed(error: Exception, *envs: VecEnv) -> bool:
    """Whether it is the process of an environment that is at fault, and was killed. One that raises ends by itself."""
    if not any(isinstance(each, (EOFError, ConnectionError)) for each in (error, error.__cause__)):
        return False
    processes = [process for env in envs if isinstance(env.unwrapped, SubprocVecEnv) for process in env.unwrapped.processes]
    deadline = time.monotonic() + 5  # its end of the pipe closes a little before it is gone
    while processes and all(process.exitcode is None for process in processes) and time.monotonic() < deadline:
        time.sleep(0.01)
    return any((process.exitcode or 0) < 0 for process in processes)


def _repeat(curve: Sequence[Evaluation], on_evaluation: Callable[[Evaluation], bool | None] | None) -> bool:
    """Tell of the evaluations of a run that goes on; False if training is to end."""
    return on_evaluation is None or all(on_evaluation(evaluation) is not False for evaluation in curve)


def _learn(model: SACAux, agent_steps: int, callbacks: list[BaseCallback], progress_bar: bool) -> None:
    """Train up to a number of agent steps; whatever goes wrong, but for disk and GPU, is the candidate's failure."""
    try:
        remaining = agent_steps - model.num_timesteps
        model.learn(remaining, callbacks, log_interval=10**9, reset_num_timesteps=False, progress_bar=progress_bar)
    except Exception as error:
        if is_disk_error(error) or device_problem(error):
            raise
        raise TrainingError(" ".join(f"{type(error).__name__}: {error}".split())) from error


def causes(error: BaseException) -> Iterator[BaseException]:
    """The error, what it was raised from or during, and so on."""
    following: BaseException | None = error
    while following is not None:
        yield following
        following = following.__cause__ or (None if following.__suppress_context__ else following.__context__)


def memory_problem(error: BaseException) -> str | None:
    """
    One line if an error says that memory ran out, with how much was asked for where that is known. None for other errors.

    :param error: The error
    """
    for cause in causes(error):
        if (
            isinstance(cause, (MemoryError, th.cuda.OutOfMemoryError))
            or (isinstance(cause, OSError) and cause.errno == errno.ENOMEM)
            or (isinstance(cause, RuntimeError) and any(message in str(cause) for message in MEMORY_MESSAGES))
        ):
            text = " ".join(str(cause).split())[:300]
            size = re.search(r"allocate ([0-9]+\.?[0-9]*) (bytes|[KMGTPE]iB)", text, re.IGNORECASE)
            asked = ""
            if size is not None:
                unit = ("bytes", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB").index(size[2])
                asked = f" ({float(size[1]) * 1024.0 ** (unit - 3):,.2f} GiB were asked for)"
            return f"out of memory{asked}: {text if isinstance(cause, TrainingError) else f'{type(cause).__name__}: {text}'}"
    return None


def device_problem(error: BaseException) -> str | None:
    """
    One line if an error says that the GPU failed, and it can no longer be used, whatever the candidate. None for other errors.

    :param error: The error
    """
    for cause in causes(error):
        of_gpu = isinstance(cause, RuntimeError) and any(words in str(cause) for words in ("CUDA error", "cuDNN error"))
        if of_gpu and memory_problem(cause) is None and not _gpu_computes():
            return "the GPU failed: " + " ".join(str(cause).split())[:300]
    return None


def _gpu_computes() -> bool:
    """Whether this process can use its GPU: after most errors of CUDA it cannot any more."""
    try:
        return th.ones(1, device="cuda").item() == 1
    except (AssertionError, RuntimeError):  # the former without CUDA
        return False


class _RunFolder:
    """
    What a training leaves: ``run.json`` (what was trained), ``curve.csv``, and, while it runs, the last checkpoint.

    :param folder: The folder
    :param loss: Notation of the loss, for people
    :param seed: Seed of the training
    :param settings: All that decides what comes out
    """

    def __init__(self, folder: Path, loss: str, seed: int, settings: Any):
        digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()
        self.description = {"loss": loss, "seed": seed, "settings": digest}
        self.folder = folder
        self.seed = seed
        self.curve_path = folder / "curve.csv"
        self.model_path = folder / MODEL
        self._checkpoints = folder / "checkpoint"

    def finished_curve(self, checkpoints: Sequence[int], with_model: bool) -> list[Evaluation] | None:
        """The curve if this very training was finished before."""
        if not _holds(self.folder, self.description) or (with_model and not self.model_path.exists()):
            return None
        try:
            curve = read_curve(self.curve_path)
        except (OSError, ValueError):
            return None
        return curve if [evaluation.environment_steps for evaluation in curve] == list(checkpoints) else None

    def load(self, env: VecEnv, device: str) -> tuple[SACAux | None, list[Evaluation]]:
        """The last checkpoint: model with replay buffer, its curve, simulations in ``env``; without one, all begins anew."""
        saved = [path for path in self._checkpoints.glob("*") if path.name.isdecimal()]
        if saved:
            newest = max(saved, key=lambda path: int(path.name))
            key = user_key()
            if key is None and _holds(newest, self.description):
                raise PermissionError(f"{newest} cannot be read without the key in {key_path()}: mend it, or remove the other")
            try:
                with opened(newest, key) as (files, about):
                    if not _holds(newest, self.description):
                        raise CheckpointError("it belongs to a training with other settings")
                    curve = read_curve(newest / "curve.csv")
                    model = SACAux.load(files[MODEL], env, device=device, force_reset=False)
                    model.load_replay_buffer(files["replay_buffer.pkl"])
                    cut_off = about["cut_off"] or _load_simulations(env, pickle.load(files["environments.pkl"]))
            except Exception as error:
                if problem := memory_problem(error) or device_problem(error):
                    message = f"the checkpoint {newest} could not be taken up, remove it to begin anew: {problem}"
                    raise DeviceError(message) from error
                if isinstance(error, OSError | EOFError):
                    raise  # of the disk, or the process of an environment: they say nothing of the checkpoint
                # What other versions do to pickle and torch.
                logger.warning("The checkpoint %s is of no use, training begins anew: %s", newest, error)
            else:
                logger.info("Training goes on after %d environment steps", curve[-1].environment_steps)
                if cut_off:
                    logger.warning("The episode that ran in %s is cut off, a new one begins: %s", self.folder, cut_off)
                    model._last_obs = None
                    # Not the initial states of the beginning again.
                    env.seed(HALF + (self.seed + model.num_timesteps) % HALF)
                for path in self._checkpoints.glob(f"{UNFINISHED}*"):
                    _remove(path)
                return model, curve
        self.remove_checkpoint()
        if self.model_path.exists():
            raise FileExistsError(f"{self.folder} has the model of another training: choose another folder")
        self.curve_path.unlink(missing_ok=True)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._describe(self.folder)
        return None, []

    def save(self, model: SACAux, curve: Sequence[Evaluation]) -> None:
        """Put a checkpoint in the place of the one before, in one step; none without a key to sign it with."""
        key = user_key()
        if key is None:
            return
        self._checkpoints.mkdir(parents=True, exist_ok=True)
        # A name of its own: a worker that was taken for dead may still be at work here.
        unfinished = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=self._checkpoints))
        env = model.get_env()
        assert env is not None
        try:
            _save_model(model, unfinished / MODEL)
            with (unfinished / "replay_buffer.pkl").open("wb") as file:
                model.save_replay_buffer(file)
            states = env.env_method("dump_state")
            cut_off = next((state for state in states if isinstance(state, str)), None)
            if cut_off is None:
                (unfinished / "environments.pkl").write_bytes(pickle.dumps(states))
            write_curve(unfinished / "curve.csv", curve)
            self._describe(unfinished)
            seal(unfinished, key, {"cut_off": cut_off})
            steps = curve[-1].environment_steps
            checkpoint = self._checkpoints / str(steps)
            if not checkpoint.exists():  # else it is that of the same training at the same step
                unfinished.rename(checkpoint)
            sync_folder(self._checkpoints)
        except FileNotFoundError:
            if unfinished.exists():
                raise
            logger.warning("No checkpoint is kept in %s now: another worker took it away", self.folder)
            return
        finally:
            _remove(unfinished)  # half of it may be what fills the disk
        for path in self._checkpoints.glob("*"):
            # Another worker, which took this one for dead, may be further.
            if path.name.isdecimal() and int(path.name) < steps:
                _remove(path)

    def save_model(self, model: SACAux) -> None:
        """Leave the trained model in the folder."""
        unfinished = self.folder / "unfinished.zip"
        try:
            _save_model(model, unfinished)
            unfinished.replace(self.model_path)
        except BaseException:
            _remove(unfinished)
            raise

    def remove_checkpoint(self) -> None:
        """Replay buffers are large."""
        _remove(self._checkpoints)

    def _describe(self, folder: Path) -> None:
        (folder / "run.json").write_text(json.dumps(self.description, indent=1) + "\n", encoding="utf-8")


def _holds(folder: Path, description: Mapping[str, Any]) -> bool:
    """Whether a folder is that of a training."""
    try:
        return json.loads((folder / "run.json").read_text(encoding="utf-8")) == description
    except (OSError, ValueError):
        return False


def _save_model(model: SACAux, path: Path) -> None:
    """Through Python's own files: torch makes a RuntimeError of a disk that is full."""
    content = io.BytesIO()
    model.save(content)
    with path.open("wb") as file:
        file.write(content.getbuffer())
        file.flush()
        os.fsync(file.fileno())


def _load_simulations(env: VecEnv, states: Sequence[bytes]) -> str | None:
    """Put the states of environments back; why not all can be, or None."""
    problems = [env.env_method("load_state", state, indices=i)[0] for i, state in enumerate(states)]
    return next((problem for problem in problems if problem), None)


def _remove(path: Path) -> None:
    """Whatever it is, if it is there and can be removed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


class _CheckpointCallback(BaseCallback):
    """
    Saves a checkpoint after every evaluation: when the agent step that was evaluated is stored and trained on.

    :param store: Where
    :param curve: The learning curve, which the other callback appends to
    """

    def __init__(self, store: _RunFolder, curve: list[Evaluation]):
        super().__init__()
        self.store = store
        self.curve = curve
        self._n_saved = len(curve)

    def _on_rollout_start(self) -> None:
        if len(self.curve) > self._n_saved:
            assert isinstance(self.model, SACAux)
            try:
                self.store.save(self.model, self.curve)
            except ConnectionError:
                raise  # to the process of an environment, not to a disk
            except OSError as error:
                raise _Unrelated(error) from error
            if self.model.use_sde:
                # A training that goes on from here draws the noise of this rollout first; so does this one.
                self.model.actor.reset_noise(self.training_env.num_envs)
            self._n_saved = len(self.curve)

    def _on_step(self) -> bool:
        return True
