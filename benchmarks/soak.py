"""
Does a search survive? Its runs are killed at random, its driver three times, PostgreSQL is restarted; it must end as if
nothing had been: every slot with the loss and the score of an undisturbed search with one worker.

    python benchmarks/soak.py [--storage sqlite postgresql] [--generations 4] [--kill-seconds 4]
"""

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import optuna
import psutil
from optuna.trial import TrialState
from saving import save_result
from sb3_aarl.search.evolution.space import loss_of
from sb3_aarl.search.execution.storage import open_storage

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from postgres import Postgres
from tiny import SEARCH, write_search


def start(*arguments: object, folder: Path) -> subprocess.Popen[str]:
    """The program ``aarl`` as a process of its own."""
    command = [sys.executable, "-m", "sb3_aarl.search.cli.main", *map(str, arguments)]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def slots(folder: Path, url: str | None) -> dict[str, Any]:
    """Loss and score of each slot."""
    study = optuna.load_study(study_name="small", storage=open_storage(folder / "runs/small", url, create=False))
    return {
        f"{trial.user_attrs['generation']}/{trial.user_attrs['slot']}": [str(loss_of(trial)), trial.value]
        for trial in study.get_trials(states=(TrialState.COMPLETE,))
    }


def disturb(config: Path, folder: Path, url: str | None, server: Postgres | None, kill_seconds: float) -> dict[str, int]:
    """Run a search to its end against a killer; how often it killed what."""
    rng = random.Random(0)
    counts = {"killed runs": 0, "killed drivers": 0, "restarted servers": 0}
    arguments = ["search", config, "--workers", 4] + ([] if url is None else ["--storage", url])
    process = start(*arguments, folder=folder)
    began = time.monotonic()
    while process.poll() is None:
        time.sleep(rng.uniform(0, 2 * kill_seconds))
        minutes = (time.monotonic() - began) / 60
        if counts["killed drivers"] < 3 and minutes > counts["killed drivers"] + 0.5:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            process = start(*arguments, folder=folder)
            counts["killed drivers"] += 1
        elif server is not None and not counts["restarted servers"] and minutes > 1:
            server.crash()
            time.sleep(5)
            server.start()
            counts["restarted servers"] += 1
        elif runs := psutil.Process(process.pid).children() if process.poll() is None else []:
            rng.choice(runs).kill()
            counts["killed runs"] += 1
    output, _ = process.communicate()
    if process.returncode != 0:
        raise RuntimeError(output)
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--storage", nargs="+", choices=["sqlite", "postgresql"], default=["sqlite", "postgresql"])
    parser.add_argument("--generations", type=int, default=4)
    parser.add_argument("--kill-seconds", type=float, default=4.0, help="mean seconds between two kills")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results/soak.json")
    options = parser.parse_args()
    text = SEARCH.replace("generations: 2", f"generations: {options.generations}").replace("retries: 50", "retries: 1000")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "expected").mkdir()
        subprocess.run(
            [sys.executable, "-m", "sb3_aarl.search.cli.main", "search", str(write_search(folder / "expected", text))],
            cwd=folder / "expected",
            check=True,
        )
        expected = slots(folder / "expected", None)
        found: dict[str, Any] = {}
        for kind in options.storage:
            (folder / kind).mkdir()
            server = Postgres() if kind == "postgresql" else None
            url = None if server is None else server.create("soak")
            began = time.monotonic()
            counts = disturb(write_search(folder / kind, text), folder / kind, url, server, options.kill_seconds)
            equal = slots(folder / kind, url) == expected
            found[kind] = {**counts, "seconds": round(time.monotonic() - began), "slots": len(expected), "equal": equal}
            print(kind, found[kind], flush=True)
            if server is not None:
                server.close()
    save_result(options.out, **found)
    sys.exit(0 if all(result["equal"] for result in found.values()) else 1)


if __name__ == "__main__":
    main()
