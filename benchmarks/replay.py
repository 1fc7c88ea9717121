"""
Time to draw images from the replay buffer and memory of a transition, beside SB3's own buffer in the same process.

Windows of horizon 3 (4 observations) of three stacked frames of 100 x 100 x 3, randomly cropped to 84 x 84, batch 128: 512
observations. SB3's buffer returns as many as 256 transitions, whole. Both draw from rings of the same length, in turns.
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
from saving import save_result
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_aarl.buffers import WindowReplayBuffer

IMAGES = spaces.Box(0, 255, (9, 100, 100), np.uint8)
ACTIONS = spaces.Box(-1, 1, (6,), np.float32)
BATCH, HORIZON, CROP = 128, 3, 84


def fill(buffer: ReplayBuffer, transitions: int) -> float:
    """
    Random frames in episodes of 250 agent steps.

    :return: Bytes of resident memory for each transition
    """
    gc.collect()
    before = psutil.Process().memory_info().rss
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (64, 3, 100, 100), np.uint8)
    for step in range(transitions):
        if step % 250 == 0:
            obs = np.concatenate([frames[step % 64]] * 3)
        next_obs = np.concatenate([obs[3:], frames[rng.integers(64)]])
        done = step % 250 == 249
        rest = (rng.uniform(-1, 1, (1, 6)), rng.normal(size=1), np.array([done]), [{"TimeLimit.truncated": done}])
        buffer.add(obs[None], next_obs[None], *rest)
        obs = next_obs
    return (psutil.Process().memory_info().rss - before) / transitions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transitions", type=int, default=10_000, help="length of both rings (SB3's takes 180 kB each)")
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--device", default="cpu", help="device of the samples")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()

    theirs = ReplayBuffer(args.transitions, IMAGES, ACTIONS, args.device)
    ours = WindowReplayBuffer(args.transitions, IMAGES, ACTIONS, args.device, frame_stack=3)
    memory = {"SB3": fill(theirs, args.transitions), "windows, cropped": fill(ours, args.transitions)}
    draws: dict[str, Callable[[], Any]] = {
        "SB3": lambda: theirs.sample(BATCH * (HORIZON + 1) // 2),
        "windows, cropped": lambda: ours.sample_windows(BATCH, HORIZON, crop_size=CROP),
        "windows, whole": lambda: ours.sample_windows(BATCH, HORIZON),
        "transitions, cropped": lambda: ours.sample(BATCH * (HORIZON + 1) // 2, crop_size=CROP),
    }

    seconds: dict[str, list[float]] = {name: [] for name in draws}
    for i in range(args.rounds + 1):
        for name, draw in draws.items():
            started = time.perf_counter()
            draw()
            if args.device != "cpu":
                th.cuda.synchronize()
            if i:  # the first one warms up
                seconds[name].append(time.perf_counter() - started)

    table = Table("draw", "ms", "observations a second", "times SB3's rate", "bytes a transition")
    rows = []
    for name, values in seconds.items():
        median = statistics.median(values)
        row: dict[str, Any] = {
            "draw": name,
            "ms": 1e3 * median,
            "windows_per_second": BATCH / median if name.startswith("windows") else None,
            "observations_per_second": BATCH * (HORIZON + 1) / median,
            "times_sb3": statistics.median(base / own for own, base in zip(values, seconds["SB3"], strict=True)),
            "bytes_per_transition": memory.get(name),
        }
        rows.append(row)
        size = f"{memory[name]:,.0f}" if name in memory else ""
        table.add_row(name, f"{row['ms']:.2f}", f"{row['observations_per_second']:,.0f}", f"{row['times_sb3']:.2f}", size)
    Console().print(table)
    if args.out:
        save_result(args.out, transitions=args.transitions, rows=rows)


if __name__ == "__main__":
    main()
