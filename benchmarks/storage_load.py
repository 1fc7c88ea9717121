"""
What many workers get out of PostgreSQL behind the gRPC proxy: an instant objective on the loss's space.

Optuna writes every parameter, that is every token of a candidate, with a call and a transaction of its own: with horizons up
to 10 there are 37 a trial, with horizons up to 3 there are 15.

Workers are processes that ask, suggest a loss and tell. AuxLossSampler and Optuna's NSGAIISampler get the same load, each in
a database of its own. PostgreSQL (Debian's package, its settings as they come), the proxy and the workers share this machine.
"""

import argparse
import multiprocessing
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import psutil
from optuna.samplers import BaseSampler, NSGAIISampler
from optuna.trial import TrialState

from search.evolution.sampler import PLACE_KEY, AuxLossSampler
from search.evolution.space import suggest_aux_loss
from search.execution.storage import open_storage
from search.training.provenance import save_result

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from postgres import Postgres, free_port

STUDY = "load"
STARTING = 120  # seconds: a worker imports PyTorch
SAMPLERS: dict[str, Callable[[int, int], BaseSampler]] = {
    "AuxLossSampler": lambda seed, horizon: AuxLossSampler(seed=0, max_horizon=horizon),
    "NSGAIISampler": lambda seed, _: NSGAIISampler(population_size=100, seed=seed),
}


def work(where: str, name: str, seed: int, n_trials: int, max_horizon: int, taken: Any, start: Any, results: Any) -> None:
    """Ask and tell until all workers together have begun enough trials; put the times of each into ``results``."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.simplefilter("ignore")  # signs of life are meant for study.optimize
    sampler = SAMPLERS[name](seed, max_horizon)
    study = optuna.load_study(study_name=STUDY, storage=open_storage(where, patience=STARTING), sampler=sampler)
    seconds: list[tuple[float, float, float]] = []
    errors: list[str] = []
    start.wait()
    while True:
        with taken.get_lock():
            if taken.value == n_trials:
                break
            taken.value += 1
        try:
            began = time.perf_counter()
            trial = study.ask()
            asked = time.perf_counter()
            try:
                loss = suggest_aux_loss(trial, max_horizon)
                result: dict[str, Any] = {"values": 2.0 * sum(loss.target) - sum(loss.source)}
            except optuna.TrialPruned:
                result = {"state": TrialState.PRUNED}
            suggested = time.perf_counter()
            study.tell(trial, **result)
            seconds.append((asked - began, suggested - began, time.perf_counter() - suggested))
        except Exception as error:  # counted: none is expected
            errors.append(f"{type(error).__name__}: {error}"[:300])
    results.put((seconds, errors))


def cpu_seconds(pid: int) -> float:
    """Processor time of a process and its children, those that have ended included where they were waited for."""
    total = 0.0
    for process in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True)):
        try:
            total += sum(process.cpu_times()[:2])
        except psutil.NoSuchProcess:
            continue
    return total + sum(psutil.Process(pid).cpu_times()[2:4])


def measure(name: str, n_trials: int, n_workers: int, max_horizon: int, server: Postgres) -> dict[str, Any]:
    """The load with one sampler."""
    url, port = server.create(name.lower()), free_port()
    where = f"grpc://127.0.0.1:{port}"
    serve = f"from search.execution.storage import serve_proxy; serve_proxy({url!r}, port={port})"
    proxy = subprocess.Popen([sys.executable, "-c", serve])
    # Imports once, and forks the workers before anybody has threads.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["search.evolution.sampler", "search.execution.storage"])
    taken, start, results = context.Value("i", 0), context.Barrier(n_workers + 1), context.SimpleQueue()
    try:
        optuna.create_study(study_name=STUDY, storage=open_storage(where, patience=STARTING), direction="maximize")
        processes = [
            context.Process(target=work, args=(where, name, seed, n_trials, max_horizon, taken, start, results), daemon=True)
            for seed in range(n_workers)
        ]
        for process in processes:
            process.start()
        start.wait(STARTING)
        pids = {"PostgreSQL": server.pid, "proxy": proxy.pid}
        before = {part: cpu_seconds(pid) for part, pid in pids.items()}
        began = time.perf_counter()
        ended = [results.get() for _ in processes]
        elapsed = time.perf_counter() - began
        cpu = {part: round(cpu_seconds(pid) - before[part], 1) for part, pid in pids.items()}
        trials = optuna.load_study(study_name=STUDY, storage=open_storage(url, create=False)).get_trials(deepcopy=False)
    finally:
        proxy.kill()
        proxy.wait()
    milliseconds = 1000 * np.array([row for seconds, _ in ended for row in seconds])
    states = Counter(trial.state.name for trial in trials)
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE and PLACE_KEY in trial.system_attrs]
    places = Counter((trial.system_attrs[PLACE_KEY]["stage"], trial.system_attrs[PLACE_KEY]["place"]) for trial in complete)
    return {
        "trials_per_second": round(len(milliseconds) / elapsed, 2),
        "seconds": round(elapsed, 1),
        "cpu_seconds": cpu,
        "milliseconds": {
            what: {f"p{q}": round(float(np.percentile(times, q)), 1) for q in (50, 99)}
            for what, times in zip(("ask", "ask_and_suggest", "tell"), milliseconds.T, strict=True)
        },
        "states": dict(states),
        "errors": [error for _, errors in ended for error in errors],
        "places_filled_twice": sum(count > 1 for count in places.values()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=10_000, help="of each sampler")
    parser.add_argument("--workers", type=int, default=32)
    parser.add_argument("--max-horizon", type=int, default=10)
    parser.add_argument("--samplers", nargs="+", choices=SAMPLERS, default=list(SAMPLERS))
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    tables = {}
    with closing(Postgres()) as server:
        for name in args.samplers:
            tables[name] = row = measure(name, args.trials, args.workers, args.max_horizon, server)
            print(f"{name}: {row['trials_per_second']} trials/s, processor seconds {row['cpu_seconds']} of {row['seconds']}")
            for what, times in row["milliseconds"].items():
                print(f"    {what:16} median {times['p50']:8.1f} ms   99 % {times['p99']:8.1f} ms")
            print(
                f"    {row['states']}, {len(row['errors'])} errors, {row['places_filled_twice']} places filled twice",
                flush=True,
            )
            for error, count in Counter(row["errors"]).most_common(3):
                print(f"    {count} times {error}")
    if args.out:
        save_result(args.out, trials=args.trials, workers=args.workers, max_horizon=args.max_horizon, tables=tables)


if __name__ == "__main__":
    main()
