"""DeepMind Control through shimmy: every task against dm_control itself, stepped by hand, and the pictures."""

import os
import subprocess
import sys
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from dm_control import suite
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env

from sb3_aarl import envs
from sb3_aarl.envs import env_ids, make_dmc_env, wrap_env

TASKS = [f"dm_control/{domain}-{task}-v0" for domain, task in suite.ALL_TASKS]
# A whole picture through a software renderer takes its time.
SMALL = {"pixels": True, "image_size": 24, "frame_stack": 3, "action_repeat": 2}


def flat(observation: dict[str, Any]) -> np.ndarray:
    """dm_control's observation in the order of keys that Gymnasium's Dict has: alphabetical."""
    return np.concatenate([np.ravel(observation[key]) for key in sorted(observation)]).astype(np.float32)


def by_hand(env_id: str, seed: int) -> Any:
    domain, _, task = env_id.removeprefix("dm_control/").removesuffix("-v0").partition("-")
    # LQR draws its masses and springs when it is made; the wrapper's are always those of seed 0.
    env = suite.load(domain, task, task_kwargs={"random": 0})
    env.task._random = np.random.RandomState(seed)
    return env


def test_all_tasks_of_the_suite_are_there() -> None:
    assert env_ids() == sorted(TASKS)
    assert len(TASKS) == 51


@pytest.mark.parametrize("env_id", {env_id.partition("-")[0]: env_id for env_id in TASKS}.values())
def test_a_task_of_every_domain_is_dm_controls_own(env_id: str) -> None:
    env = make_dmc_env(env_id, action_repeat=3)
    assert isinstance(env.observation_space, spaces.Box) and env.observation_space.dtype == np.float32
    assert isinstance(env.action_space, spaces.Box) and np.isfinite(env.action_space.low).all()
    first, _ = env.reset(seed=7)
    raw = by_hand(env_id, 7)
    np.testing.assert_allclose(first, flat(raw.reset().observation), rtol=1e-6)
    assert env.observation_space.contains(first)

    action = np.random.default_rng(0).uniform(env.action_space.low, env.action_space.high).astype(env.action_space.dtype)
    observation, reward, terminated, truncated, _ = env.step(action)
    steps = [raw.step(action) for _ in range(3)]
    np.testing.assert_allclose(observation, flat(steps[-1].observation), rtol=1e-6)
    assert observation.dtype == np.float32 and env.observation_space.contains(observation)
    assert reward == pytest.approx(sum(step.reward for step in steps))
    assert not terminated and not truncated

    again, _ = env.reset(seed=7)
    np.testing.assert_array_equal(again, first)
    env.close()


def test_an_episode_is_a_thousand_simulator_steps_and_is_truncated() -> None:
    env = make_dmc_env("cartpole-balance", action_repeat=8)
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(125)]
    assert ends == [(False, False)] * 124 + [(False, True)]


def test_lqr_has_bounded_actions_and_an_end() -> None:
    env = make_dmc_env("lqr-lqr_2_1", action_repeat=10)
    env.reset(seed=0)
    ends = [env.step(np.zeros(env.action_space.shape))[3] for _ in range(100)]
    np.testing.assert_array_equal([env.action_space.low, env.action_space.high], [[-1.0], [1.0]])
    assert ends == [False] * 99 + [True]


def test_the_seed_of_the_constructor_decides_episodes_and_actions() -> None:
    def play(seed: int) -> list[np.ndarray]:
        env = make_dmc_env("reacher-easy", seed=seed)
        observations = []
        for _ in range(2):
            observations += [env.reset()[0], env.step(env.action_space.sample())[0]]
        return observations

    np.testing.assert_array_equal(play(1), play(1))
    assert not np.array_equal(play(1), play(2))
    assert not np.array_equal(*play(1)[::2])  # each episode begins elsewhere


@pytest.mark.parametrize("kwargs", [{"action_repeat": 2, "frame_stack": 2}, SMALL], ids=["state", "pixels"])
def test_sb3_takes_it(kwargs: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of small images
        check_env(make_dmc_env("cheetah-run", **kwargs))


def test_pictures_are_the_suites_own_channels_first_and_stacked() -> None:
    env = make_dmc_env("cheetah-run", **{**SMALL, "image_size": (24, 32)})
    assert env.observation_space == spaces.Box(0, 255, (9, 24, 32), np.uint8)
    raw = by_hand("dm_control/cheetah-run-v0", 5)
    raw.reset()
    pictures = [raw.physics.render(24, 32, camera_id=0)]
    observations = [env.reset(seed=5)[0]]
    for value in (1.0, -1.0):
        action = np.full(env.action_space.shape, value)
        for _ in range(2):
            raw.step(action)
        pictures.append(raw.physics.render(24, 32, camera_id=0))
        observations.append(env.step(action)[0])
    assert not np.array_equal(pictures[0], pictures[2])
    for i, observation in enumerate(observations):
        expected = [pictures[max(0, i - back)].transpose(2, 0, 1) for back in (2, 1, 0)]
        assert observation.dtype == np.uint8
        np.testing.assert_array_equal(observation, np.concatenate(expected))
    env.close()


def picture(env_id: str, **kwargs: Any) -> np.ndarray:
    env = make_dmc_env(env_id, pixels=True, image_size=48, **kwargs)
    try:
        return env.reset(seed=0)[0].astype(float)
    finally:
        env.close()


@pytest.mark.slow
def test_the_quadruped_is_seen_by_its_third_camera() -> None:
    usual = picture("quadruped-run")
    np.testing.assert_array_equal(usual, picture("quadruped-run", camera_id=2))
    assert np.abs(usual - picture("quadruped-run", camera_id=0)).mean() > 5


def test_fast_pictures_differ_but_little() -> None:
    usual, fast = picture("cheetah-run"), picture("cheetah-run", fast_rendering=True)
    other = picture("walker-walk")
    # Shadows, reflections and soft edges only: the same scene, much nearer than another one.
    assert 0 < np.abs(usual - fast).mean() < 15
    assert np.abs(usual - fast).mean() < np.abs(usual - other).mean() / 2
    assert np.corrcoef(usual.ravel(), fast.ravel())[0, 1] > 0.8


@pytest.mark.parametrize(
    ("task", "nearest"), [("cheetah-rnu", "cheetah-run"), ("dm_control/waker-walk-v0", "walker-walk"), ("", "dm_control/")]
)
def test_an_unknown_task_names_the_nearest(task: str, nearest: str) -> None:
    with pytest.raises(ValueError, match=nearest):
        make_dmc_env(task)


@pytest.mark.parametrize("argument", ["action_repeat", "frame_stack"])
def test_counts_below_one_are_refused(argument: str) -> None:
    with pytest.raises(ValueError, match=argument):
        wrap_env(gym.make("Pendulum-v1"), **{argument: 0})


def test_images_are_stacked_along_their_channels() -> None:
    class Image(gym.Wrapper):
        observation_space = spaces.Box(0, 255, (40, 40, 3), np.uint8)

        def reset(self, **_: Any) -> Any:
            return np.full((40, 40, 3), [0, 1, 2], np.uint8), {}

    env = wrap_env(Image(gym.make("Pendulum-v1")), frame_stack=2)
    assert env.observation_space == spaces.Box(0, 255, (6, 40, 40), np.uint8)
    np.testing.assert_array_equal(env.reset()[0][:, 7, 9], [0, 1, 2, 0, 1, 2])
    grey = gym.wrappers.GrayscaleObservation(Image(gym.make("Pendulum-v1")))
    assert wrap_env(grey, frame_stack=2).observation_space == spaces.Box(0, 255, (2, 40, 40), np.uint8)
    with pytest.raises(ValueError, match="frame_stack is for vectors and images, not for Discrete"):
        wrap_env(gym.make("FrozenLake-v1"), frame_stack=2)


def test_other_environments_are_wrapped_alike() -> None:
    env = wrap_env(gym.make("Pendulum-v1"), action_repeat=2, frame_stack=2)
    raw = gym.make("Pendulum-v1")
    first, _ = env.reset(seed=1)
    np.testing.assert_array_equal(first, np.tile(raw.reset(seed=1)[0], 2))
    observation, reward, *_ = env.step(np.array([0.5], np.float32))
    steps = [raw.step(np.array([0.5], np.float32)) for _ in range(2)]
    np.testing.assert_array_equal(observation, np.concatenate([first[3:], steps[1][0]]))
    assert reward == pytest.approx(steps[0][1] + steps[1][1])


@pytest.mark.parametrize(
    ("environment", "expected"), [({}, ["egl", "osmesa"]), ({"DISPLAY": ":0"}, [None]), ({"MUJOCO_GL": "glfw"}, ["glfw"])]
)
def test_a_renderer_is_chosen_where_there_is_no_display(
    environment: dict[str, str], expected: list[str | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    envs._choose_renderer()
    assert os.environ.get("MUJOCO_GL") in expected


def test_states_need_no_driver_for_rendering() -> None:
    """A library for EGL without a driver, such as conda's on a machine without a graphics card."""
    code = "from sb3_aarl.envs import make_dmc_env; make_dmc_env('cheetah-run').reset()"
    chosen = {"DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL", "PYOPENGL_PLATFORM"}
    variables = {name: value for name, value in os.environ.items() if name not in chosen}
    subprocess.run([sys.executable, "-c", code], env={**variables, "__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent"}, check=True)


def test_deprecations_of_libraries_stay_hidden() -> None:
    """dm_control has Python show them all, each time, from its import on."""
    program = "import warnings; from sb3_aarl.envs import make_dmc_env; make_dmc_env('walker-walk')"
    program += "; warnings.warn_explicit('old', DeprecationWarning, 'library.py', 1)"
    process = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, check=True)
    assert "old" not in process.stderr
