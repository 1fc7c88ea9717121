"""WindowReplayBuffer against whole trajectories kept in plain lists, and against SB3's own buffers."""

import copy
import io
import pickle
import re
import types
import warnings
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import (
    DelayObservation,
    FlattenObservation,
    FrameStackObservation,
    MaxAndSkipObservation,
    NormalizeObservation,
    TransformObservation,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecExtractDictObs, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_aarl import SACAux
from sb3_aarl.buffers import NoWindowError, WindowReplayBuffer, detect_frame_stack, map_parts

Obs = np.ndarray | dict[str, np.ndarray]
ACTIONS = spaces.Box(-1, 1, (2,))
FRAME = (2, 1, 2)


class Step:
    """One transition of one env; its action and reward are found nowhere else in the trajectories."""

    def __init__(self, env: int, number: int, episode: int, obs: Obs, next_obs: Obs, ends: str):
        self.env, self.number, self.episode = env, number, episode
        self.obs, self.next_obs = obs, next_obs
        self.action = np.array([env, number], np.float32)
        self.reward = np.float32(-number - env / 8)
        self.done = ends in ("terminated", "truncated")
        self.info = {"TimeLimit.truncated": ends == "truncated"}


def numbered_frame(env: int, number: int, dtype: Any = np.uint8) -> np.ndarray:
    """A frame of its own for each pair of numbers, nowhere zero."""
    return np.array([number % 255 + 1, env + 1, number % 7 + 1, number // 255 + 1], dtype).reshape(FRAME)


def stacked(frames: list[np.ndarray], t: int, stack: int, padding: str) -> np.ndarray:
    first = {"repeat": frames[0], "zeros": np.zeros_like(frames[0]), "others": np.full_like(frames[0], 99)}[padding]
    return np.concatenate([frames[i] if i >= 0 else first for i in range(t - stack + 1, t + 1)])


def trajectory(
    env: int, episodes: list[tuple[int, str]], stack: int, padding: str, as_dict: bool = False, dtype: Any = np.uint8
) -> Iterator[Step]:
    """
    The steps of one env, over and over through these episodes; "by hand" is a reset without an end before it. With the
    padding "late" they are no stacks of frames from the fourth episode on.
    """
    number, n_frames, episode = 0, 0, 0
    while True:
        length, how = episodes[episode % len(episodes)]
        frames = [numbered_frame(env, n_frames + t, dtype) for t in range(length + 1)]
        n_frames += length + 1
        filler = padding if padding != "late" else "zeros" if episode < 3 else "others"
        for t in range(length):
            now, then = (
                {"pixels": stacked(frames, i, stack, filler), "state": frames[i].ravel().astype(np.float32) / 2}
                if as_dict
                else stacked(frames, i, stack, filler)
                for i in (t, t + 1)
            )
            yield Step(env, number, episode, now, then, how if t == length - 1 else "continues")
            number += 1
        episode += 1


def batched(observations: list[Any]) -> Any:
    if isinstance(observations[0], dict):
        return {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
    return np.stack(observations)


def transition(steps: list[Step]) -> tuple[Any, ...]:
    """The arguments of ``add``, as SB3's algorithms pass them."""
    return (
        batched([step.obs for step in steps]),
        batched([step.next_obs for step in steps]),
        np.stack([step.action for step in steps]),
        np.array([step.reward for step in steps]),
        np.array([step.done for step in steps]),
        [step.info for step in steps],
    )


def observation_space(stack: int, as_dict: bool = False, dtype: Any = np.uint8) -> spaces.Space:
    pixels = spaces.Box(0, 255, (FRAME[0] * stack, *FRAME[1:]), dtype)
    return spaces.Dict({"pixels": pixels, "state": spaces.Box(0, 255, (4,), np.float32)}) if as_dict else pixels


def make_buffer(
    buffer_size: int, n_envs: int = 1, stack: int = 1, as_dict: bool = False, dtype: Any = np.uint8, **kwargs: Any
) -> WindowReplayBuffer:
    frame_stack = {"pixels": stack} if as_dict else stack
    space = observation_space(stack, as_dict, dtype)
    return WindowReplayBuffer(buffer_size, space, ACTIONS, "cpu", n_envs=n_envs, frame_stack=frame_stack, **kwargs)


def whole_windows(histories: list[list[Step]], capacity: int, horizon: int) -> dict[tuple[int, int], list[Step]]:
    """Every window inside one episode whose steps are among the last ``capacity`` of its env, by env and first number."""
    windows = {}
    for history in histories:
        kept = history[-capacity:]
        for i in range(len(kept) - horizon + 1):
            window = kept[i : i + horizon]
            if window[0].episode == window[-1].episode:
                windows[(window[0].env, window[0].number)] = window
    return windows


def assert_same(actual: Any, expected: Any) -> None:
    """Equality of tensors, arrays, or dicts of them, data types included."""
    if isinstance(expected, dict):
        assert actual.keys() == expected.keys()
        for key in expected:
            assert_same(actual[key], expected[key])
    else:
        actual, expected = np.asarray(actual), np.asarray(expected)
        assert actual.dtype == expected.dtype
        np.testing.assert_array_equal(actual, expected)


def assert_same_samples(one: ReplayBuffer, other: ReplayBuffer) -> None:
    for seed in range(3):
        drawn = []
        for buffer in (one, other):
            np.random.seed(seed)
            drawn.append(buffer.sample(40)._asdict())
        assert_same(*drawn)


def check_windows(buffer: WindowReplayBuffer, histories: list[list[Step]], horizon: int) -> None:
    """All windows that are whole can be drawn, nothing else can, and each holds what happened."""
    windows = whole_windows(histories, buffer.buffer_size, horizon)
    if not windows:
        with pytest.raises(NoWindowError, match=f"spans {horizon} agent steps"):
            buffer.sample_windows(4, horizon)
        return
    # One that can be drawn stays out with a probability of exp(-30).
    drawn = buffer.sample_windows(30 * len(windows), horizon)
    keys = [(int(env), int(number)) for env, number in drawn.actions[:, 0]]
    assert set(keys) == set(windows)
    expected = [windows[key] for key in keys]
    assert_same(drawn.actions, np.stack([[step.action for step in window] for window in expected]))
    assert_same(drawn.rewards, np.stack([[[step.reward] for step in window] for window in expected]))
    observations = [batched([*(step.obs for step in window), window[-1].next_obs]) for window in expected]
    assert_same(drawn.observations, batched(observations))


EPISODES = st.lists(
    st.tuples(st.integers(1, 9), st.sampled_from(["terminated", "truncated", "by hand"])), min_size=1, max_size=5
)


@pytest.mark.filterwarnings("ignore:frame_stack=")
@settings(max_examples=40, deadline=None)
@given(
    episodes=st.lists(EPISODES, min_size=1, max_size=4),
    capacity=st.integers(1, 14),
    n_added=st.integers(1, 60),
    stack=st.integers(1, 4),
    paddings=st.tuples(*[st.sampled_from(["repeat", "zeros", "late"])] * 4),
    as_dict=st.booleans(),
    data=st.data(),
)
def test_windows_are_those_of_the_trajectories(episodes, capacity, n_added, stack, paddings, as_dict, data):
    n_envs = len(episodes)
    buffer_size = capacity * n_envs + data.draw(st.integers(0, n_envs - 1))
    buffer = make_buffer(buffer_size, n_envs, stack, as_dict)
    assert buffer.buffer_size == capacity
    buffer.frame_stack_detected = True
    envs = [trajectory(env, plan, stack, paddings[env], as_dict) for env, plan in enumerate(episodes)]
    histories: list[list[Step]] = [[] for _ in envs]
    for _ in range(n_added):
        steps = [next(env) for env in envs]
        obs, next_obs, *rest = transition(steps)
        buffer.add(obs, next_obs, *rest)
        # An env may write its next observations over the last ones.
        for part in (obs, next_obs):
            for array in part.values() if as_dict else [part]:
                array.fill(77)
        for history, step in zip(histories, steps, strict=True):
            history.append(step)
    for horizon in (1, 2, data.draw(st.integers(3, 11))):
        check_windows(buffer, histories, horizon)
    # Single transitions too: SB3's arrays, as they would be.
    views = [view if as_dict else {"": view} for view in (buffer.observations, buffer.next_observations)]
    for env, history in enumerate(histories):
        for step in history[-capacity:]:
            for view, obs in zip(views, (step.obs, step.next_obs), strict=True):
                stored = {key: part[step.number % capacity, env] for key, part in view.items()}
                assert_same(stored, obs if as_dict else {"": obs})


@settings(max_examples=25, deadline=None)
@given(episodes=EPISODES, n_added=st.integers(6, 60), horizon=st.integers(1, 4), stack=st.integers(1, 3), data=st.data())
def test_offsets_gather_just_those(episodes, n_added, horizon, stack, data):
    buffer = make_buffer(20, 1, stack)
    env = trajectory(0, [(6, "truncated"), *episodes], stack, "repeat")
    for _ in range(n_added):
        buffer.add(*transition([next(env)]))
    offsets = data.draw(st.lists(st.integers(0, horizon), min_size=1, max_size=horizon + 1))
    try:
        np.random.seed(1)
        everything = buffer.sample_windows(30, horizon)
    except NoWindowError:
        # The six steps that the ring began with were overwritten by shorter episodes.
        assert max(length for length, _ in episodes) < 6
        return
    np.random.seed(1)
    some = buffer.sample_windows(30, horizon, offsets=offsets)
    assert_same(some.observations, everything.observations[:, offsets])
    assert_same(some.actions, everything.actions)
    assert_same(some.rewards, everything.rewards)


def filled(buffer: ReplayBuffer, n_added: int, episodes: list[tuple[int, str]], **kwargs: Any) -> list[list[Step]]:
    envs = [trajectory(env, episodes[env:] + episodes[:env], **kwargs) for env in range(buffer.n_envs)]
    histories: list[list[Step]] = [[] for _ in envs]
    for _ in range(n_added):
        steps = [next(env) for env in envs]
        buffer.add(*transition(steps))
        for history, step in zip(histories, steps, strict=True):
            history.append(step)
    return histories


LIFE = [(7, "truncated"), (1, "terminated"), (4, "terminated"), (12, "truncated"), (1, "truncated"), (3, "terminated")]


@pytest.mark.parametrize("horizon", [1, 3, 7])
@pytest.mark.parametrize("batch_size", [8, 3000])  # with the larger one some steps of no window remain, and are looked up
def test_whole_windows_are_drawn_uniformly(batch_size, horizon):
    buffer = make_buffer(80, n_envs=2)
    histories = filled(buffer, 101, LIFE, stack=1, padding="repeat")
    windows = whole_windows(histories, buffer.buffer_size, horizon)
    np.random.seed(0)
    counts = dict.fromkeys(windows, 0)
    for _ in range(1 + 100 * len(windows) // batch_size):
        for env, number in buffer.sample_windows(batch_size, horizon).actions[:, 0]:
            counts[(int(env), int(number))] += 1
    assert chisquare(list(counts.values())).pvalue > 0.01


class Shown(gym.Env):
    """Shows frames that count upwards; episodes of five steps."""

    def __init__(self, space: spaces.Space):
        self.observation_space = space
        self.action_space = ACTIONS
        self.counter = 0

    def _observation(self) -> Obs:
        self.counter += 1

        def numbered(space: spaces.Space) -> np.ndarray:
            return (np.arange(np.prod(space.shape)) % 7 + self.counter).reshape(space.shape).astype(space.dtype)

        if isinstance(self.observation_space, spaces.Dict):
            return {key: numbered(space) for key, space in self.observation_space.items()}
        return numbered(self.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        self.t = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        self.t += 1
        return self._observation(), float(self.t), self.counter % 2 == 0 and self.t >= 5, self.t >= 5, {}


VECTOR = spaces.Box(-np.inf, np.inf, (3,), np.float32)
IMAGE = spaces.Box(0, 255, (40, 48, 3), np.uint8)


ENDED = st.lists(st.tuples(st.integers(1, 9), st.sampled_from(["terminated", "truncated"])), min_size=1, max_size=5)


@settings(max_examples=50, deadline=None)
@given(
    episodes=st.lists(ENDED, min_size=1, max_size=3),
    capacity=st.integers(1, 14),
    n_added=st.integers(1, 40),
    n_steps=st.sampled_from([1, 2, 3, 12]),
    kind=st.sampled_from(["image", "vector", "dict"]),
    handle_timeout_termination=st.booleans(),
    normalized=st.booleans(),
)
def test_samples_are_those_of_sb3(episodes, capacity, n_added, n_steps, kind, handle_timeout_termination, normalized):
    n_envs, as_dict, dtype = len(episodes), kind == "dict", np.float32 if kind == "vector" else np.uint8
    stack = 1 if kind == "vector" else 3
    space = observation_space(stack, as_dict, dtype)
    kwargs = {"handle_timeout_termination": handle_timeout_termination, "n_steps": n_steps, "gamma": 0.9}
    ours = make_buffer(capacity * n_envs, n_envs, stack, as_dict, dtype, **kwargs)
    # SB3 has no n-step returns for Dict observations: one buffer for each key, with the same random numbers.
    sb3_class = ReplayBuffer if n_steps == 1 else NStepReplayBuffer
    kwargs = {key: value for key, value in kwargs.items() if n_steps > 1 or key == "handle_timeout_termination"}
    parts = space.spaces if as_dict else {"": space}
    theirs = {key: sb3_class(capacity * n_envs, part, ACTIONS, "cpu", n_envs, **kwargs) for key, part in parts.items()}
    normalize = normalization(space)

    envs = [trajectory(env, plan, stack, "zeros", as_dict, dtype) for env, plan in enumerate(episodes)]
    for _ in range(n_added):
        obs, next_obs, *rest = transition([next(env) for env in envs])
        ours.add(obs, next_obs, *rest)
        for key, buffer in theirs.items():
            buffer.add(*(part[key] if as_dict else part for part in (obs, next_obs)), *rest)
    for key, buffer in theirs.items():
        assert (ours.size(), ours.pos, ours.full) == (buffer.size(), buffer.pos, buffer.full)
        for name in ("actions", "rewards", "dones", "timeouts"):
            assert_same(getattr(ours, name), getattr(buffer, name))
        for name in ("observations", "next_observations"):
            array = getattr(ours, name)[key] if as_dict else getattr(ours, name)
            assert_same(array, getattr(buffer, name))
            with pytest.raises(ValueError, match="read-only"):  # a copy
                array[0] = 0

    np.random.seed(0)
    drawn = ours.sample(40, env=normalize if normalized else None)
    rewards_only = types.SimpleNamespace(normalize_obs=lambda obs: obs, normalize_reward=normalize.normalize_reward)
    expected = {}
    for key, buffer in theirs.items():
        np.random.seed(0)
        expected[key] = buffer.sample(40, env=rewards_only if normalized else None)
        for name in ("actions", "rewards", "dones", "discounts"):
            assert_same(getattr(drawn, name), getattr(expected[key], name))
    for name in ("observations", "next_observations"):
        arrays = {key: getattr(sample, name).numpy() for key, sample in expected.items()}
        wanted = arrays if as_dict else arrays[""]
        assert_same(getattr(drawn, name), normalize.normalize_obs(wanted) if normalized else wanted)


def normalization(space: spaces.Space) -> VecNormalize:
    """VecNormalize with statistics of its own; of a Dict it normalizes "state"."""
    as_dict = isinstance(space, spaces.Dict)
    normalize = VecNormalize(DummyVecEnv([lambda: Shown(space)]), norm_obs_keys=["state"] if as_dict else None)
    for rms in normalize.obs_rms.values() if as_dict else [normalize.obs_rms]:
        rms.mean, rms.var = rms.mean + 3, rms.var * 5
    normalize.ret_rms.var = np.float64(7)
    return normalize


def test_extend_and_reset_as_sb3_does():
    theirs, ours = ReplayBuffer(15, observation_space(2), ACTIONS, "cpu"), make_buffer(15, stack=2)
    for n_added, first in ((11, 0), (22, 2)):
        env = trajectory(0, LIFE[first:], 2, "zeros")
        rows = [transition([next(env)]) for _ in range(n_added)]
        for *_, infos in rows:  # SB3's own test passes an array of one number
            infos[0]["TimeLimit.truncated"] = np.array([infos[0]["TimeLimit.truncated"]])
        for buffer in (theirs, ours):
            buffer.extend(*zip(*rows, strict=True))
        assert ours.size() == theirs.size() == min(n_added, 15)
        assert_same_samples(ours, theirs)
        for buffer in (theirs, ours):
            buffer.reset()
        assert ours.size() == theirs.size() == 0
        with pytest.raises(NoWindowError):
            ours.sample_windows(1, 1)


def test_observations_of_another_layout_are_refused():
    space = spaces.Box(0, 255, (3, 8, 10), np.uint8)
    for image, is_right in ((np.zeros((1, 8, 10, 3), np.uint8), False), (np.zeros((1, 3, 8, 10), np.uint8), True)):
        for buffer in (ReplayBuffer(5, space, ACTIONS), WindowReplayBuffer(5, space, ACTIONS)):
            with nullcontext() if is_right else pytest.raises(ValueError, match="shape"):
                buffer.add(image, image, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])


def test_what_was_before_a_reset_is_gone_even_inside_of_an_episode():
    buffer = make_buffer(20)
    env = trajectory(0, [(30, "truncated")], 1, "repeat")
    steps = [next(env) for _ in range(12)]
    for step in steps[:8]:
        buffer.add(*transition([step]))
    buffer.reset()
    for step in steps[8:]:
        buffer.add(*transition([step]))
    for horizon in (1, 4, 5):
        check_windows(buffer, [steps[8:]], horizon)


def through_sb3(buffer: WindowReplayBuffer) -> WindowReplayBuffer:
    file = io.BytesIO()
    save_to_pkl(file, buffer)
    file.seek(0)
    return load_from_pkl(file)


@pytest.mark.parametrize("copied", [through_sb3, copy.deepcopy])
@pytest.mark.parametrize("n_added", [5, 43])
def test_saved_and_loaded_it_is_the_same(copied, n_added):
    buffer = make_buffer(40, 2, stack=3, as_dict=True)
    envs = [trajectory(env, LIFE[env:], 3, "zeros", True) for env in range(2)]
    for _ in range(n_added):
        buffer.add(*transition([next(env) for env in envs]))
    loaded = copied(buffer)
    for _ in range(2):
        assert_same_samples(loaded, buffer)
        for _ in range(30):
            rows = transition([next(env) for env in envs])
            buffer.add(*rows)
            loaded.add(*rows)


@pytest.mark.filterwarnings("ignore:frame_stack=")
@settings(max_examples=20, deadline=None)
@given(
    episodes=st.lists(EPISODES, min_size=1, max_size=2),
    capacity=st.integers(2, 14),
    n_added=st.integers(0, 40),
    stack=st.integers(1, 3),
    paddings=st.tuples(*[st.sampled_from(["repeat", "zeros", "late"])] * 2),
    kind=st.sampled_from(["plain", "dict", "n_steps"]),
)
def test_a_restored_buffer_continues_with_new_episodes(episodes, capacity, n_added, stack, paddings, kind):
    n_envs, as_dict = len(episodes), kind == "dict"
    arguments = {"n_envs": n_envs, "stack": stack, "as_dict": as_dict, "n_steps": 3 if kind == "n_steps" else 1}
    buffer, restored = (make_buffer(capacity * n_envs, **arguments) for _ in range(2))
    buffer.frame_stack_detected = restored.frame_stack_detected = True
    histories: list[list[Step]] = [[] for _ in episodes]

    def add(envs: list[Iterator[Step]], buffers: list[WindowReplayBuffer], part: int) -> None:
        steps = [next(env) for env in envs]
        for one in buffers:
            one.add(*transition(steps))
        for history, step in zip(histories, steps, strict=True):
            step.episode = (part, step.episode)
            history.append(step)

    envs = [trajectory(env, plan, stack, paddings[env], as_dict) for env, plan in enumerate(episodes)]
    for _ in range(n_added):
        add(envs, [buffer], 0)
    file = io.BytesIO()
    th.save(buffer.training_state(), file)
    file.seek(0)
    restored.load_training_state(th.load(file, weights_only=True))
    if n_added:
        assert_same_samples(restored, buffer)
        truncated = [not history[-1].done or history[-1].info["TimeLimit.truncated"] for history in histories]
        assert restored.timeouts[restored.pos - 1].tolist() == truncated
    # The environments are reset.
    envs = [trajectory(env + 4, plan, stack, paddings[env], as_dict) for env, plan in enumerate(episodes)]
    for n in range(20):
        add(envs, [buffer, restored], 1)
        if n in (0, 19):
            assert_same_samples(restored, buffer)
            for horizon in (1, 3):
                check_windows(restored, histories, horizon)


@pytest.mark.parametrize("other, message", [((30, 1), "buffer_size=20, not 30"), ((40, 2), "n_envs=1, not 2")])
def test_the_state_of_another_buffer_is_refused(other, message):
    with pytest.raises(ValueError, match=message):
        make_buffer(*other).load_training_state(make_buffer(20).training_state())


def measured_bytes(holder: Any) -> int:
    """All bytes of the arrays and tensors of an object, however deep."""
    if isinstance(holder, (np.ndarray, th.Tensor)):
        return holder.nbytes
    if isinstance(holder, dict):
        return sum(measured_bytes(part) for part in holder.values())
    if isinstance(holder, (list, tuple)):
        return sum(measured_bytes(part) for part in holder)
    return measured_bytes(vars(holder)) if hasattr(holder, "__dict__") and not isinstance(holder, (type, spaces.Space)) else 0


def test_memory_of_stacked_images():
    space = spaces.Box(0, 255, (9, 100, 100), np.uint8)
    buffer = WindowReplayBuffer(2000, space, ACTIONS, "cpu", frame_stack=3)
    rng = np.random.default_rng(0)
    for i in range(2250):
        if i % 250 == 0:
            frames = [rng.integers(256, size=(3, 100, 100), dtype=np.uint8)] * 3
        obs = np.concatenate(frames)[None]
        frames = [*frames[1:], rng.integers(256, size=(3, 100, 100), dtype=np.uint8)]
        truncated = i % 250 == 249
        info = {"TimeLimit.truncated": truncated}
        buffer.add(obs, np.concatenate(frames)[None], np.zeros((1, 2)), np.zeros(1), np.array([truncated]), [info])
    assert measured_bytes(buffer) / buffer.size() <= 32_000


def test_memory_of_states_and_of_last_observations():
    wide = spaces.Box(-1, 1, (60,), np.float32)
    theirs, ours = (cls(1000, wide, ACTIONS, "cpu") for cls in (ReplayBuffer, WindowReplayBuffer))
    obs = np.zeros((1, 60), np.float32)
    for i in range(4000):
        done = np.array([i % 50 == 49])
        for buffer in (theirs, ours):
            buffer.add(obs, obs + 1, np.zeros((1, 2)), np.zeros(1), done, [{}])
        obs = -obs if done[0] else obs + 1
    both = theirs.observations.nbytes + theirs.next_observations.nbytes
    assert measured_bytes(ours.stores) < 0.55 * both
    # Last observations are deleted as the ring overwrites their transitions.
    assert len(ours.stores[""].final_frames) == 20


@pytest.mark.parametrize("enough", [True, False])
def test_a_buffer_that_does_not_fit_into_memory_warns(enough, monkeypatch):
    needed = 2 * 502 * 3 * 30 * 40  # of frames
    monkeypatch.setattr(psutil, "virtual_memory", lambda: types.SimpleNamespace(available=needed if enough else needed - 1))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        WindowReplayBuffer(1000, spaces.Box(0, 255, (6, 30, 40), np.uint8), ACTIONS, "cpu", frame_stack=2, n_envs=2)
    assert ["not enough memory for a replay buffer" in str(warning.message) for warning in caught] == [True] * (not enough)


def test_what_is_sampled_is_not_the_buffer_itself():
    buffer = make_buffer(20, stack=2)
    history = filled(buffer, 20, [(9, "truncated")], stack=2, padding="repeat")
    for _ in range(2):
        check_windows(buffer, history, 2)
        for part in buffer.sample_windows(50, 2):
            part.zero_()
        for part in buffer.sample(50)[:5]:
            part.zero_()


def steps_of(stack: int, padding: str = "repeat", as_dict: bool = False, n_envs: int = 1) -> list[list[Step]]:
    envs = [trajectory(env, [(6, "terminated")], stack, padding, as_dict) for env in range(n_envs)]
    return [[next(env) for env in envs] for _ in range(20)]


@pytest.mark.parametrize("as_dict", [False, True])
@pytest.mark.parametrize(
    "fault, problem",
    [
        ("newest first", "the next observation is not the last one plus one new frame"),
        ("begins with others", "an episode begins neither with one frame repeated nor with zeros"),
        ("a frame left out", "the next observation is not the last one plus one new frame"),
    ],
)
@pytest.mark.parametrize("n_before", [0, 3, 6, 12])
@pytest.mark.parametrize("detected", [False, True])
def test_stacks_that_frames_do_not_make_are_refused_unless_they_were_detected(detected, fault, problem, as_dict, n_before):
    buffer, n_envs = make_buffer(20, 2, stack=3, as_dict=as_dict), 2
    buffer.frame_stack_detected = detected
    rows = steps_of(3, as_dict=as_dict, n_envs=n_envs)
    for steps in rows[:n_before]:
        buffer.add(*transition(steps))
    obs, next_obs, *rest = copy.deepcopy(transition(rows[n_before]))
    stacks = [part["pixels"] if as_dict else part for part in (obs, next_obs)]
    if fault == "newest first":
        # The first env is all right, the second is not.
        for stack in stacks:
            stack[1] = stack[1].reshape(3, *FRAME)[::-1].reshape(stack[1].shape)
        if n_before == 3:
            # Inside of an episode this looks like a reset by hand.
            problem = "an episode begins neither with one frame repeated nor with zeros"
    elif fault == "begins with others":
        stacks[0][1] = np.arange(stacks[0][1].size).reshape(stacks[0][1].shape)
    else:
        stacks[1][1] = np.concatenate([stacks[1][1, 2:], stacks[1][1, :2]])
    under = " under 'pixels'" if as_dict else ""
    message = rf"frame_stack=3 .*{under} of shape .*env 1, transition {n_before}\): {problem}.* or VecFrameStack outside"
    if detected:
        theirs = (DictReplayBuffer if as_dict else ReplayBuffer)(20, buffer.observation_space, ACTIONS, "cpu", n_envs)
        added = [*map(transition, rows[:n_before]), (obs, next_obs, *rest), *map(transition, rows[n_before + 1 :])]
        for each in added:
            theirs.add(*each)
        with pytest.warns(UserWarning, match="whole observations are stored instead, which takes 3 times the mem") as caught:
            for each in added[n_before:]:
                buffer.add(*each)
        assert len(caught) == 1 and re.match(message, str(caught[0].message))
        assert {key: store.stack for key, store in buffer.stores.items()} == dict.fromkeys(buffer.stores, 1)
        assert_same(buffer.observations, theirs.observations)
        assert_same(buffer.next_observations, theirs.next_observations)
        return
    before = pickle.dumps(buffer)
    with pytest.raises(ValueError, match=message):
        buffer.add(obs, next_obs, *rest)
    # Nothing was added: what comes next finds the buffer as it was.
    assert pickle.dumps(buffer) == before
    for steps in rows[n_before:]:
        buffer.add(*transition(steps))
    check_windows(buffer, [[row[env] for row in rows] for env in range(2)], 2)


@pytest.mark.parametrize("wrong", ["action", "reward", "done", "obs"])
def test_a_part_of_a_wrong_shape_leaves_the_buffer_as_it_was(wrong):
    buffer = make_buffer(6, stack=2)
    rows = steps_of(2)
    for steps in rows[:9]:
        buffer.add(*transition(steps))
    before = pickle.dumps(buffer)
    parts = list(transition(rows[9]))
    position = ["obs", "next_obs", "action", "reward", "done"].index(wrong)
    parts[position] = np.zeros(7)
    with pytest.raises(ValueError, match="reshape"):
        buffer.add(*parts)
    assert pickle.dumps(buffer) == before


def test_horizons_and_offsets_that_cannot_be():
    buffer = make_buffer(30)
    filled(buffer, 25, [(4, "truncated"), (5, "terminated")], stack=1, padding="repeat")
    assert buffer.sample_windows(3, 5).actions.shape == (3, 5, 2)
    for horizon in (6, 31, 1000):
        with pytest.raises(NoWindowError, match=f"no episode in the replay buffer spans {horizon} agent steps"):
            buffer.sample_windows(3, horizon)
    for horizon in (0, -1):
        with pytest.raises(ValueError, match="at least 1") as error:
            buffer.sample_windows(3, horizon)
        assert not isinstance(error.value, NoWindowError)
    for offsets in ([0, 4], [-1]):
        with pytest.raises(ValueError, match="not all in 0 to 3"):
            buffer.sample_windows(3, 3, offsets=offsets)


@pytest.mark.parametrize(
    "space, kwargs, message",
    [
        (observation_space(2), {"frame_stack": 3}, "frame_stack=3 does not divide"),
        (observation_space(2), {"frame_stack": 0}, "frame_stack=0"),
        (spaces.Discrete(4), {"frame_stack": 2}, "frame_stack=2 does not divide"),
        (observation_space(2, True), {"frame_stack": {"pixel": 2}}, "names keys that observations do not have"),
    ],
)
def test_settings_that_cannot_be(space, kwargs, message):
    with pytest.raises(ValueError, match=message):
        WindowReplayBuffer(10, space, ACTIONS, "cpu", **kwargs)


def test_n_step_returns_do_not_cross_a_reset_by_hand():
    """They bootstrap from what came last."""
    buffer = make_buffer(40, stack=3, n_steps=3)
    histories = filled(buffer, 24, [(5, "by hand"), (8, "terminated")], stack=3, padding="repeat")
    np.random.seed(0)
    batch = buffer.sample(300)
    for env_number, reward, done, obs in zip(batch.actions, batch.rewards, batch.dones, batch.next_observations, strict=True):
        number = int(env_number[1])
        steps = [step for step in histories[0][number : number + 3] if step.episode == histories[0][number].episode]
        np.testing.assert_allclose(reward, sum(0.99**i * step.reward for i, step in enumerate(steps)), rtol=1e-6)
        assert bool(done) == steps[-1].done
        assert_same(obs, steps[-1].next_obs)


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.int64, np.uint16])
def test_other_data_types(dtype):
    buffer = make_buffer(20, 2, stack=2, dtype=dtype)
    check_windows(buffer, filled(buffer, 33, LIFE, stack=2, padding="zeros", dtype=dtype), 3)


def small(algorithm: type[SAC], env: Any, **kwargs: Any) -> SAC:
    space = env.observation_space
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "CnnPolicy" if is_image_space(space) else "MlpPolicy"
    kwargs = {"buffer_size": 100, "learning_starts": 20, "batch_size": 4, "policy_kwargs": {"net_arch": [8]}, **kwargs}
    return algorithm(policy, env, device="cpu", **kwargs)


class Foreign(DummyVecEnv):
    """As VecEnvs of other packages may answer."""

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Any:
        return False


def image_env(n_frames: int = 1) -> gym.Env:
    env: gym.Env = Shown(IMAGE)
    if n_frames > 1:
        # (stack, height, width, channels) to (height, width, stack * channels), as SB3 wants images.
        env = FrameStackObservation(env, n_frames)
        shape = (*IMAGE.shape[:2], n_frames * IMAGE.shape[2])
        env = TransformObservation(
            env, lambda frames: np.moveaxis(frames, 0, 2).reshape(shape), spaces.Box(0, 255, shape, np.uint8)
        )
    return env


def vector_env() -> gym.Env:
    return FlattenObservation(FrameStackObservation(Shown(VECTOR), 3))


TABLE = spaces.Box(-1, 1, (4, 5), np.float32)
BOTH = spaces.Dict({"image": IMAGE, "state": VECTOR, "table": TABLE})


@pytest.mark.parametrize(
    "make_env, expected",
    [
        (lambda: DummyVecEnv([lambda: Shown(VECTOR)]), 1),
        (lambda: Foreign([lambda: Shown(VECTOR)]), 1),
        (lambda: VecTransposeImage(DummyVecEnv([image_env])), 1),
        (lambda: VecTransposeImage(DummyVecEnv([lambda: image_env(4)] * 2)), 4),
        (lambda: VecTransposeImage(VecFrameStack(DummyVecEnv([image_env] * 2), 3)), 3),
        (lambda: VecFrameStack(VecTransposeImage(DummyVecEnv([image_env])), 3), 3),
        (lambda: VecNormalize(VecFrameStack(DummyVecEnv([lambda: Shown(VECTOR)]), 2)), 2),
        (lambda: VecNormalize(VecFrameStack(VecTransposeImage(DummyVecEnv([image_env])), 3), clip_obs=1e6), 3),
        (lambda: DummyVecEnv([lambda: FrameStackObservation(Shown(VECTOR), 3)]), 3),
        (lambda: DummyVecEnv([lambda: FrameStackObservation(Shown(VECTOR), 3, padding_type="zero")]), 3),
        (lambda: DummyVecEnv([vector_env]), 3),
        # The outer stack's frames are the inner stacks.
        (lambda: VecFrameStack(DummyVecEnv([vector_env]), 2), 2),
        # VecFrameStack takes the last axis of what is neither a vector nor an image.
        (lambda: VecFrameStack(DummyVecEnv([lambda: Shown(TABLE)]), 2), 1),
        (lambda: VecFrameStack(DummyVecEnv([lambda: Shown(TABLE)]), 2, channels_order="first"), 2),
        (
            lambda: VecTransposeImage(VecFrameStack(DummyVecEnv([lambda: Shown(BOTH)]), 2)),
            {"image": 2, "state": 2, "table": 1},
        ),
        (lambda: DummyVecEnv([lambda: Shown(BOTH)]), {"image": 1, "state": 1, "table": 1}),
        # What was extracted has no key any more.
        (lambda: VecExtractDictObs(VecFrameStack(DummyVecEnv([lambda: Shown(BOTH)]), 2), "state"), 1),
    ],
)
def test_detected_stacks_fit_what_the_wrappers_give(make_env, expected):
    assert detect_frame_stack(make_env()) == expected
    kwargs = {"learning_starts": 100, "buffer_size": 30}  # no training
    theirs, ours = (small(cls, make_env(), **kwargs).learn(40).replay_buffer for cls in (SAC, SACAux))
    assert {key: store.stack for key, store in ours.stores.items()} == (expected if type(expected) is dict else {"": expected})
    assert_same(ours.observations, theirs.observations)
    # VecNormalize returns the last observation of an episode with rounding errors.
    exact = ~ours.ended[:, 0] if isinstance(make_env(), VecNormalize) else slice(None)
    found, wanted = (map_parts(lambda part: part[exact], buffer.next_observations) for buffer in (ours, theirs))
    assert_same(found, wanted)


# --- Crops ------------------------------------------------------------------------------------------------------------

SIZE, CROP = (9, 11), 6  # 4 x 6 positions


def image_buffer(stack: int, as_dict: bool = False, **kwargs: Any) -> WindowReplayBuffer:
    """Random images of two channels, episodes of seven steps, a ring that has gone round."""
    rng = np.random.default_rng(0)
    image = spaces.Box(0, 255, (2 * stack, *SIZE), np.uint8)
    space = spaces.Dict({"camera": image, "state": spaces.Box(-1, 1, (3,), np.float32)}) if as_dict else image
    frame_stack = {"camera": stack} if as_dict else stack
    buffer = WindowReplayBuffer(60, space, ACTIONS, "cpu", n_envs=2, frame_stack=frame_stack, **kwargs)
    for i in range(80):
        if i % 7 == 0:
            obs = np.repeat(rng.integers(1, 256, (2, 1, 2, *SIZE), np.uint8), stack, axis=1).reshape(2, *image.shape)
            state = rng.uniform(-1, 1, (2, 3)).astype(np.float32)
        following = np.concatenate([obs[:, 2:], rng.integers(1, 256, (2, 2, *SIZE), np.uint8)], axis=1)
        next_state = rng.uniform(-1, 1, (2, 3)).astype(np.float32)
        done = np.full(2, i % 7 == 6)
        rest = (rng.uniform(-1, 1, (2, 2)), rng.normal(size=2), done, [{"TimeLimit.truncated": True}] * 2)
        if as_dict:
            buffer.add({"camera": obs, "state": state}, {"camera": following, "state": next_state}, *rest)
        else:
            buffer.add(obs, following, *rest)
        obs, state = following, next_state
    return buffer


def corner_of(crop: np.ndarray, image: np.ndarray) -> tuple[int, int]:
    """Where in an image a crop was cut out."""
    corners = np.ndindex(SIZE[0] - CROP + 1, SIZE[1] - CROP + 1)
    (corner,) = [(i, j) for i, j in corners if np.array_equal(image[:, i : i + CROP, j : j + CROP], crop)]
    return corner


@pytest.mark.parametrize("stack, n_steps", [(1, 1), (3, 1), (3, 3)])
@pytest.mark.parametrize("as_dict", [False, True])
def test_crops_are_parts_of_what_is_drawn_without(stack, n_steps, as_dict):
    buffer = image_buffer(stack, as_dict, n_steps=n_steps)
    corners = []
    for draw in (buffer.sample, partial(buffer.sample_windows, horizon=4, offsets=[4, 0, 2, 0])):
        np.random.seed(3)
        whole = draw(300)
        np.random.seed(3)
        cropped = draw(300, crop_size=CROP)
        for name in ("observations", "next_observations"):
            if not hasattr(whole, name):
                continue
            images, crops = getattr(whole, name), getattr(cropped, name)
            if as_dict:
                assert_same(crops["state"], images["state"])
                images, crops = images["camera"], crops["camera"]
            assert crops.shape == (*images.shape[:-2], CROP, CROP)
            pairs = zip(crops.flatten(end_dim=-4).numpy(), images.flatten(end_dim=-4).numpy(), strict=True)
            found = [corner_of(*pair) for pair in pairs]
            corners.append(found)
        assert_same(cropped.actions, whole.actions)
        assert_same(cropped.rewards, whole.rewards)
    # Every observation has a corner of its own, uniform over all: the two of a transition, the same offset twice.
    assert len({tuple(found[:300]) for found in corners}) == len(corners)
    windows = np.array(corners[-1]).reshape(300, 4, 2)
    assert (windows[:, 1] != windows[:, 3]).any(axis=1).mean() > 0.8
    counts = [sum(found.count(corner) for found in corners) for corner in np.ndindex(4, 6)]
    assert chisquare(counts).pvalue > 1e-3


def test_normalized_images_are_not_cropped():
    """VecNormalize's statistics are those of whole images."""
    space = spaces.Box(0, 255, (2, *SIZE), np.float32)
    normalize = VecNormalize(DummyVecEnv([lambda: Shown(space)]))
    buffer = image_buffer(1)
    assert buffer.sample(5, env=normalize, crop_size=CROP).observations.shape == (5, 2, *SIZE)


# --- In SACAux --------------------------------------------------------------------------------------------------------


class WithGoal(gym.ObservationWrapper):
    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.observation_space = spaces.Dict({"goal": VECTOR, "seen": env.observation_space})

    def observation(self, observation: np.ndarray) -> Obs:
        return {"goal": np.arange(3, dtype=np.float32), "seen": observation}


def stacked_env(**kwargs: Any) -> gym.Env:
    return FrameStackObservation(Shown(VECTOR), 3, **kwargs)


@pytest.mark.parametrize(
    "make_env",
    [
        lambda: NormalizeObservation(stacked_env()),
        lambda: DelayObservation(stacked_env(), 2),
        lambda: MaxAndSkipObservation(stacked_env(), 2),
        lambda: stacked_env(padding_type=np.full(3, 50, np.float32)),
        lambda: FlattenObservation(FrameStackObservation(WithGoal(Shown(VECTOR)), 3)),
        lambda: WithGoal(stacked_env()),
    ],
    ids=["normalized", "delayed", "skipped", "padded", "flattened", "goal"],
)
def test_a_detected_stack_that_does_not_hold_is_stored_as_sac_does(make_env):
    theirs = small(SAC, make_env(), learning_starts=100).learn(40).replay_buffer
    model = small(SACAux, make_env(), learning_starts=100)
    with pytest.warns(UserWarning, match="whole observations are stored instead") as caught:
        model.learn(40)
    assert len(caught) == 1
    assert_same(model.replay_buffer.observations, theirs.observations)
    assert_same(model.replay_buffer.next_observations, theirs.next_observations)
    if "goal" in model.replay_buffer.stores:
        assert model.replay_buffer.stores["seen"].stack == 3  # this one holds


def test_another_env_need_not_stack(tmp_path, recwarn):
    model = small(SACAux, stacked_env()).learn(30)
    model.save(tmp_path / "model")
    env = Shown(stacked_env().observation_space)
    assert SACAux.load(tmp_path / "model").replay_buffer.stores[""].stack == 3  # without wrappers to look at
    loaded = SACAux.load(tmp_path / "model", env).learn(30)
    assert loaded.replay_buffer.stores[""].stack == 1 and not recwarn
    before = model.replay_buffer.observations[:30]
    model.set_env(DummyVecEnv([lambda: env]))
    with pytest.warns(UserWarning, match="transition 30.*whole observations are stored instead"):
        model.learn(30)
    assert_same(model.replay_buffer.observations[:30], before)
    asked = small(SACAux, env, replay_buffer_kwargs={"frame_stack": 3})
    with pytest.raises(ValueError, match="frame_stack=3 does not fit"):
        asked.learn(30)


class Mine(WindowReplayBuffer):
    def _get_samples(self, batch_inds, env=None):  # SB3's arguments
        return super()._get_samples(np.zeros_like(batch_inds), env)


@pytest.mark.parametrize("buffer_class", [None, Mine])
def test_a_buffer_class_of_a_users_own_gets_stack_and_n_steps(buffer_class, recwarn):
    env = VecFrameStack(DummyVecEnv([lambda: Shown(spaces.Dict({"state": VECTOR, "table": TABLE}))]), 2)
    model = small(SACAux, env, replay_buffer_class=buffer_class, n_steps=3, gamma=0.9).learn(30)
    buffer = model.replay_buffer
    assert {key: store.stack for key, store in buffer.stores.items()} == {"state": 2, "table": 1}
    assert (type(buffer), buffer.n_steps, buffer.gamma) == (buffer_class or WindowReplayBuffer, 3, 0.9)
    assert (len(np.unique(buffer.sample(30).rewards)) == 1) == (buffer_class is Mine)
    own = small(SACAux, env, replay_buffer_class=buffer_class, replay_buffer_kwargs={"n_steps": 5})  # as SB3 advises
    assert own.replay_buffer.n_steps == 5
    assert not recwarn


def test_a_replay_buffer_of_sac_is_for_models_without_an_auxiliary_loss(tmp_path):
    env = Shown(VECTOR)
    small(SAC, env, n_steps=3).learn(30).save_replay_buffer(tmp_path / "buffer")
    model = small(SACAux, env)
    with pytest.raises(ValueError, match=r"NStepReplayBuffer has no windows, which aux_loss=.* needs"):
        model.load_replay_buffer(tmp_path / "buffer")
    model.learn(30)  # with its own
    plain = small(SACAux, env, aux_loss=None)
    plain.load_replay_buffer(tmp_path / "buffer")
    assert plain.learn(30).replay_buffer.size() == 60
