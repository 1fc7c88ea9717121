"""How far a search with the matrices in its folder is, or a benchmark. Nothing is started."""

import inspect
from collections import defaultdict
from pathlib import Path
from typing import Any

import optuna
import pandas as pd
from filelock import FileLock, Timeout

from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.callbacks import aulc
from search.evolution.sampler import AuxLossSampler
from search.execution import driver
from search.studies.search import SETTINGS_KEY
from search.training.provenance import read_about
from search.training.run import LOCK, RUN, Outcome, read_outcome

# Folders of matrices in that of a search.
PARTS = ("baselines", "cross-validation", "operators")


def search_status(study: optuna.Study, folder: Path) -> tuple[driver.SearchProgress, bool]:
    """The progress of a search, and whether its driver runs on this machine."""
    settings = dict(study.user_attrs[SETTINGS_KEY])
    settings["initial"] = [AuxLoss.parse(loss) for loss in settings["initial"]]
    names = inspect.signature(AuxLossSampler).parameters
    sampler = AuxLossSampler(**{name: settings[name] for name in names if name in settings})
    return driver.search_progress(study, sampler), is_locked(folder / driver.LOCK)


def matrix_status(folder: Path) -> tuple[pd.DataFrame, float | None]:
    """
    One row for each variant of a matrix, with the mean AULC of what is done, None where it is of several environments; and the
    estimated seconds until all are over, None while that is not known.
    """
    runs: dict[str, list[tuple[Outcome | None, bool]]] = defaultdict(list)
    tasks: dict[str, set[str]] = defaultdict(set)
    for path in sorted(file.parent for file in folder.glob(f"*/*/*/{RUN}")):
        outcome = read_outcome(path)
        variant = read_about(path)["variant"]
        runs[variant].append((outcome, outcome is None and is_locked(path / LOCK)))
        tasks[variant].add(path.parent.name)
    rows: list[dict[str, Any]] = []
    seconds: list[float] = []
    for variant, found in runs.items():
        done = [outcome.curve for outcome, _ in found if outcome is not None and outcome.failure is None]
        seconds += [curve[-1].seconds for curve in done]
        row = {"variant": variant, "runs": len(found), "done": len(done), "running": sum(runs for _, runs in found)}
        row["failed"] = sum(outcome is not None for outcome, _ in found) - len(done)
        rows.append({**row, "score": sum(map(aulc, done)) / len(done) if done and len(tasks[variant]) == 1 else None})
    table = pd.DataFrame(rows, columns=["variant", "runs", "done", "running", "failed", "score"])
    left = int((table["runs"] - table["done"] - table["failed"]).sum())
    to_go = sum(seconds) / len(seconds) * left / max(1, int(table["running"].sum())) if seconds else None
    return table, to_go


def is_locked(path: Path) -> bool:
    """Whether a process holds a lock."""
    if not path.exists():
        return False
    try:
        with FileLock(path, timeout=0, fallback_to_soft=False):
            return False
    except Timeout:
        return True
