"""
What one gradient step costs: SACAux beside SB3's SAC with networks of the same widths and the same batch.

Each row is printed, and written to ``--out``, as soon as it is measured. SB3's SAC takes turns with it, so that what disturbs
the machine disturbs both; the ratio is the median of the rounds' ratios. ``small``: observations and actions of Cheetah-Run,
SB3's sizes, batch 256 and two hidden layers of 256, on one thread; ``state``: the paper's, batch 512 and layers of 1024. Both
have AARL-State and DenseMLP; ``simba`` is SACAux's own encoder, with forward dynamics. ``pixels``: three stacked frames of
100 x 100 x 3 cropped to 84 x 84, batch 128 (``pixels-512``: 512), AARL-Pixel. SB3's SAC reads pixels of 84 x 84 through the
same encoder class, so that both do the same convolutions. The replay buffers hold random numbers: a gradient step costs the
same whatever they mean.

The public reference implementation took 107 ms (state) and 1139 ms (pixels) on a CPU where float32 matrix products peaked at
220 GFLOP/s. On a CPU the last column compares with that, scaled by the peak of this run: ms / (reference x 220 / peak).
"""

import argparse
import functools
import gc
import statistics
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from saving import save_result
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import configure
from torch.utils import _pytree as pytree

from sb3_aarl import SACAux
from sb3_aarl.encoders import PixelEncoder
from sb3_aarl.sac_aux import COMPILED

ACTION_DIM = 6
STATE_DIM = 17
EPISODE = 250
BATCH = {"small": 256, "state": 512, "pixels": 128, "pixels-512": 512}
WIDTH = {"small": 256, "state": 1024, "pixels": 1024, "pixels-512": 1024}
TRANSITIONS = {"small": 20_000, "state": 20_000, "pixels": 2000, "pixels-512": 2000}
REFERENCE_MS, REFERENCE_GFLOPS = {"state": 107, "pixels": 1139}, 220
WAYS = ["", ", compiled", ", CUDA graphs"]
GRAPHS = WAYS[-1]
DENSE_MLP: dict[str, Any] = {"policy_kwargs": {"features_extractor_class": "dense_mlp"}}
PARTS = ("sampling", "critic", "actor", "auxiliary", "targets")


class RandomEnv(gym.Env):
    """Spaces of Cheetah-Run; only its spaces are used."""

    def __init__(self, setting: str, size: int):
        self.action_space = spaces.Box(-1, 1, (ACTION_DIM,), np.float32)
        if not setting.startswith("pixels"):
            self.observation_space = spaces.Box(-np.inf, np.inf, (STATE_DIM,), np.float32)
        else:
            self.observation_space = spaces.Box(0, 255, (9, size, size), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}


def fill(model: SAC, transitions: int) -> None:
    """Random episodes of 250 agent steps, whose stacks are what their frames say."""
    assert model.replay_buffer is not None
    rng = np.random.default_rng(0)
    shape = model.observation_space.shape or ()
    stacked = len(shape) == 3

    def frame() -> np.ndarray:
        if stacked:
            return rng.integers(0, 256, (3, *shape[1:]), np.uint8)
        return rng.normal(size=shape).astype(np.float32)

    for step in range(transitions):
        if step % EPISODE == 0:
            obs = np.concatenate([frame()] * 3) if stacked else frame()
        next_obs = np.concatenate([obs[3:], frame()]) if stacked else frame()
        over = np.array([step % EPISODE == EPISODE - 1])
        action, reward = rng.uniform(-1, 1, (1, ACTION_DIM)), rng.normal(size=1)
        infos = [{"TimeLimit.truncated": bool(over[0])}]
        model.replay_buffer.add(obs[None], next_obs[None], action, reward, over, infos)
        obs = next_obs


def sb3(setting: str, device: str) -> SAC:
    kwargs: dict[str, Any] = {"net_arch": [WIDTH[setting]] * 2}
    if setting.startswith("pixels"):
        # SB3's own way: one encoder for actor and one for critic, no augmentation, images of the size that convolutions see.
        kwargs["features_extractor_class"] = PixelEncoder
    policy = "CnnPolicy" if setting.startswith("pixels") else "MlpPolicy"
    return SAC(
        policy,
        RandomEnv(setting, 84),
        batch_size=BATCH[setting],
        buffer_size=TRANSITIONS[setting],
        policy_kwargs=kwargs,
        device=device,
    )


def ours(setting: str, device: str, **kwargs: Any) -> SACAux:
    policy = "CnnPolicy" if setting.startswith("pixels") else "MlpPolicy"
    if setting.startswith("pixels"):
        kwargs["replay_buffer_kwargs"] = {"frame_stack": 3, **kwargs.get("replay_buffer_kwargs", {})}
    kwargs["policy_kwargs"] = {"net_arch": [WIDTH[setting]] * 2, **kwargs.get("policy_kwargs", {})}
    return SACAux(
        policy, RandomEnv(setting, 100), batch_size=BATCH[setting], buffer_size=TRANSITIONS[setting], device=device, **kwargs
    )


def modes(setting: str, ways: list[str]) -> dict[str, dict[str, Any]]:
    """SACAux's arguments for each row of a setting, by the row's name, which ends with one of ``WAYS``."""
    encoder, loss = ({}, "aarl-pixel") if setting.startswith("pixels") else (DENSE_MLP, "aarl-state")
    rows: dict[str, dict[str, Any]] = {}
    for way in ways:
        for precision in ("fp32", "bf16"):
            kwargs = {"precision": precision, "compile": way == ", compiled"}
            rows[f"{precision}{way}"] = {**kwargs, **encoder, "aux_loss": loss}
            if setting == "small":
                rows[f"simba, {precision}{way}"] = kwargs
                rows[f"simba, n_steps=3, {precision}{way}"] = {**kwargs, "n_steps": 3}
    if "" in ways:
        rows["no auxiliary loss"] = {**encoder, "aux_loss": None}
        if setting == "small":
            rows |= {"simba, no auxiliary loss": {"aux_loss": None}, "simba, AARL-State": {"aux_loss": "aarl-state"}}
    return rows


def use_cuda_graphs(model: SACAux) -> None:
    """
    Compile a model's losses with CUDA graphs, which overwrite what they returned when they run again: it is copied, and each
    gradient step says that it begins, so that no graph overwrites what a backward pass of the same step needs.
    """

    def compiled(function: Callable) -> Callable:
        function = th.compile(function, options={"fallback_random": True, "triton.cudagraphs": True})
        return lambda *args: pytree.tree_map_only(th.Tensor, th.clone, function(*args))

    def sample(*args: Any) -> Any:
        th.compiler.cudagraph_mark_step_begin()
        return original(*args)

    original = model._sample
    for name, method in {**{name: compiled(getattr(model, name)) for name in COMPILED}, "_sample": sample}.items():
        setattr(model, name, method)


def synchronize(device: str) -> None:
    if device == "cuda":
        th.cuda.synchronize()


def peak(setting: str) -> float:
    """Float32 GFLOP/s of the product that dominates a step: (batch, width) x (width, width)."""
    batch, width = BATCH[setting], WIDTH[setting]
    one, other = th.randn(batch, width), th.randn(width, width)
    seconds = []
    for _ in range(10):
        started = time.perf_counter()
        for _ in range(5):
            one @ other
        seconds.append((time.perf_counter() - started) / 5)
    return 2e-9 * batch * width * width / min(seconds)


def parts(model: SACAux, device: str, steps: int) -> dict[str, float]:
    """Milliseconds that each part of a gradient step takes: each ends when its optimizer has stepped."""
    seconds = dict.fromkeys(PARTS, 0.0)
    last = 0.0

    def ends(part: str) -> None:
        nonlocal last
        synchronize(device)
        now = time.perf_counter()
        seconds[part] += now - last
        last = now

    def timed(method: Callable, part: str) -> Callable:
        def call(*args: Any, **kwargs: Any) -> Any:
            result = method(*args, **kwargs)
            ends(part)
            return result

        return call

    optimizers: dict[str, list[th.optim.Optimizer | None]] = {
        "critic": [model.critic.optimizer],
        "actor": [model.actor.optimizer, model.ent_coef_optimizer],
        "auxiliary": [model.aux_optimizer],
    }
    hooks = [
        optimizer.register_step_post_hook(lambda *_, part=part: ends(part))
        for part, some in optimizers.items()
        for optimizer in some
        if optimizer is not None
    ]
    methods = {"_sample": "sampling", "_update_target": "targets"}
    originals = {name: getattr(model, name) for name in methods}
    for name, part in methods.items():
        setattr(model, name, timed(originals[name], part))
    synchronize(device)
    last = time.perf_counter()
    model.train(steps, model.batch_size)
    for hook in hooks:
        hook.remove()
    for name, method in originals.items():
        setattr(model, name, method)
    return {part: 1e3 * value / steps for part, value in seconds.items()}


def waits(model: SACAux) -> dict[str, int]:
    """How often two gradient steps wait for the GPU, by line of code."""
    th.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.train(2, model.batch_size)
    th.cuda.set_sync_debug_mode("default")
    found = [warning for warning in caught if "called a synchronizing" in str(warning.message)]
    return dict(Counter(f"{Path(warning.filename).name}:{warning.lineno}" for warning in found))


class Measured:
    """A model that has made its first gradient steps, in which it allocates and compiles; ``make`` makes it."""

    def __init__(self, make: Callable[[], SAC], device: str, buffers: dict[Any, ReplayBuffer | None], graphs: bool = False):
        before = th.cuda.memory_allocated() if device == "cuda" else 0
        model = self.model = make()
        self.device = device
        kind = type(model), model.n_steps
        if kind not in buffers:
            fill(model, model.buffer_size)
            buffers[kind] = model.replay_buffer
        model.replay_buffer = buffers[kind]
        model.set_logger(configure(None, []))
        if graphs:
            assert isinstance(model, SACAux)
            model.train(2, model.batch_size)  # what is computed once and kept would split the graphs
            use_cuda_graphs(model)
        if device == "cuda":
            th.cuda.reset_peak_memory_stats()
        started = time.perf_counter()
        model.train(8, model.batch_size)
        synchronize(device)
        self.first_seconds = time.perf_counter() - started
        self.memory_mb = (th.cuda.max_memory_allocated() - before) / 1e6 if device == "cuda" else None
        self.steps = 4

    def seconds(self) -> float:
        """Of a gradient step, the mean of some; each in a call of train(), as in learn()."""
        synchronize(self.device)
        started = time.perf_counter()
        for _ in range(self.steps):
            self.model.train(1, self.model.batch_size)
        synchronize(self.device)
        return (time.perf_counter() - started) / self.steps


def compare(base: Measured, measured: Measured, rounds: int, seconds: float) -> dict[str, Any]:
    """The columns of a row; rounds of so many seconds take turns with the base's."""
    model, device = measured.model, measured.device
    for one in (base, measured):
        one.steps = max(2, round(seconds / one.seconds()))
    pairs = [(base.seconds(), measured.seconds()) for _ in range(rounds)]
    ms = 1e3 * statistics.median(own for _, own in pairs)
    row: dict[str, Any] = {
        "ms": ms,
        "steps_per_second": 1e3 / ms,
        "ratio": statistics.median(own / theirs for theirs, own in pairs),
        "memory_mb": measured.memory_mb,
        "first_seconds": measured.first_seconds,
        "rounds_ms": [1e3 * own for _, own in pairs],
        "sb3_rounds_ms": [1e3 * theirs for theirs, _ in pairs],
    }
    if isinstance(model, SACAux):
        row["parts_ms"] = parts(model, device, 2 * measured.steps)
        if device == "cuda":
            row["waits"] = waits(model)
    return row


def measure(
    setting: str, device: str, rows: dict[str, dict[str, Any]], rounds: int, seconds: float
) -> Iterator[dict[str, Any]]:
    """SB3's SAC and each row, as soon as it is measured; one that fails has the reason."""
    buffers: dict[Any, ReplayBuffer | None] = {}
    base = Measured(lambda: sb3(setting, device), device, buffers)
    yield {"setting": setting, "algorithm": "SB3 SAC", **compare(base, base, rounds, seconds)}
    for name, kwargs in rows.items():
        row: dict[str, Any] = {"setting": setting, "algorithm": name}
        # The model before is gone, and another one is no reason to compile a function again.
        gc.collect()
        th.compiler.reset()
        try:
            make = functools.partial(ours, setting, device, **kwargs)
            row |= compare(base, Measured(make, device, buffers, name.endswith(GRAPHS)), rounds, seconds)
        except Exception as error:  # the other rows are worth having
            traceback.print_exc()
            row["error"] = f"{type(error).__name__}: {error}".partition("\n")[0]
        yield row


def line(row: dict[str, Any]) -> str:
    """A row of the table that is printed."""
    start = f"{row['setting']:10} {row['algorithm']:32}"
    if "ms" not in row:
        return f"{start} {row.get('error') or row['skipped']}"
    memory = f"{row['memory_mb']:8.0f}" if row["memory_mb"] is not None else " " * 8
    split = row.get("parts_ms")
    shares = " ".join(f"{split[part]:10.2f}" for part in PARTS) if split else " " * 54
    reference = f"{row['ratio_to_reference']:9.3f}" if "ratio_to_reference" in row else ""
    measured = f"{row['steps_per_second']:8.1f} {row['ms']:8.2f} {row['ratio']:6.3f} {memory} {row['first_seconds']:6.1f}"
    return f"{start} {measured} {shares} {reference}".rstrip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--settings", nargs="+", default=list(BATCH), choices=list(BATCH))
    parser.add_argument("--device", default="cuda" if th.cuda.is_available() else "cpu", choices=["cpu", "cuda"])
    names = list(modes("small", WAYS))
    parser.add_argument("--rows", nargs="+", choices=names, help="SB3's SAC is always there. Default: all")
    parser.add_argument("--batch-size", type=int, help="another than the settings'")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=0.5, help="of a round, for each of the two")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()

    BATCH.update(dict.fromkeys(BATCH, args.batch_size) if args.batch_size else {})
    titles = " ".join(f"{part:>10}" for part in PARTS)
    print(f"{'setting':10} {'algorithm':32}  steps/s       ms  ratio  peak MB  first {titles} reference", flush=True)
    rows, threads = [], th.get_num_threads()

    def done(row: dict[str, Any]) -> None:
        rows.append(row)
        print(line(row), flush=True)
        if args.out:  # what comes later may be cut off
            save_result(args.out, threads=threads, rows=rows)

    for setting in args.settings:
        th.set_num_threads(1 if setting == "small" else threads)
        all_rows = modes(setting, WAYS)
        chosen = {name: all_rows[name] for name in args.rows or all_rows if name in all_rows}
        for name in [name for name in chosen if args.device == "cpu" and name.endswith(GRAPHS)]:
            del chosen[name]
            done({"setting": setting, "algorithm": name, "skipped": "needs a GPU"})
        compared = args.device == "cpu" and setting in REFERENCE_MS and not args.batch_size
        reference = REFERENCE_MS[setting] * REFERENCE_GFLOPS / peak(setting) if compared else None
        for row in measure(setting, args.device, chosen, args.rounds, args.seconds):
            if reference is not None and "ms" in row:
                row["ratio_to_reference"] = row["ms"] / reference
            done(row)


if __name__ == "__main__":
    main()
