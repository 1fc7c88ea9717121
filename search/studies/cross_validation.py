"""Cross-validation of a search's best candidates (paper, A.4): the best on one environment may have overfitted to it."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import optuna
import pandas as pd
import yaml
from optuna.study import StudyDirection
from sb3_aarl.search.evolution.surrogate import TokenModel
from sb3_aarl.search.execution.matrix import Cell, Matrix
from sb3_aarl.search.results.analysis import analysed, ranked, trial_table
from sb3_aarl.search.studies.config import Baseline, CrossValidation, SearchConfig
from sb3_aarl.search.studies.search import check_study, search_matrix
from sb3_aarl.search.training.config import ConfigError
from sb3_aarl.search.training.folder import Run

from sb3_aarl import catalog
from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.files import replace_text

logger = logging.getLogger(__name__)


def top_losses(study: optuna.Study, top: int, top_rated: int = 0) -> list[AuxLoss]:
    """
    The best candidates of a search by their scores, the best first, and after them ``top_rated`` others that the surrogate,
    fitted to all scores, rates highest; in canonical form and each once.
    """
    scored = ranked(analysed(trial_table(study.get_trials(deepcopy=False))), study.direction)
    if scored.empty:
        raise ValueError(f"study {study.study_name!r} has no completed candidate yet")
    losses = list(dict.fromkeys(scored["canonical"]))
    surrogate = TokenModel(max(loss.horizon for loss in losses))
    surrogate.add(list(scored["canonical"]), list(scored["score"]))
    rated = sorted(losses[top:], key=surrogate.rating, reverse=study.direction == StudyDirection.MAXIMIZE)
    return losses[:top] + rated[:top_rated]


def make_matrix(
    config: SearchConfig, study: optuna.Study, folder: Path, top: int | None = None, baselines: Sequence[Baseline] = ()
) -> Matrix:
    """
    Candidates and baselines x environments x seeds; ``top`` replaces the configuration's number of candidates.

    :raises ValueError: when the configuration is not that of the study
    """
    section = _section(config)
    check_study(study, config, free=("threads",))
    if own := sorted({*config.seeds} & {*section.seeds}):
        for environment in {*config.tasks} & {*(section.environments or config.tasks)}:
            logger.warning(
                "cross_validation.seeds has %s, as the search on %s: the scores that candidates were chosen for count again",
                ", ".join(map(str, own)),
                environment,
            )
    losses = top_losses(study, section.top, section.top_rated) if top is None else top_losses(study, top)
    candidates = [Baseline(name=str(loss), aux_loss=loss) for loss in losses]
    return _make_matrix(config, folder, [*candidates, *baselines])


def all_runs(config: SearchConfig) -> Mapping[Cell, Run]:
    """Baselines, and candidates that are not known yet, each with AARL-State: what a cross-validation would cost."""
    loss, section = catalog.load("aarl-state"), _section(config)
    candidates = [Baseline(name=f"candidate {n}", aux_loss=loss) for n in range(section.top + section.top_rated)]
    return _make_matrix(config, Path(), [*candidates, *config.baselines]).runs


def _section(config: SearchConfig) -> CrossValidation:
    if config.cross_validation is None:
        raise ConfigError(f"{config.path}: cross_validation is missing: environments, seeds, top")
    return config.cross_validation


def _make_matrix(config: SearchConfig, folder: Path, variants: Sequence[Baseline]) -> Matrix:
    section = _section(config)
    by_name = {variant.name: variant for variant in variants}
    environments = section.environments or tuple(config.tasks)
    cells = [Cell(name, environment, seed) for seed, environment, name in product(section.seeds, environments, by_name)]
    matrix = search_matrix(config, f"{config.name}-cross-validation", folder / "cross-validation", cells, by_name)
    # On the search's environments, runs may be longer than those of its candidates.
    checkpoints = {environment: {"checkpoints": steps} for environment, steps in section.checkpoints.items()}
    runs = {cell: run.model_copy(update=checkpoints.get(cell.environment)) for cell, run in matrix.runs.items()}
    return replace(matrix, runs=runs)


def ranking(runs: pd.DataFrame) -> pd.DataFrame:
    """
    The candidates by their mean AULC over all environments (paper, A.4), the best first; ``std`` is the sample deviation over
    seeds of the mean over environments.
    """
    by_environment = runs.pivot_table(index="variant", columns="environment", values="score", aggfunc="mean")
    by_seed = runs.groupby(["variant", "seed"])["score"].mean().groupby("variant")
    # The mean of the environments' means: each counts alike, however many seeds it has so far.
    overall = pd.DataFrame({"mean": by_environment.mean(axis=1), "std": by_seed.std()})
    overall["runs"] = runs.groupby("variant")["score"].count()
    return by_environment.join(overall).sort_values("mean", ascending=False)


def write_winner(table: pd.DataFrame, path: Path) -> AuxLoss:
    """
    Write the best candidate of a :func:`ranking` as YAML, a mapping whose ``aux_loss`` is what SACAux and hyper-parameter
    files take, and return it.
    """
    winner = AuxLoss.parse(str(table.index[0]))
    mean, runs = table["mean"].iloc[0], table["runs"].iloc[0]
    comment = f"# Best of {len(table)} candidates in cross-validation: mean score {mean:.3f}, runs: {runs}\n"
    replace_text(path, comment + yaml.safe_dump({"aux_loss": winner}, sort_keys=False))
    return winner
