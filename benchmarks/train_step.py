"""
What one gradient step costs: SACAux beside SB3's SAC with networks of the same widths and the same batch.

All run in one process and take turns, so that what disturbs the machine disturbs all; ratios are medians of the ratios
within each round. ``state``: observations and actions of Cheetah-Run, batch 512, two hidden layers of 1024, AARL-State and
DenseMLP. ``small``: the same with SB3's sizes, batch 256 and two hidden layers of 256, on one thread; ``simba``: with that
encoder, by default with forward dynamics.
``pixels``: three stacked frames of 100 x 100 x 3 cropped to 84 x 84, batch 128, AARL-Pixel. SB3's SAC reads pixels of
84 x 84 through the same encoder class, so that both do the same convolutions. The replay buffers hold random numbers:
a gradient step costs the same whatever they mean.

The peak of matrix products is measured in the same process, and every step as a share of it: the floating point operations
of all matrix products and convolutions, as PyTorch counts them, over what the peak would have done in that time.

The public reference implementation took 107 ms (state) and 1139 ms (pixels) in float32 where matrix products peaked at 220
GFLOP/s. The last column compares with that, scaled by the float32 peak of this run: ms / (reference x 220 / peak).
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from rich.console import Console
from rich.table import Table
from saving import save_result
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from torch.utils.flop_counter import FlopCounterMode

from sb3_aarl import SACAux
from sb3_aarl.encoders import PixelEncoder

torch_compile = th.compile
ACTION_DIM = 6
STATE_DIM = 17
EPISODE = 250
BATCH = {"state": 512, "small": 256, "pixels": 128, "pixels-512": 512}
WIDTH = {"state": 1024, "small": 256, "pixels": 1024, "pixels-512": 1024}
STEPS = {"state": 6, "small": 40, "pixels": 2, "pixels-512": 1}
REFERENCE_MS, REFERENCE_GFLOPS = {"state": 107, "pixels": 1139}, 220
TRANSITIONS = {"state": 20_000, "small": 20_000, "pixels": 2000, "pixels-512": 2000}
# How the losses of a row whose name ends so are compiled; SACAux's own way is the first.
COMPILED: dict[str, dict[str, Any]] = {", compiled": {}, ", CUDA graphs": {"triton.cudagraphs": True}}
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


def modes(setting: str, compiled: list[str]) -> dict[str, dict[str, Any]]:
    """The ways to run a gradient step, by name; ``compiled``: endings of ``COMPILED``, and ``""`` for those that are not."""
    encoder, loss = ({}, "aarl-pixel") if setting.startswith("pixels") else (DENSE_MLP, "aarl-state")
    ways: dict[str, dict[str, Any]] = {}
    for ending in compiled:
        for precision in ("fp32", "bf16"):
            kwargs = {"precision": precision, "compile": bool(ending)}
            ways[f"{precision}{ending}"] = {**kwargs, **encoder, "aux_loss": loss}
            if setting == "small":
                ways[f"simba, {precision}{ending}"] = kwargs
                ways[f"simba, n_steps=3, {precision}{ending}"] = {**kwargs, "n_steps": 3}
    if "" in compiled:
        ways["no auxiliary loss"] = {**encoder, "aux_loss": None}
        if setting == "small":
            ways |= {"simba, no auxiliary loss": {"aux_loss": None}, "simba, AARL-State": {"aux_loss": "aarl-state"}}
    return ways


def synchronize(device: str) -> None:
    if device == "cuda":
        th.cuda.synchronize()


def peak(device: str, dtype: th.dtype, setting: str) -> float:
    """
    Floating point operations a second of the product that dominates a step: (batch, width) x (width, width). On a GPU, where
    Python would take longer than that, of a large one.
    """
    batch, width, n = (8192, 8192, 20) if device == "cuda" else (BATCH[setting], WIDTH[setting], 5)
    one, other = th.randn(batch, width, device=device).to(dtype), th.randn(width, width, device=device).to(dtype)
    seconds = []
    for _ in range(10):
        started = time.perf_counter()
        for _ in range(n):
            one @ other
        synchronize(device)
        seconds.append((time.perf_counter() - started) / n)
    return 2 * batch * width * width / min(seconds)


def flops(model: SAC, steps: int = 4) -> float:
    """Floating point operations of matrix products and convolutions in one gradient step, the mean of some."""
    with FlopCounterMode(display=False) as counter:
        model.train(steps, model.batch_size)
    return counter.get_total_flops() / steps


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
    }
    optimizers["auxiliary"] = [model.aux_optimizer]
    hooks = [
        optimizer.register_step_post_hook(lambda *_, part=part: ends(part))
        for part, some in optimizers.items()
        for optimizer in some
        if optimizer is not None
    ]
    methods = {"_sample": "sampling", "_update_target": "targets"}
    for name, part in methods.items():
        setattr(model, name, timed(getattr(model, name), part))
    synchronize(device)
    last = time.perf_counter()
    model.train(steps, model.batch_size)
    for hook in hooks:
        hook.remove()
    for name in methods:
        delattr(model, name)
    return {part: 1e3 * value / steps for part, value in seconds.items()}


def compiling(name: str) -> Any:
    """While a model is made: SACAux compiles its losses as the name of its row says."""
    options = next((options for ending, options in COMPILED.items() if name.endswith(ending)), {})

    def compile_losses(function: Callable, **_: Any) -> Callable:
        return torch_compile(function, options={"fallback_random": True, **options})

    return mock.patch.object(th, "compile", compile_losses)


def measure(
    setting: str, device: str, variants: dict[str, dict[str, Any]], rounds: int, steps: int, at_once: int = 1
) -> list[dict[str, Any]]:
    models: dict[str, SAC] = {}
    memory: dict[str, float] = {}
    for name in ("SB3 SAC", *variants):
        before = th.cuda.memory_allocated() if device == "cuda" else 0
        with compiling(name):
            model = models[name] = sb3(setting, device) if name == "SB3 SAC" else ours(setting, device, **variants[name])
        model.set_logger(configure(None, []))
        # On a GPU time is short, and no cache of a processor plays a part.
        fill(model, TRANSITIONS[setting] // (5 if device == "cuda" else 1))
        if device == "cuda":
            th.cuda.reset_peak_memory_stats()
        model.train(8, model.batch_size)  # allocates, warms up, compiles
        if device == "cuda":
            memory[name] = (th.cuda.max_memory_allocated() - before) / 1e6
    seconds: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(rounds):
        for name, model in models.items():
            synchronize(device)
            started = time.perf_counter()
            calls = max(1, steps // at_once)
            for _ in range(calls):
                model.train(at_once, model.batch_size)
            synchronize(device)
            seconds[name].append((time.perf_counter() - started) / (calls * at_once))
    rows = []
    for name, model in models.items():
        bf16 = getattr(model, "precision", "fp32") == "bf16"
        row: dict[str, Any] = {
            "setting": setting,
            "algorithm": name,
            "ms": 1e3 * statistics.median(seconds[name]),
            "steps_per_second": 1 / statistics.median(seconds[name]),
            "memory_mb": memory.get(name),
            "ratio": statistics.median(own / base for own, base in zip(seconds[name], seconds["SB3 SAC"], strict=True)),
            "rounds_ms": [1e3 * value for value in seconds[name]],
            "gflop": flops(model) / 1e9,
            "peak_gflops": peak(device, th.bfloat16 if bf16 else th.float32, setting) / 1e9,
        }
        row["share_of_peak"] = row["gflop"] / row["peak_gflops"] / (row["ms"] / 1e3)
        if isinstance(model, SACAux):
            row["parts_ms"] = parts(model, device, 2 * steps)
        rows.append(row)
    float32_peak = max(row["peak_gflops"] for row in rows if "bf16" not in row["algorithm"])
    for row in rows if device == "cpu" and setting in REFERENCE_MS else []:
        row["ratio_to_reference"] = row["ms"] / (REFERENCE_MS[setting] * REFERENCE_GFLOPS / float32_peak)
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    columns = ["setting", "algorithm", "ms", "ratio", "GFLOP", "of peak", *PARTS, "reference"]
    table = Table(
        *columns, title="One gradient step (median; ratio to SB3's SAC; parts in ms; ratio to the reference, scaled)"
    )
    for row in rows:
        split = row.get("parts_ms", {})
        table.add_row(
            row["setting"],
            row["algorithm"],
            f"{row['ms']:.1f}" if row["ms"] >= 10 else f"{row['ms']:.3f}",
            f"{row['ratio']:.3f}",
            f"{row['gflop']:.1f}",
            f"{row['share_of_peak']:.0%}",
            *(f"{split[part]:.2f}" if split else "" for part in PARTS),
            f"{row['ratio_to_reference']:.3f}" if "ratio_to_reference" in row else "",
        )
    Console(width=160).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--settings", nargs="+", default=list(BATCH), choices=list(BATCH))
    parser.add_argument("--device", default="cuda" if th.cuda.is_available() else "cpu", choices=["cpu", "cuda"])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--steps", type=int, help="gradient steps of each algorithm in a round")
    parser.add_argument(
        "--at-once", type=int, default=1, help="gradient steps in a call of train(); learn() makes one in each"
    )
    ways = {"no": [""], "all": ["", ", compiled"], "only": [", compiled"], "graphs": [", CUDA graphs"]}
    parser.add_argument("--compiled", choices=list(ways), default="all", help="by SACAux, or with CUDA graphs too")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()

    rows, threads = [], th.get_num_threads()
    for setting in args.settings:
        th.set_num_threads(1 if setting == "small" else threads)
        steps = args.steps or (200 if args.device == "cuda" else STEPS[setting])
        rows += measure(setting, args.device, modes(setting, ways[args.compiled]), args.rounds, steps, args.at_once)
        show(rows)
        if args.out:  # after each setting: what comes later may be cut off
            save_result(args.out, threads=threads, rows=rows)


if __name__ == "__main__":
    main()
