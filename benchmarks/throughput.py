"""
Many trainings on one machine at once: gradient steps a second of 1, 2, 4, ... processes, and the hours of a whole search.

Every process trains a model of its own, as ``train_step.py`` makes it, on random data for some seconds, all at the same time.
From the total follow the hours that the gradient steps of a search take (the paper's: about 700 candidates, 500,000
environment steps each, one gradient step for each agent step of 4 environment steps). Environments come on top, see
``env_steps.py``.
"""

import argparse
import multiprocessing
import time
from pathlib import Path
from typing import Any

import torch as th
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.logger import configure
from train_step import BATCH, fill, modes, ours, synchronize

from search.provenance import save_result

CANDIDATES = 700
GRADIENT_STEPS = 500_000 // 4


def train(setting: str, device: str, mode: str, threads: int, seconds: float, barrier: Any, queue: Any) -> None:
    """One process: gradient steps a second while all others train too."""
    th.set_num_threads(threads)
    model = ours(setting, device, **modes(device)[mode])
    model.set_logger(configure(None, []))
    fill(model, 2000)
    model.train(10 if device == "cuda" else 2, BATCH[setting])
    synchronize(device)
    barrier.wait()
    started = time.perf_counter()
    steps = 0
    # Nobody stops before all are done: the last ones would have the machine to themselves.
    while time.perf_counter() - started < seconds:
        model.train(20 if device == "cuda" else 2, BATCH[setting])
        synchronize(device)
        steps += 20 if device == "cuda" else 2
    queue.put(steps / (time.perf_counter() - started))


def total(setting: str, device: str, mode: str, processes: int, threads: int, seconds: float) -> float:
    """Gradient steps a second of all processes together."""
    context = multiprocessing.get_context("spawn")
    barrier, queue = context.Barrier(processes), context.Queue()
    arguments = (setting, device, mode, threads, seconds, barrier, queue)
    workers = [context.Process(target=train, args=arguments, daemon=True) for _ in range(processes)]
    for worker in workers:
        worker.start()
    rates = [queue.get(timeout=300) for _ in workers]
    for worker in workers:
        worker.join()
    return sum(rates)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    device = "cuda" if th.cuda.is_available() else "cpu"
    parser.add_argument("--settings", nargs="+", default=["state"], choices=["state", "pixels"])
    parser.add_argument("--device", default=device, choices=["cpu", "cuda"])
    parser.add_argument("--modes", nargs="+", default=list(modes(device)), choices=list(modes("cuda")))
    parser.add_argument("--processes", nargs="+", type=int, default=[1, 2] if device == "cpu" else [1, 2, 4, 8, 16])
    parser.add_argument("--cores", type=int, default=th.get_num_threads(), help="shared out among the processes as threads")
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()

    columns = ("setting", "mode", "processes", "threads each", "steps/s in all", "hours of a search")
    table = Table(*columns, title=f"Gradient steps a second, {args.device}")
    rows = []
    for setting in args.settings:
        for mode in args.modes:
            for processes in args.processes:
                threads = max(1, args.cores // processes)
                rate = total(setting, args.device, mode, processes, threads, args.seconds)
                hours = CANDIDATES * GRADIENT_STEPS / rate / 3600
                keys = ("setting", "mode", "processes", "threads", "steps_per_second", "search_hours")
                rows.append(dict(zip(keys, (setting, mode, processes, threads, rate, hours), strict=True)))
                table.add_row(setting, mode, str(processes), str(threads), f"{rate:,.1f}", f"{hours:,.0f}")
    Console(width=120).print(table)
    if args.out:
        save_result(args.out, device=args.device, rows=rows)


if __name__ == "__main__":
    main()
