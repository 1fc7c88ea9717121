"""FrameStore: each frame once; stacks and next observations are put together when they are read."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper

from sb3_aarl.augmentation import cut


def rows_equal(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Whether all values of a row are equal, (n,), of two arrays that broadcast to (n, ...)."""
    return (one == other).reshape(len(one), -1).all(axis=1)


class FrameStore:
    """
    The frames of one observation key, each once, in a ring that is as long as the buffer plus a stack.

    Transition n (counted from the first one ever added) has its newest frame in row n, so the next observation's is in
    row n + 1. Where an episode ends, row n + 1 belongs to the next one, and the last frame of the old one is stored
    separately. Frames are stacked along the first axis of an observation, oldest first.
    """

    def __init__(self, key: str, buffer_size: int, n_envs: int, shape: tuple[int, ...], dtype: Any, stack: int):
        if stack < 1 or (stack > 1 and (not shape or shape[0] % stack)):
            raise ValueError(f"frame_stack={stack} does not divide the first axis of observations of shape {shape}")
        self.key = key
        self.buffer_size = buffer_size
        self.n_envs = n_envs
        self.shape = shape
        self.stack = stack
        self.frame_shape = (shape[0] // stack, *shape[1:]) if stack > 1 else shape
        # Zeros of NumPy take memory as they are written to, those of PyTorch at once.
        self.frames = np.zeros((buffer_size + stack, n_envs, *self.frame_shape), dtype)
        self.final_frames: dict[int, np.ndarray] = {}  # by flat index in (buffer_size, n_envs)
        self.zero_padded = np.zeros((buffer_size, n_envs), bool)  # whether zeros came before an episode's first frame

    def split(self, observations: np.ndarray) -> np.ndarray:
        """The frames (n, stack, *frame_shape) of stacked observations (n, *shape), oldest first."""
        return observations.reshape(len(observations), self.stack, *self.frame_shape)

    def problem(
        self, observations: np.ndarray, next_observations: np.ndarray, starts: np.ndarray, done: np.ndarray, number: int
    ) -> str | None:
        """What is wrong with stacks of transition ``number`` that are not made of the frames before them."""
        if self.stack == 1:
            return None
        old, new = self.split(observations), self.split(next_observations)
        begins = rows_equal(old[:, :-1], old[:, -1:]) | rows_equal(old[:, :-1], np.zeros_like(old[:, -1:]))
        problems = {
            "an episode begins neither with one frame repeated nor with zeros": starts & ~begins,
            # VecNormalize returns an episode's last observation with rounding errors.
            "the next observation is not the last one plus one new frame": ~done & ~rows_equal(new[:, :-1], old[:, 1:]),
        }
        for problem, wrong in problems.items():
            if wrong.any():
                return (
                    f"frame_stack={self.stack} does not fit observations{f' under {self.key!r}' if self.key else ''} of "
                    f"shape {self.shape} (env {int(wrong.argmax())}, transition {number}): {problem}"
                )
        return None

    def put(self, number: int, observations: np.ndarray, next_observations: np.ndarray, starts: np.ndarray) -> None:
        """Store transition ``number``, the next one; ``starts`` (n_envs,): whether its observation begins an episode."""
        for env in range(self.n_envs):
            self.final_frames.pop(self._index(number, env), None)
        old, new = self.split(observations), self.split(next_observations)
        for row, frames in ((number, old), (number + 1, new)):
            self.frames[row % len(self.frames)] = frames[:, -1]
        position = number % self.buffer_size
        self.zero_padded[position] = self.zero_padded[position - 1]
        if starts.any():
            self.zero_padded[position, starts] = ~rows_equal(old[starts, :-1], old[starts, -1:])

    def put_final(self, number: int, envs: np.ndarray) -> None:
        """Store the last frames of episodes that ended with transition ``number`` in ``envs`` (n_envs,) separately."""
        for env in np.flatnonzero(envs).tolist():
            self.final_frames[self._index(number, env)] = self.frames[(number + 1) % len(self.frames), env].copy()

    def _index(self, number: int, env: int) -> int:
        return number % self.buffer_size * self.n_envs + env

    def gather(
        self, indices: np.ndarray, newest: np.ndarray, age: np.ndarray, final: np.ndarray, crop_size: int | None = None
    ) -> th.Tensor:
        """
        Stacked observations (..., *shape), each cropped at a random position of its own if a crop's size is given.

        :param indices: Flat indices of their transitions in (buffer_size, n_envs); broadcasts to (...)
        :param newest: (...), number of the transition whose row holds the newest frame
        :param age: (...), how many frames of the same episode came before the newest one
        :param final: (...), whether the newest frame is stored separately
        """
        back = np.arange(self.stack)[::-1]
        rows = (newest[..., None] - np.minimum(back, age[..., None])) % len(self.frames)
        numbers = th.from_numpy(rows * self.n_envs + (indices % self.n_envs)[..., None])
        frames = th.from_numpy(self.frames).flatten(0, 1)
        if crop_size is None:
            stacked = frames.index_select(0, numbers.flatten()).view(*numbers.shape, *self.frame_shape)
        else:  # 1.6 to 4 times as fast as a crop of gathered frames
            top, left = (th.randint(length - crop_size + 1, newest.shape) for length in self.frame_shape[1:])
            stacked = cut(frames, numbers, top[..., None], left[..., None], crop_size, crop_size)
        indices = np.broadcast_to(indices, newest.shape)
        if final.any():
            last = th.from_numpy(np.stack([self.final_frames[index] for index in indices[final].tolist()]))
            if crop_size is not None:
                last = cut(last, th.arange(len(last)), top[final], left[final], crop_size, crop_size)
            stacked.numpy()[final, -1] = last.numpy()  # PyTorch does not index all types of NumPy
        if self.stack == 1:
            return stacked.squeeze(newest.ndim)
        # Few are at an episode's start.
        padded = (back > age[..., None]) & self.zero_padded.take(indices)[..., None]
        for index in map(tuple, np.argwhere(padded).tolist()):
            stacked[index] = 0
        return stacked.flatten(newest.ndim, newest.ndim + 1)

    def training_state(self, n_added: int) -> dict[str, th.Tensor]:
        """What ``n_added`` transitions have stored, for ``load_training_state``; it shares memory with the store."""
        finals = np.array(list(self.final_frames.values()), self.frames.dtype).reshape(-1, *self.frame_shape)
        return {
            "frames": th.from_numpy(self.frames[: n_added + 1]),
            "final_indices": th.tensor(list(self.final_frames), dtype=th.int64),
            "final_frames": th.from_numpy(finals),
            "zero_padded": th.from_numpy(self.zero_padded[:n_added]),
        }

    def load_training_state(self, state: dict[str, th.Tensor]) -> None:
        """Continue with what another store of the same settings has stored."""
        self.frames[: len(state["frames"])] = state["frames"].numpy()
        self.zero_padded[: len(state["zero_padded"])] = state["zero_padded"].numpy()
        pairs = zip(state["final_indices"].tolist(), state["final_frames"].numpy(), strict=True)
        self.final_frames = {index: frame.copy() for index, frame in pairs}


def detect_frame_stack(env: VecEnv) -> int | dict[str, int]:
    """
    How many frames an environment stacks along the first axis of observations, by its wrappers.

    :param env: Vectorized environment, images transposed as SB3's algorithms do
    :return: The size of SB3's VecFrameStack, else of Gymnasium's FrameStackObservation; for Dict observations by key.
        1 without them, where the first axis is not a multiple of it, where VecFrameStack took the last axis, and where a
        wrapper outside of it has given observations other keys
    """
    space = env.observation_space
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    outer = unwrap_vec_wrapper(env, VecFrameStack)
    inner: dict[str, Any] = {}
    if isinstance(outer, VecFrameStack):
        # The frames of VecFrameStack are all that is stacked inside of it.
        stack = outer.stacked_obs.n_stack
        inner = getattr(outer.stacked_obs, "sub_stacked_observations", {"": outer.stacked_obs})
    else:
        try:
            stack = env.get_attr("stack_size")[0] if all(env.env_is_wrapped(FrameStackObservation)) else 1
        except (NotImplementedError, AttributeError, TypeError):
            stack = 1  # VecEnvs of other packages do not all have env_is_wrapped, or answer with None or one bool
    stacks = dict.fromkeys(parts, 1)
    for key, part in parts.items():
        shape = part.shape or (1,)
        if inner and key not in inner:
            continue  # a wrapper outside took one of several observations: its key is not known any more
        first_axis = not inner or inner[key].channels_first or len(shape) == 1 or is_image_space(part)
        if first_axis and shape[0] % stack == 0:
            stacks[key] = stack
    return stacks if isinstance(space, spaces.Dict) else stacks[""]
