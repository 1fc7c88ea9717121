"""What a search teaches about auxiliary losses (paper, section 3.3, B.2, B.3): pure functions of a table of trials."""

import math
import warnings
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import optuna
import pandas as pd
from optuna.distributions import CategoricalDistribution
from optuna.importance import (
    BaseImportanceEvaluator,
    FanovaImportanceEvaluator,
    MeanDecreaseImpurityImportanceEvaluator,
    get_param_importances,
)
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState, create_trial
from scipy.stats import kendalltau, spearmanr, ttest_ind

from sb3_aarl import catalog
from sb3_aarl.aux_loss import KINDS, AuxLoss
from search.evolution.space import distributions, loss_to_params
from search.execution import workers
from search.results.trials import curve_of, lineage, loss_of, operation_of, parents_of, ranked, score_of, stage_of

# Section 3.3, in the order of table 5.
PATTERNS: Mapping[str, str | AuxLoss] = {
    "Forward dynamics": "forward-dynamics",
    "Inverse dynamics": "inverse-dynamics",
    "Reward prediction": "reward-prediction",
    "Action inference": "action-inference",
    "State reconstruction": "{s_t} -> {s_t}",
}
# The other columns of table 5, one for each kind of token.
COUNTS = tuple(f"{name}, n_target > n_source" for name in ("State", "Action", "Reward"))
# How the columns of a summary's tables are written, and what they are called where their names do not say it; numbers that
# are not here are integers.
FORMATS = {
    **dict.fromkeys(("difference", "gain"), "+.2f"),
    **dict.fromkeys(("welch_p", "student_p", "spearman_p", "kendall_p"), ".2g"),
    **dict.fromkeys(("score", "mean", "std", "median", "mean_with", "mean_without", "spearman", "kendall"), ".2f"),
    **dict.fromkeys(("hours", "core_hours"), ".2f"),
    **{"importance": ".3f", "distinct": ".0%", "hamming": ".1f"},
}
HEADINGS = {
    "n": "Losses",
    "std": "Deviation",
    "hamming": "Hamming distance",
    "index": "",
    "number": "Trial",
    "device": "Trained on",
}
HEADINGS |= {name: f"n {name[2:]}" for name in ("n_with", "n_without", "n_neither")}
HEADINGS |= {"welch_p": "Welch p", "student_p": "Student p", "spearman_p": "Spearman p", "kendall_p": "Kendall p"}
METRICS = ("aulc", "first", "last")
COLUMNS: dict[str, Any] = {
    **{"number": int, "state": str, "stage": int, "operation": str, "parents": object, "score": float, "loss": object},
    **{"canonical": object, "horizon": "Int64", "operator": object, "negatives": "boolean", "curve": object},
}


def trial_table(trials: Sequence[FrozenTrial]) -> pd.DataFrame:
    """
    The trials of a study as the table that the other functions take, one row each, whatever became of them.

    :param trials: Trials of a study
    :return: ``number``; ``state`` (``complete``, ``pruned``, ``fail``, ``running``, ``waiting``); ``stage``; ``operation``;
        ``parents`` (numbers); ``score`` (NaN where there is none); ``loss`` (as it was searched) and ``canonical``, both an
        AuxLoss or None; ``horizon`` (agent steps), ``operator``, ``negatives`` of the loss; ``curve``, a list of
        (environment steps, mean return, standard deviation)
    """
    rows = []
    for trial in trials:
        loss, score = loss_of(trial), score_of(trial)
        row = {
            "number": trial.number,
            "state": trial.state.name.lower(),
            "stage": stage_of(trial),
            "operation": operation_of(trial),
            "parents": parents_of(trial),
            "score": np.nan if score is None else score,
            "loss": loss,
            "canonical": None if loss is None else loss.canonical(),
            "horizon": None if loss is None else loss.horizon,
            "operator": None if loss is None else loss.operator,
            "negatives": None if loss is None else loss.negatives,
            "curve": curve_of(trial),
        }
        rows.append(row)
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype(COLUMNS)


def analysed(table: pd.DataFrame) -> pd.DataFrame:
    """
    The trials that can be compared: complete, with a finite score and a valid loss. The score of a pruned trial is that of
    a training which was cut short; failed, running and waiting ones have none.

    :param table: As :func:`trial_table` gives it
    """
    return table[(table["state"] == "complete") & table["score"].notna() & table["loss"].notna()]


def population(table: pd.DataFrame) -> pd.Series:
    """
    How many trials there are, how many of them are analysed, and what became of the others.

    :param table: As :func:`trial_table` gives it
    :return: ``trials``, ``analysed``, then trials by state: ``pruned``, ``fail``, ``running``, ``waiting``, and ``unusable``:
        complete, but without a finite score or a valid loss. ``trials`` is the sum of the others
    """
    states = table["state"].value_counts()
    n_analysed = len(analysed(table))
    counts = {"trials": len(table), "analysed": n_analysed}
    counts |= {state: int(states.get(state, 0)) for state in ("pruned", "fail", "running", "waiting")}
    return pd.Series({**counts, "unusable": int(states.get("complete", 0)) - n_analysed}, name="trials")


def has_pattern(loss: AuxLoss, pattern: AuxLoss) -> bool:
    """
    The paper's rule (section 3.3): a candidate has a pattern if the pattern's source is a subset of the candidate's source,
    and the pattern's target is a subset of the candidate's target.

    The sets are those of tokens, offsets included, and nothing is shifted in time: ``{s_t+1, a_t+1} -> {s_t+2}`` does not
    have the pattern ``{s_t, a_t} -> {s_t+1}`` though its canonical form does. Neither operator matters. To ask the
    canonical forms instead, give functions ``table.assign(loss=table["canonical"])``.

    :param loss: The candidate
    :param pattern: The pattern
    """
    return all(
        set(few) <= set(many)
        for few, many in ((pattern.source_tokens, loss.source_tokens), (pattern.target_tokens, loss.target_tokens))
    )


def target_surplus(loss: AuxLoss) -> dict[str, int]:
    """
    n_target - n_source for each kind of token (paper, section 3.3).

    :param loss: The candidate
    :return: Keys ``s``, ``a``, ``r``
    """
    return {kind: sum(loss.target[place::3]) - sum(loss.source[place::3]) for place, kind in enumerate(KINDS)}


def table5_classes(
    table: pd.DataFrame, patterns: Mapping[str, str | AuxLoss] = PATTERNS, ties_without: bool = False
) -> pd.DataFrame:
    """
    The class of every analysed trial in each column of table 5.

    Section 3.3 compares losses with n_target > n_source to "the other way around", which it writes n_target < n_source. So
    a loss with n_target = n_source is in neither class. The table itself only says "n_target > n_source":
    ``ties_without=True`` counts these losses to the class without.

    :param table: As :func:`trial_table` gives it
    :param patterns: Name and pattern of each column: an AuxLoss, its notation, or its name in the catalogue
    :param ties_without: Whether n_target = n_source counts as not n_target > n_source
    :return: One row an analysed trial, one column a pattern, then ``COUNTS``; True, False, or NA for neither
    :raises ValueError: for a pattern that cannot be read
    """
    losses = analysed(table)["loss"]
    parsed = {name: catalog.resolve(pattern) for name, pattern in patterns.items()}
    columns: dict[str, list[bool | None]] = {
        name: [has_pattern(loss, pattern) for loss in losses] for name, pattern in parsed.items()
    }
    for name, kind in zip(COUNTS, KINDS, strict=True):
        surplus = [target_surplus(loss)[kind] for loss in losses]
        columns[name] = [None if n == 0 and not ties_without else n > 0 for n in surplus]
    return pd.DataFrame(columns, index=losses.index, dtype="boolean")


def table5(table: pd.DataFrame, patterns: Mapping[str, str | AuxLoss] = PATTERNS, ties_without: bool = False) -> pd.DataFrame:
    """
    Whether losses with a pattern score otherwise than those without it (paper, section 3.3, table 5).

    All analysed trials of all stages are one sample, as in the paper. They are not independent: candidates descend from each
    other, and later stages score higher and have other patterns. So p-values are lower than those of an experiment, and
    they are not corrected for the number of tests.

    :param table: As :func:`trial_table` gives it
    :param patterns: As in :func:`table5_classes`
    :param ties_without: As in :func:`table5_classes`
    :return: One row a pattern, then ``COUNTS``: ``difference`` of the mean scores (with - without), ``welch_p`` and
        ``student_p`` of the two-sided t-tests without and with equal variances (NaN where a class is too small),
        ``mean_with``, ``mean_without``, ``n_with``, ``n_without``, ``n_neither``
    :raises ValueError: for a pattern that cannot be read
    """
    scores = analysed(table)["score"]
    classes = table5_classes(table, patterns, ties_without)
    rows = {}
    for name in classes:
        column = classes[name]
        comparison = _compare(scores[column.fillna(False)], scores[~column.fillna(True)])
        rows[name] = {**comparison, "n_neither": int(column.isna().sum())}
    return pd.DataFrame.from_dict(rows, orient="index").astype(dict.fromkeys(("n_with", "n_without", "n_neither"), int))


def _compare(scores_with: pd.Series, scores_without: pd.Series) -> dict[str, float]:
    with warnings.catch_warnings():
        # Of classes that are too small or whose scores are all alike: the counts stand beside the NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        welch, student = (ttest_ind(scores_with, scores_without, equal_var=equal).pvalue for equal in (False, True))
    mean_with, mean_without = scores_with.mean(), scores_without.mean()
    return {
        "difference": mean_with - mean_without,
        "welch_p": float(welch),
        "student_p": float(student),
        "mean_with": mean_with,
        "mean_without": mean_without,
        "n_with": len(scores_with),
        "n_without": len(scores_without),
    }


def table5_layout(tables: Mapping[str, pd.DataFrame], p_value: str = "welch_p") -> pd.DataFrame:
    """
    Table 5 as the paper prints it: one row a study, differences with * where p < 0.05 and ** where p < 0.01.

    :param tables: Name of each study and what :func:`table5` gives for it
    :param p_value: ``welch_p`` or ``student_p``; the paper says no more than "t-test"
    :return: Strings; a dash where a class is empty
    """

    def cell(row: pd.Series) -> str:
        if np.isnan(row["difference"]):
            return "–"
        return f"{row['difference']:+.2f}{'*' * sum(row[p_value] < level for level in (0.05, 0.01))}"

    return pd.DataFrame({name: table.apply(cell, axis=1) for name, table in tables.items()}).T


def effects(table: pd.DataFrame, by: str | Sequence[str]) -> pd.DataFrame:
    """
    How the analysed trials of each group score, and how they differ from all others: ``by="horizon"``,
    ``by=["operator", "negatives"]``, ``by="operation"`` (what the mutations are worth), ``by="stage"``.

    :param table: As :func:`trial_table` gives it
    :param by: One column of the table, or several
    :return: One row a group: ``n``, ``mean``, ``std``, ``median``, ``difference`` of its mean to that of all others, and
        ``welch_p``, ``student_p`` as in :func:`table5`
    :raises ValueError: for columns that the table does not have
    """
    names = [by] if isinstance(by, str) else list(by)
    if unknown := [name for name in names if name not in table]:
        raise ValueError(f"trials have no column {unknown[0]!r}, but {', '.join(table.columns)}")
    trials = analysed(table)
    groups = trials.groupby(names)["score"]
    group = groups.ngroup()
    result = pd.DataFrame({"n": groups.size(), "mean": groups.mean(), "std": groups.std(), "median": groups.median()})
    against = [_compare(trials["score"][group == i], trials["score"][group != i]) for i in range(len(result))]
    return result.join(pd.DataFrame(against, index=result.index, columns=["difference", "welch_p", "student_p"], dtype=float))


def importances(
    table: pd.DataFrame,
    evaluator: BaseImportanceEvaluator | None = None,
    direction: StudyDirection = StudyDirection.MAXIMIZE,
) -> pd.DataFrame:
    """
    How much of the scores each parameter of the losses explains, by one of Optuna's evaluators.

    A loss has no parameters for tokens beyond its horizon, and most of Optuna's evaluators only look at parameters that all
    trials have. Such a token is not chosen, so its parameter is filled in as False. The horizon and, if they vary, operator
    and negatives are parameters too: what they explain is not put down to the tokens.

    :param table: As :func:`trial_table` gives it
    :param evaluator: One of ``optuna.importance``, None for fANOVA with a fixed seed: 8 s for 725 trials with horizons up to
        10 on one core, where the mean decrease of impurity takes 1.5 s
    :param direction: The study's; PED-ANOVA asks for it
    :return: One row a parameter (``source/s_t+1``, ``target/r_t``, ``horizon``, ...), the most important first:
        ``importance`` (they sum to 1), and for tokens ``difference`` (mean score with - without), ``n_with``, ``n_without``
    :raises ValueError: when there are no two different scores
    """
    trials = analysed(table)
    if trials["score"].nunique() < 2:
        raise ValueError(f"importances need different scores; there are {len(trials)} complete trials, all alike")
    longest = int(trials["horizon"].max())
    # Parameters that are the same in all trials explain nothing.
    varied = {name: sorted(trials[name].unique().tolist()) for name in ("operator", "negatives") if trials[name].nunique() > 1}
    space = distributions(longest, longest) | {name: CategoricalDistribution(choices) for name, choices in varied.items()}
    tokens = {name: False for name, distribution in distributions(longest).items() if name != "horizon"}
    params = [
        {
            **tokens,
            **loss_to_params(AuxLoss(loss.horizon, loss.source, loss.target)),
            **{name: getattr(loss, name) for name in varied},
        }
        for loss in trials["loss"]
    ]
    study = _quiet_study(direction)
    study.add_trials(
        [
            create_trial(state=TrialState.COMPLETE, value=float(score), params=values, distributions=space)
            for values, score in zip(params, trials["score"], strict=True)
        ]
    )
    importance = get_param_importances(study, evaluator=evaluator or FanovaImportanceEvaluator(seed=0))
    rows: dict[str, dict[str, Any]] = {}
    chosen = pd.DataFrame(params, index=trials.index)
    for name, value in importance.items():
        rows[name] = {"importance": value}
        if name in tokens:
            bits = chosen[name].astype(bool)
            comparison = _compare(trials["score"][bits], trials["score"][~bits])
            rows[name] |= {key: comparison[key] for key in ("difference", "n_with", "n_without")}
    columns = ["importance", "difference", "n_with", "n_without"]
    result = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
    return result.astype({"n_with": "Int64", "n_without": "Int64"}).sort_values("importance", ascending=False, kind="stable")


def _quiet_study(direction: StudyDirection) -> optuna.Study:
    """A study in memory, without the line that Optuna logs for a new one."""
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        return optuna.create_study(direction=direction)
    finally:
        optuna.logging.set_verbosity(verbosity)


def diversity(table: pd.DataFrame) -> pd.DataFrame:
    """
    How different the losses of each stage are. Trials that are complete or pruned count: a failed one gave its place to
    another, and what runs may still fail.

    :param table: As :func:`trial_table` gives it
    :return: One row a stage: ``n`` losses, ``distinct`` (share of different canonical forms, operators included), and
        ``hamming``: mean over all pairs of the number of bits in which the masks of their canonical forms differ, shorter ones
        filled up with zeros (NaN for fewer than two losses)
    """
    trials = table[table["state"].isin(["complete", "pruned"]) & table["loss"].notna()]
    rows = {}
    for stage, losses in trials.groupby("stage")["canonical"]:
        n = len(losses)
        masks = np.zeros((n, 2, 3 * max(loss.horizon for loss in losses) + 1), dtype=int)
        for mask, loss in zip(masks, losses, strict=True):
            mask[:, : 3 * loss.horizon + 1] = loss.source, loss.target
        ones = masks.sum(axis=0)
        # Of each bit, the pairs in which one loss has it and the other one not.
        hamming = (ones * (n - ones)).sum() / (n * (n - 1) / 2) if n > 1 else np.nan
        rows[stage] = {"n": n, "distinct": losses.nunique() / n, "hamming": hamming}
    result = pd.DataFrame.from_dict(rows, orient="index", columns=["n", "distinct", "hamming"])
    return result.astype({"n": int}).rename_axis("stage")


def winner_lineage(trials: Sequence[FrozenTrial], direction: StudyDirection = StudyDirection.MAXIMIZE) -> pd.DataFrame:
    """
    The best trial and all its ancestors, the latest first.

    :param trials: All trials of the study, in the order of numbers
    :param direction: The study's
    :return: As :func:`trial_table`, and ``gain``: the score less that of the best parent (NaN without parents). Empty if no
        trial has a score
    """
    best = ranked(trials, direction)[:1]
    line = [*best, *(ancestor for trial in best for ancestor in lineage(trial, trials))]
    table = trial_table(sorted(line, key=lambda trial: -trial.number))
    scores = table.set_index("number")["score"]
    reduce = pd.Series.max if direction == StudyDirection.MAXIMIZE else pd.Series.min
    parents = [reduce(scores.reindex(of)) if of else np.nan for of in table["parents"]]
    return table.assign(gain=table["score"] - np.array(parents, dtype=float))


def rankings(table: pd.DataFrame) -> pd.DataFrame:
    """
    The analysed trials under three metrics of their learning curves (paper, B.2, figure 10).

    :param table: As :func:`trial_table` gives it
    :return: One row a trial that has a curve, in the order of AULC: ``number``, ``loss``, ``curve``, ``aulc`` (mean return
        over all checkpoints), ``first`` and ``last`` (mean return at the first and the last checkpoint), ``rank_aulc``,
        ``rank_first``, ``rank_last`` (1 is the highest return, equals share the better rank)
    :raises ValueError: when the curves have different checkpoints
    """
    trials = analysed(table)
    trials = trials[trials["curve"].map(len) > 0]
    checkpoints = {
        number: tuple(point[0] for point in curve) for number, curve in zip(trials["number"], trials["curve"], strict=True)
    }
    reference = next(iter(checkpoints.items()), (0, ()))
    for number, steps in checkpoints.items():
        if steps != reference[1]:
            raise ValueError(
                f"trial {number} was evaluated at {_steps(steps)} environment steps, trial {reference[0]} at "
                f"{_steps(reference[1])}: their learning curves cannot be compared"
            )
    for number, curve in zip(trials["number"], trials["curve"], strict=True):
        if not all(math.isfinite(mean) for _, mean, _ in curve):
            raise ValueError(f"the learning curve of trial {number} has a return that is not finite: it cannot be ranked")
    result = trials[["number", "loss", "curve"]].copy()
    returns = trials["curve"].map(lambda curve: [mean for _, mean, _ in curve])
    result["aulc"] = returns.map(np.mean).astype(float)
    result["first"], result["last"] = (returns.str[place].astype(float) for place in (0, -1))
    for name in METRICS:
        result[f"rank_{name}"] = result[name].rank(ascending=False, method="min").astype(int)
    return result.sort_values(["rank_aulc", "number"]).reset_index(drop=True)


def _steps(checkpoints: Sequence[int]) -> str:
    return ", ".join(map(str, checkpoints))


def rank_agreement(ranking: pd.DataFrame, top: int = 10) -> pd.DataFrame:
    """
    How far the three metrics agree on which losses are good (paper, B.2, figure 10).

    :param ranking: As :func:`rankings` gives it
    :param top: Size of the leading groups that are compared
    :return: One row a pair of metrics: ``spearman``, ``spearman_p``, ``kendall``, ``kendall_p`` (scipy's, over all trials),
        and ``shared``: how many trials are among the best ``top`` under both
    """
    rows = {}
    leaders = {metric: set(leading(ranking, metric, top)["number"]) for metric in METRICS}
    for first, second in combinations(METRICS, 2):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # too few trials, or all alike: NaN says so
            spearman, kendall = (test(ranking[first], ranking[second]) for test in (spearmanr, kendalltau))
        rows[first, second] = {
            "spearman": spearman.statistic,
            "spearman_p": spearman.pvalue,
            "kendall": kendall.statistic,
            "kendall_p": kendall.pvalue,
            "shared": len(leaders[first] & leaders[second]),
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def leading(ranking: pd.DataFrame, metric: str, top: int = 10) -> pd.DataFrame:
    """
    The best trials under one metric; of equals the ones with lower numbers.

    :param ranking: As :func:`rankings` gives it
    :param metric: ``aulc``, ``first`` or ``last``
    :param top: How many
    """
    return ranking.sort_values([f"rank_{metric}", "number"]).head(top)


def machines(trials: Sequence[FrozenTrial]) -> pd.DataFrame:
    """
    Where the trials were trained, and how long it took.

    :param trials: Trials of a study
    :return: One row a device and commit, as ``Objective`` notes them: finished ``trials``, failed ones included, but not
        those whose workers died, nobody knows when; their ``hours``, one trial after the other; ``core_hours`` (hours x
        threads; NaN for GPUs and where nothing is noted)
    """
    rows = []
    for trial in trials:
        if trial.duration is not None and workers.DIED_KEY not in trial.user_attrs:
            about = trial.user_attrs
            hours = trial.duration.total_seconds() / 3600
            device, commit = (str(about.get(key, "not noted")) for key in ("device", "commit"))
            rows.append((device, commit, hours, hours * about.get("threads", 1) if device.startswith("CPU") else np.nan))
    table = pd.DataFrame(rows, columns=["device", "commit", "hours", "core_hours"])
    groups = table.groupby(["device", "commit"], sort=False)
    # Of nothing but NaN: NaN, not 0.
    return groups.agg(
        trials=("hours", "size"), hours=("hours", "sum"), core_hours=("core_hours", lambda of: of.sum(min_count=1))
    )


class Summary(NamedTuple):
    """
    All that is known of a study's losses.

    :param tables: ``population``, ``table5``, ``importances``, ``horizon`` and ``operation`` (their effects), ``operator``
        (its effects, if it was searched), ``diversity``, ``lineage`` (of the best; losses as their notation),
        ``machines`` and ``rank_agreement``, as the functions above give them; without those that cannot be made
    :param problems: Why a table cannot be made, by its name
    """

    tables: dict[str, pd.DataFrame]
    problems: dict[str, str]


def summary(
    trials: Sequence[FrozenTrial],
    direction: StudyDirection = StudyDirection.MAXIMIZE,
    patterns: Mapping[str, str | AuxLoss] = PATTERNS,
    ties_without: bool = False,
    top: int = 10,
) -> Summary:
    """
    Everything above for one study. Importances are mean decreases of impurity: they take 1.5 s where fANOVA's take 8 s.

    :param trials: All trials of the study, in the order of numbers
    :param direction: The study's
    :param patterns: As in :func:`table5_classes`
    :param ties_without: As in :func:`table5_classes`
    :param top: As in :func:`rank_agreement`
    :raises ValueError: for a pattern that cannot be read
    """
    table = trial_table(trials)
    operator = ["operator", "negatives"]
    tables = {
        "population": population(table).to_frame().rename_axis("state"),
        "table5": table5(table, patterns, ties_without).rename_axis("pattern"),
        "horizon": effects(table, "horizon"),
        "operation": effects(table, "operation"),
        **({"operator": effects(table, operator)} if len(analysed(table)[operator].drop_duplicates()) > 1 else {}),
        "diversity": diversity(table),
        "lineage": _written(winner_lineage(trials, direction)),
        "machines": machines(trials),
    }
    problems = {}
    try:
        evaluator = MeanDecreaseImpurityImportanceEvaluator(seed=0)
        tables["importances"] = importances(table, evaluator, direction).rename_axis("parameter")
    except ValueError as error:
        problems["importances"] = str(error)
    try:
        tables["rank_agreement"] = rank_agreement(rankings(table), top).rename_axis(["metric", "other metric"])
    except ValueError as error:
        problems["rank_agreement"] = str(error)
    return Summary(tables, problems)


def _written(line: pd.DataFrame) -> pd.DataFrame:
    """A lineage in plain values."""
    losses = pd.Series([None if loss is None else str(loss) for loss in line["loss"]], index=line.index, dtype=object)
    columns = ["number", "stage", "operation", "parents", "score", "gain", "loss"]
    return line.assign(loss=losses)[columns].set_index("number")


def readable(name: str, table: pd.DataFrame) -> pd.DataFrame:
    """
    A table of a summary for people: all cells text, a dash for what there is not, * where Welch's p < 0.05 and ** where it is
    < 0.01.

    :param name: Name of the table
    :param table: The table
    """

    def cell(column: Any, value: Any) -> str:
        if isinstance(value, list):
            return ", ".join(map(str, value)) or "–"
        if value is None or value is pd.NA or (isinstance(value, float) and np.isnan(value)):
            return "–"
        if isinstance(value, bool):
            return "yes" if value else "no"
        return format(value, FORMATS.get(column, "" if isinstance(value, str) else "d"))

    flat = table.reset_index()
    text = pd.DataFrame({column: [cell(column, value) for value in flat[column].tolist()] for column in flat}, dtype=object)
    if name == "table5":
        text["difference"] = list(table5_layout({"": table}).iloc[0])
    if "operation" in text:
        text["operation"] = text["operation"].str.replace("_", " ")
    return text.rename(columns=lambda column: HEADINGS.get(column, str(column).replace("_", " ").capitalize()))
