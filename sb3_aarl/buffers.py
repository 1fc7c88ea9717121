"""WindowReplayBuffer: windows of consecutive steps out of a replay buffer that stores each frame once."""

import math
import warnings
import weakref
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape, is_image_space
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, unwrap_vec_wrapper

from sb3_aarl.augmentation import image_spaces

try:
    import psutil
except ImportError:  # an extra of SB3
    psutil = None  # type: ignore[assignment]


# Copies to a GPU that nobody waits for are of at most this size.
MAX_PINNED_BYTES = 2**20
# Rounds in which steps that end no whole window are drawn again, before all that do are looked up.
MAX_REDRAWS = 8
# Memory that drawn observations had, and that others may have after them: pieces and bytes in all, at most.
MAX_SCRATCH, MAX_SCRATCH_BYTES = 8, 2**28
# Of equal width.
SIGNED = {th.uint16: th.int16, th.uint32: th.int32, th.uint64: th.int64}


class WindowSamples(NamedTuple):
    """
    Windows of one horizon k; ``observations`` is a dict of such tensors for Dict observations.

    :param observations: (batch, k + 1, ...), or (batch, len(offsets), ...) where offsets were asked for
    :param actions: (batch, k, action_dim), scaled to [-1, 1] as SB3 stores them
    :param rewards: (batch, k, 1)
    """

    observations: th.Tensor | dict[str, th.Tensor]
    actions: th.Tensor
    rewards: th.Tensor


class NoWindowError(ValueError):
    """No episode in the buffer is long enough for the horizon yet."""


def _equal(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two arrays are the same; NaN is NaN, so that one in an observation does not look like a new episode."""
    # The plain comparison is much faster, and mostly enough.
    return bool((one == other).all()) or np.array_equal(one, other, equal_nan=True)


def _first_stack(frames: np.ndarray) -> str | None:
    """How a stack begins an episode: with its one frame "repeated", or with "zeros" before it; None if it does not."""
    before = frames[:-1]
    if _equal(before, np.broadcast_to(frames[-1], before.shape)):
        return "repeated"
    return None if before.any() else "zeros"


def to_device(values: np.ndarray | th.Tensor, device: th.device | None) -> th.Tensor:
    """
    What a sample is made of, on its device. Copies to a GPU are queued behind what that does, and nobody waits for them, but
    for images: many batches of them would lie in pinned memory.

    :param values: Values, which the tensor may share
    :param device: The device, None for the one where they are
    """
    tensor = th.as_tensor(values)
    if device is None:
        return tensor
    if device.type == "cuda" and tensor.device.type == "cpu" and tensor.nbytes <= MAX_PINNED_BYTES:
        pinned = th.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor)
        return pinned.to(device, non_blocking=True)  # PyTorch keeps pinned memory as long as a copy is under way
    return tensor.to(device)


class FrameStore:
    """
    The frames of one observation key, each once, in a ring that is as long as the buffer plus a stack.

    Transition n (counted from the first one ever added) has its newest frame in row n, so the next observation's is in
    row n + 1. Where an episode ends, row n + 1 belongs to the next episode; the last frame of the old one lies aside.

    :param buffer_size: Transitions per env that can be read back
    :param n_envs: Number of envs
    :param shape: Shape of a stacked observation; frames are stacked along its first axis, oldest first
    :param dtype: Data type of observations
    :param stack: Number of frames in an observation
    :param device: Where the frames lie, as a tensor; None for an array of NumPy's
    """

    frames: Any
    final_frames: Any

    def __init__(
        self,
        buffer_size: int,
        n_envs: int,
        shape: tuple[int, ...],
        dtype: Any,
        stack: int,
        device: th.device | None = None,
    ):
        if stack < 1 or (stack > 1 and (not shape or shape[0] % stack)):
            raise ValueError(f"frame_stack={stack} does not divide the first axis of observations of shape {shape}")
        self.stack = stack
        self.shape = shape
        self.frame_shape = (shape[0] // stack, *shape[1:]) if stack > 1 else shape
        self.dtype = np.dtype(dtype)
        self.device = device
        self.frames = self._zeros((buffer_size + stack, n_envs, *self.frame_shape))
        self.final_frames = self._zeros((0, *self.frame_shape))
        # Pieces of memory, each with a reference to the part of it that was given out last.
        self._scratch: list[tuple[np.ndarray, weakref.ref[np.ndarray]]] = []

    def _zeros(self, shape: tuple[int, ...]) -> Any:
        zeros = np.zeros(shape, self.dtype)
        return zeros if self.device is None else th.zeros(shape, dtype=th.from_numpy(zeros[:0]).dtype, device=self.device)

    def _here(self, array: np.ndarray) -> Any:
        """An array, as what indexes the frames and may be written to them."""
        if self.device is None or isinstance(array, th.Tensor):
            return array
        return th.as_tensor(np.ascontiguousarray(array), device=self.device)

    def __getstate__(self) -> dict[str, Any]:
        state = {**self.__dict__, "_scratch": []}
        if self.device is not None:
            # Tensors of a GPU could only be loaded where there is one.
            state |= {"frames": self.frames.cpu().numpy(), "final_frames": self.final_frames.cpu().numpy()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({"device": None, "_scratch": [], "dtype": state["frames"].dtype, **state})
        if self.device is not None and self.device.type == "cuda" and not th.cuda.is_available():
            self.device = None
        self.frames, self.final_frames = self._here(self.frames), self._here(self.final_frames)

    def split(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: Stacked, (n, *shape)
        :return: (n, stack, *frame_shape), oldest first
        """
        return observations.reshape(len(observations), self.stack, *self.frame_shape)

    def put(self, row: int, frames: np.ndarray) -> None:
        """
        :param row: Number of the transition
        :param frames: Its newest frames, (n_envs, *frame_shape)
        """
        self.frames[row % len(self.frames)] = self._here(frames)

    def gather(
        self,
        newest: np.ndarray,
        envs: np.ndarray,
        age: np.ndarray,
        zero_padded: np.ndarray,
        final: np.ndarray,
        crop_size: int | None = None,
    ) -> th.Tensor:
        """
        Stacked observations; all arguments broadcast to the shape (...) of ``newest``.

        :param newest: Number of the transition whose row holds the newest frame
        :param envs: Env of each
        :param age: How many frames of the same episode came before the newest one
        :param zero_padded: Whether the stack was filled with zeros when the episode began, not with its first frame
        :param final: Where the newest frame lies aside, -1 where it does not
        :param crop_size: Height and width in pixels that each observation is cropped to, at a place of its own, uniform
            over all; the frames of a stack stay together. None for no crop
        :return: (..., *shape), height and width those of the crop, on the device that the frames lie on
        """
        back = np.arange(self.stack - 1, -1, -1)
        rows = (newest[..., None] - np.minimum(back, age[..., None])) % len(self.frames)
        numbers = rows * self.frames.shape[1] + envs[..., None]
        corners = None if crop_size is None else self._random_corners(newest.shape, crop_size)
        stacked = self._read(self.frames, numbers, crop_size, corners)
        # PyTorch cannot write to places of unsigned numbers but bytes.
        written = stacked.view(SIGNED.get(stacked.dtype, stacked.dtype))
        if (is_final := final >= 0).any():
            newest_of: Any = (*self._places(is_final), -1)
            corners = None if corners is None else corners[(slice(None), *newest_of)]
            finals = self._read(self.final_frames, final[is_final], crop_size, corners)
            written[newest_of] = finals.view(written.dtype)
        if self.stack > 1 and (before := (back > age[..., None]) & zero_padded[..., None]).any():
            written[self._places(before)] = 0
        return stacked.flatten(newest.ndim, newest.ndim + 1) if self.stack > 1 else stacked.squeeze(newest.ndim)

    def _places(self, mask: np.ndarray) -> tuple[th.Tensor, ...]:
        """Where a mask is true, as indices; a GPU would wait to know how many a mask of its own has."""
        return tuple(to_device(places, self.device) for places in np.nonzero(mask))

    def _random_corners(self, shape: tuple[int, ...], crop_size: int) -> th.Tensor:
        """Top and left of a crop for every observation, the same for all frames of its stack: (2, *shape, stack)."""
        free = [length - crop_size + 1 for length in self.frame_shape[1:]]
        corners = th.stack([th.randint(places, (*shape, 1), device=self.device) for places in free])
        return corners.expand(2, *shape, self.stack)

    def _read(self, frames: Any, numbers: np.ndarray, crop_size: int | None, corners: th.Tensor | None) -> th.Tensor:
        """
        Copies of frames.

        :param frames: (..., *frame_shape)
        :param numbers: Which ones, counted as they lie in memory, of any shape (...)
        :param crop_size: Height and width in pixels of a crop of each, None for all of it
        :param corners: Top and left of the crops, (2, ...)
        :return: (..., *frame_shape), cropped or not
        """
        memory = th.as_tensor(frames).reshape(-1)
        length = math.prod(self.frame_shape)
        starts = to_device(numbers, self.device)
        if crop_size is None or corners is None:
            rows = math.prod(frames.shape[: frames.ndim - len(self.frame_shape)])
            drawn = self._empty((numbers.size, length), memory)
            th.index_select(memory.view(rows, length), 0, starts.flatten(), out=drawn)
            return drawn.view(*numbers.shape, *self.frame_shape)
        # Of each channel all from its crop's first pixel to its last, pixels beside the crop included, is one piece.
        channels, height, width = self.frame_shape
        top, left = corners[..., None]
        channel = th.arange(channels, device=self.device) * height * width
        starts = starts[..., None] * length + channel + top * width + left
        length = (crop_size - 1) * width + crop_size
        pieces = memory.as_strided((len(memory) - length + 1, length), (1, 1))  # one from every place in memory on
        drawn = self._empty((starts.numel(), length), memory)
        th.index_select(pieces, 0, starts.flatten(), out=drawn)
        drawn = drawn.view(*starts.shape, length)
        return drawn.as_strided((*starts.shape, crop_size, crop_size), (*drawn.stride()[:-1], width, 1))

    def _empty(self, shape: tuple[int, int], like: th.Tensor) -> th.Tensor:
        """Memory to write to. On a CPU new memory costs more than copying to it: what nobody looks at is used again."""
        if like.device.type != "cpu":
            return like.new_empty(shape)
        size = math.prod(shape)
        # Every tensor and array that was made of a part of a piece would keep that part alive. The newest is likely cached.
        fits = [size <= len(piece) <= 2 * size and part() is None for piece, part in self._scratch]
        found = max((i for i, fit in enumerate(fits) if fit), default=None)
        piece = np.empty(size, self.dtype) if found is None else self._scratch.pop(found)[0]
        part = piece[:size]
        self._scratch.append((piece, weakref.ref(part)))
        while len(self._scratch) > MAX_SCRATCH or sum(piece.nbytes for piece, _ in self._scratch) > MAX_SCRATCH_BYTES:
            del self._scratch[0]
        return th.from_numpy(part).view(shape)

    def put_final(self, slot: int, frame: Any) -> None:
        """Lay an episode's last frame aside; the space for them doubles when it is full."""
        if slot >= len(self.final_frames):
            longer = self._zeros((max(16, 2 * slot), *self.frame_shape))
            longer[: len(self.final_frames)] = self.final_frames
            self.final_frames = longer
        self.final_frames[slot] = self._here(frame)


class _Observations:
    """
    Looks like SB3's array (buffer_size, n_envs, *shape) of observations; what is read is put together on the way.

    :param buffer: The buffer
    :param key: Key of Dict observations, else ""
    :param following: Whether these are the next observations
    """

    def __init__(self, buffer: "WindowReplayBuffer", key: str, following: bool):
        self.buffer = buffer
        self.key = key
        self.following = following
        store = buffer.stores[key]
        self.shape = (buffer.buffer_size, buffer.n_envs, *store.shape)
        self.dtype = store.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> np.ndarray:
        index = index if isinstance(index, tuple) else (index,)
        if any(part is Ellipsis or part is None for part in index):
            return self[:][index]
        where = np.ogrid[: self.shape[0], : self.shape[1]]
        positions, envs = (part[index[:2]] for part in np.broadcast_arrays(*where))
        observations = self.buffer.gather(self.key, positions.reshape(-1), envs.reshape(-1), self.following).cpu().numpy()
        return observations.reshape(*positions.shape, *self.shape[2:])[(*(slice(None),) * positions.ndim, *index[2:])]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)


class WindowReplayBuffer(NStepReplayBuffer):
    """
    SB3's replay buffer (n-step returns included) that also gives windows, and stores each frame once.

    Stacks and next observations are put together when they are read. A transition of 3 stacked frames of
    100 x 100 x 3 bytes takes 30 kB, where SB3's buffer takes 180 kB. Observations that do not follow the last next
    observation, without an end of the episode in between (a reset by hand, a new env), begin a new episode; the
    transition before them counts as truncated.

    :param buffer_size: Max number of transitions, all envs together
    :param observation_space: Observation space, Dict or not
    :param action_space: Action space
    :param device: PyTorch device of what is sampled
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Accepted for SB3; frames are stored once anyway
    :param handle_timeout_termination: Whether to bootstrap where an episode was truncated
    :param n_steps: Number of steps of n-step returns in ``sample``; only 1 for Dict observations, as in SB3
    :param gamma: Discount of n-step returns
    :param frame_stack: How many frames the environment stacks along the first axis of an observation, oldest first
        (channels of images, which SB3 puts first); one number, or one for each key of a Dict. At an episode's begin
        the first frame may be repeated (Gymnasium's FrameStackObservation) or zeros may fill up (SB3's VecFrameStack)
    :param storage_device: Device that holds the observations, such as ``"cuda"``: they are then put together, cropped and
        handed over there. None for main memory. 100,000 frames of 100 x 100 x 3 bytes take 3 GB
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        frame_stack: int | Mapping[str, int] = 1,
        storage_device: th.device | str | None = None,
    ):
        if n_steps > 1 and isinstance(observation_space, spaces.Dict):
            raise ValueError(f"n_steps={n_steps}: SB3 has no n-step returns for Dict observations")
        # SB3's ReplayBuffer would allocate its two arrays of observations.
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.n_steps = n_steps
        self.gamma = gamma

        parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        if isinstance(frame_stack, Mapping) and not set(frame_stack) <= set(parts):
            raise ValueError(f"frame_stack={dict(frame_stack)} names keys that observations do not have: {sorted(parts)}")
        self.storage_device = None if storage_device is None else get_device(storage_device)
        self.stores: dict[str, FrameStore] = {}
        for key, space in parts.items():
            stack = frame_stack.get(key, 1) if isinstance(frame_stack, Mapping) else frame_stack
            shape = get_obs_shape(space)
            assert isinstance(shape, tuple)
            self.stores[key] = FrameStore(self.buffer_size, n_envs, shape, space.dtype, stack, self.storage_device)

        size = (self.buffer_size, n_envs)
        self.actions = np.zeros((*size, self.action_dim), self._maybe_cast_dtype(action_space.dtype))
        self.rewards = np.zeros(size, np.float32)
        self.dones = np.zeros(size, np.float32)
        self.timeouts = np.zeros(size, np.float32)
        self._clear()
        self._warn_of_memory()

    def _warn_of_memory(self) -> None:
        """As SB3 does: memory is taken as it fills, which may be hours later."""
        if psutil is None:
            return
        arrays = [self.actions, self.rewards, self.dones, self.timeouts]
        arrays += [store.frames for store in self.stores.values() if store.device is None]
        needed, available = sum(array.nbytes for array in arrays), psutil.virtual_memory().available
        if needed > available:
            warnings.warn(
                f"This system does not seem to have enough memory for the whole replay buffer: {needed / 1e9:.2f} GB of "
                f"{available / 1e9:.2f} GB",
                stacklevel=3,
            )

    def _clear(self) -> None:
        size = (self.buffer_size, self.n_envs)
        self.n_added = 0  # transitions per env ever added; number n lies at position n % buffer_size
        self._age = np.zeros(size, np.int32)  # steps since the episode began
        self._zero_padded = {key: np.zeros(size, bool) for key in self.stores}
        self._final_slot = np.full(size, -1, np.int64)  # where the last frame of an episode lies aside
        self._free_slots: list[int] = []
        self._n_slots = 0
        self._last_next_obs: dict[str, np.ndarray] = {}
        self._episode_over = np.ones(self.n_envs, bool)

    def reset(self) -> None:
        """Forget everything."""
        super().reset()
        self._clear()

    @cached_property
    def _image_keys(self) -> frozenset[str]:
        return frozenset(image_spaces(self.observation_space))

    @property
    def observations(self) -> Any:  # type: ignore[override]
        """What SB3's buffer has under this name: array-like (buffer_size, n_envs, ...), a dict of them for Dict spaces."""
        return self._as_sb3(following=False)

    @property
    def next_observations(self) -> Any:  # type: ignore[override]
        """As ``observations``, one step later and never across the end of an episode."""
        return self._as_sb3(following=True)

    def _as_sb3(self, following: bool) -> Any:
        views = {key: _Observations(self, key, following) for key in self.stores}
        return views if isinstance(self.observation_space, spaces.Dict) else views[""]

    def gather(
        self,
        key: str,
        positions: np.ndarray,
        envs: np.ndarray,
        following: bool | np.ndarray = False,
        crop_size: int | None = None,
    ) -> th.Tensor:
        """
        Observations of one key.

        :param key: Key of Dict observations, else ""
        :param positions: Positions in the buffer, at least one axis; like envs not checked
        :param envs: Envs, one for each position, or of a shape that broadcasts to theirs
        :param following: Whether to give the next observation instead; (...) is what it and positions broadcast to
        :param crop_size: Height and width in pixels that images are cropped to at random, None for no crop
        :return: (..., *observation shape), height and width those of the crop, on ``storage_device``
        """
        at = positions * self.n_envs + envs
        # Positions before self.pos were written in this round of the ring, the others in the round before.
        numbers = self.n_added - self.pos + positions - np.where(positions < self.pos, 0, self.buffer_size)
        return self.stores[key].gather(
            numbers + following,
            envs,
            self._age.take(at) + following,
            self._zero_padded[key].take(at),
            np.where(following, self._final_slot.take(at), -1),
            crop_size if key in self._image_keys else None,
        )

    def add(  # type: ignore[override]
        self,
        obs: np.ndarray | dict[str, np.ndarray],
        next_obs: np.ndarray | dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Add one transition of every env.

        :param obs: Observations (n_envs, ...), not normalized
        :param next_obs: The following observations, of the old episode where it is done
        :param action: (n_envs, action_dim), scaled to [-1, 1]
        :param reward: (n_envs,)
        :param done: (n_envs,), whether the episode ended, for whatever reason
        :param infos: One dict per env; ``TimeLimit.truncated`` tells truncation from termination
        :raises ValueError: when a stack is not made of the frames before it; nothing is added then
        """
        current, following = self._by_key(obs), self._by_key(next_obs)
        action = np.asarray(action).reshape(self.n_envs, self.action_dim)
        reward = np.asarray(reward).reshape(self.n_envs)
        done = np.array(done, bool).reshape(self.n_envs)  # a copy: it is looked at again with the next transition
        starts = self._starts(current)
        zero_padded = self._check_stacks(current, following, starts, done)

        pos, row = self.pos, self.n_added
        previous = (pos - 1) % self.buffer_size
        for env in np.flatnonzero(starts & ~self._episode_over):
            # A new episode although the old one was not done: its last frame is about to be overwritten.
            self._lay_aside(
                previous, env, {key: store.frames[row % len(store.frames), int(env)] for key, store in self.stores.items()}
            )
            self.timeouts[previous, env] = True

        for env in np.flatnonzero(self._final_slot[pos] >= 0):
            self._free_slots.append(int(self._final_slot[pos, env]))
            self._final_slot[pos, env] = -1
        for key, store in self.stores.items():
            store.put(row, store.split(current[key])[:, -1])
            store.put(row + 1, store.split(following[key])[:, -1])
            padded = self._zero_padded[key]
            padded[pos] = np.where(starts, zero_padded[key], padded[previous])
        self._age[pos] = np.where(starts, 0, self._age[previous] + 1)
        self.actions[pos] = action
        self.rewards[pos] = reward
        self.dones[pos] = done
        timeouts = [self.handle_timeout_termination and info.get("TimeLimit.truncated", False) for info in infos]
        self.timeouts[pos] = np.array(timeouts).reshape(self.n_envs)  # extend() may be given rows of another buffer's
        for env in np.flatnonzero(done):
            self._lay_aside(pos, env, {key: store.split(following[key])[env, -1] for key, store in self.stores.items()})
        self._episode_over = done
        self._last_next_obs = {key: value.copy() for key, value in following.items()}

        self.n_added += 1
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    @property
    def stacks(self) -> bool:
        """Whether any observation is a stack of frames."""
        return any(store.stack > 1 for store in self.stores.values())

    def can_go_on(self, obs: np.ndarray | dict[str, np.ndarray]) -> bool:
        """
        Whether the frames of these observations are known: each is what the last transition led to, or begins an episode. A
        buffer that was emptied or exchanged inside an episode has not the earlier frames of a stack.

        :param obs: Observations of all envs
        """
        current = self._by_key(obs)
        starts = self._starts(current)
        return all(
            _first_stack(store.split(current[key])[env]) is not None
            for key, store in self.stores.items()
            for env in np.flatnonzero(starts)
        )

    def _starts(self, current: dict[str, np.ndarray]) -> np.ndarray:
        """Which envs begin an episode with these observations."""
        starts = self._episode_over.copy()
        for key, last in self._last_next_obs.items():
            starts |= [not _equal(*pair) for pair in zip(current[key], last, strict=True)]
        return starts

    def _by_key(self, obs: np.ndarray | dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        parts = obs if isinstance(obs, dict) else {"": obs}
        return {key: np.asarray(parts[key]).reshape(self.n_envs, *store.shape) for key, store in self.stores.items()}

    def _lay_aside(self, pos: int, env: np.intp, frames: dict[str, Any]) -> None:
        if not self._free_slots:
            self._free_slots.append(self._n_slots)
            self._n_slots += 1
        slot = self._free_slots.pop()
        self._final_slot[pos, env] = slot
        for key, store in self.stores.items():
            store.put_final(slot, frames[key])

    def _check_stacks(
        self, current: dict[str, np.ndarray], following: dict[str, np.ndarray], starts: np.ndarray, done: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Which envs fill a stack up with zeros (where ``starts``), by key; refuses stacks that frames do not make."""
        zero_padded = {key: np.zeros(self.n_envs, bool) for key in self.stores}
        for key, store in self.stores.items():
            if store.stack == 1:
                continue
            old, new = store.split(current[key]), store.split(following[key])
            for env in range(self.n_envs):
                if starts[env]:
                    first = _first_stack(old[env])
                    if first is None:
                        raise self._stack_error(key, env, "an episode begins neither with one frame repeated nor with zeros")
                    zero_padded[key][env] = first == "zeros"
                # VecNormalize gives an episode's last observation back with rounding errors; images are floats then.
                rounded = done[env] and (np.issubdtype(store.dtype, np.floating) or len(store.shape) == 1)
                if not rounded and not _equal(new[env, :-1], old[env, 1:]):
                    raise self._stack_error(key, env, "the next observation is not the last one plus one new frame")
        return zero_padded

    def _stack_error(self, key: str, env: int, problem: str) -> ValueError:
        store = self.stores[key]
        return ValueError(
            f"frame_stack={store.stack} does not fit observations{f' under {key!r}' if key else ''} of shape {store.shape} "
            f"(env {env}, transition {self.n_added}): {problem}. The stack has to be the outermost observation wrapper, along "
            "the channels, oldest frame first: action repeat, rendering and resizing inside, FrameStackObservation or "
            "VecFrameStack outside. If observations are no stacks, pass replay_buffer_kwargs=dict(frame_stack=1); if the "
            "buffer was emptied inside an episode, reset the environments too; if somebody else stepped them since, such as "
            "evaluate_policy(model, model.get_env()), call learn() again: it resets them first"
        )

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None, crop_size: int | None = None
    ) -> ReplayBufferSamples | DictReplayBufferSamples:
        """
        Transitions, uniform over all; the same as SB3's buffers give for one seed.

        :param batch_size: Number of transitions
        :param env: VecNormalize that observations and rewards go through; it normalizes whole images, which are not cropped
        :param crop_size: Height and width in pixels that images are cropped to at random while their frames are gathered,
            each observation at a place of its own; None for no crop. n-step returns come without crops
        """
        upper = self.buffer_size if self.full else self.pos
        positions = np.random.randint(0, upper, size=batch_size)
        # A user's class may have SB3's arguments only.
        return self._get_samples(positions, env, **({} if crop_size is None else {"crop_size": crop_size}))

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None, crop_size: int | None = None
    ) -> ReplayBufferSamples | DictReplayBufferSamples:
        if self.n_steps > 1:
            # SB3's own code draws from the arrays that this buffer only seems to have.
            return super()._get_samples(batch_inds, env)
        batch_inds = np.asarray(batch_inds, np.int64)  # small integers could not count all transitions
        envs = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        at = batch_inds * self.n_envs + envs
        dones = self.dones.take(at) * (1 - self.timeouts.take(at))
        # Observations and next ones together.
        both = self._gather_all(batch_inds, envs, np.array([[False], [True]]), env, crop_size)
        if isinstance(both, dict):
            samples: Any = DictReplayBufferSamples
            obs, next_obs = ({key: value[i] for key, value in both.items()} for i in range(2))
        else:
            samples, (obs, next_obs) = ReplayBufferSamples, both
        return samples(
            obs,
            self.to_torch(self._actions(at), copy=False),
            next_obs,
            self.to_torch(dones[:, None], copy=False),
            self.to_torch(self._normalize_reward(self.rewards.take(at)[:, None], env), copy=False),
        )

    def _actions(self, at: np.ndarray) -> np.ndarray:
        """The actions (..., action_dim) at places of (buffer_size, n_envs), one row after the other."""
        return self.actions.reshape(-1, self.action_dim).take(at, axis=0)

    def to_torch(self, array: np.ndarray, copy: bool = True) -> th.Tensor:
        """
        As in SB3, but that nobody waits for a GPU.

        :param array: What is sampled
        :param copy: Whether to copy it where it could be shared
        """
        return super().to_torch(array, copy) if copy else to_device(array, self.device)

    def _gather_all(
        self,
        positions: np.ndarray,
        envs: np.ndarray,
        following: bool | np.ndarray,
        env: VecNormalize | None,
        crop_size: int | None,
    ) -> Any:
        """Observations as ``gather`` gives them, of all keys, normalized, on the device."""
        crop_size = crop_size if env is None else None
        parts = {key: self.gather(key, positions, envs, following, crop_size) for key in self.stores}
        if env is not None:
            arrays: dict[str, Any] = {key: part.cpu().numpy() for key, part in parts.items()}
            normalized: Any = self._normalize_obs(arrays.get("", arrays), env)
            parts = normalized if isinstance(normalized, dict) else {"": normalized}
        tensors = {key: to_device(part, self.device) for key, part in parts.items()}
        return tensors.get("", tensors)

    def _draw_windows(self, batch_size: int, horizon: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the last steps, and envs, of windows, uniform over all whole ones."""
        if horizon < 1:
            raise ValueError(f"a horizon is at least 1, not {horizon}")
        n_steps = self.size() * self.n_envs
        # A step that has horizon - 1 steps of its episode before it ends a whole window, if they are all still there. Most
        # steps do; those that do not are drawn again, without a look at all the others.
        ends, wrong = np.zeros(batch_size, np.int64), np.arange(batch_size)
        for _ in range(MAX_REDRAWS if n_steps else 0):
            ends[wrong] = np.random.randint(n_steps, size=len(wrong))
            whole = self._age.take(ends) >= horizon - 1
            if self.full:
                whole &= (ends // self.n_envs - self.pos) % self.buffer_size >= horizon - 1
            wrong = np.flatnonzero(~whole)
            if not len(wrong):
                break
        else:
            whole = self._age[: self.size()] >= horizon - 1
            if self.full:
                oldest = np.arange(min(horizon - 1, self.buffer_size))
                whole[(self.pos + oldest) % self.buffer_size] = False
            every = np.flatnonzero(whole)
            if not len(every):
                raise NoWindowError(f"no episode in the replay buffer spans {horizon} agent steps yet")
            ends = every[np.random.randint(len(every), size=batch_size)]
        positions, envs = np.divmod(ends, self.n_envs)
        return positions, envs

    def sample_windows(
        self,
        batch_size: int,
        horizon: int,
        env: VecNormalize | None = None,
        offsets: Sequence[int] | None = None,
        crop_size: int | None = None,
    ) -> WindowSamples:
        """
        Windows of consecutive steps inside one episode of one env, uniform over all whole ones in the buffer.

        :param batch_size: Number of windows
        :param horizon: Agent steps k of each: k + 1 observations, the k actions and rewards between them
        :param env: VecNormalize that observations and rewards go through
        :param offsets: Gather only the observations at these offsets from the start (0 to k), in this order; None for all
            k + 1
        :param crop_size: As in ``sample``; an offset that is named twice gets two crops
        :raises NoWindowError: when no episode is long enough yet
        """
        wanted = np.arange(horizon + 1) if offsets is None else np.asarray(offsets, np.int64)
        if ((wanted < 0) | (wanted > horizon)).any():
            raise ValueError(f"offsets {wanted.tolist()} of a window of horizon {horizon} are not all in 0 to {horizon}")
        ends, envs = self._draw_windows(batch_size, horizon)
        steps = (ends[:, None] + np.arange(1 - horizon, 1)) % self.buffer_size
        # The last observation is the next one of the last step: the episode may have ended there.
        following = wanted == horizon
        # Gathered one offset after the other, so that all observations at some of the offsets lie together.
        observations = self._gather_all(steps[:, wanted - following].T, envs, following[:, None], env, crop_size)
        at = steps * self.n_envs + envs[:, None]
        rewards = self._normalize_reward(self.rewards.take(at)[..., None], env)
        return WindowSamples(
            {key: value.transpose(0, 1) for key, value in observations.items()}
            if isinstance(observations, dict)
            else observations.transpose(0, 1),
            self.to_torch(self._actions(at), copy=False),
            self.to_torch(rewards, copy=False),
        )


def _gymnasium_stack(env: VecEnv) -> Any:
    try:
        wrapped = env.env_is_wrapped(FrameStackObservation)
        return env.get_attr("stack_size")[0] if wrapped and all(wrapped) else 1
    except (NotImplementedError, AttributeError):
        return 1  # a VecEnv that does not say what it is made of


def detect_frame_stack(env: VecEnv) -> int | dict[str, int]:
    """
    How many frames an environment stacks along the first axis of observations, as its wrappers tell.

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
        # Whatever stacks inside of it only makes its frames.
        stack = outer.stacked_obs.n_stack
        inner = getattr(outer.stacked_obs, "sub_stacked_observations", {"": outer.stacked_obs})
    else:
        stack = _gymnasium_stack(env)
        stack = stack if isinstance(stack, int) and stack > 0 else 1  # of a wrapper outside of it
    stacks: dict[str, int] = {}
    for key, part in parts.items():
        shape = part.shape or (1,)
        # A wrapper outside may have taken one of several observations: what it is called inside is not known.
        stacked = inner.get(key)
        is_known = not inner or stacked is not None
        first_axis = stacked is None or stacked.channels_first or len(shape) == 1 or is_image_space(part)
        stacks[key] = stack if is_known and first_axis and shape[0] % stack == 0 else 1
    return stacks if isinstance(space, spaces.Dict) else stacks[""]
