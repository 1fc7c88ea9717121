"""WindowReplayBuffer: windows of consecutive steps out of a replay buffer that stores each frame once."""

import warnings
from collections.abc import Mapping, Sequence
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
from sb3_aarl.frame_store import FrameStore, rows_equal

try:
    import psutil
except ImportError:  # an extra of SB3
    psutil = None  # type: ignore[assignment]


# Rounds in which steps that end no whole window are drawn again, before all that do are looked up. In a buffer of a million
# steps a lookup takes 3 % of a gradient step.
MAX_REDRAWS = 8
# What is stored of each transition beside its frames.
ARRAYS = ("actions", "rewards", "dones", "timeouts", "ages", "ended")


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


class _Observations:
    """
    Looks like SB3's array (buffer_size, n_envs, *shape) of observations, which its own code reads; each read gathers them.

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
        grid = np.broadcast_arrays(*np.ogrid[: self.shape[0], : self.shape[1]])
        positions, envs = (np.asarray(part[index[:2]]) for part in grid)
        observations = self.buffer.gather(self.key, positions, envs, self.following).cpu().numpy()
        return observations[(*(slice(None),) * positions.ndim, *index[2:])]

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
        (channels of images, which SB3 puts first); one number, or one for each key of a Dict. At an episode's begin
        the first frame may be repeated (Gymnasium's FrameStackObservation) or zeros may fill up (SB3's VecFrameStack)
    :param storage_device: Device that observations are stored on, such as ``"cuda"``: they are then gathered and cropped
        there. None for main memory. 100,000 frames of 100 x 100 x 3 bytes take 3 GB
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
        self._image_keys = frozenset(image_spaces(observation_space))
        storage_device = get_device(storage_device or "cpu")
        self.stores: dict[str, FrameStore] = {}
        for key, space in parts.items():
            stack = frame_stack.get(key, 1) if isinstance(frame_stack, Mapping) else frame_stack
            shape = get_obs_shape(space)
            assert isinstance(shape, tuple)
            self.stores[key] = FrameStore(key, self.buffer_size, n_envs, shape, space.dtype, stack, storage_device)
        needed = sum(store.frames.nbytes for store in self.stores.values())
        if psutil is not None and storage_device.type == "cpu" and needed > psutil.virtual_memory().available:
            # As SB3 does: memory is taken as it fills, which may be hours later.
            warnings.warn(
                f"This system does not have enough memory for a replay buffer of {needed / 1e9:.2f} GB", stacklevel=2
            )

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
        super().reset()
        self.n_added = 0  # transitions per env ever added; number n is at position n % buffer_size
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
        key: str,
        positions: np.ndarray,
        envs: np.ndarray,
        following: bool | np.ndarray = False,
        crop_size: int | None = None,
    ) -> th.Tensor:
        """
        Observations of one key.

        :param key: Key of Dict observations, else ""
        :param positions: Positions in the buffer; like envs not checked
        :param envs: Envs, one for each position, or of a shape that broadcasts to theirs
        :param following: Whether to give the next observation instead; (...) is what it and positions broadcast to
        :param crop_size: Height and width in pixels that images are cropped to at random, None for no crop
        :return: (..., *observation shape), height and width those of the crop, on ``storage_device``
        """
        places = positions * self.n_envs + envs
        # Positions before self.pos were written in this round of the ring, the others in the round before.
        numbers = self.n_added - self.pos + positions - np.where(positions < self.pos, 0, self.buffer_size)
        return self.stores[key].gather(
            places,
            numbers + following,
            self.ages.take(places) + following,
            self.ended.take(places) & following,
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
        self.timeouts[pos] = [self.handle_timeout_termination and info.get("TimeLimit.truncated", False) for info in infos]
        self._last_next_obs = {key: value.copy() for key, value in following.items()}
        self._episode_over = np.zeros(self.n_envs, bool)
        self.n_added += 1
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0
        self._end_episodes(done)

    def _end_episodes(self, envs: np.ndarray) -> None:
        """The last transitions of these envs (n_envs,) are the last of their episodes."""
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
        return all(store.begins(current[key])[starts].all() for key, store in self.stores.items())

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
        self.n_added = state["n_added"]
        self.pos = self.n_added % self.buffer_size
        self.full = self.n_added >= self.buffer_size
        for name, values in state["arrays"].items():
            getattr(self, name)[: len(values)] = values.cpu().numpy()
        for key, store in self.stores.items():
            store.load_training_state(state["stores"][key])
        self._episode_over = np.array(state["episode_over"])
        self._truncate(~self._episode_over)

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None, crop_size: int | None = None
    ) -> ReplayBufferSamples | DictReplayBufferSamples:
        """
        Transitions, uniform over all; the same as those of SB3's buffers for one seed.

        :param batch_size: Number of transitions
        :param env: VecNormalize that observations and rewards go through; it normalizes whole images, which are not cropped
        :param crop_size: Height and width in pixels that images are cropped to at random while their frames are gathered,
            each observation at a place of its own; None for no crop. n-step returns come without crops
        """
        positions = np.random.randint(0, self.size(), size=batch_size)
        return self._get_samples(positions, env, **({} if crop_size is None else {"crop_size": crop_size}))

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None, crop_size: int | None = None
    ) -> ReplayBufferSamples | DictReplayBufferSamples:
        if self.n_steps > 1:
            # SB3's own code draws from the arrays that this buffer only seems to have.
            return super()._get_samples(batch_inds, env)
        envs = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        # Observations and next ones together.
        both = self._gather_all(batch_inds, envs, np.array([[False], [True]]), env, crop_size)
        is_dict = isinstance(both, dict)
        obs, next_obs = ({key: value[i] for key, value in both.items()} if is_dict else both[i] for i in range(2))
        dones = self.dones[batch_inds, envs] * (1 - self.timeouts[batch_inds, envs])
        return (DictReplayBufferSamples if is_dict else ReplayBufferSamples)(
            obs,  # type: ignore[arg-type]
            self.to_torch(self.actions[batch_inds, envs]),
            next_obs,  # type: ignore[arg-type]
            self.to_torch(dones[:, None]),
            self.to_torch(self._normalize_reward(self.rewards[batch_inds, envs][:, None], env)),
        )

    def _gather_all(
        self,
        positions: np.ndarray,
        envs: np.ndarray,
        following: np.ndarray,
        env: VecNormalize | None,
        crop_size: int | None,
    ) -> Any:
        """Observations as ``gather`` returns them, of all keys, normalized, on the device."""
        crop_size = crop_size if env is None else None
        parts = {key: self.gather(key, positions, envs, following, crop_size).to(self.device) for key in self.stores}
        if env is not None:
            arrays: dict[str, Any] = {key: part.cpu().numpy() for key, part in parts.items()}
            normalized: Any = self._normalize_obs(arrays.get("", arrays), env)
            parts = {key: self.to_torch(part) for key, part in (normalized if "" not in arrays else {"": normalized}).items()}
        return parts.get("", parts)

    def _draw_windows(self, batch_size: int, horizon: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the last steps, and envs, of windows, uniform over all whole ones."""
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
        if horizon < 1:
            raise ValueError(f"a horizon is at least 1, not {horizon}")
        wanted = np.arange(horizon + 1) if offsets is None else np.asarray(offsets, np.int64)
        if ((wanted < 0) | (wanted > horizon)).any():
            raise ValueError(f"offsets {wanted.tolist()} of a window of horizon {horizon} are not all in 0 to {horizon}")
        ends, envs = self._draw_windows(batch_size, horizon)
        steps = (ends[:, None] + np.arange(1 - horizon, 1)) % self.buffer_size
        # The last observation is the next one of the last step: the episode may have ended there.
        following = wanted == horizon
        # Gathered one offset after the other, so that all observations at some of the offsets are contiguous.
        observations = self._gather_all(steps[:, wanted - following].T, envs, following[:, None], env, crop_size)
        return WindowSamples(
            {key: value.transpose(0, 1) for key, value in observations.items()}
            if isinstance(observations, dict)
            else observations.transpose(0, 1),
            self.to_torch(self.actions[steps, envs[:, None]]),
            self.to_torch(self._normalize_reward(self.rewards[steps, envs[:, None], None], env)),
        )


def _gymnasium_stack(env: VecEnv) -> int:
    try:
        stack = env.get_attr("stack_size")[0] if all(env.env_is_wrapped(FrameStackObservation)) else 1
    except (NotImplementedError, AttributeError):
        return 1  # a VecEnv that does not report what it is made of
    return stack if isinstance(stack, int) else 1  # of a wrapper outside of it


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
        stack = _gymnasium_stack(env)
    stacks: dict[str, int] = {}
    for key, part in parts.items():
        shape = part.shape or (1,)
        stacked = inner.get(key)
        # A wrapper outside may have taken one of several observations, whose key is not known any more.
        is_known = not inner or stacked is not None
        first_axis = stacked is None or stacked.channels_first or len(shape) == 1 or is_image_space(part)
        stacks[key] = stack if is_known and first_axis and shape[0] % stack == 0 else 1
    return stacks if isinstance(space, spaces.Dict) else stacks[""]
