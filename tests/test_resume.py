"""A run that is killed and resumed ends bit for bit like one that is not; what others put into its folder is not executed."""

import multiprocessing
import os
import pickle
import signal
import zlib
from collections.abc import Callable
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium.envs.classic_control import CartPoleEnv
from hypothesis import given
from hypothesis import strategies as st
from sb3_aarl.search.training import checkpoint, run
from sb3_aarl.search.training.checkpoint import TruncateAt, restart_seed
from sb3_aarl.search.training.run import Run, prepare_run, train
from test_sac_aux import assert_same
from tiny import DENSE

from sb3_aarl import SACAux
from sb3_aarl.callbacks import read_curve

HYPER: dict[str, Any] = {"env_kwargs": {}, **DENSE}
PIXELS = {"pixels": True, "image_size": 16, "frame_stack": 2, "fast_rendering": True}
CNN = {"net_arch": [8], "features_extractor_kwargs": {"features_dim": 8, "n_filters": 4}}
SIMBA = {"net_arch": [8], "features_extractor_class": "simba", "features_extractor_kwargs": {"features_dim": 8}}
# Episodes have 17, 50 or up to 1000 agent steps: most are truncated at evaluations.
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "pixels": ("dm_control/cartpole-swingup-v0", {"env_kwargs": {"action_repeat": 60, **PIXELS}, "policy_kwargs": CNN}),
    "mujoco": ("Hopper-v5", {"env_kwargs": {"frame_stack": 2}, "train_freq": [1, "episode"], "gradient_steps": -1}),
    "normalize": ("InvertedPendulum-v5", {"normalize": True, "n_steps": 3, "policy_kwargs": SIMBA}),
    "two": (
        "dm_control/reacher-easy-v0",
        {
            "env_kwargs": {"action_repeat": 20},
            "n_envs": 2,
            "train_freq": 3,
            "gradient_steps": -1,
            "aux_kwargs": {"joint": True},
        },
    ),
    # The second checkpoint lies between random actions.
    "noise": ("Pendulum-v1", {"use_sde": True, "sde_sample_freq": 4, "n_envs": 2, "normalize": {}, "learning_starts": 70}),
}
# Agent steps between evaluations.
EVERY = {case: 10 if case == "pixels" else 30 for case in CASES}
N_EVALUATIONS = 4


@pytest.fixture(scope="module")
def processes() -> ForkServerContext:
    """Processes that start with everything imported."""
    context = multiprocessing.get_context("forkserver")
    # Those that DeepMind Control and the first optimizer import.
    context.set_forkserver_preload(["sb3_aarl.search.training.run", "shimmy", "torch._dynamo"])
    return context


def make_run(case: str, **changes: Any) -> Run:
    environment, hyper = CASES[case]
    repeat = hyper.get("env_kwargs", {}).get("action_repeat", 1)
    return Run(
        **{
            "environment": environment,
            "aux_loss": "{s_t, a_t} -> {s_t+1}",
            "hyperparameters": HYPER | hyper,
            "seed": 1,
            "checkpoints": tuple(EVERY[case] * repeat * (i + 1) for i in range(N_EVALUATIONS)),
            "evaluation_episodes": 1,
            "keep_model": True,
            **changes,
        }
    )


def kill_at(moment: str, count: int) -> None:
    """
    Let this process kill itself.

    :param moment: ``step``: when so many agent steps were made; ``write`` and ``rename``: while the checkpoint of this number
        is written, and when it has its name, but the curve is not written
    :param count: The number
    """
    calls = 0

    def before(owner: Any, name: str, is_due: Callable[..., bool]) -> None:
        function = getattr(owner, name)

        def kill_or_call(*args: Any, **kwargs: Any) -> Any:
            nonlocal calls
            calls += 1
            if is_due(*args):
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*args, **kwargs)

        setattr(owner, name, kill_or_call)

    if moment == "step":
        before(SACAux, "_store_transition", lambda model, *_: model.num_timesteps >= count)
    else:
        owner, name = (checkpoint.os, "fsync") if moment == "write" else (run, "write_curve")  # type: ignore[attr-defined]
        before(owner, name, lambda *_: calls == count)


def train_in_process(folder: Path, kill: tuple[str, int] | None) -> None:
    """Train, note how many evaluations there are already, and die if asked to."""
    state = checkpoint.read(folder)
    with (folder / "starts").open("a") as file:
        file.write(f"{len(state['curve']) if state else 0}\n")
    if kill is not None:
        kill_at(*kill)
    train(folder)


def result(folder: Path) -> tuple[Any, Any]:
    """What a run leaves, without wall times."""
    model = SACAux.load(folder / "model.zip", device="cpu")
    return [point[:4] for point in read_curve(folder / "curve.csv")], model.training_state()


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_killed_run_ends_like_an_undisturbed_one(case: str, tmp_path: Path, processes: ForkServerContext) -> None:
    rng = np.random.default_rng(zlib.crc32(case.encode()))
    step = int(rng.integers(EVERY[case] + 1, 3 * EVERY[case]))

    def train_until(folder: Path, kill: tuple[str, int] | None) -> int | None:
        process = processes.Process(target=train_in_process, args=(folder, kill))
        process.start()
        process.join()
        return process.exitcode

    prepare_run(tmp_path / "undisturbed", make_run(case))
    assert train_until(tmp_path / "undisturbed", None) == 0

    folder, n_evaluations = tmp_path / "killed", (step - 1) // EVERY[case]
    kills: dict[tuple[str, int] | None, int] = {("step", step): 0, None: n_evaluations}  # and the evaluations before
    if case == "noise":  # a checkpoint is written alike in all of them
        kills = {("write", 1): 0, ("step", step): 0, ("rename", 1): n_evaluations, None: n_evaluations + 1}
    for kill in kills:
        prepare_run(folder, make_run(case))
        assert train_until(folder, kill) == (-signal.SIGKILL if kill else 0)
    starts = [int(line) for line in (folder / "starts").read_text().split()]
    assert starts == list(kills.values())

    (curve, state), (expected_curve, expected_state) = result(folder), result(tmp_path / "undisturbed")
    assert curve == expected_curve and len(curve) == N_EVALUATIONS
    assert len({point[1] for point in curve}) > 1 or case == "normalize"  # or equality would say little
    assert assert_same(state, expected_state) > 40
    assert not (folder / "checkpoint.pt").exists() and not (folder / "checkpoint.tmp").exists()


class Malicious:
    """Leaves a file when it is unpickled."""

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.marker,)


def test_a_checkpoint_is_not_unpickled(tmp_path: Path) -> None:
    prepare_run(tmp_path, make_run("noise"))
    marker = tmp_path / "marker"
    th.save({"model": Malicious(marker), "curve": []}, tmp_path / "checkpoint.pt")
    with pytest.raises(pickle.UnpicklingError, match="weights_only"):
        train(tmp_path)
    assert not marker.exists()
    th.load(tmp_path / "checkpoint.pt", weights_only=False)  # it would have worked
    assert marker.exists()


@given(st.sets(st.integers(1, 60)))
def test_episodes_end_at_checkpoints(steps: set[int]) -> None:
    env = TruncateAt(CartPoleEnv(), sorted(steps))
    env.reset()
    for n in range(1, 61):
        *_, terminated, truncated, _ = env.step(0)
        assert truncated is (n in steps)
        if terminated or truncated:
            env.reset()


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 10**7), min_size=2, max_size=2, unique=True))
def test_seeds_after_checkpoints_are_other_ones(seed: int, steps: list[int]) -> None:
    seeds = [restart_seed(seed, step) for step in steps]
    assert seeds == [restart_seed(seed, step) for step in steps] and seeds[0] != seeds[1]
    # Those below are of evaluations and beginnings; NumPy takes less than 2**32, with that of the last environment.
    assert all(2**31 <= each < 2**32 - 1000 for each in seeds)
