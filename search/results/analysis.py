"""What a search teaches about auxiliary losses (paper, section 3.3, B.2, B.3): functions of trials or of a table of them."""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from sb3_aarl.search.evolution.space import loss_of, loss_to_params
from scipy.spatial.distance import pdist
from scipy.stats import ttest_ind
from sklearn.ensemble import RandomForestRegressor

from sb3_aarl import catalog
from sb3_aarl.aux_loss import OPERATORS, AuxLoss

# Section 3.3, in the order of table 5.
PATTERNS: Mapping[str, str | AuxLoss] = {
    "Forward dynamics": "forward-dynamics",
    "Inverse dynamics": "inverse-dynamics",
    "Reward prediction": "reward-prediction",
    "Action inference": "action-inference",
    "State reconstruction": "{s_t} -> {s_t}",
}
# The other columns of table 5, one for each kind of token: n_target - n_source.
COUNTS = tuple(f"{name}, n_target > n_source" for name in ("State", "Action", "Reward"))
# Formats of the columns of a summary's tables where these are not integers or .2f, and their headings where these are not
# their names.
FORMATS = {"difference": "+.2f", "gain": "+.2f", "welch_p": ".2g", "importance": ".3f", "distinct": ".0%", "hamming": ".1f"}
HEADINGS = {
    **{"n": "Losses", "std": "Deviation", "hamming": "Hamming distance", "index": "", "number": "Trial"},
    **{"device": "Trained on", "average": "Mean", "welch_p": "Welch p"},
    **{name: f"n {name[2:]}" for name in ("n_with", "n_without", "n_neither")},
}
COLUMNS: dict[str, Any] = {
    **{"number": int, "state": str, "generation": int, "operation": str, "parents": object, "score": float},
    **{"loss": object, "canonical": object, "horizon": "Int64", "operator": object, "negatives": "boolean", "curve": object},
}


def trial_table(trials: Sequence[FrozenTrial]) -> pd.DataFrame:
    """
    The trials of a study as the table that the other functions take, one row each, finished or not: ``score`` is NaN where
    there is none, ``loss`` and ``canonical`` an AuxLoss or None, ``curve`` a list of (environment steps, mean return).
    """
    rows = []
    for trial in trials:
        loss = loss_of(trial)
        has_score = trial.state == TrialState.COMPLETE and trial.value is not None and math.isfinite(trial.value)
        row = {
            "number": trial.number,
            "state": "interrupted" if trial.user_attrs.get("interrupted") else trial.state.name.lower(),
            # Other samplers than AuxLossSampler have one generation only.
            "generation": trial.user_attrs.get("generation", 1),
            "operation": trial.user_attrs.get("operation", "-"),
            "parents": list(trial.user_attrs.get("parents", ())),
            "score": trial.value if has_score else np.nan,
            "loss": loss,
            "canonical": None if loss is None else loss.canonical(),
            "curve": trial.user_attrs.get("curve", []),
        }
        rows.append(row | {key: getattr(loss, key, None) for key in ("horizon", "operator", "negatives")})
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype(COLUMNS)


def ranked(table: pd.DataFrame, direction: StudyDirection = StudyDirection.MAXIMIZE) -> pd.DataFrame:
    """The trials that have a score, the best first; ties are ordered by trial number."""
    return table.dropna(subset="score").sort_values("score", ascending=direction == StudyDirection.MINIMIZE, kind="stable")


def analysed(table: pd.DataFrame) -> pd.DataFrame:
    """
    The trials that can be compared: complete, with a finite score and a valid loss. The score of a pruned trial is that of
    a run which was stopped early; failed, running and waiting ones have none.
    """
    return table[(table["state"] == "complete") & table["score"].notna() & table["loss"].notna()]


def population(table: pd.DataFrame) -> pd.Series:
    """
    How many ``trials`` there are, how many of them are ``analysed``, and how many of the others are ``pruned``, ``fail``,
    ``interrupted``, ``running``, ``waiting``, or ``unusable``: complete, but without a finite score or a valid loss.
    """
    states = table["state"].value_counts()
    n_analysed = len(analysed(table))
    counts = {"trials": len(table), "analysed": n_analysed}
    counts |= {state: int(states.get(state, 0)) for state in ("pruned", "fail", "interrupted", "running", "waiting")}
    return pd.Series({**counts, "unusable": int(states.get("complete", 0)) - n_analysed}, name="trials")


def has_pattern(loss: AuxLoss, pattern: AuxLoss) -> bool:
    """
    The paper's rule (section 3.3): a candidate has a pattern if the pattern's source is a subset of the candidate's source,
    and the pattern's target is a subset of the candidate's target.

    The sets are those of tokens, offsets included, and nothing is shifted in time: ``{s_t+1, a_t+1} -> {s_t+2}`` does not
    have the pattern ``{s_t, a_t} -> {s_t+1}`` though its canonical form does. Neither operator matters. To compare the
    canonical forms instead, pass ``table.assign(loss=table["canonical"])`` to the functions below.
    """
    sides = ((pattern.source_tokens, loss.source_tokens), (pattern.target_tokens, loss.target_tokens))
    return all(set(few) <= set(many) for few, many in sides)


def table5_classes(table: pd.DataFrame, patterns: Mapping[str, str | AuxLoss] = PATTERNS) -> pd.DataFrame:
    """
    The class of every analysed trial in each column of table 5: True, False, or NA for neither.

    Section 3.3 compares losses with n_target > n_source to "the other way around", which it writes n_target < n_source. So
    a loss with n_target = n_source is in neither class.
    """
    losses = analysed(table)["loss"]
    parsed = {name: catalog.resolve(pattern) for name, pattern in patterns.items()}
    columns: dict[str, list[bool | None]] = {}
    for name, pattern in parsed.items():
        columns[name] = [has_pattern(loss, pattern) for loss in losses]
    for i, name in enumerate(COUNTS):
        surplus = [sum(loss.target[i::3]) - sum(loss.source[i::3]) for loss in losses]
        columns[name] = [None if n == 0 else n > 0 for n in surplus]
    return pd.DataFrame(columns, index=losses.index, dtype="boolean")


def pattern_scores(
    table: pd.DataFrame, patterns: Mapping[str, str | AuxLoss] = PATTERNS
) -> dict[str, tuple[pd.Series, pd.Series]]:
    """The scores of the trials with and of those without each pattern, those in neither class left out."""
    scores, classes = analysed(table)["score"], table5_classes(table, patterns)
    return {str(name): (scores[column.fillna(False)], scores[~column.fillna(True)]) for name, column in classes.items()}


def table5(table: pd.DataFrame, patterns: Mapping[str, str | AuxLoss] = PATTERNS) -> pd.DataFrame:
    """
    Whether losses with a pattern have other scores than those without it (paper, section 3.3, table 5).

    All analysed trials of all generations are one sample, as in the paper. They are not independent: candidates descend from
    each other, and later generations score higher and have other patterns. So p-values are lower than those of an
    experiment, and they are not corrected for the number of tests.
    """
    rows = {name: _compare(*scores) for name, scores in pattern_scores(table, patterns).items()}
    result = pd.DataFrame.from_dict(rows, orient="index")
    result["n_neither"] = len(analysed(table)) - result["n_with"] - result["n_without"]
    return result


def _compare(scores_with: pd.Series, scores_without: pd.Series) -> dict[str, float]:
    with warnings.catch_warnings():
        # Classes that are too small or have equal scores: the counts stand beside the NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        welch = ttest_ind(scores_with, scores_without, equal_var=False).pvalue
    mean_with, mean_without = scores_with.mean(), scores_without.mean()
    return {
        "difference": mean_with - mean_without,
        "welch_p": float(welch),
        "mean_with": mean_with,
        "mean_without": mean_without,
        "n_with": len(scores_with),
        "n_without": len(scores_without),
    }


def table5_layout(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """
    Table 5 as the paper prints it: one row a study, differences with * where Welch's p < 0.05 and ** where p < 0.01 (the
    paper only says "t-test"), a dash where a class is empty.
    """

    def cell(row: pd.Series) -> str:
        if np.isnan(row["difference"]):
            return "–"
        return f"{row['difference']:+.2f}{'*' * sum(row['welch_p'] < level for level in (0.05, 0.01))}"

    return pd.DataFrame({name: table.apply(cell, axis=1) for name, table in tables.items()}).T


def effects(table: pd.DataFrame, by: str | Sequence[str]) -> pd.DataFrame:
    """
    Scores of the analysed trials of each group, and their differences from all others: ``by="horizon"``,
    ``by=["operator", "negatives"]``, ``by="operation"`` (the effect of the mutations), ``by="generation"``.
    """
    trials = analysed(table)
    groups = trials.groupby(by if isinstance(by, str) else list(by))["score"]
    result = groups.agg(n="size", mean="mean", std="std", median="median")
    group = groups.ngroup()
    tests = [_compare(trials["score"][group == i], trials["score"][group != i]) for i in range(len(result))]
    return result.join(pd.DataFrame(tests, index=result.index, columns=["difference", "welch_p"], dtype=float))


def importances(table: pd.DataFrame) -> pd.DataFrame:
    """
    How much of the scores each parameter of the losses explains: mean decrease of impurity in a random forest.

    A loss has no parameters for tokens beyond its horizon: such a token is not chosen. The horizon and, if they vary,
    operator and negatives are parameters too: what they explain is not attributed to the tokens.
    """
    trials = analysed(table)
    scores = trials["score"]
    if scores.nunique() < 2:
        raise ValueError(f"importances need different scores; there are {len(trials)} complete trials, all alike")
    params = pd.DataFrame([loss_to_params(loss, OPERATORS) for loss in trials["loss"]], index=trials.index)
    tokens = params.drop(columns=["horizon", "operator", "negatives"]).eq(True)
    varied = [name for name in ("operator", "negatives") if trials[name].nunique() > 1]
    others = trials[["horizon", *varied]].apply(lambda column: column.astype("category").cat.codes)
    features = tokens.join(others)
    # Optuna's settings of MeanDecreaseImpurityImportanceEvaluator.
    forest = RandomForestRegressor(n_estimators=64, max_depth=64, random_state=0).fit(features, scores)
    result = pd.DataFrame({"importance": forest.feature_importances_}, index=features.columns)
    comparisons = {name: _compare(scores[tokens[name]], scores[~tokens[name]]) for name in tokens}
    columns = ["difference", "n_with", "n_without"]
    result = result.join(pd.DataFrame.from_dict(comparisons, orient="index", columns=columns))
    return result.astype({"n_with": "Int64", "n_without": "Int64"}).sort_values("importance", ascending=False, kind="stable")


def diversity(table: pd.DataFrame) -> pd.DataFrame:
    """
    How different the losses of each generation are. Trials that are complete or pruned count: the slot of a failed one has
    another candidate, and one that runs may still fail. ``distinct`` is the share of different canonical forms, operators
    included, ``hamming`` the mean over all pairs of the number of bits in which the masks of their canonical forms differ,
    shorter ones filled up with zeros.
    """
    trials = table[table["state"].isin(["complete", "pruned"]) & table["loss"].notna()]
    rows = {}
    for generation, losses in trials.groupby("generation")["canonical"]:
        width = 3 * max(loss.horizon for loss in losses) + 1
        masks = [np.pad([loss.source, loss.target], ((0, 0), (0, width - len(loss.source)))).ravel() for loss in losses]
        hamming = pdist(np.array(masks), "hamming").mean() * 2 * width if len(losses) > 1 else np.nan
        rows[generation] = {"n": len(losses), "distinct": losses.nunique() / len(losses), "hamming": hamming}
    result = pd.DataFrame.from_dict(rows, orient="index", columns=["n", "distinct", "hamming"])
    return result.astype({"n": int}).rename_axis("generation")


def rankings(table: pd.DataFrame) -> pd.DataFrame:
    """
    The trials of :func:`analysed` that have a curve, with their scores under the metrics: AULC, and the mean returns at the
    first and the last checkpoint.
    """
    trials = table[table["curve"].map(len) > 0]
    if trials.empty:
        raise ValueError("no complete trial has a learning curve")
    if trials["curve"].map(lambda curve: tuple(point[0] for point in curve)).nunique() > 1:
        raise ValueError("trials were evaluated at different environment steps: their learning curves cannot be compared")
    returns = np.array([[point[1] for point in curve] for curve in trials["curve"]])
    return trials[["number", "curve"]].assign(aulc=returns.mean(axis=1), first=returns[:, 0], last=returns[:, -1])


def leaders(table: pd.DataFrame, top: int = 10) -> pd.DataFrame:
    """The learning curves of the best trials under each metric, for ``learning_curves_plot`` (paper, B.2, figure 10)."""
    ranking = rankings(analysed(table))
    names = {"aulc": "by AULC", "first": "by the first evaluation", "last": "by the last evaluation"}
    rows = []
    for metric, name in names.items():
        best = ranking.nlargest(top, metric)
        for number, curve in zip(best["number"], best["curve"], strict=True):
            rows += [(name, f"The best {top} candidates", number, *point[:2], math.nan) for point in curve]
    return pd.DataFrame(rows, columns=["variant", "env", "seed", "environment_steps", "mean", "std"])


def lineage(table: pd.DataFrame, direction: StudyDirection = StudyDirection.MAXIMIZE) -> pd.DataFrame:
    """The best trial and all its ancestors, the latest first; ``gain`` is the score less that of the best parent."""
    numbers = set(ranked(table, direction)["number"][:1])
    for number in range(max(numbers, default=-1), -1, -1):
        if number in numbers:
            numbers |= set(table["parents"][number])
    line = table.loc[sorted(numbers, reverse=True)].set_index("number")
    best = pd.Series.max if direction == StudyDirection.MAXIMIZE else pd.Series.min
    before = [best(table["score"][parents]) if parents else np.nan for parents in line["parents"]]
    line["gain"] = line["score"] - np.array(before, dtype=float)
    line["loss"] = [None if loss is None else str(loss) for loss in line["loss"]]
    return line[["generation", "operation", "parents", "score", "gain", "loss"]]


def machines(trials: Sequence[FrozenTrial]) -> pd.DataFrame:
    """
    Where the trials were trained, and how long it took, one run after the other; failed ones count, interrupted ones do not.
    ``core_hours`` are hours x threads, NaN for GPUs.
    """
    rows = []
    for attributes in (trial.user_attrs for trial in trials if "seconds" in trial.user_attrs):
        hours = attributes["seconds"] / 3600
        device, commit = (str(attributes.get(key, "not noted")) for key in ("device", "commit"))
        rows.append((device, commit, hours, hours * attributes.get("threads", 1) if device.startswith("CPU") else np.nan))
    table = pd.DataFrame(rows, columns=["device", "commit", "hours", "core_hours"])
    groups = table.groupby(["device", "commit"], sort=False)
    # min_count: the sum of nothing but NaN is NaN.
    sums = groups[["hours", "core_hours"]].sum(min_count=1)
    return groups.size().to_frame("trials").join(sums)


class Summary(NamedTuple):
    """The tables of a study's losses by name, as returned by the functions above, and why one cannot be made, by its name."""

    tables: dict[str, pd.DataFrame]
    problems: dict[str, str]


def summary(
    trials: Sequence[FrozenTrial],
    direction: StudyDirection = StudyDirection.MAXIMIZE,
    patterns: Mapping[str, str | AuxLoss] = PATTERNS,
) -> Summary:
    """Everything above for one study; ``operator`` only if it was searched, the losses of ``lineage`` as their notation."""
    table = trial_table(trials)
    operator = ["operator", "negatives"]
    tables = {
        "population": population(table).to_frame().rename_axis("state"),
        "table5": table5(table, patterns).rename_axis("pattern"),
        "horizon": effects(table, "horizon"),
        "operation": effects(table, "operation"),
        "diversity": diversity(table),
        "lineage": lineage(table, direction),
        "machines": machines(trials),
    }
    if len(analysed(table)[operator].drop_duplicates()) > 1:
        tables["operator"] = effects(table, operator)
    problems = {}
    try:
        tables["importances"] = importances(table).rename_axis("parameter")
    except ValueError as error:
        problems["importances"] = str(error)
    try:
        ranking = rankings(analysed(table))
        tables["rank_agreement"] = ranking[["aulc", "first", "last"]].corr("spearman").rename_axis("metric")
    except ValueError as error:
        problems["rank_agreement"] = str(error)
    return Summary(tables, problems)


def readable(name: str, table: pd.DataFrame) -> pd.DataFrame:
    """A table of a summary as texts: a dash for missing values, * where Welch's p < 0.05 and ** where it is < 0.01."""

    def cell(column: Any, value: Any) -> str:
        if isinstance(value, list):
            return ", ".join(map(str, value)) or "–"
        if value is None or value is pd.NA or (isinstance(value, float) and np.isnan(value)):
            return "–"
        if isinstance(value, bool):
            return "yes" if value else "no"
        return format(value, FORMATS.get(column, ".2f" if isinstance(value, float) else ""))

    flat = table.reset_index()
    text = pd.DataFrame({column: [cell(column, value) for value in flat[column].tolist()] for column in flat}, dtype=object)
    if name == "table5":
        text["difference"] = list(table5_layout({"": table}).iloc[0])
    if "operation" in text:
        text["operation"] = text["operation"].str.replace("_", " ")
    return text.rename(columns=lambda column: HEADINGS.get(column, str(column).replace("_", " ").capitalize()))
