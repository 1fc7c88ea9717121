"""WindowReplayBuffer: windows of consecutive steps out of a replay buffer that stores each frame once."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
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
STACK_ADVICE = (
    "The stack has to be the outermost observation wrapper, along the channels, oldest frame first: action repeat, rendering "
    "and resizing inside, FrameStackObservation or VecFrameStack outside. If observations are no stacks, pass "
    "replay_buffer_kwargs=dict(frame_stack=1). If the environments were stepped outside of learn(), or the buffer was emptied "
    "inside an episode, model.set_env(model.get_env()) has learn() reset them"
)


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


class WindowReplayBuffer(ReplayBuffer):
    """
    SB3's replay buffer (n-step returns included) that also draws windows, and stores each frame once.

    A transition of 3 stacked frames of 100 x 100 x 3 bytes takes 30 kB, where SB3's buffer takes 180 kB. Observations that
    do not follow the last next observation, without an end of the episode in between (a reset by hand, a new env), begin a
    new episode; the transition before them counts as truncated.

    Other arguments are those of SB3's buffers.

    :param buffer_size: Max number of transitions, all envs together
    :param observation_space: Observation space, Dict or not
    :param optimize_memory_usage: Accepted for SB3; frames are stored once anyway
    :param n_steps: Number of steps of n-step returns in ``sample``, discounted by ``gamma``
    :param frame_stack: How many frames the environment stacks along the first axis of an observation, oldest first
        (channels of images, which SB3 puts first); one number, or one for each key of a Dict. At an episode's start
        the first frame may be repeated (Gymnasium's FrameStackObservation) or zeros may fill up (SB3's VecFrameStack)
    """

    # Whether ``frame_stack`` is only what the wrappers suggest: where it does not hold, ``add`` warns and stores whole
    # observations from then on, instead of raising an error.
    frame_stack_detected = False

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
        self.ended.fill(False)
        self._last_next_obs: dict[str, np.ndarray] = {}
        self._episode_over = np.ones(self.n_envs, bool)

    @property
    def observations(self) -> Any:  # type: ignore[override]
        """All that is stored as SB3's array (buffer_size, n_envs, ...), a dict of them for Dict spaces: a read-only copy."""
        return self._as_sb3(following=False)

    @property
    def next_observations(self) -> Any:  # type: ignore[override]
        """As ``observations``, one step later and never across the end of an episode."""
        return self._as_sb3(following=True)

    def _as_sb3(self, following: bool) -> Any:
        def read_only(part: th.Tensor) -> np.ndarray:
            array = np.zeros((self.buffer_size, *part.shape[1:]), part.numpy().dtype)
            array[: self.size()] = part.numpy()
            array.flags.writeable = False
            return array

        stored = np.arange(self.ages.size).reshape(self.ages.shape)[: self.size()]
        return map_parts(read_only, self.gather(stored, following))

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
        located = self._locate(indices, following)
        crops = dict.fromkeys(self._image_keys, crop_size) if env is None else {}
        parts = {key: store.gather(indices, *located, crops.get(key)) for key, store in self.stores.items()}
        observations: Any = parts if isinstance(self.observation_space, spaces.Dict) else parts[""]
        if env is not None:
            observations = env.normalize_obs(map_parts(lambda part: part.numpy(), observations))
        return map_parts(th.as_tensor, observations)

    def _locate(self, indices: np.ndarray, following: bool | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where a store has the observations of ``gather``: the arguments of its own ``gather`` after the indices."""
        positions = indices // self.n_envs
        # Positions before self.pos were written in this round of the ring, the others in the round before.
        numbers = self.n_added - self.pos + positions - np.where(positions < self.pos, 0, self.buffer_size)
        return numbers + following, self.ages.take(indices) + following, self.ended.take(indices) & following

    def _store_whole(self, key: str) -> None:
        """Store whole observations of this key from now on, also those of the transitions so far."""
        old = self.stores[key]
        new = self.stores[key] = FrameStore(key, self.buffer_size, self.n_envs, old.shape, old.frames.dtype, 1)
        numbers = np.arange(self.n_added - self.size(), self.n_added)
        for some in np.array_split(numbers, 1 + len(numbers) // 100):
            indices = some[:, None] % self.buffer_size * self.n_envs + np.arange(self.n_envs)
            for following in (True, False):  # an episode's first observation replaces the last one of the episode before
                new.frames[(some + following) % len(new.frames)] = old.gather(indices, *self._locate(indices, following))
        ended = np.array(list(old.final_frames), np.int64)
        final = old.gather(ended, *self._locate(ended, True)).numpy()
        new.final_frames = {index: frame.copy() for index, frame in zip(old.final_frames, final, strict=True)}

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

        :raises ValueError: when a stack that was asked for is not made of the frames before it; nothing is added then
        """
        current, following = self._by_key(obs), self._by_key(next_obs)
        action = np.asarray(action).reshape(self.n_envs, self.action_dim)
        reward = np.asarray(reward).reshape(self.n_envs)
        done = np.array(done, bool).reshape(self.n_envs)  # a copy: it is looked at again with the next transition
        starts = self._starts(current)
        for key, store in self.stores.items():
            problem = store.problem(current[key], following[key], starts, done, self.n_added)
            if problem and not self.frame_stack_detected:
                raise ValueError(f"{problem}. {STACK_ADVICE}")
            if problem:
                self._store_whole(key)
                size = self.stores[key].frames.nbytes / 1e9
                warnings.warn(
                    f"{problem}. The stack was inferred from the wrappers: whole observations are stored instead, which takes "
                    f"{store.stack} times the memory, {size:.2g} GB in a full replay buffer. {STACK_ADVICE}",
                    stacklevel=2,
                )

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
        def rows(part: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
            missing = np.ndim(part) <= len(shape)  # axes that SB3 adds, as to a Discrete observation
            return np.reshape(part, (self.n_envs, *shape)) if missing else np.broadcast_to(part, (self.n_envs, *shape))

        parts = obs if isinstance(obs, dict) else {"": obs}
        return {key: rows(parts[key], store.shape) for key, store in self.stores.items()}

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
        for key, stored in state["stores"].items():
            if stored["frames"].shape[2:] != self.stores[key].frame_shape:  # a detected stack did not hold there
                self._store_whole(key)
            self.stores[key].load_training_state(stored)
        self._count(state["n_added"])
        for name, values in state["arrays"].items():
            getattr(self, name)[: len(values)] = values.numpy()
        self._episode_over = np.array(state["episode_over"])
        self._truncate(~self._episode_over)

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None, crop_size: int | None = None
    ) -> ReplayBufferSamples | DictReplayBufferSamples:
        """
        As in SB3.

        :param crop_size: Height and width in pixels that images are cropped to while their frames are gathered, each
            observation at a random position of its own; None for no crop
        """
        crop = {} if crop_size is None else {"crop_size": crop_size}  # derived classes may have SB3's arguments alone
        return self._get_samples(np.random.randint(0, self.size(), size=batch_size), env, **crop)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None, crop_size: int | None = None
    ) -> ReplayBufferSamples | DictReplayBufferSamples:
        indices = batch_inds * self.n_envs + np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        if self.n_steps > 1:
            last, rewards, discounts = self._n_step_returns(indices, env)
        else:
            last, rewards, discounts = indices, self._normalize_reward(self._take("rewards", indices)[:, None], env), None
        # Observations and next ones together.
        both = self.gather(np.stack([indices, last]), np.array([[False], [True]]), env, crop_size)
        dones = self._take("dones", last) * (1 - self._take("timeouts", last))
        return (DictReplayBufferSamples if isinstance(both, dict) else ReplayBufferSamples)(
            map_parts(lambda part: part[0].to(self.device), both),
            self.to_torch(self._take("actions", indices), copy=False),
            map_parts(lambda part: part[1].to(self.device), both),
            self.to_torch(dones[:, None], copy=False),
            self.to_torch(rewards, copy=False),
            discounts if discounts is None else self.to_torch(discounts, copy=False),
        )

    def _n_step_returns(self, indices: np.ndarray, env: VecNormalize | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        :return: Flat indices (batch,) of the last of at most ``n_steps`` steps from each of these, up to the episode's end or
            the newest step; their discounted rewards (batch, 1), and the discounts (batch, 1) of what comes after them
        """
        steps = np.arange(self.n_steps)
        every = (indices[:, None] + steps * self.n_envs) % self.ages.size
        over = self._take("dones", every) + self._take("timeouts", every) > 0
        over |= every // self.n_envs == (self.pos - 1) % self.buffer_size
        over[:, -1] = True
        n_more = over.argmax(axis=1)
        # SB3's own products and sums in float32, so that all is equal to the last bit.
        rewards = self._normalize_reward(self._take("rewards", every), env) * self.gamma ** steps.astype(np.float32)
        returns = (rewards * (steps <= n_more[:, None])).sum(axis=1, keepdims=True)
        last = (indices + n_more * self.n_envs) % self.ages.size
        return last, returns, self.gamma ** (n_more[:, None] + 1).astype(np.float32)

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
        crop_size: int | None = None,
    ) -> WindowSamples:
        """
        Windows of consecutive steps inside one episode of one env, uniform over all whole ones in the buffer.

        :param batch_size: Number of windows
        :param horizon: Agent steps k of each: k + 1 observations, the k actions and rewards between them
        :param env: VecNormalize that observations and rewards go through
        :param offsets: Gather only the observations at these offsets from the start (0 to k), in this order; None for all
            k + 1
        :param crop_size: As for ``sample``; an observation that is there twice is cropped twice
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
        observations = self.gather(steps[:, wanted - following].T, following[:, None], env, crop_size)
        return WindowSamples(
            map_parts(lambda part: part.transpose(0, 1).to(self.device), observations),
            self.to_torch(self._take("actions", steps), copy=False),
            self.to_torch(self._normalize_reward(self._take("rewards", steps)[..., None], env), copy=False),
        )
