"""
Many workers on one study: are the stages filled exactly, by different trials, without a locked database and idle workers?

Eight processes run a whole search on a cheap objective (it trains nothing, and sleeps as long as --seconds says), on a
journal file and on SQLite. Idle is what a worker spends asking for a candidate: storage, planning and waiting.
"""

import argparse
import json
import multiprocessing
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend

from search.evolution.sampler import AuxLossSampler, SearchComplete
from search.evolution.space import params_to_loss, suggest_aux_loss
from search.training.provenance import save_result


def open_storage(kind: str, folder: str) -> BaseStorage:
    """A storage that several processes may use."""
    if kind == "journal":
        return JournalStorage(JournalFileBackend(f"{folder}/journal.log"))
    # SQLite gives up after 5 s by default, which many writers can reach.
    return RDBStorage(f"sqlite:///{folder}/study.db", engine_kwargs={"connect_args": {"timeout": 120}})


def work(start: Any, results: Any, kind: str, folder: str, n_stages: int, seconds: float) -> None:
    """One worker; reports its asks and errors."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = AuxLossSampler(seed=0, n_stages=n_stages)
    study = optuna.load_study(study_name="study", storage=open_storage(kind, folder), sampler=sampler)
    rng = np.random.default_rng()
    start.wait()
    asking, error = [], ""
    try:
        while True:
            started = time.perf_counter()
            trial = study.ask()
            asking.append(time.perf_counter() - started)
            loss = suggest_aux_loss(trial)
            time.sleep(seconds * rng.uniform(0.5, 1.5))
            if rng.random() < 0.05:
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
            else:
                study.tell(trial, sum(loss.target) - sum(loss.source))
    except SearchComplete:
        pass
    except Exception as problem:
        error = repr(problem)
    results.put((asking, error))


def measure(kind: str, n_workers: int, n_stages: int, seconds: float) -> dict[str, Any]:
    """Run a search; what became of it."""
    context = multiprocessing.get_context("spawn")
    start, results = context.Barrier(n_workers + 1), context.Queue()
    with tempfile.TemporaryDirectory() as folder:
        study = optuna.create_study(study_name="study", storage=open_storage(kind, folder), direction="maximize")
        arguments = (start, results, kind, folder, n_stages, seconds)
        crew = [context.Process(target=work, args=arguments) for _ in range(n_workers)]
        for process in crew:
            process.start()
        start.wait()
        started = time.perf_counter()
        reports = [results.get() for _ in crew]
        took = time.perf_counter() - started
        for process in crew:
            process.join()
        complete = study.get_trials(states=(optuna.trial.TrialState.COMPLETE,))
        places = Counter((trial.user_attrs["stage"], trial.user_attrs["place"]) for trial in complete)
        asks = np.array([ask for asking, _ in reports for ask in asking])
        return {
            "storage": kind,
            "workers": n_workers,
            "complete_by_stage": dict(Counter(stage for stage, _ in places)),
            "complete": len(complete),
            "places_filled_twice": sum(count > 1 for count in places.values()),
            "losses_trained_twice": len(complete) - len({params_to_loss(trial.params).canonical() for trial in complete}),
            "failed": sum("stage" in t.user_attrs for t in study.get_trials(states=(optuna.trial.TrialState.FAIL,))),
            "errors": [error for _, error in reports if error],
            "seconds": round(took, 1),
            "ask_median_ms": round(1000 * float(np.median(asks)), 1),
            "ask_max_s": round(float(asks.max()), 2),
            "idle_share": round(float(asks.sum() / (n_workers * took)), 3),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=8)
    parser.add_argument("--stages", type=int, default=5, help="125 candidates, then 100 in each")
    parser.add_argument("--seconds", type=float, default=0.0, help="how long a candidate takes, 0.5 to 1.5 times that")
    parser.add_argument("--storages", nargs="+", default=["journal", "sqlite"], choices=["journal", "sqlite"])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    rows = []
    for kind in args.storages:
        rows.append(measure(kind, args.workers, args.stages, args.seconds))
        print(json.dumps(rows[-1], indent=1), flush=True)
    if args.out:
        save_result(args.out, seconds=args.seconds, runs=rows)


if __name__ == "__main__":
    main()
