"""
How fast the replay buffer gives images, and what a transition takes, beside SB3's own buffer in the same process.

Windows of horizon 3 (4 observations) of three stacked frames of 100 x 100 x 3, randomly cropped to 84 x 84, batch 128: 512
observations. SB3's buffer gives as many as 256 transitions, whole. Both draw from rings of the same length, in turns.
"""

import argparse
import gc
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch as th
from gymnasium import spaces
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_aarl.buffers import WindowReplayBuffer
from search.training.provenance import save_result

IMAGES = spaces.Box(0, 255, (9, 100, 100), np.uint8)
ACTIONS = spaces.Box(-1, 1, (6,), np.float32)
BATCH, HORIZON, CROP = 128, 3, 84


def resident() -> int:
    gc.collect()
    return psutil.Process().memory_info().rss


def fill(buffer: ReplayBuffer, transitions: int) -> None:
    """Random frames in episodes of 250 agent steps."""
    rng = np.random.default_rng(0)
    pool = rng.integers(0, 256, (64, 3, 100, 100), np.uint8)
    for step in range(transitions):
        if step % 250 == 0:
            obs = np.concatenate([pool[step % 64]] * 3)
        next_obs = np.concatenate([obs[3:], pool[rng.integers(64)]])
        over = step % 250 == 249
        rest = (rng.uniform(-1, 1, (1, 6)), rng.normal(size=1), np.array([over]), [{"TimeLimit.truncated": over}])
        buffer.add(obs[None], next_obs[None], *rest)
        obs = next_obs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transitions", type=int, default=10_000, help="length of both rings (SB3's takes 180 kB each)")
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument(
        "--device", default="cpu", help="device of what is drawn, and of the frames in the last row if not cpu"
    )
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()

    bytes_each: dict[str, float] = {}

    def make(name: str, cls: type[ReplayBuffer], **kwargs: Any) -> Any:
        before = resident()
        buffer = cls(args.transitions, IMAGES, ACTIONS, args.device, **kwargs)
        fill(buffer, args.transitions)
        bytes_each[name] = (resident() - before) / args.transitions
        return buffer

    draws: dict[str, Callable[[], Any]] = {}
    theirs = make("SB3", ReplayBuffer)
    draws["SB3"] = lambda: theirs.sample(BATCH * (HORIZON + 1) // 2)
    ours = make("windows, cropped", WindowReplayBuffer, frame_stack=3)
    draws["windows, cropped"] = lambda: ours.sample_windows(BATCH, HORIZON, crop_size=CROP)
    draws["windows, whole"] = lambda: ours.sample_windows(BATCH, HORIZON)
    draws["transitions, cropped"] = lambda: ours.sample(BATCH * (HORIZON + 1) // 2, crop_size=CROP)
    if args.device != "cpu":
        there = make("windows, cropped, on the device", WindowReplayBuffer, frame_stack=3, storage_device=args.device)
        draws["windows, cropped, on the device"] = lambda: there.sample_windows(BATCH, HORIZON, crop_size=CROP)

    seconds: dict[str, list[float]] = {name: [] for name in draws}
    for i in range(args.rounds + 1):
        for name, draw in draws.items():
            started = time.perf_counter()
            draw()
            if args.device != "cpu":
                th.cuda.synchronize()
            if i:  # the first one warms up
                seconds[name].append(time.perf_counter() - started)

    names = ("what is drawn", "ms", "windows a second", "observations a second", "times SB3's rate", "bytes a transition")
    table = Table(*names)
    rows = []
    for name, values in seconds.items():
        row: dict[str, Any] = {
            "draw": name,
            "ms": 1e3 * statistics.median(values),
            "windows_per_second": BATCH / statistics.median(values) if name.startswith("windows") else None,
            "observations_per_second": BATCH * (HORIZON + 1) / statistics.median(values),
            "times_sb3": statistics.median(base / own for own, base in zip(values, seconds["SB3"], strict=True)),
            "bytes_per_transition": bytes_each.get(name),
        }
        rows.append(row)
        windows, size = (
            "" if row[key] is None else f"{row[key]:,.0f}" for key in ("windows_per_second", "bytes_per_transition")
        )
        rate = f"{row['observations_per_second']:,.0f}"
        table.add_row(name, f"{row['ms']:.2f}", windows, rate, f"{row['times_sb3']:.2f}", size)
    Console().print(table)
    if args.out:
        save_result(args.out, transitions=args.transitions, rows=rows)


if __name__ == "__main__":
    main()
