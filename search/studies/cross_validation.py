"""Cross-validation of a search's best candidates (paper, A.4): the best on one environment may have overfitted to it."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count, islice, product
from pathlib import Path
from typing import Any

import optuna
import pandas as pd
import yaml
from optuna.study import StudyDirection
from sb3_aarl.search.evolution.racing import next_runs, standings
from sb3_aarl.search.evolution.surrogate import TokenModel
from sb3_aarl.search.execution.matrix import Cell, Matrix, scores
from sb3_aarl.search.results.analysis import analysed, ranked, trial_table
from sb3_aarl.search.studies.config import Baseline, SearchConfig, merge_space
from sb3_aarl.search.studies.search import check_study, search_matrix, stored_settings
from sb3_aarl.search.training.config import ConfigError

from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.files import replace_text

logger = logging.getLogger(__name__)


def top_losses(study: optuna.Study, top: int, top_rated: int = 0) -> list[AuxLoss]:
    """
    The best candidates of a search by their scores, the best first, and after them ``top_rated`` others that the surrogate,
    fitted to all scores, rates highest; in canonical form and each once. Where losses are trained again, the surrogate
    decides alone: the best score of several is luck.
    """
    scored = ranked(analysed(trial_table(study.get_trials(deepcopy=False))), study.direction)
    if scored.empty:
        raise ValueError(f"study {study.study_name!r} has no completed candidate yet")
    losses = list(dict.fromkeys(scored["canonical"]))
    surrogate = TokenModel(max(loss.horizon for loss in losses))
    surrogate.add(list(scored["canonical"]), list(scored["score"]))

    def by_rating(some: list[AuxLoss]) -> list[AuxLoss]:
        return sorted(some, key=surrogate.rating, reverse=study.direction == StudyDirection.MAXIMIZE)

    losses = by_rating(losses) if stored_settings(study).get("again") else losses
    return losses[:top] + by_rating(losses[top:])[:top_rated]


def searched_values(config: SearchConfig, study: optuna.Study) -> dict[AuxLoss, dict[str, Any]]:
    """The values of the search's ``space`` in the best trial of each loss."""
    scored = ranked(analysed(trial_table(study.get_trials(deepcopy=False))), study.direction).drop_duplicates("canonical")
    pairs = zip(scored["canonical"], scored["others"], strict=True)
    return {loss: {name: others[name] for name in config.space} for loss, others in pairs}


def make_matrix(config: SearchConfig, study: optuna.Study, folder: Path, baselines: Sequence[Baseline] = ()) -> Matrix:
    """
    Candidates and baselines x environments x seeds.

    :raises ValueError: when the configuration is not that of the study
    """
    section = config.cross_validation
    if section is None:
        raise ConfigError(f"{config.path}: cross_validation is missing: environments, seeds, top")
    check_study(study, config, free=("threads",))
    environments = section.environments or tuple(config.tasks)
    if {*config.seeds} & {*section.seeds} and {*config.tasks} & {*environments}:
        logger.warning("cross_validation.seeds has seeds of the search: scores that candidates were chosen for count again")
    losses, values = top_losses(study, section.top, section.top_rated), searched_values(config, study)
    candidates = [Baseline(name=str(loss), aux_loss=loss, overrides=merge_space({}, values[loss])) for loss in losses]
    # Those that race may have more seeds.
    n_more = section.budget - len(section.seeds) if section.budget else 0
    more = islice((seed for seed in count(max(section.seeds) + 1) if seed not in config.seeds), n_more)
    variants = [*candidates, *baselines]
    cells = [
        Cell(variant.name, environment, seed)
        for seed, some in (dict.fromkeys(section.seeds, variants) | dict.fromkeys(more, candidates)).items()
        for environment, variant in product(environments, some)
    ]
    by_name = {variant.name: variant for variant in variants}
    name, returns = f"{config.name}-cross-validation", config.returns | section.returns
    matrix = search_matrix(config, name, folder / "cross-validation", cells, by_name, returns)
    # On the search's environments, runs may be longer than those of its candidates.
    checkpoints = {environment: {"checkpoints": steps} for environment, steps in section.checkpoints.items()}
    runs = {cell: run.model_copy(update=checkpoints.get(cell.environment)) for cell, run in matrix.runs.items()}
    return replace(matrix, runs=runs)


def rounds(config: SearchConfig, matrix: Matrix) -> Iterator[Matrix]:
    """
    The parts of a matrix, each of which must be trained before the next one is asked for: all of it or, with a budget, the
    rounds of a race, which a loss leaves when a run of it fails.
    """
    section, baselines = config.cross_validation, {baseline.name for baseline in config.baselines}
    assert section is not None
    if section.budget is None:
        yield matrix
        return
    names = list(dict.fromkeys(cell.variant for cell in matrix.runs if cell.variant not in baselines))
    environments, seeds = ({cell[i]: None for cell in matrix.runs} for i in (1, 2))
    waiting, failed = {cell for cell in matrix.runs if cell.variant in baselines}, set[str]()
    while True:
        racing = [name for name in names if name not in failed]
        table = seed_scores(scores(matrix), len(environments)).reindex(index=names, columns=list(seeds))
        spent = int(table.loc[sorted(failed)].count().sum())
        found = next_runs(table.loc[racing].to_numpy(), section.budget - spent, len(section.seeds))
        # Without those that failed, other losses would have had the seeds: what is trained is spent.
        found = found[: max(0, section.budget - int(table.count().sum()))]
        chosen = {(racing[row], list(seeds)[column]) for row, column in found}
        cells = [cell for cell in matrix.runs if (cell.variant, cell.seed) in chosen or cell in waiting]
        if not cells:
            return
        part = replace(matrix, runs={cell: matrix.runs[cell] for cell in cells})
        yield part
        waiting.clear()
        trained = scores(part).dropna(subset="score")  # of a finished run too, a score may be NaN
        failed |= {cell.variant for cell in {*cells}.difference(trained.iloc[:, :3].itertuples(index=False))} - baselines


def seed_scores(runs: pd.DataFrame, n_environments: int) -> pd.DataFrame:
    """The mean score over all environments of each variant (row) and seed (column), NaN where it lacks one of them."""
    groups = runs.groupby(["variant", "seed"])["score"]
    return groups.mean().where(groups.count() == n_environments).unstack()


def without_failed(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs of the variants of which none failed."""
    return runs[~runs["variant"].isin(runs.loc[runs["score"].isna(), "variant"])]


def ranking(runs: pd.DataFrame) -> pd.DataFrame:
    """
    The candidates, the best first, by what their runs say of the mean score over all seeds and environments (paper, A.4):
    ``mean`` with its 95 % interval from ``low`` to ``high``, ``p_best``, the probability that a candidate is the best of them,
    and ``runs``, beside the mean scores on each environment. Candidates of which a run failed are left out; an environment on
    which no run is finished does not count.
    """
    runs = runs[runs.groupby("environment")["score"].transform("count") > 0]
    runs = without_failed(runs)
    by_seed = seed_scores(runs, runs["environment"].nunique())
    by_environment = runs.pivot_table(index="variant", columns="environment", values="score", aggfunc="mean")
    overall = pd.DataFrame(standings(by_seed.to_numpy())._asdict(), index=by_seed.index)
    overall["runs"] = runs.groupby("variant")["score"].count()
    return by_environment.join(overall).dropna(subset="mean").sort_values("mean", ascending=False, kind="stable")


def write_winner(table: pd.DataFrame, path: Path, values: Mapping[AuxLoss, Mapping[str, Any]] | None = None) -> AuxLoss:
    """
    Write the best candidate of a :func:`ranking` as YAML, a mapping whose ``aux_loss`` is what SACAux and hyper-parameter
    files take, and return it. Its values of :func:`searched_values` are a comment.
    """
    winner = AuxLoss.parse(str(table.index[0]))
    mean, runs, p_best = (table[name].iloc[0] for name in ("mean", "runs", "p_best"))
    comment = f"# Best of {len(table)} candidates in cross-validation: mean score {mean:.3f}, runs: {runs}, "
    comment += f"probability that it is the best of the table: {p_best:.2f}\n"
    comment += "".join(f"# {name}: {value}\n" for name, value in (values or {}).get(winner, {}).items())
    replace_text(path, comment + yaml.safe_dump({"aux_loss": winner}, sort_keys=False))
    return winner
