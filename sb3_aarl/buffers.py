"""WindowReplayBuffer: windows of consecutive steps out of a replay buffer that stores each frame once."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_aarl.augmentation import image_spaces
from sb3_aarl.frame_store import FrameStore, detect_frame_stack, rows_equal

try:
    import psutil
except ImportError:  # an extra of SB3
    psutil = None  # type: ignore[assignment]

__all__ = ["NoWindowError", "WindowReplayBuffer", "WindowSamples", "detect_frame_stack"]

# Rounds in which steps that end no whole window are drawn again, before all that do are looked up. In a buffer of a million
# steps a lookup takes 3 % of a gradient step.
MAX_REDRAWS = 8
# What is stored of each transition beside its frames.
ARRAYS = ("actions", "rewards", "dones", "timeouts", "ages", "ended")


class WindowSamples(NamedTuple):
    """
    Windows of one horizon k; ``observations`` is a dict of such tensors for Dict observations.

    :param observations: (batch, k + 1, ...), or (batch, len(offsets), ...) where offsets are given
    :param actions: (batch, k, action_dim), scaled to [-1, 1] as SB3 stores them
    :param rewards: (batch, k, 1)
    """

    observations: th.Tensor | dict[str, th.Tensor]
    actions: th.Tensor
    rewards: th.Tensor


class NoWindowError(ValueError):
    """No episode in the buffer is long enough for the horizon yet."""


def map_parts(function: Callable[[Any], Any], observations: Any) -> Any:
    """The same function of observations, or of every part of Dict observations."""
    if isinstance(observations, dict):
        return {key: function(part) for key, part in observations.items()}
    return function(observations)


@dataclass
class _Observations:
    """SB3's array (buffer_size, n_envs, ...) of observations of one key, or of the next ones, as its own code reads it."""

    buffer: "WindowReplayBuffer"
    key: str
    following: bool

    def __getitem__(self, index: Any) -> np.ndarray:
        index = index if isinstance(index, tuple) else (index,)
        if any(part is Ellipsis or part is None for part in index):
            return self[:][index]
        grid = np.broadcast_arrays(*np.ogrid[: self.buffer.buffer_size, : self.buffer.n_envs])
        positions, envs = (np.asarray(part[index[:2]]) for part in grid)
        observations = self.buffer.gather(positions * self.buffer.n_envs + envs, self.following)
        part = observations[self.key] if isinstance(observations, dict) else observations
        return part.numpy()[(*(slice(None),) * positions.ndim, *index[2:])]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)


class WindowReplayBuffer(NStepReplayBuffer):
    """
    SB3's replay buffer (n-step returns included) that also draws windows, and stores each frame once.

    A transition of 3 stacked frames of 100 x 100 x 3 bytes takes 30 kB, where SB3's buffer takes 180 kB. Observations that
    do not follow the last next observation, without an end of the episode in between (a reset by hand, a new env), begin a
    new episode; the transition before them counts as truncated.

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
        (channels of images, which SB3 puts first); one number, or one for each key of a Dict. At an episode's start
        the first frame may be repeated (Gymnasium's FrameStackObservation) or zeros may fill up (SB3's VecFrameStack)
    """

    # Height and width in pixels that images are cropped to at random while their frames are gathered, each observation at a
    # position of its own, also one that a window has twice; None for no crop, as always for n-step returns.
    crop_size: int | None = None

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
        stacks = frame_stack if isinstance(frame_stack, Mapping) else dict.fromkeys(parts, frame_stack)
        if not set(stacks) <= set(parts):
            raise ValueError(f"frame_stack={dict(stacks)} names keys that observations do not have: {sorted(parts)}")
        self._image_keys = list(image_spaces(observation_space))
        self.stores: dict[str, FrameStore] = {}
        for key, space in parts.items():
            shape: Any = get_obs_shape(space)
            stack = stacks.get(key, 1)
            self.stores[key] = FrameStore(key, self.buffer_size, n_envs, shape, space.dtype, stack)
        needed = sum(store.frames.nbytes for store in self.stores.values())
        if psutil is not None and needed > psutil.virtual_memory().available:
            # As SB3 does: memory is taken as it fills, which may be hours later.
            warnings.warn(f"There is not enough memory for a replay buffer of {needed / 1e9:.2f} GB", stacklevel=2)

        size = (self.buffer_size, n_envs)
        self.actions = np.zeros((*size, self.action_dim), self._maybe_cast_dtype(action_space.dtype))
        self.rewards = np.zeros(size, np.float32)
        self.dones = np.zeros(size, np.float32)
        self.timeouts = np.zeros(size, np.float32)
        self.ages = np.zeros(size, np.int32)  # steps since the episode began
        self.ended = np.zeros(size, bool)  # whether the episode's last frame is stored separately
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._count(0)
        self._last_next_obs: dict[str, np.ndarray] = {}
        self._episode_over = np.ones(self.n_envs, bool)

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
        indices: np.ndarray,
        following: bool | np.ndarray = False,
        env: VecNormalize | None = None,
        crop_size: int | None = None,
    ) -> Any:
        """
        Observations (..., *shape) at flat indices in (buffer_size, n_envs), or the next ones where ``following`` is true;
        (...) is what both broadcast to. With VecNormalize, which normalizes whole images, none is cropped.
        """
        positions = indices // self.n_envs
        # Positions before self.pos were written in this round of the ring, the others in the round before.
        numbers = self.n_added - self.pos + positions - np.where(positions < self.pos, 0, self.buffer_size)
        ages, final = self.ages.take(indices) + following, self.ended.take(indices) & following
        crops = dict.fromkeys(self._image_keys, crop_size) if env is None else {}
        parts = {
            key: store.gather(indices, numbers + following, ages, final, crops.get(key)) for key, store in self.stores.items()
        }
        observations: Any = parts if isinstance(self.observation_space, spaces.Dict) else parts[""]
        if env is not None:
            observations = env.normalize_obs(map_parts(lambda part: part.numpy(), observations))
        return map_parts(th.as_tensor, observations)

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
        Add one transition of every env, not normalized, with the arguments of SB3's buffer.

        :raises ValueError: when a stack is not made of the frames before it; nothing is added then
        """
        current, following = self._by_key(obs), self._by_key(next_obs)
        action = np.asarray(action).reshape(self.n_envs, self.action_dim)
        reward = np.asarray(reward).reshape(self.n_envs)
        done = np.array(done, bool).reshape(self.n_envs)  # a copy: it is looked at again with the next transition
        starts = self._starts(current)
        for key, store in self.stores.items():
            store.check(current[key], following[key], starts, done, self.n_added)

        self._truncate(starts & ~self._episode_over)
        for key, store in self.stores.items():
            store.put(self.n_added, current[key], following[key], starts)
        pos = self.pos
        self.ages[pos] = np.where(starts, 0, self.ages[pos - 1] + 1)
        self.ended[pos] = False
        self.actions[pos] = action
        self.rewards[pos] = reward
        self.dones[pos] = done
        # An array as in SB3: values may be arrays of one number.
        truncated = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        self.timeouts[pos] = truncated if self.handle_timeout_termination else False
        self._last_next_obs = {key: value.copy() for key, value in following.items()}
        self._episode_over = np.zeros(self.n_envs, bool)
        self._count(self.n_added + 1)
        self._end_episodes(done)

    def _count(self, n_added: int) -> None:
        self.n_added = n_added  # transitions per env ever added; number n is at position n % buffer_size
        self.pos = n_added % self.buffer_size
        self.full = n_added >= self.buffer_size

    def _end_episodes(self, envs: np.ndarray) -> None:
        """The last transitions of these envs (n_envs,) are the last of their episodes."""
        if not envs.any():
            return
        self._episode_over |= envs
        self.ended[self.pos - 1, envs] = True
        for store in self.stores.values():
            store.put_final(self.n_added - 1, envs)

    def _truncate(self, envs: np.ndarray) -> None:
        """End episodes of these envs (n_envs,) that were left before they were over."""
        self._end_episodes(envs)
        self.timeouts[self.pos - 1, envs] = True

    def _by_key(self, obs: np.ndarray | dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        parts = obs if isinstance(obs, dict) else {"": obs}
        return {key: np.asarray(parts[key]).reshape(self.n_envs, *store.shape) for key, store in self.stores.items()}

    def _starts(self, current: dict[str, np.ndarray]) -> np.ndarray:
        """Which envs begin an episode with these observations."""
        starts = self._episode_over.copy()
        for key, last in self._last_next_obs.items():
            starts |= ~rows_equal(current[key], last)
        return starts

    def training_state(self) -> dict[str, Any]:
        """Tensors and plain values of what was added, for ``load_training_state``; they share memory with the buffer."""
        return {
            "buffer_size": self.buffer_size,
            "n_envs": self.n_envs,
            "n_added": self.n_added,
            "episode_over": self._episode_over.tolist(),
            "arrays": {name: th.from_numpy(getattr(self, name)[: self.size()]) for name in ARRAYS},
            "stores": {key: store.training_state(self.n_added) for key, store in self.stores.items()},
        }

    def load_training_state(self, state: dict[str, Any]) -> None:
        """
        Continue where another buffer was. Episodes that were running there are truncated: the environments have to be
        reset, and the next observations begin new episodes.

        :param state: Returned by ``training_state`` of a buffer with the same settings
        """
        for name in ("buffer_size", "n_envs"):
            if state[name] != getattr(self, name):
                raise ValueError(f"the state is of a replay buffer with {name}={state[name]}, not {getattr(self, name)}")
        self.reset()
        self._count(state["n_added"])
        for name, values in state["arrays"].items():
            getattr(self, name)[: len(values)] = values.numpy()
        for key, store in self.stores.items():
            store.load_training_state(state["stores"][key])
        self._episode_over = np.array(state["episode_over"])
        self._truncate(~self._episode_over)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> ReplayBufferSamples | DictReplayBufferSamples:
        if self.n_steps > 1:
            # SB3's own code, which reads ``observations`` and ``next_observations``.
            return super()._get_samples(batch_inds, env)
        indices = batch_inds * self.n_envs + np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        # Observations and next ones together.
        both = self.gather(indices, np.array([[False], [True]]), env, self.crop_size)
        dones = self._take("dones", indices) * (1 - self._take("timeouts", indices))
        return (DictReplayBufferSamples if isinstance(both, dict) else ReplayBufferSamples)(
            map_parts(lambda part: part[0].to(self.device), both),
            self.to_torch(self._take("actions", indices), copy=False),
            map_parts(lambda part: part[1].to(self.device), both),
            self.to_torch(dones[:, None], copy=False),
            self.to_torch(self._normalize_reward(self._take("rewards", indices)[:, None], env), copy=False),
        )

    def _take(self, name: str, indices: np.ndarray) -> np.ndarray:
        """A copy of some rows of an array (buffer_size, n_envs, ...), by flat indices."""
        array: np.ndarray = getattr(self, name)
        return array.reshape(-1, *array.shape[2:]).take(indices, axis=0)

    def _draw_windows(self, batch_size: int, horizon: int) -> np.ndarray:
        """Flat indices of the last steps of windows, uniform over all whole ones."""
        n_steps = self.size() * self.n_envs
        # A step that has horizon - 1 steps of its episode before it ends a whole window, if they are all still there. Most
        # steps do; those that do not are drawn again, without a look at all the others.
        ends, wrong = np.zeros(batch_size, np.int64), np.arange(batch_size)
        for _ in range(MAX_REDRAWS if n_steps else 0):
            ends[wrong] = np.random.randint(n_steps, size=len(wrong))
            whole = self.ages.take(ends) >= horizon - 1
            if self.full:
                whole &= (ends // self.n_envs - self.pos) % self.buffer_size >= horizon - 1
            wrong = np.flatnonzero(~whole)
            if not len(wrong):
                break
        else:
            whole = self.ages[: self.size()] >= horizon - 1
            if self.full:
                whole[(self.pos + np.arange(horizon - 1)) % self.buffer_size] = False
            every = np.flatnonzero(whole)
            if not len(every):
                raise NoWindowError(f"no episode in the replay buffer spans {horizon} agent steps yet")
            ends = every[np.random.randint(len(every), size=batch_size)]
        return ends

    def sample_windows(
        self,
        batch_size: int,
        horizon: int,
        env: VecNormalize | None = None,
        offsets: Sequence[int] | None = None,
    ) -> WindowSamples:
        """
        Windows of consecutive steps inside one episode of one env, uniform over all whole ones in the buffer.

        :param batch_size: Number of windows
        :param horizon: Agent steps k of each: k + 1 observations, the k actions and rewards between them
        :param env: VecNormalize that observations and rewards go through
        :param offsets: Gather only the observations at these offsets from the start (0 to k), in this order; None for all
            k + 1
        :raises NoWindowError: when no episode is long enough yet
        """
        if horizon < 1:
            raise ValueError(f"a horizon is at least 1, not {horizon}")
        wanted = np.arange(horizon + 1) if offsets is None else np.asarray(offsets, np.int64)
        if ((wanted < 0) | (wanted > horizon)).any():
            raise ValueError(f"offsets {wanted.tolist()} of a window of horizon {horizon} are not all in 0 to {horizon}")
        ends = self._draw_windows(batch_size, horizon)
        steps = (ends[:, None] + np.arange(1 - horizon, 1) * self.n_envs) % self.ages.size
        # The last observation is the next one of the last step: the episode may have ended there.
        following = wanted == horizon
        # Gathered one offset after the other, so that all observations at some of the offsets are contiguous.
        observations = self.gather(steps[:, wanted - following].T, following[:, None], env, self.crop_size)
        return WindowSamples(
            map_parts(lambda part: part.transpose(0, 1).to(self.device), observations),
            self.to_torch(self._take("actions", steps), copy=False),
            self.to_torch(self._normalize_reward(self._take("rewards", steps)[..., None], env), copy=False),
        )
