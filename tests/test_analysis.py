"""Analysis of trials: against scipy, naive counts, and effects that were planted."""

import re

import numpy as np
import optuna
import pandas as pd
import pytest
import scipy.stats
from hypothesis import given
from optuna.study import StudyDirection
from optuna.trial import TrialState, create_trial
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import distributions, loss_to_params, random_loss, suggest_aux_loss
from sb3_aarl.search.results import analysis
from test_space import losses

from sb3_aarl.aux_loss import OPERATORS, AuxLoss

# Section 3.3, typed in again.
PATTERNS = {
    "Forward dynamics": ({"s_t", "a_t"}, {"s_t+1"}),
    "Inverse dynamics": ({"a_t", "s_t+1"}, {"s_t"}),
    "Reward prediction": ({"s_t", "a_t"}, {"r_t"}),
    "Action inference": ({"s_t", "s_t+1"}, {"a_t"}),
    "State reconstruction": ({"s_t"}, {"s_t"}),
}
COUNTS = {"State, n_target > n_source": "s", "Action, n_target > n_source": "a", "Reward, n_target > n_source": "r"}


def tokens(loss):
    """Both sets as texts, out of the notation."""
    source, target = str(loss).split(" -> ")
    return tuple(set(re.findall(r"[sar]_t(?:\+\d+)?", part)) for part in (source, target))


def naive_class(loss, name):
    source, target = tokens(loss)
    if name in PATTERNS:
        return PATTERNS[name][0] <= source and PATTERNS[name][1] <= target
    n_source, n_target = (sum(token[0] == COUNTS[name] for token in side) for side in (source, target))
    return None if n_source == n_target else n_target > n_source


def make_trial(loss, value=None, state=TrialState.COMPLETE, operators=None, **attrs):
    params = {} if loss is None else loss_to_params(loss, operators)
    space = {} if loss is None else distributions(loss.horizon, operators=operators)
    return create_trial(state=state, value=value, params=params, distributions=space, user_attrs=attrs)


def in_study(trials):
    study = optuna.create_study(direction="maximize")
    study.add_trials(trials)
    return study.get_trials(deepcopy=False)


# What the planted scores are made of.
EFFECTS = {"Forward dynamics": 40.0, "State, n_target > n_source": 60.0, "Reward prediction": -50.0}


@pytest.fixture(scope="module")
def planted():
    """800 candidates with planted effects, among them trials of every other kind; the table, and the candidates."""
    rng = np.random.default_rng(0)
    candidates = []
    for _ in range(800):
        loss = random_loss(rng, 3)
        effect = sum(size for name, size in EFFECTS.items() if naive_class(loss, name))
        candidates.append((loss, 100 + effect + rng.normal(0, 20)))
    trials = [make_trial(loss, value, generation=1 + i // 200) for i, (loss, value) in enumerate(candidates)]
    loss = candidates[0][0]
    others = [
        *(make_trial(loss, state=TrialState.FAIL, generation=2) for _ in range(4)),
        make_trial(loss, state=TrialState.FAIL, interrupted=True),
        *(make_trial(loss, 1e9, state=TrialState.PRUNED, generation=2) for _ in range(3)),
        *(make_trial(loss, state=TrialState.RUNNING, generation=3) for _ in range(2)),
        make_trial(None, state=TrialState.RUNNING),
        make_trial(None, state=TrialState.WAITING),
        make_trial(loss, np.inf),
        make_trial(None, 5.0),
    ]
    return analysis.trial_table(in_study([*trials[:300], *others, *trials[300:]])), candidates


@given(losses(), losses(max_horizon=2))
def test_rule_is_that_of_sets(loss, pattern):
    (source, target), (pattern_source, pattern_target) = tokens(loss), tokens(pattern)
    assert analysis.has_pattern(loss, pattern) == (pattern_source <= source and pattern_target <= target)


def test_table5_recovers_planted_effects_as_scipy_tests_them(planted):
    table, candidates = planted
    result = analysis.table5(table)
    assert list(result.index) == [*PATTERNS, *COUNTS]
    for name, row in result.iterrows():
        groups = {
            value: np.array([score for loss, score in candidates if naive_class(loss, name) is value])
            for value in (True, False, None)
        }
        with_, without = groups[True], groups[False]
        assert (row["n_with"], row["n_without"], row["n_neither"]) == tuple(map(len, groups.values()))
        assert row["difference"] == pytest.approx(with_.mean() - without.mean(), abs=1e-9)
        assert row["mean_with"] == pytest.approx(with_.mean(), abs=1e-9)
        assert row["mean_without"] == pytest.approx(without.mean(), abs=1e-9)
        summary = (with_.mean(), with_.std(ddof=1), len(with_), without.mean(), without.std(ddof=1), len(without))
        # Another way to it: from the moments alone.
        expected = scipy.stats.ttest_ind_from_stats(*summary, equal_var=False).pvalue
        assert row["welch_p"] == pytest.approx(expected, rel=1e-6, abs=1e-300)
    for name, size in EFFECTS.items():
        assert np.sign(result["difference"][name]) == np.sign(size) and result["welch_p"][name] < 1e-4


def test_patterns_in_notation_and_by_name(planted):
    table, candidates = planted
    patterns = {"two rewards": "{s_t} -> {r_t, r_t+1}", "named": "forward-dynamics", "value": AuxLoss.parse("{s_t} -> {s_t}")}
    result = analysis.table5(table, patterns)
    assert list(result.index) == [*patterns, *COUNTS]
    n_with = sum({"s_t"} <= tokens(loss)[0] and {"r_t", "r_t+1"} <= tokens(loss)[1] for loss, _ in candidates)
    assert result["n_with"]["two rewards"] == n_with > 0
    with pytest.raises(ValueError, match="forward-dynamic"):
        analysis.table5(table, {"typo": "forward-dynamcs"})
    with pytest.raises(ValueError, match="is not a token"):
        analysis.table5(table, {"typo": "{s_t} -> {q_t}"})


def test_stars_of_table5(planted):
    result = analysis.table5(planted[0]).rename_axis("pattern")
    result.loc["Inverse dynamics", ["difference", "welch_p"]] = -3.514, 0.03
    result.loc["Action inference", ["difference", "welch_p"]] = 42.438, 0.0099
    result.loc["State reconstruction", ["difference", "welch_p"]] = np.nan
    shown = analysis.readable(result).set_index("Pattern")["Difference"]
    names = ["Inverse dynamics", "Action inference", "State reconstruction"]
    assert shown[names].tolist() == ["-3.51*", "+42.44**", "–"]


@pytest.mark.filterwarnings("error")
def test_small_studies_give_counts_and_no_p_values():
    trials = in_study([make_trial(AuxLoss.parse("{s_t, a_t} -> {s_t+1}"), value) for value in (1.0, 3.0)])
    row = analysis.table5(analysis.trial_table(trials)).loc["Forward dynamics"]
    assert (row["n_with"], row["n_without"], row["mean_with"]) == (2, 0, 2.0)
    assert row[["difference", "welch_p", "mean_without"]].isna().all()
    empty = analysis.trial_table([])
    assert analysis.table5(empty)["n_with"].sum() == 0
    assert analysis.effects(empty, "horizon").empty and analysis.lineage(empty).empty
    assert analysis.lineage(analysis.trial_table([make_trial(None, state=TrialState.FAIL)])).empty


def test_effects_are_those_of_groups_against_the_rest():
    rng = np.random.default_rng(2)
    drawn = [random_loss(rng, 4, OPERATORS) for _ in range(200)]
    scores = [rng.normal(10 * loss.negatives - 3 * loss.horizon, 5) for loss in drawn]
    trials = [make_trial(loss, score, operators=OPERATORS) for loss, score in zip(drawn, scores, strict=True)]
    table = analysis.trial_table(in_study([*trials, make_trial(drawn[0], state=TrialState.FAIL, operators=OPERATORS)]))
    for by in ("horizon", ["operator", "negatives"]):
        result = analysis.effects(table, by)
        assert result["n"].sum() == 200
        for key, row in result.iterrows():
            member = [
                loss.horizon == key if by == "horizon" else (loss.operator, loss.negatives) == tuple(key) for loss in drawn
            ]
            own, rest = np.array(scores)[member], np.array(scores)[~np.array(member)]
            assert row["n"] == len(own)
            statistics = (own.mean(), own.std(ddof=1), np.median(own), own.mean() - rest.mean())
            np.testing.assert_allclose(row[["mean", "std", "median", "difference"]].astype(float), statistics)
            p_value = scipy.stats.ttest_ind(own, rest, equal_var=False).pvalue
            np.testing.assert_allclose(row["welch_p"], p_value, rtol=1e-9)
    # Studies side by side keep their trials apart even though the numbers repeat.
    twice = analysis.effects(pd.concat([table.assign(task="a"), table.assign(task="b")], ignore_index=True), "task")
    assert twice["n"].tolist() == [200, 200] and twice["difference"].abs().max() < 1e-9


def test_an_evolution_of_the_sampler():
    """Columns out of a real search, which has no loss twice; its winner's line goes back to the first generation."""
    sampler = AuxLossSampler(population_size=20, n_random=16, n_prior=4, max_horizon=3, seed=0, n_generations=5)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    study.optimize(lambda trial: float(sum(suggest_aux_loss(trial, 3).target)), n_trials=100)
    trials = study.get_trials(deepcopy=False)
    table = analysis.trial_table(trials)
    assert table["score"].tolist() == [sum(loss.target) for loss in table["loss"]]
    assert table["generation"].value_counts().to_dict() == dict.fromkeys(range(1, 6), 20)
    assert set(table["operation"]) == {"random", "prior", "replacement", "crossover", "horizon_change"}
    line = analysis.lineage(table)
    assert line["score"].iloc[0] == table["score"].max() and line.index.is_monotonic_decreasing
    assert line["generation"].min() == 1 and not line["parents"].iloc[-1]
    found, todo = set(), [int(line.index[0])]
    while todo:
        found.add(todo.pop())
        todo += [parent for number in found for parent in table["parents"][number] if parent not in found]
    assert set(line.index) == found
    for row in line.itertuples():
        expected = row.score - max(table["score"][row.parents]) if row.parents else np.nan
        np.testing.assert_equal(row.gain, expected)
        assert AuxLoss.parse(row.loss) == table["loss"][row.Index]
    worst = analysis.lineage(table, StudyDirection.MINIMIZE)
    assert worst["score"].iloc[0] == table["score"].min()
