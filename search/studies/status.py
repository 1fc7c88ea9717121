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
from sb3_aarl.search.execution.queue import seconds_to_go
from sb3_aarl.search.execution.storage import has_driver
from sb3_aarl.search.studies.search import stored_settings
from sb3_aarl.search.training.folder import RUN, is_running, read_outcome
from sb3_aarl.search.training.provenance import read_about

from sb3_aarl.aux_loss import AuxLoss

# Folders of matrices in that of a search.
PARTS = ("baselines", "cross-validation")


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
    The runs of each variant of a matrix: all, done, running, failed; and the estimated seconds until all are over, None while
    that is not known.
    """
    rows = []
    for path in sorted(file.parent for file in folder.glob(f"*/*/*/{RUN}")):
        outcome = read_outcome(path)
        done = outcome is not None and outcome.failure is None
        failed = outcome is not None and not done
        seconds = outcome.curve[-1].seconds if outcome is not None and done else None
        rows.append((read_about(path)["variant"], done, outcome is None and is_running(path), failed, seconds))
    runs = pd.DataFrame(rows, columns=["variant", "done", "running", "failed", "seconds"])
    by_variant = runs.groupby("variant", sort=False)
    table = by_variant[["done", "running", "failed"]].sum().astype(int)
    table.insert(0, "runs", by_variant.size())
    left = int((table["runs"] - table["done"] - table["failed"]).sum())
    return table.reset_index(), seconds_to_go(list(runs["seconds"].dropna()), left, int(runs["running"].sum()))
