"""What a search teaches about auxiliary losses (paper, section 3.3, B.2, B.3): functions of trials or of a table of them."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial
from sb3_aarl.search.evolution.space import loss_of, other_params, score_of
from scipy.stats import ttest_ind

from sb3_aarl import catalog
from sb3_aarl.aux_loss import AuxLoss

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
# Formats of the columns where these are not integers or .2f, and their headings where these are not their names.
FORMATS = {"difference": "+.2f", "gain": "+.2f", "welch_p": ".2g"}
HEADINGS = {
    **{"n": "Losses", "std": "Deviation", "number": "Trial", "device": "Trained on", "average": "Mean", "welch_p": "Welch p"},
    **{name: f"n {name[2:]}" for name in ("n_with", "n_without", "n_neither")},
}
COLUMNS: dict[str, Any] = {
    **{"number": int, "state": str, "generation": int, "operation": str, "parents": object, "score": float},
    **{"loss": object, "canonical": object, "horizon": "Int64", "operator": object, "negatives": "boolean", "curve": object},
    "others": object,
}


def trial_table(trials: Sequence[FrozenTrial]) -> pd.DataFrame:
    """
    The trials of a study as the table that the other functions take, one row each, finished or not: ``score`` is NaN where
    there is none, ``loss`` and ``canonical`` an AuxLoss or None, ``curve`` a list of (environment steps, mean return),
    ``others`` the parameters that were searched beside the loss.
    """
    rows = []
    for trial in trials:
        loss = loss_of(trial)
        row = {
            "number": trial.number,
            "state": "interrupted" if trial.user_attrs.get("interrupted") else trial.state.name.lower(),
            # Other samplers than AuxLossSampler have one generation only.
            "generation": trial.user_attrs.get("generation", 1),
            "operation": trial.user_attrs.get("operation", "-"),
            "parents": list(trial.user_attrs.get("parents", ())),
            "score": score_of(trial),
            "loss": loss,
            "canonical": None if loss is None else loss.canonical(),
            "curve": trial.user_attrs.get("curve", []),
            "others": other_params(trial.params),
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


def has_pattern(loss: AuxLoss, pattern: AuxLoss) -> bool:
    """
    The paper's rule (section 3.3): a candidate has a pattern if the pattern's source is a subset of the candidate's source,
    and the pattern's target is a subset of the candidate's target.

    Nothing is shifted in time: ``{s_t+1, a_t+1} -> {s_t+2}`` does not have the pattern ``{s_t, a_t} -> {s_t+1}``, though its
    canonical form does. Operators do not matter.
    """
    sides = ((pattern.source_tokens, loss.source_tokens), (pattern.target_tokens, loss.target_tokens))
    return all(set(few) <= set(many) for few, many in sides)


def pattern_scores(
    table: pd.DataFrame, patterns: Mapping[str, str | AuxLoss] = PATTERNS
) -> dict[str, tuple[pd.Series, pd.Series]]:
    """
    The scores of the trials with and of those without each pattern, and of the other columns of table 5.

    Section 3.3 compares losses with n_target > n_source to "the other way around", which it writes n_target < n_source. So
    a loss with n_target = n_source is in neither class.
    """
    scores, losses = analysed(table)["score"], analysed(table)["loss"]
    result = {}
    for name, pattern in patterns.items():
        parsed = catalog.resolve(pattern)
        has = losses.map(lambda loss, parsed=parsed: has_pattern(loss, parsed)).astype(bool)
        result[name] = scores[has], scores[~has]
    for i, name in enumerate(COUNTS):
        surplus = losses.map(lambda loss, i=i: sum(loss.target[i::3]) - sum(loss.source[i::3])).astype(int)
        result[name] = scores[surplus > 0], scores[surplus < 0]
    return result


def table5(table: pd.DataFrame, patterns: Mapping[str, str | AuxLoss] = PATTERNS) -> pd.DataFrame:
    """
    Whether losses with a pattern have other scores than those without it (paper, section 3.3, table 5).

    All analysed trials are one sample, as in the paper. They descend from each other, and p-values are not corrected for the
    number of tests: they are too low.
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


def effects(table: pd.DataFrame, by: str | Sequence[str]) -> pd.DataFrame:
    """Scores of the analysed trials of each group, such as ``by="horizon"``, and their differences from all others."""
    trials = analysed(table)
    groups = trials.groupby(by if isinstance(by, str) else list(by))["score"]
    result = groups.agg(n="size", mean="mean", std="std", median="median")
    group = groups.ngroup()
    tests = [_compare(trials["score"][group == i], trials["score"][group != i]) for i in range(len(result))]
    return result.join(pd.DataFrame(tests, index=result.index, columns=["difference", "welch_p"], dtype=float))


def lineage(
    table: pd.DataFrame, direction: StudyDirection = StudyDirection.MAXIMIZE, number: int | None = None
) -> pd.DataFrame:
    """
    A trial, None for the best one, and all its ancestors, the latest first. ``gain`` is the score less that of the best
    parent.
    """
    numbers = set(ranked(table, direction)["number"][:1]) if number is None else {number}
    for earlier in range(max(numbers, default=-1), -1, -1):
        if earlier in numbers:
            numbers |= set(table["parents"][earlier])
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


def summary(
    trials: Sequence[FrozenTrial], direction: StudyDirection = StudyDirection.MAXIMIZE, best: int | None = None
) -> dict[str, pd.DataFrame]:
    """Everything above for one study by name, ``best`` as for ``lineage``; ``operator`` only if it was searched."""
    table = trial_table(trials)
    operator = ["operator", "negatives"]
    tables = {
        "table5": table5(table).rename_axis("pattern"),
        "horizon": effects(table, "horizon"),
        "operator": effects(table, operator) if len(analysed(table)[operator].drop_duplicates()) > 1 else None,
        "operation": effects(table, "operation"),
        "lineage": lineage(table, direction, best),
        "machines": machines(trials),
    }
    return {name: found for name, found in tables.items() if found is not None}


def readable(table: pd.DataFrame) -> pd.DataFrame:
    """
    A table of a summary as texts: a dash for missing values; at differences of table 5 * where Welch's p < 0.05 and ** where
    it is < 0.01 (the paper only says "t-test").
    """

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
    if "pattern" in text:
        text["difference"] += ["*" * sum(p < level for level in (0.05, 0.01)) for p in flat["welch_p"]]
    if "operation" in text:
        text["operation"] = text["operation"].str.replace("_", " ")
    return text.rename(columns=lambda column: HEADINGS.get(column, str(column).replace("_", " ").capitalize()))
