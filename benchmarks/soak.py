"""
Does a search survive? Workers are killed at random, the database is restarted, and the search must end as if nothing had been.

The search trains real candidates (SACAux on Pendulum-v1, tiny networks), so that checkpoints, notes and curves are real too.
It runs twice for each storage: undisturbed, with two workers; and with ``aarl search`` and ``aarl worker`` side by side, where
the second runs in a process namespace of its own (if this process may make one), so that its dead are recognised by their
heartbeats as those of another machine are. A killer sends SIGKILL to a random worker every few seconds, now and then to one
of the two programs, which are started again; PostgreSQL is restarted once, half way through.

At the end every place of every stage must have exactly one completed trial, with the loss and the score of the undisturbed
run.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import optuna
import psutil
from optuna.trial import FrozenTrial, TrialState

from search.evolution.space import params_to_loss
from search.execution.storage import open_storage
from search.training.provenance import save_result

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from postgres import Postgres

HYPERPARAMETERS = """\
default:
  policy: MlpPolicy
  n_timesteps: 240
  learning_starts: 60
  batch_size: 16
  buffer_size: 240
  policy_kwargs: {net_arch: [16], features_extractor_class: mlp, features_extractor_kwargs: {features_dim: 8}}
"""
CONFIG = """\
environment: Pendulum-v1
hyperparameters: hyperparameters.yml
checkpoints: [80, 160, 240]
evaluation_episodes: 1
stages: STAGES
n_random: 24
n_prior: 6
population_size: 30
max_horizon: 3
retries: 100
"""
AARL = [sys.executable, "-m", "search.cli.main"]


class Program:
    """
    One of the two programs, started again whenever it dies.

    :param arguments: Of ``aarl``
    :param folder: Where it runs
    :param apart: Whether in a process namespace of its own
    """

    def __init__(self, arguments: list[str], folder: Path, apart: bool):
        unshare = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child"] if apart else []
        self._command = [*unshare, *AARL, *arguments]
        self._folder = folder
        self._log = (folder / f"{arguments[0]}.log").open("a")
        self.restarts = -1
        self.start()

    def start(self) -> None:
        """Start it."""
        self.restarts += 1
        environment = {**os.environ, "COLUMNS": "200", "PYTHONPATH": str(Path(__file__).parent.parent)}
        self.process = subprocess.Popen(
            self._command, cwd=self._folder, stdout=self._log, stderr=subprocess.STDOUT, env=environment
        )

    def workers(self) -> list[psutil.Process]:
        """Its worker processes."""
        with psutil_errors():
            children = psutil.Process(self.process.pid).children(recursive=True)
            return [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        return []


@contextmanager
def psutil_errors() -> Iterator[None]:
    """Processes that are gone meanwhile are no news here."""
    try:
        yield
    except psutil.Error:
        return


def may_unshare() -> bool:
    """Whether this process may make process namespaces."""
    command = ["unshare", "--pid", "--fork", "--mount-proc", "true"]
    return shutil.which("unshare") is not None and subprocess.run(command, capture_output=True).returncode == 0


def filled(trials: list[FrozenTrial]) -> dict[tuple[int, int], list[tuple[str, float]]]:
    """Loss and score of the completed trials of every place."""
    places: dict[tuple[int, int], list[tuple[str, float]]] = {}
    for trial in trials:
        if trial.state == TrialState.COMPLETE:
            assert trial.value is not None
            place = (trial.user_attrs["stage"], trial.user_attrs["place"])
            places.setdefault(place, []).append((str(params_to_loss(trial.params)), trial.value))
    return places


def study_of(where: str) -> optuna.Study:
    """The search's study."""
    return optuna.load_study(study_name="soak", storage=open_storage(where, create=False))


def make_folder(parent: Path, name: str, n_stages: int) -> Path:
    """A folder with the configuration of the search."""
    folder = parent / name
    folder.mkdir()
    (folder / "hyperparameters.yml").write_text(HYPERPARAMETERS)
    (folder / "soak.yml").write_text(CONFIG.replace("STAGES", str(n_stages)))
    return folder


def soak(
    where: str, folder: Path, n_workers: int, seconds: float, expected: dict[Any, Any], postgres: Postgres | None, seed: int
) -> dict[str, Any]:
    """
    A disturbed search.

    :param where: Its storage
    :param folder: Where it runs
    :param n_workers: Workers of both programs together
    :param seconds: Mean time between two kills
    :param expected: What :func:`filled` gives for the undisturbed one
    :param postgres: The server to restart, None for SQLite
    :param seed: Of the killer
    """
    rng = random.Random(seed)
    apart = may_unshare()
    options = ["--storage", where, "--threads", "1", "--heartbeat", "5"]
    half = str(n_workers // 2)
    first = Program(["search", "soak.yml", "--workers", half, *options], folder, apart=False)
    while not (folder / "runs/soak/config/soak.yml").exists():  # a first worker has read what the study says
        time.sleep(0.2)
    second = Program(["worker", "--study", "soak", "--workers", half, *options], folder, apart)
    kills: Counter[str] = Counter()
    started, restarted = time.monotonic(), 0.0
    trials: list[FrozenTrial] = []
    while len(filled(trials)) < len(expected):
        time.sleep(rng.expovariate(1 / seconds))
        for program in (first, second):
            if program.process.poll() is not None and len(filled(trials)) < len(expected):
                program.start()
        program = rng.choice((first, second))
        if rng.random() < 0.05:
            program.process.kill()
            program.process.wait()
            kills["programs"] += 1
        elif workers := program.workers():
            with psutil_errors():
                rng.choice(workers).send_signal(signal.SIGKILL)
                kills["workers"] += 1
        if postgres is not None and not restarted and len(filled(trials)) > len(expected) / 2:
            before = time.monotonic()
            postgres.restart(seconds=3)
            restarted = time.monotonic() - before
        trials = study_of(where).get_trials(deepcopy=False)
        print(
            f"{time.monotonic() - started:.0f} s: {len(filled(trials))}/{len(expected)} places, kills {dict(kills)}",
            flush=True,
        )
    took = time.monotonic() - started
    for program in (first, second):
        if program.process.poll() is None:
            program.process.wait(timeout=120)

    trials = study_of(where).get_trials(deepcopy=False)
    places = filled(trials)
    reasons = Counter(trial.user_attrs.get("reason", "-") for trial in trials if trial.state == TrialState.FAIL)
    undisturbed = {place: results[0] for place, results in expected.items()}
    best = max(score for _, score in undisturbed.values())
    return {
        "storage": where.partition(":")[0],
        "places": len(expected),
        "filled": len(places),
        "filled_twice": sum(len(results) > 1 for results in places.values()),
        "losses_trained_twice": len(places) - len({results[0][0] for results in places.values()}),
        "other_loss_than_undisturbed": sum(places[place][0][0] != loss for place, (loss, _) in undisturbed.items()),
        "other_score_than_undisturbed": sum(places[place][0][1] != score for place, (_, score) in undisturbed.items()),
        "best": max(results[0][1] for results in places.values()),
        "best_undisturbed": best,
        "trials": len(trials),
        "states": {state.name: count for state, count in Counter(trial.state for trial in trials).items()},
        "retries_by_reason": dict(reasons),
        "kills": dict(kills),
        "programs_started_again": first.restarts + second.restarts,
        "own_process_namespace": apart,
        "postgres_restart_seconds": round(restarted, 1),
        "minutes": round(took / 60, 1),
        "exit_codes": [first.process.returncode, second.process.returncode],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=8)
    parser.add_argument("--stages", type=int, default=4, help="of 30 candidates each")
    often = "mean time between two kills; more where workers take long to begin: all of them must not die before"
    parser.add_argument("--seconds", type=float, default=4.0, help=often)
    parser.add_argument("--storages", nargs="+", default=["sqlite", "postgresql"], choices=["sqlite", "postgresql"])
    parser.add_argument("--seed", type=int, default=0, help="of the killer")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with tempfile.TemporaryDirectory() as parent:
        alone = make_folder(Path(parent), "alone", args.stages)
        started = time.monotonic()
        command = [*AARL, "search", "soak.yml", "--workers", "2", "--threads", "1"]
        root = str(Path(__file__).parent.parent)
        subprocess.run(command, cwd=alone, check=True, stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": root})
        expected = filled(study_of(str(alone / "runs/soak")).get_trials(deepcopy=False))
        print(f"undisturbed: {len(expected)} places in {time.monotonic() - started:.0f} s", flush=True)
        runs = []
        for kind in args.storages:
            folder = make_folder(Path(parent), kind, args.stages)
            if kind == "sqlite":
                runs.append(
                    soak(f"sqlite:///{folder}/study.db", folder, args.workers, args.seconds, expected, None, args.seed)
                )
            else:
                with closing(Postgres()) as postgres:
                    where = postgres.create("soak")
                    runs.append(soak(where, folder, args.workers, args.seconds, expected, postgres, args.seed))
            print(json.dumps(runs[-1], indent=1), flush=True)
    if args.out:
        save_result(args.out, workers=args.workers, seconds_between_kills=args.seconds, seed=args.seed, runs=runs)


if __name__ == "__main__":
    main()
