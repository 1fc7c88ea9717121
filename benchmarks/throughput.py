"""
Many training runs on one machine at once: gradient steps a second of 1, 2, 4, ... processes, and the hours of a whole search.

Every process trains a model of its own, as ``train_step.py`` makes it, on random data for some seconds, all at the same time.
From the total follow the hours that the gradient steps of a search take (the paper's: about 700 candidates, 500,000
environment steps each, one gradient step for each agent step of 4 environment steps). Environments come on top, see
``env_steps.py``.
"""

import argparse
import multiprocessing
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from threading import BrokenBarrierError
from typing import Any

import torch as th
from rich.console import Console
from rich.table import Table
from saving import save_result
from stable_baselines3.common.logger import configure
from train_step import BATCH, fill, modes, ours, synchronize

CANDIDATES = 700
GRADIENT_STEPS = 500_000 // 4


barrier: Any = None  # of each worker


def begin(shared: Any) -> None:
    global barrier
    barrier = shared


def rate(setting: str, device: str, mode: str, threads: int, seconds: float) -> float:
    """One process: gradient steps a second while all others train too."""
    try:
        th.set_num_threads(threads)
        model = ours(setting, device, **modes(setting, ["", ", compiled"])[mode])
        model.set_logger(configure(None, []))
        fill(model, 2000)
        model.train(10 if device == "cuda" else 2, BATCH[setting])
        synchronize(device)
        barrier.wait(timeout=300)
    except Exception:
        barrier.abort()  # so that the others do not wait
        raise
    started = time.perf_counter()
    steps = 0
    # All start together and train for the same time: no process has the machine to itself.
    while time.perf_counter() - started < seconds:
        model.train(20 if device == "cuda" else 2, BATCH[setting])
        synchronize(device)
        steps += 20 if device == "cuda" else 2
    return steps / (time.perf_counter() - started)


def total(setting: str, device: str, mode: str, processes: int, threads: int, seconds: float) -> float:
    """
    Gradient steps a second of all processes together.

    :raises Exception: that of a process that failed, as when they do not fit into the GPU's memory
    """
    context = multiprocessing.get_context("spawn")
    shared = context.Barrier(processes)
    with ProcessPoolExecutor(processes, context, initializer=begin, initargs=(shared,)) as pool:
        futures = [pool.submit(rate, setting, device, mode, threads, seconds) for _ in range(processes)]
    errors = [error for future in futures if (error := future.exception()) is not None]
    if errors:
        raise next((error for error in errors if not isinstance(error, BrokenBarrierError)), errors[0])
    return sum(future.result() for future in futures)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    device = "cuda" if th.cuda.is_available() else "cpu"
    parser.add_argument("--settings", nargs="+", default=["state"], choices=["state", "small", "pixels"])
    parser.add_argument("--device", default=device, choices=["cpu", "cuda"])
    names = list(modes("pixels", ["", ", compiled"]))
    parser.add_argument("--modes", nargs="+", default=names, choices=names)
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
                row = {"setting": setting, "mode": mode, "processes": processes, "threads": threads}
                try:
                    steps = total(setting, args.device, mode, processes, threads, args.seconds)
                    hours = CANDIDATES * GRADIENT_STEPS / steps / 3600
                    rows.append({**row, "steps_per_second": steps, "search_hours": hours})
                    table.add_row(*map(str, row.values()), f"{steps:,.1f}", f"{hours:,.0f}")
                except Exception as error:  # out of memory, mostly: the other rows are worth having
                    traceback.print_exc()
                    rows.append({**row, "error": f"{type(error).__name__}: {error}"})
                    table.add_row(*map(str, row.values()), type(error).__name__, "")
                if args.out:  # after each row: a device may be lost
                    save_result(args.out, device=args.device, rows=rows)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
