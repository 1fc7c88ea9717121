"""
What asking for a candidate costs: study.ask() and all suggestions, in memory, after 100 to 10,000 finished trials.

The study is filled by the sampler itself. 200 asks follow at each size, each trial finished at once, so that with
AuxLossSampler two whole generations pass: the first asks of a generation, with the choice of parents and the fit of the model,
are among them. Python's collection of garbage, which looks at all objects of the process, is measured separately.
"""

import argparse
import gc
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import optuna
from optuna.samplers import BaseSampler, NSGAIISampler
from saving import save_result
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import suggest_aux_loss

SAMPLERS: dict[str, Callable[[], BaseSampler]] = {
    "AuxLossSampler": lambda: AuxLossSampler(seed=0),
    "screening=32": lambda: AuxLossSampler(seed=0, screening=32),
    "NSGAIISampler": lambda: NSGAIISampler(seed=0),
}


def measure(sampler: BaseSampler, sizes: list[int], n_asks: int) -> list[dict[str, float]]:
    """
    Median and maximum at each size, in milliseconds, of the time without collections of garbage; also of processor time, which
    other processes do not change, and the longest collection.
    """
    gc.collect()  # the study before has many objects: not in the middle of this one
    collecting: list[float] = []  # when each began, and then how long it took

    def note(phase: str, info: dict[str, int]) -> None:
        collecting.append(time.perf_counter() if phase == "start" else time.perf_counter() - collecting.pop())

    gc.callbacks.append(note)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    rng = np.random.default_rng(0)
    seconds: list[tuple[float, float, float]] = []
    rows = []
    for size in sizes:
        while len(seconds) < size + n_asks:
            collecting.clear()
            started, cpu_started = time.perf_counter(), time.process_time()
            trial = study.ask()
            try:
                loss = suggest_aux_loss(trial).canonical()
            except optuna.TrialPruned:
                study.tell(trial, state=optuna.trial.TrialState.PRUNED)
                continue
            elapsed, of_cpu, garbage = time.perf_counter() - started, time.process_time() - cpu_started, sum(collecting)
            seconds.append((elapsed - garbage, of_cpu - garbage, garbage))
            study.tell(trial, 2 * sum(loss.target[::3]) - sum(loss.target) + sum(loss.source[1::3]) + rng.normal())
        wall, cpu, collected = 1000 * np.array(seconds[size:]).T
        row = {
            "median_ms": np.median(wall),
            "max_ms": wall.max(),
            "garbage_max_ms": collected.max(),
            "cpu_median_ms": np.median(cpu),
            "cpu_max_ms": cpu.max(),
        }
        rows.append({"finished": size, **{name: round(float(value), 2) for name, value in row.items()}})
    gc.callbacks.remove(note)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 1000, 3000, 10_000])
    parser.add_argument("--asks", type=int, default=200)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    tables = {}
    print(f"{'':16} finished   median ms   max ms   of the processor: median ms   max ms   garbage: max ms")
    for name, make_sampler in SAMPLERS.items():
        tables[name] = measure(make_sampler(), args.sizes, args.asks)
        for row in tables[name]:
            print(f"{name:16} {row['finished']:8} {row['median_ms']:11.2f} {row['max_ms']:8.2f}", end="")
            print(f"{row['cpu_median_ms']:30.2f} {row['cpu_max_ms']:8.2f} {row['garbage_max_ms']:17.2f}", flush=True)
    if args.out:
        save_result(args.out, asks=args.asks, tables=tables)


if __name__ == "__main__":
    main()
