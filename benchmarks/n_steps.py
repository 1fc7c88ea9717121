"""
What three-step returns cost in the replay buffer, beside SB3's own buffers in the same process: CPU time of a batch of 256.

Vectors of 17 numbers, episodes of 1000 steps, a buffer as large as the defaults' of which a fiftieth is full.
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from rich.console import Console
from rich.table import Table
from saving import save_result
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

from sb3_aarl.buffers import WindowReplayBuffer

STATES, ACTIONS = spaces.Box(-1, 1, (17,), np.float32), spaces.Box(-1, 1, (6,), np.float32)
BATCH, DRAWS = 256, 50


def fill(buffer: ReplayBuffer, transitions: int) -> ReplayBuffer:
    """Random transitions in episodes of 1000 steps."""
    rng = np.random.default_rng(0)
    obs = rng.normal(size=(1, 17)).astype(np.float32)
    for step in range(transitions):
        next_obs, done = rng.normal(size=(1, 17)).astype(np.float32), step % 1000 == 999
        rest = (rng.uniform(-1, 1, (1, 6)), rng.normal(size=1), np.array([done]), [{"TimeLimit.truncated": done}])
        buffer.add(obs, next_obs, *rest)
        obs = next_obs
    return buffer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--buffer-size", type=int, default=1_000_000)
    parser.add_argument("--transitions", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()

    n_step: dict[str, Any] = {"n_steps": 3, "gamma": 0.99}
    buffers: dict[str, ReplayBuffer] = {
        "SB3": ReplayBuffer(args.buffer_size, STATES, ACTIONS, "cpu"),
        "SB3, three steps": NStepReplayBuffer(args.buffer_size, STATES, ACTIONS, "cpu", **n_step),
        "ours": WindowReplayBuffer(args.buffer_size, STATES, ACTIONS, "cpu"),
        "ours, three steps": WindowReplayBuffer(args.buffer_size, STATES, ACTIONS, "cpu", **n_step),
    }
    milliseconds: dict[str, list[float]] = {name: [] for name in buffers}
    for buffer in buffers.values():
        fill(buffer, args.transitions).sample(BATCH)
    for _ in range(args.rounds):
        for name, buffer in buffers.items():
            started = time.process_time()
            for _ in range(DRAWS):
                buffer.sample(BATCH)
            milliseconds[name].append(1e3 * (time.process_time() - started) / DRAWS)

    table = Table("buffer", "ms")
    rows = [{"buffer": name, "ms": statistics.median(values)} for name, values in milliseconds.items()]
    for row in rows:
        table.add_row(str(row["buffer"]), f"{row['ms']:.2f}")
    Console().print(table)
    if args.out:
        save_result(args.out, buffer_size=args.buffer_size, transitions=args.transitions, rows=rows)


if __name__ == "__main__":
    main()
