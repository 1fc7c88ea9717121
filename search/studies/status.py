"""How far a search with the matrices in its folder is, or a benchmark. Nothing is started."""

import inspect
from collections import Counter
from pathlib import Path

import optuna
import pandas as pd
from optuna.storages import BaseStorage
from optuna.trial import TrialState
from sb3_aarl.search.evolution.sampler import AuxLossSampler, GenerationProgress
from sb3_aarl.search.execution import driver
from sb3_aarl.search.execution.matrix import scaled
from sb3_aarl.search.execution.queue import pace, seconds_to_go
from sb3_aarl.search.execution.storage import has_driver
from sb3_aarl.search.studies.search import stored_settings
from sb3_aarl.search.training.folder import RUN, is_running, partial_curve, read_outcome, read_run
from sb3_aarl.search.training.provenance import read_about

from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.callbacks import aulc

# Folders of matrices in that of a search.
PARTS = ("baselines", "cross-validation", "operators")


def search_status(study: optuna.Study, storage: BaseStorage, folder: Path) -> tuple[driver.SearchProgress, bool]:
    """
    The progress of a search, and whether its driver runs. All trials of a study without an ``AuxLossSampler`` count as one
    generation.
    """
    if settings := stored_settings(study):
        settings["initial"] = [AuxLoss.parse(loss) for loss in settings["initial"]]
        arguments = {name: settings[name] for name in inspect.signature(AuxLossSampler).parameters if name in settings}
        generations = AuxLossSampler(**arguments).progress(study)
    else:
        states = Counter(trial.state for trial in study.get_trials(deepcopy=False))
        filled = states[TrialState.COMPLETE] + states[TrialState.PRUNED]
        running, failed = states[TrialState.RUNNING], states[TrialState.FAIL]
        generations = [GenerationProgress(1, sum(states.values()) - failed, filled, running, failed)]
    return driver.search_progress(study, generations), has_driver(storage, study.study_name, folder)


def matrix_status(folder: Path) -> tuple[pd.DataFrame, float | None]:
    """
    One row for each variant of a matrix, with the mean score of what is done, NaN where it is of several environments without
    returns that count as 0 and 1; and the estimated seconds until all are over, None while that is not known.
    """
    rows = []
    for path in sorted(file.parent for file in folder.glob(f"*/*/*/{RUN}")):
        outcome = read_outcome(path)
        curve = partial_curve(path) if outcome is None else outcome.curve
        left, seconds = pace(read_run(path), curve)
        about = read_about(path)
        row = {"variant": about["variant"], "task": path.parent.name, "done": 0, "running": 0, "failed": 0}
        if outcome is None:
            row |= {"running": is_running(path), "left": left}
        elif outcome.failure is not None:
            row["failed"] = 1
        else:
            row |= {"done": 1, "score": scaled(aulc(curve), about.get("returns")), "scaled": "returns" in about}
        rows.append(row | {"seconds": seconds})
    runs = pd.DataFrame(rows, columns=["variant", "task", "done", "running", "failed", "left", "score", "scaled", "seconds"])
    by_variant = runs.groupby("variant", sort=False)
    table = by_variant[["done", "running", "failed"]].sum().astype(int)
    table.insert(0, "runs", by_variant.size())
    is_comparable = (by_variant["task"].nunique() == 1) | (by_variant["scaled"].sum() == by_variant["score"].count())
    table["score"] = by_variant["score"].mean().where(is_comparable)
    return table.reset_index(), seconds_to_go(list(runs["seconds"].dropna()), runs["left"].sum(), int(runs["running"].sum()))
