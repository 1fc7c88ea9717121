"""Plots hold exactly the data of the trials."""

import io
import math
from collections import defaultdict

import matplotlib.image
import numpy as np
import optuna
import pytest
from optuna.study import StudyDirection
from optuna.trial import TrialState, create_trial

from sb3_aarl.aux_loss import AuxLoss
from search.plots import evolution_figure, learning_curve_png, learning_curves_figure
from search.space import distributions, loss_to_params
from search.trials import curve_of, lineage, loss_of, ranked

LOSS = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
BASELINES = [("SAC", 12.5), ("<b>CURL</b>", -3.0)]


def make_trial(value=None, state=TrialState.COMPLETE, loss=LOSS, **attrs):
    params = {} if loss is None else loss_to_params(loss)
    space = {} if loss is None else distributions(loss.horizon)
    return create_trial(state=state, value=value, params=params, distributions=space, user_attrs=attrs)


def make_trials(*trials):
    study = optuna.create_study(direction="maximize")
    study.add_trials(trials)
    return study.get_trials(deepcopy=False)


@pytest.fixture
def trials():
    rng = np.random.default_rng(0)
    drawn = [make_trial(rng.normal(), stage=int(rng.integers(1, 4)), operation="crossover") for _ in range(60)]
    others = [
        make_trial(state=TrialState.FAIL, stage=2),
        make_trial(state=TrialState.PRUNED, stage=2),
        make_trial(state=TrialState.RUNNING, loss=None),
        make_trial(math.inf, stage=1),
    ]
    return make_trials(*drawn[:30], *others, *drawn[30:])


def scores_by_stage(trials):
    scores = defaultdict(list)
    for trial in trials:
        if trial.state == TrialState.COMPLETE and abs(trial.value) < math.inf:
            scores[trial.user_attrs["stage"]].append(trial.value)
    return scores


@pytest.mark.parametrize("direction, best", [(StudyDirection.MAXIMIZE, max), (StudyDirection.MINIMIZE, min)])
def test_evolution_shows_every_candidate_in_its_stage(trials, direction, best):
    candidates, bests, means, *lines = evolution_figure(trials, BASELINES, direction).data
    drawn = defaultdict(list)
    for x, y in zip(candidates.x, candidates.y, strict=True):
        assert abs(x - round(x)) <= 0.3  # stages do not touch
        drawn[round(x)].append(y)
    assert drawn == scores_by_stage(trials)
    assert len(set(candidates.x)) == 60  # spread, not one above the other
    assert bests.x == means.x == (1, 2, 3)
    np.testing.assert_allclose(bests.y, [best(drawn[stage]) for stage in (1, 2, 3)])
    np.testing.assert_allclose(means.y, [np.mean(drawn[stage]) for stage in (1, 2, 3)])
    assert [(line.name, *line.y) for line in lines] == [("SAC", 12.5, 12.5), ("&lt;b&gt;CURL&lt;/b&gt;", -3.0, -3.0)]
    assert len({line.line.dash for line in lines}) == 2 and "solid" not in {line.line.dash for line in lines}


def test_evolution_says_what_a_candidate_is():
    trials = make_trials(make_trial(1.0, stage=1, operation="<script>"), make_trial(2.0, loss=None))
    candidates = evolution_figure(trials).data[0]
    assert list(candidates.customdata[0]) == [0, "{s_t, a_t} -&gt; {s_t+1}", "&lt;script&gt;"]
    assert list(candidates.customdata[1]) == [1, "no loss", "-"]


def test_evolution_of_nothing():
    figure = evolution_figure([], BASELINES)
    assert [len(trace.y) for trace in figure.data] == [0, 0, 0, 2, 2]


def test_figures_are_plain_numbers(trials):
    """The plotly.js of the dashboard does not know the packed arrays of newer ones."""
    assert "bdata" not in evolution_figure(trials, BASELINES).to_json()


def test_learning_curves_of_trials_that_have_one():
    curve = [[1000, 1.5, 0.5], [2000, 3.0, 0.25]]
    trials = make_trials(*(make_trial(1.0, curve=value) for value in (curve, None, "broken", [[1]], curve[:1], [])))
    figure = learning_curves_figure(trials)
    assert [trace.name for trace in figure.data] == ["trial 0", "trial 4"]
    assert figure.data[0].x == (1000, 2000) and figure.data[0].y == (1.5, 3.0)
    assert figure.data[0].error_y.array == (0.5, 0.25)
    assert [curve_of(trial) != [] for trial in trials] == [True, False, False, False, True, False]


def test_many_learning_curves_differ_in_grey():
    trials = make_trials(*(make_trial(1.0, curve=[[1, value, 0.0]]) for value in range(5)))
    looks = {(trace.line.dash, trace.marker.symbol) for trace in learning_curves_figure(trials).data}
    assert len(looks) == 5


@pytest.mark.parametrize("slope", [1, -1])
def test_png_of_a_learning_curve(slope):
    curve = [(step, slope * step / 100, 1.0) for step in range(0, 1000, 100)]
    image = matplotlib.image.imread(io.BytesIO(learning_curve_png(curve, r"$\{s_t\} \rightarrow \{s_{t+1}\}$")))
    assert image.shape[:2] == (380, 640)
    line = np.abs(image[..., :3] - np.array([0x1F, 0x4E, 0x79]) / 255).max(-1) < 0.02
    # The lowest pixels of the line at both ends: a legend lies above it.
    left, right = (np.nonzero(line[:, columns])[0].max() for columns in (slice(0, 160), slice(480, 640)))
    assert (right - left) * slope < -50  # rows are counted from above


def test_ranked_and_losses(trials):
    best = ranked(trials)
    assert [trial.value for trial in best] == sorted((s for of in scores_by_stage(trials).values() for s in of), reverse=True)
    assert ranked(trials, StudyDirection.MINIMIZE)[0] is best[-1]
    assert loss_of(best[0]) == LOSS
    assert loss_of(trials[32]) is None


def test_lineage_reaches_every_ancestor_and_the_first_line_first():
    rng = np.random.default_rng(1)
    parents = [[]] * 5 + [rng.choice(number, rng.integers(0, 3), replace=False).tolist() for number in range(5, 60)]
    trials = make_trials(*(make_trial(float(number), parents=of) for number, of in enumerate(parents)))

    def ancestors(number):
        return {number for parent in parents[number] for number in {parent, *ancestors(parent)}}

    for trial in trials:
        found = [ancestor.number for ancestor in lineage(trial, trials)]
        assert set(found) == ancestors(trial.number) and len(found) == len(set(found))
        line, number = [], trial.number
        while parents[number]:
            number = parents[number][0]
            line.append(number)
        assert found[: len(line)] == line


def test_lineage_of_nonsense():
    trials = make_trials(make_trial(1.0, parents=[0, 1, -1, "x", None]), make_trial(1.0, parents="0"))
    assert [lineage(trial, trials) for trial in trials] == [[], []]
