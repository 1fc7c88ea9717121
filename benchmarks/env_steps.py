"""
How fast environments step, alone and several at once, and what an evaluation of ten episodes takes.

Stepping: random actions on DeepMind Control, environment steps (agent steps x action repeat) of all environments a second,
in one process (``dummy``) and in one for each environment (``subproc``), beside what SB3 gets from shimmy without our
wrappers (Dict observations, no action repeat). Pixels are 100 x 100, three stacked, drawn by this machine's renderer.

Evaluation: ten episodes of an untrained SACAux of the default widths, one after the other, and several at once with one
prediction for all. Episodes from pixels are cut short.

All variants of a task take turns, so that what disturbs the machine disturbs all; ratios are medians of the ratios within
each round.
"""

import argparse
import functools
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.wrappers import TimeLimit
from rich.console import Console
from rich.table import Table
from saving import save_result
from sb3_aarl.search.training.config import VEC_ENVS
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_aarl import SACAux
from sb3_aarl.callbacks import LearningCurveCallback
from sb3_aarl.envs import make_dmc_env

ACTION_REPEAT = 4
EPISODES = 10
PIXELS = {"pixels": True, "frame_stack": 3}
PLAIN = "SB3 over shimmy"
BASE = "dummy 1"


def make_short_env(agent_steps: int, **kwargs: Any) -> gym.Env:
    """An environment whose episodes end early: a whole one from pixels takes many seconds."""
    return TimeLimit(make_dmc_env(**kwargs), agent_steps)


def make(task: str, pixels: bool, kind: str, n_envs: int, **settings: Any) -> VecEnv:
    """Environments as ``aarl train`` makes them."""
    kwargs = {"env_id": task, "action_repeat": ACTION_REPEAT, **(PIXELS if pixels else {})}
    function: Callable[..., gym.Env] = make_dmc_env
    if "agent_steps" in settings:
        function, kwargs["agent_steps"] = make_short_env, settings.pop("agent_steps")
    return make_vec_env(function, n_envs, seed=0, env_kwargs=kwargs, vec_env_cls=VEC_ENVS[kind], **settings)


def take_turns(variants: dict[str, Callable[[], float]], rounds: int) -> dict[str, tuple[float, float, list[float]]]:
    """
    Run variants in turns.

    :param variants: By name, functions whose result is a rate
    :param rounds: How often
    :return: By name: median rate, median of the ratios to the rate of ``BASE``, rates
    """
    rates: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(rounds):
        for name, run in variants.items():
            rates[name].append(run())
    return {
        name: (
            statistics.median(own),
            statistics.median(rate / basis for rate, basis in zip(own, rates[BASE], strict=True)),
            own,
        )
        for name, own in rates.items()
    }


def stepping(env: VecEnv, environment_steps: int, action_repeat: int) -> float:
    """Environment steps a second of all environments together."""
    rng = np.random.default_rng(0)
    agent_steps = max(1, environment_steps // action_repeat // env.num_envs)
    assert isinstance(env.action_space, gym.spaces.Box) and env.action_space.shape is not None
    shape = (agent_steps, env.num_envs, *env.action_space.shape)
    actions = rng.uniform(env.action_space.low, env.action_space.high, shape).astype(np.float32)
    started = time.perf_counter()
    for action in actions:
        env.step(action)
    return agent_steps * env.num_envs * action_repeat / (time.perf_counter() - started)


def measure_stepping(task: str, pixels: bool, numbers: list[int], steps: int, rounds: int) -> list[dict[str, Any]]:
    ways = [(kind, n) for kind in VEC_ENVS for n in numbers]
    envs = {f"{kind} {n}": make(task, pixels, kind, n) for kind, n in ways if (kind, n) != ("subproc", 1)}
    repeats = dict.fromkeys(envs, ACTION_REPEAT)
    if not pixels:  # SB3 has no pictures of it
        envs[PLAIN] = make_vec_env(f"dm_control/{task}-v0", 1, seed=0)
        repeats[PLAIN] = 1
    variants: dict[str, Callable[[], float]] = {}
    for name, env in envs.items():
        env.reset()
        stepping(env, 20 * env.num_envs, repeats[name])
        variants[name] = functools.partial(stepping, env, steps, repeats[name])
    results = take_turns(variants, rounds)
    for env in envs.values():
        env.close()
    common = {"what": "stepping", "task": task, "pixels": pixels}
    return [
        {**common, "variant": name, "environment_steps_per_s": rate, "ratio": ratio, "rounds": own}
        for name, (rate, ratio, own) in results.items()
    ]


def evaluation(callback: LearningCurveCallback) -> float:
    """Evaluations a second."""
    started = time.perf_counter()
    callback._episode_returns(0)
    return 1 / (time.perf_counter() - started)


def measure_evaluation(
    task: str, pixels: bool, ways: list[tuple[str, int]], rounds: int, pixel_steps: int
) -> list[dict[str, Any]]:
    settings: dict[str, Any] = {"agent_steps": pixel_steps} if pixels else {}
    model = SACAux("CnnPolicy" if pixels else "MlpPolicy", make(task, pixels, "dummy", 1), buffer_size=100, seed=0)
    variants: dict[str, Callable[[], float]] = {}
    envs = []
    for kind, n in ways:
        env = make(task, pixels, kind, n, **settings)
        envs.append(env)
        callback = LearningCurveCallback(env, [ACTION_REPEAT], EPISODES)
        callback.init_callback(model)
        variants[f"{kind} {n}"] = functools.partial(evaluation, callback)
    results = take_turns(variants, rounds)
    for env in envs:
        env.close()
    common = {"what": f"{EPISODES} episodes", "task": task, "pixels": pixels}
    if pixels:
        common["agent_steps_of_an_episode"] = pixel_steps
    return [
        {**common, "variant": name, "seconds": 1 / rate, "ratio": ratio, "rounds": [1 / value for value in own]}
        for name, (rate, ratio, own) in results.items()
    ]


def show(rows: list[dict[str, Any]]) -> None:
    table = Table("what", "task", "environments", "environment steps/s", "seconds", "times as fast")
    for column in table.columns[3:]:
        column.justify = "right"
    last = None
    for row in rows:
        if last not in (None, (row["what"], row["task"], row["pixels"])):
            table.add_section()
        last = (row["what"], row["task"], row["pixels"])
        table.add_row(
            row["what"],
            row["task"] + (" (pixels)" if row["pixels"] else ""),
            row["variant"],
            f"{row['environment_steps_per_s']:,.0f}" if "environment_steps_per_s" in row else "",
            f"{row['seconds']:.2f}" if "seconds" in row else "",
            f"{row['ratio']:.2f}",
        )
    Console(width=110).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["cheetah-run", "walker-walk"], help="from states")
    parser.add_argument("--pixel-task", default="cheetah-run")
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 2, 4], help="numbers of environments, first 1")
    parser.add_argument("--steps", type=int, default=2000, help="environment steps of a variant in a round")
    parser.add_argument("--pixel-steps", type=int, default=10, help="agent steps of an evaluation episode from pixels")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.envs[0] != 1:
        parser.error("--envs must begin with 1, which ratios refer to")

    rows = []
    for task in args.tasks:
        rows += measure_stepping(task, False, args.envs, args.steps, args.rounds)
        rows += measure_evaluation(task, False, [("dummy", 1), ("dummy", EPISODES)], args.rounds, args.pixel_steps)
    # A picture takes as long as a hundred steps where software draws it.
    rows += measure_stepping(args.pixel_task, True, args.envs[:2], 40 * ACTION_REPEAT, args.rounds)
    ways = [("dummy", 1), ("dummy", EPISODES), ("subproc", 2)]
    rows += measure_evaluation(args.pixel_task, True, ways, args.rounds, args.pixel_steps)
    show(rows)
    if args.out:
        save_result(args.out, threads=th.get_num_threads(), rows=rows)


if __name__ == "__main__":
    main()
