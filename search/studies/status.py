"""How far a search with the matrices in its folder is, or a benchmark. Nothing is started."""

import inspect
from pathlib import Path

import optuna
import pandas as pd
from optuna.storages import BaseStorage
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.execution import driver
from sb3_aarl.search.execution.storage import has_driver
from sb3_aarl.search.training.folder import read_outcome
from sb3_aarl.search.training.provenance import ABOUT, read_about

from sb3_aarl.aux_loss import AuxLoss

# Folders of matrices in that of a search.
PARTS = ("baselines", "cross-validation")


def search_status(study: optuna.Study, storage: BaseStorage, folder: Path) -> tuple[driver.SearchProgress, bool]:
    """The progress of a search, and whether its driver runs."""
    settings = AuxLossSampler.stored_settings(study)
    if not settings:
        raise ValueError(f"study {study.study_name!r} has no trial of an AuxLossSampler: there are no generations to count")
    settings["initial"] = [AuxLoss.parse(loss) for loss in settings["initial"]]
    arguments = {name: settings[name] for name in inspect.signature(AuxLossSampler).parameters if name in settings}
    generations = AuxLossSampler(**arguments).progress(study)
    return driver.search_progress(study, generations), has_driver(storage, study.study_name, folder)


def matrix_status(folder: Path) -> pd.DataFrame:
    """How many runs of each variant of a matrix there are, are done, and failed."""
    outcomes = {file.parent: read_outcome(file.parent) for file in sorted(folder.glob(f"*/*/*/{ABOUT}"))}
    rows = [
        (read_about(path)["variant"], 1, bool(outcome and outcome.failure is None), bool(outcome and outcome.failure))
        for path, outcome in outcomes.items()
    ]
    runs = pd.DataFrame(rows, columns=["variant", "runs", "done", "failed"])
    return runs.groupby("variant", sort=False).sum().astype(int).reset_index()
