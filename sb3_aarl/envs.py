"""Environments: DeepMind Control through shimmy, as vectors or pixels, out of Gymnasium's own wrappers."""

import contextlib
import ctypes
import difflib
import functools
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import (
    AddRenderObservation,
    FlattenObservation,
    FrameStackObservation,
    RepeatAction,
    ReshapeObservation,
    TimeLimit,
    TransformAction,
    TransformObservation,
)
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first


def _choose_renderer() -> None:
    """Without a display, set MUJOCO_GL to what can render without one: MuJoCo reads it when it is imported."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if "MUJOCO_GL" in os.environ or display or not sys.platform.startswith("linux"):
        return
    with contextlib.suppress(OSError):
        get_display = ctypes.CDLL("libEGL.so.1").eglGetDisplay
        get_display.restype = ctypes.c_void_p
        if get_display(None):  # a null pointer without a driver
            os.environ["MUJOCO_GL"] = "egl"
            return
    with contextlib.suppress(OSError):
        ctypes.CDLL("libOSMesa.so.8")
        os.environ["MUJOCO_GL"] = "osmesa"


# PyTorch's CUDA build imports triton at the first optimizer step. If Mesa is loaded by then, as it is with EGL in
# software, the two copies of LLVM crash the process; in this order they do not.
with contextlib.suppress(ImportError):
    import triton  # type: ignore[import-not-found]  # noqa: F401
_choose_renderer()

PREFIX = "dm_control/"
NEEDS_DMC = (
    'DeepMind Control\'s tasks need: pip install "sb3-aarl[dmc]" (on Python 3.13 also: pip install --no-deps dm-control)'
)
# Environment steps of an episode; only LQR has no time limit of its own.
EPISODE_LENGTH = 1000
# The camera that papers render a domain with, where it is not the first one (CURL, DrQ-v2: behind the quadruped).
CAMERAS = {"quadruped": 2}


@functools.cache
def env_ids() -> list[str]:
    """
    The ids of all tasks of the DeepMind Control Suite, such as ``dm_control/cheetah-run-v0``, and Gymnasium knows them from
    then on. None where the extra ``dmc`` is not installed.
    """
    try:
        # Locomotion tasks need labmaze, which has no wheel for Python 3.13: shimmy prints a warning at its import. dm_control
        # has Python show each DeprecationWarning each time: with NumPy 2.5 two in every step of some tasks, 28 MB in a run.
        with contextlib.redirect_stdout(None), warnings.catch_warnings():
            import shimmy  # noqa: F401  (registers them)
        from dm_control import suite
    except ModuleNotFoundError:
        return []
    # dm_control's models use what MuJoCo has deprecated: a warning for each environment.
    logging.getLogger("absl").addFilter(lambda record: "settotalmass" not in record.getMessage())
    return sorted(f"{PREFIX}{domain}-{task}-v0" for domain, task in suite.ALL_TASKS)


def find_task(name: str) -> str | None:
    """The id of a task by it or by its short form, such as ``Cheetah-Run`` or ``humanoid_CMU-run``; None if there is none."""
    return {env_id.lower(): env_id for env_id in env_ids()}.get(_long_form(name))


def _long_form(name: str) -> str:
    return f"{PREFIX}{name.lower().removeprefix(PREFIX).removesuffix('-v0')}-v0"


def make_dmc_env(
    env_id: str,
    *,
    pixels: bool = False,
    action_repeat: int = 1,
    frame_stack: int = 1,
    image_size: int | tuple[int, int] = 100,
    camera_id: int | str | None = None,
    fast_rendering: bool = False,
    seed: int | None = None,
) -> gym.Env:
    """
    A task of the DeepMind Control Suite with one float32 vector, or with images, as observation.

    ``env.reset(seed=s)`` makes all that follows repeatable. Rewards of repeated steps are summed; an episode has 1000
    environment steps (control steps of the suite, each some steps of MuJoCo), so 1000 / action_repeat agent steps, and ends
    by truncation.

    :param env_id: Such as ``dm_control/cheetah-run-v0``, ``cheetah-run`` or the paper's ``Cheetah-Run``
    :param pixels: Whether to observe rendered images, (3 * frame_stack, height, width) bytes, instead of state vectors
    :param action_repeat: Environment steps for which each action is kept
    :param frame_stack: Consecutive observations put side by side, the newest last; the first one of an episode fills up
    :param image_size: Height and width in pixels, one number for both
    :param camera_id: Number or name of the camera, None for the usual one of the domain
    :param fast_rendering: Whether to leave out shadows, reflections and anti-aliasing: several times faster without a GPU,
        but other pictures than the suite's own
    :param seed: Seed of the initial states from the first ``reset()`` on, and of ``action_space``; None for a random one
    :raises ValueError: for an unknown task, with the nearest ones
    :raises ImportError: without the extra ``dmc``
    """
    known, task = env_ids(), find_task(env_id)
    if not known:
        raise ImportError(NEEDS_DMC)
    if task is None:
        nearest = ", ".join(difflib.get_close_matches(_long_form(env_id), known, cutoff=0.4)) or f"something like {known[0]}"
        raise ValueError(f"unknown DeepMind Control task {env_id!r}, nearest: {nearest}")
    env_id = task
    domain = env_id.removeprefix(PREFIX).partition("-")[0]
    height, width = image_size if isinstance(image_size, Sequence) else (image_size, image_size)
    camera_id = CAMERAS.get(domain, 0) if camera_id is None else camera_id
    render_kwargs: dict[str, Any] = {"height": height, "width": width, "camera_id": camera_id}
    if fast_rendering:
        render_kwargs["render_flag_overrides"] = {"shadow": False, "reflection": False}
    env = gym.make(
        env_id,
        render_mode="rgb_array",
        render_kwargs=render_kwargs,
        # LQR draws its masses and springs when it is made: one task, not another one each time.
        task_kwargs={"random": 0},
        disable_env_checker=True,
    )
    env.unwrapped.np_random = np.random.RandomState(seed)  # type: ignore[assignment]
    if fast_rendering:
        env.unwrapped.physics.model.vis.quality.offsamples = 0  # type: ignore[attr-defined]
    if domain == "lqr":
        # Its actions have no bounds (1e10), which no policy with squashed actions can use.
        env = TimeLimit(env, EPISODE_LENGTH)
        assert isinstance(env.action_space, spaces.Box)
        env = TransformAction(env, lambda action: action, spaces.Box(-1.0, 1.0, env.action_space.shape, np.float64))
    if not pixels:
        env = FlattenObservation(env)
        assert isinstance(env.observation_space, spaces.Box)
        low, high = (bound.astype(np.float32) for bound in (env.observation_space.low, env.observation_space.high))
        env = TransformObservation(env, lambda vector: vector.astype(np.float32), spaces.Box(low, high, dtype=np.float32))
    env = wrap_env(env, pixels=pixels, action_repeat=action_repeat, frame_stack=frame_stack)
    env.action_space.seed(seed)
    return env


def wrap_env(env: gym.Env, *, pixels: bool = False, action_repeat: int = 1, frame_stack: int = 1) -> gym.Env:
    """
    Action repeat, rendered images, channels before height and width, and frame stack, in the order that
    ``WindowReplayBuffer`` needs.

    :param env: Any Gymnasium environment; for ``pixels`` with ``render_mode="rgb_array"``
    :param pixels: Whether to observe what the environment renders, in that size, and not what it observes
    :param action_repeat: As in :func:`make_dmc_env`
    :param frame_stack: As in :func:`make_dmc_env`, for a vector or an image
    """
    for name, value in (("action_repeat", action_repeat), ("frame_stack", frame_stack)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, not {value}")
    if action_repeat > 1:
        env = RepeatAction(env, action_repeat)
    if pixels:
        # Outside the action repeat: one picture for each agent step.
        env = AddRenderObservation(env, render_only=True)
    space = env.observation_space
    if isinstance(space, spaces.Box) and is_image_space(space) and not is_image_space_channels_first(space):
        height, width, channels = space.shape
        channel_first = spaces.Box(0, 255, (channels, height, width), np.uint8)
        env = TransformObservation(env, lambda image: np.ascontiguousarray(image.transpose(2, 0, 1)), channel_first)
    if frame_stack > 1:
        space = env.observation_space
        if not space.shape:
            raise ValueError(f"frame_stack is for vectors and images, not for {space}")
        first, *rest = space.shape
        env = FrameStackObservation(env, frame_stack)
        if len(rest) != 1 or space.dtype != np.uint8:  # a grey image has no channels: its frames are
            env = ReshapeObservation(env, (frame_stack * first, *rest))
    return env
