"""Checkpoints: all that a run needs to be resumed exactly, as tensors and plain values in one file."""

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_aarl import SACAux
from sb3_aarl.buffers import WindowReplayBuffer
from sb3_aarl.callbacks import Evaluation
from sb3_aarl.files import replacing

CHECKPOINT = "checkpoint.pt"
UNFINISHED = "checkpoint.tmp"


class TruncateAt(gym.Wrapper):
    """Truncate the episode after given steps of this environment: a checkpoint there needs no state of the environment."""

    def __init__(self, env: gym.Env, steps: Collection[int]):
        super().__init__(env)
        self._steps = frozenset(steps)
        self._n_steps = 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._n_steps += 1
        return observation, reward, terminated, truncated or self._n_steps in self._steps, info


def restart_seed(seed: int, num_timesteps: int) -> int:
    """
    The seed of what follows a checkpoint at these agent steps, from 2**31 on: evaluations and the beginnings of runs have
    those below. Environment i takes the i-th after it.
    """
    return 2**31 + int(np.random.SeedSequence((seed, num_timesteps)).generate_state(1)[0]) // 4


def restart(model: SACAux, seed: int) -> None:
    """Start new episodes and random sequences before a rollout, in an undisturbed run as in a resumed one."""
    env = model.get_env()
    assert env is not None
    # Python's, NumPy's and PyTorch's generators, the action space, and the environments at their next reset.
    model.set_random_seed(restart_seed(seed, model.num_timesteps))
    model._last_obs = env.reset()  # type: ignore[assignment]
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        model._last_original_obs = normalization.get_original_obs()
    if model.use_sde:  # SB3 has drawn this rollout's noise before
        model.actor.reset_noise(env.num_envs)


def save(folder: Path, model: SACAux, curve: Sequence[Evaluation]) -> None:
    """Replace the checkpoint of a run at the end of all episodes, in one step."""
    assert isinstance(model.replay_buffer, WindowReplayBuffer)
    state = {
        "model": model.training_state(),
        "replay_buffer": model.replay_buffer.training_state(),
        "normalization": {
            name: (th.as_tensor(statistics.mean), th.as_tensor(statistics.var), float(statistics.count))
            for name, statistics in _statistics(model.get_vec_normalize_env()).items()
        },
        "curve": [list(evaluation) for evaluation in curve],
    }
    try:
        with replacing(folder / CHECKPOINT, folder / UNFINISHED) as unfinished, unfinished.open("wb") as file:
            th.save(state, file)
            file.flush()
            os.fsync(file.fileno())
    except RuntimeError as error:
        # PyTorch closes its archive, which fails too, and hides the error of the disk.
        raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None


def read(folder: Path) -> dict[str, Any] | None:
    """The checkpoint of a run, None if there is none."""
    if not (folder / CHECKPOINT).exists():
        return None
    # Mapped into memory, so that the replay buffer is not there twice.
    return th.load(folder / CHECKPOINT, map_location="cpu", weights_only=True, mmap=True)


def load(model: SACAux, state: Mapping[str, Any]) -> None:
    """Put a checkpoint into a new model with the same settings, and into its environment."""
    assert isinstance(model.replay_buffer, WindowReplayBuffer)
    model.load_training_state(state["model"])
    buffer, stored = model.replay_buffer, state["replay_buffer"]
    if stored["n_added"] < stored["buffer_size"] < buffer.buffer_size:  # the run was to be shorter, with a smaller buffer
        stored = {**stored, "buffer_size": buffer.buffer_size}
    buffer.load_training_state(stored)
    for name, statistics in _statistics(model.get_vec_normalize_env()).items():
        mean, var, count = state["normalization"][name]
        statistics.mean, statistics.var, statistics.count = mean.numpy(), var.numpy(), count


def _statistics(env: VecNormalize | None) -> dict[str, Any]:
    """VecNormalize's running statistics by name; Dict observations have those of each key."""
    statistics = {name: getattr(env, name) for name in ("obs_rms", "ret_rms") if hasattr(env, name)}
    if isinstance(statistics.get("obs_rms"), dict):
        statistics |= {f"obs_rms/{key}": part for key, part in statistics.pop("obs_rms").items()}
    return statistics


def remove(folder: Path) -> None:
    """Remove the checkpoint of a run: replay buffers are large."""
    for name in (CHECKPOINT, UNFINISHED):
        (folder / name).unlink(missing_ok=True)


class CheckpointCallback(BaseCallback):
    """
    Save the run after each evaluation, call ``on_save``, and restart it. When the file ``stop`` exists, training ends at once,
    and the checkpoint stays. ``state`` is the checkpoint from which the run is resumed.
    """

    model: SACAux

    def __init__(
        self,
        folder: Path,
        seed: int,
        curve: list[Evaluation],
        on_save: Callable[[], object],
        stop: Path,
        state: Mapping[str, Any] | None = None,
    ):
        super().__init__()
        self.folder = folder
        self.seed = seed
        self.curve = curve
        self.on_save = on_save
        self.stop = stop
        self.stopped = False
        self._state = state
        self._n_saved = len(curve)

    def _on_training_start(self) -> None:
        # Not before learn(), which resets the environment, and VecNormalize learns from that.
        if self._state is not None:
            load(self.model, self._state)

    def _on_rollout_start(self) -> None:
        is_due = len(self.curve) > self._n_saved
        if is_due:
            save(self.folder, self.model, self.curve)
            self._n_saved = len(self.curve)
            self.on_save()
        if is_due or self._state is not None:
            restart(self.model, self.seed)
            self._state = None

    def _on_step(self) -> bool:
        is_saved = len(self.curve) == self._n_saved
        self.stopped = is_saved and self.stop.exists()
        return not self.stopped
