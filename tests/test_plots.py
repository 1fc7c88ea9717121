"""Plots hold exactly the data of the trials."""

import io
import math
import warnings
from collections import defaultdict

import matplotlib.image
import numpy as np
import optuna
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from optuna.study import StudyDirection
from optuna.trial import TrialState, create_trial
from sb3_aarl.search.evolution.space import distributions, loss_to_params, random_loss
from sb3_aarl.search.results import analysis
from sb3_aarl.search.results.plots import (
    evolution_figure,
    evolution_plot,
    histogram_plot,
    learning_curves_plot,
    patterns_plot,
    rankings_plot,
)

from sb3_aarl.aux_loss import AuxLoss

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
    drawn = [make_trial(rng.normal(), generation=int(rng.integers(1, 4)), operation="crossover") for _ in range(60)]
    others = [
        make_trial(state=TrialState.FAIL, generation=2),
        make_trial(state=TrialState.PRUNED, generation=2),
        make_trial(state=TrialState.RUNNING, loss=None),
        make_trial(math.inf, generation=1),
    ]
    return make_trials(*drawn[:30], *others, *drawn[30:])


def scores_by_generation(trials):
    scores = defaultdict(list)
    for trial in trials:
        if trial.state == TrialState.COMPLETE and abs(trial.value) < math.inf:
            scores[trial.user_attrs["generation"]].append(trial.value)
    return scores


@pytest.mark.parametrize("direction, best", [(StudyDirection.MAXIMIZE, max), (StudyDirection.MINIMIZE, min)])
def test_evolution_shows_every_candidate_in_its_generation(trials, direction, best):
    candidates, bests, means, *lines = evolution_figure(analysis.trial_table(trials), BASELINES, direction).data
    drawn = defaultdict(list)
    for x, y in zip(candidates.x, candidates.y, strict=True):
        assert abs(x - round(x)) <= 0.3  # generations do not touch
        drawn[round(x)].append(y)
    assert drawn == scores_by_generation(trials)
    assert len(set(candidates.x)) == 60  # spread, not one above the other
    assert bests.x == means.x == (1, 2, 3)
    np.testing.assert_allclose(bests.y, [best(drawn[generation]) for generation in (1, 2, 3)])
    np.testing.assert_allclose(means.y, [np.mean(drawn[generation]) for generation in (1, 2, 3)])
    assert [(line.name, *line.y) for line in lines] == [("SAC", 12.5, 12.5), ("&lt;b&gt;CURL&lt;/b&gt;", -3.0, -3.0)]
    assert len({line.line.dash for line in lines}) == 2 and "solid" not in {line.line.dash for line in lines}


def test_evolution_names_the_candidates():
    trials = make_trials(make_trial(1.0, generation=1, operation="<script>"), make_trial(2.0, loss=None))
    candidates = evolution_figure(analysis.trial_table(trials)).data[0]
    assert list(candidates.customdata[0]) == [0, "{s_t, a_t} -&gt; {s_t+1}", "&lt;script&gt;"]
    assert list(candidates.customdata[1]) == [1, "no loss", "-"]


def texts(figure):
    """All that is written in a figure, but for the ticks."""
    written = [text.get_text() for legend in figure.legends for text in legend.get_texts()] + [figure.get_suptitle()]
    for axes in figure.axes:
        written += [axes.get_title(), axes.get_xlabel(), axes.get_ylabel()]
    return [text for text in written if text]


def legend_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def check_drawing(figure):
    """It can be drawn, has ink, and nothing that is written lies outside the picture or on top of something else."""
    file = io.BytesIO()
    figure.savefig(file, format="png")
    assert matplotlib.image.imread(io.BytesIO(file.getvalue()))[..., :3].min() < 0.2
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [legend.get_window_extent(renderer) for legend in figure.legends]
    for axes in figure.axes:
        for text in (axes.title, axes.xaxis.label, axes.yaxis.label):
            if text.get_text():
                boxes.append(text.get_window_extent(renderer))
    for i, box in enumerate(boxes):
        assert box.x0 >= -1 and box.y0 >= -1 and box.x1 <= figure.bbox.x1 + 1 and box.y1 <= figure.bbox.y1 + 1
        assert not any(box.overlaps(other) for other in boxes[:i])


def luminance(colour):
    return float(np.dot(to_rgb(colour), (0.299, 0.587, 0.114)))


@pytest.fixture
def tables():
    """Two studies with learning curves, and trials of all other kinds."""
    studies = {}
    for seed, name in enumerate(["Cheetah-Run", "Walker-Walk"]):
        rng = np.random.default_rng(seed)
        drawn = []
        for i in range(80):
            curve = [[100_000 * (j + 1), float(rng.normal(100 * j + 50 * seed, 20)), 5.0] for j in range(5)]
            value = float(np.mean([mean for _, mean, _ in curve]))
            drawn.append(make_trial(value, loss=random_loss(rng, 2), generation=1 + i // 30, curve=curve))
        others = [make_trial(state=TrialState.FAIL, generation=1)] * 2 + [
            make_trial(1e6, state=TrialState.PRUNED, generation=2)
        ]
        studies[name] = analysis.trial_table(make_trials(*drawn, *others, make_trial(state=TrialState.RUNNING, loss=None)))
    return studies


def test_evolution_plot_draws_what_the_tables_say(tables):
    lines = {"Cheetah-Run": [("SAC", 150.0), ("CURL", 180.0)], "Walker-Walk": [("CURL", 230.0)]}
    figure = evolution_plot(tables, lines)
    assert legend_of(figure) == ["candidate", "best of the generation", "mean of the generation", "SAC", "CURL"]
    looks = {}
    for axes, (name, table) in zip(figure.axes, tables.items(), strict=True):
        drawn = {line.get_label(): line for line in axes.lines}
        scores = table[table["state"] == "complete"]
        np.testing.assert_array_equal(drawn["candidate"].get_ydata(), scores["score"])
        np.testing.assert_array_equal(np.round(drawn["candidate"].get_xdata()), scores["generation"])
        by_generation = [scores["score"][scores["generation"] == generation] for generation in (1, 2, 3)]
        np.testing.assert_allclose(drawn["best of the generation"].get_ydata(), [max(of) for of in by_generation])
        np.testing.assert_allclose(drawn["mean of the generation"].get_ydata(), [np.mean(of) for of in by_generation])
        for baseline, score in lines[name]:
            assert set(drawn[baseline].get_ydata()) == {score}
            looks.setdefault(baseline, set()).add((drawn[baseline].get_linestyle(), drawn[baseline].get_color()))
        assert axes.get_title() == f"{name}\n80 candidates (left out: 1 pruned, 2 failed, 1 running)"
        assert axes.get_xlabel() == "Generation"
    assert figure.axes[0].get_ylabel() == "Score (AULC, mean return)"
    # One look a baseline in all panels, and none like another's in grey.
    assert {len(of) for of in looks.values()} == {1} and len({style for of in looks.values() for style, _ in of}) == 2
    check_drawing(figure)
    lowest = evolution_plot(tables, direction=StudyDirection.MINIMIZE).axes[0].lines[1]
    assert lowest.get_ydata()[0] == tables["Cheetah-Run"].query("generation == 1 and state == 'complete'")["score"].min()


def test_histogram_is_in_percent_of_each_study(tables):
    figure = histogram_plot(tables)
    (axes,) = figure.axes
    for name, table in tables.items():
        scores = table["score"][table["state"] == "complete"]
        both = np.concatenate([other["score"][other["state"] == "complete"] for other in tables.values()])
        edges = np.linspace(both.min(), both.max(), 26)
        counts = np.histogram(scores, edges)[0]
        path = next(patch.get_xy() for patch in axes.patches if patch.get_label() == name)
        for count, left, right in zip(counts, edges[:-1], edges[1:], strict=True):
            middle = np.isclose(path[:, 0], left) | np.isclose(path[:, 0], right)
            assert np.isclose(path[middle, 1], 100 * count / 80).sum() >= 2
        mean = next(line for line in axes.lines if line.get_label() == f"{name}, mean")
        assert set(mean.get_xdata()) == {scores.mean()}
    assert axes.get_ylabel() == "Share of the candidates (%)" and axes.get_xlabel() == "Score (AULC, mean return)"
    assert [bool(patch.get_hatch()) for patch in axes.patches] == [False, True]
    assert axes.get_title().count("80 candidates (left out: 1 pruned, 2 failed, 1 running)") == 2
    check_drawing(figure)
    with pytest.raises(ValueError, match="at most 3 studies, not 4: 0, 1, 2, 3"):
        histogram_plot({str(i): tables["Cheetah-Run"] for i in range(4)})


@pytest.mark.parametrize("n_studies", [1, 2])
def test_patterns_plot_has_a_panel_for_each_column_of_table_5(tables, n_studies):
    """Of two studies side by side, or of one and a pattern of the user's own."""
    tables = dict(list(tables.items())[:n_studies])
    patterns = {"my own": "{s_t} -> {r_t}"} if n_studies == 1 else dict(list(analysis.PATTERNS.items())[:2])
    figure = patterns_plot(tables, patterns)
    names = [*patterns, *analysis.COUNTS]
    assert len(figure.axes) == len(names) * n_studies
    for i, axes in enumerate(figure.axes):
        name, title = names[i // n_studies], list(tables)[i % n_studies]
        row = analysis.table5(tables[title], patterns).loc[name]
        assert axes.get_title().startswith(name) and (n_studies == 1 or title in axes.get_title())
        assert axes.get_title().endswith(f"n = {row['n_with']:.0f} with, {row['n_without']:.0f} without")
        means = {line.get_label(): line.get_xdata()[0] for line in axes.lines}
        assert means["with, mean"] == row["mean_with"] and means["without, mean"] == row["mean_without"]
    assert legend_of(figure) == ["without", "with", "without, mean", "with, mean"]
    assert figure.get_suptitle().count("left out: 1 pruned, 2 failed, 1 running") == n_studies
    check_drawing(figure)


def test_rankings_plot_has_the_best_of_each_metric(tables):
    table = tables["Cheetah-Run"]
    figure = rankings_plot(table, top=6)
    curves = np.array([[mean for _, mean, _ in curve] for curve in table["curve"] if curve])
    tops = {}
    for axes, (name, values) in zip(
        figure.axes, {"aulc": curves.mean(axis=1), "first": curves[:, 0], "last": curves[:, -1]}.items(), strict=True
    ):
        expected = curves[np.argsort(-values)[:6]]
        *single, mean = axes.lines
        np.testing.assert_array_equal([line.get_ydata() for line in single], expected)
        np.testing.assert_allclose(mean.get_ydata(), expected.mean(axis=0))
        np.testing.assert_array_equal(mean.get_xdata(), [100_000, 200_000, 300_000, 400_000, 500_000])
        tops[name] = {tuple(curve) for curve in expected}
        dotted = {tuple(line.get_ydata()) for line in single if line.get_linestyle() == ":"}
        assert dotted == tops[name] - tops["aulc"]
    titles = [axes.get_title().partition("\n")[0] for axes in figure.axes]
    assert titles == ["Top 6 by AULC", "Top 6 by the return at 100k steps", "Top 6 by the return at 500k steps"]
    assert len({axes.get_ylim() for axes in figure.axes}) == 1
    check_drawing(figure)
    with pytest.raises(ValueError, match="no complete trial has a learning curve"):
        rankings_plot(table.assign(state="running"))


@pytest.fixture
def curves():
    rng = np.random.default_rng(0)
    rows = [
        (variant, env, seed, 10_000 * step, rng.normal(50 * step, 10), 7.0)
        for env in ("walker", "cheetah")
        for variant in ("aarl", "curl", "sac")
        for seed in range(1 if (env, variant) == ("cheetah", "sac") else 4)
        for step in range(12 if (variant, seed) == ("curl", 1) else 15)
    ]
    frame = pd.DataFrame(rows, columns=["variant", "env", "seed", "environment_steps", "mean", "std"])
    return frame.sample(frac=1, random_state=0)


def test_learning_curves_are_means_and_deviations_over_seeds(curves):
    order = list(dict.fromkeys(curves["env"]))
    figure = learning_curves_plot(curves)
    assert [axes.get_title().partition("\n")[0] for axes in figure.axes] == order
    for axes, env in zip(figure.axes, order, strict=True):
        looks = set()
        for line, shade in zip(axes.lines, axes.collections, strict=True):
            variant = line.get_label()
            runs = curves[(curves["env"] == env) & (curves["variant"] == variant)]
            # curl's second seed is not finished
            whole = runs.pivot(index="environment_steps", columns="seed", values="mean").dropna()
            assert len(whole) == (12 if variant == "curl" else 15)
            np.testing.assert_array_equal(line.get_xdata(), whole.index)
            np.testing.assert_allclose(line.get_ydata(), whole.mean(axis=1))
            spread = whole.to_numpy().std(axis=1, ddof=1) if whole.shape[1] > 1 else np.full(len(whole), 7.0)
            outline = shade.get_paths()[0].vertices
            for step, mean, deviation in zip(whole.index, whole.mean(axis=1), spread, strict=True):
                at_step = outline[np.isclose(outline[:, 0], step), 1]
                np.testing.assert_allclose((at_step.min(), at_step.max()), (mean - deviation, mean + deviation))
            looks.add((line.get_linestyle(), line.get_marker()))
        assert len(looks) == 3
        assert axes.get_xlabel() == "Environment steps"
    title = figure.axes[order.index("cheetah")].get_title()
    assert title == "cheetah\n1 to 4 seeds (shade of one: its episodes)"
    assert figure.axes[order.index("walker")].get_title() == "walker\n4 seeds"
    assert figure.axes[0].get_ylabel() == "Return (mean ± std)" and "aarl" in legend_of(figure)
    check_drawing(figure)


def test_many_variants_are_told_apart_and_leave_room_for_the_curves(curves):
    one = curves.query("env == 'walker' and variant == 'aarl'")
    names = [f"a_variant_with_a_long_name_{number}" for number in range(14)]
    many = pd.concat([one[one["seed"] < 1 + number % 3].assign(variant=name) for number, name in enumerate(names)])
    figure = learning_curves_plot(many)
    (axes,) = figure.axes
    # In grey too; of dashes of one's own get_linestyle() says "--" only.
    assert len({(str(line._unscaled_dash_pattern), line.get_marker()) for line in axes.lines}) == 14
    assert axes.get_title() == "walker\n1 to 3 seeds (shade of one: its episodes)"
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # matplotlib's, that nothing is left of the axes
        check_drawing(figure)
    assert axes.get_window_extent().height > 150


@pytest.mark.filterwarnings("error")
def test_plots_of_studies_without_scores():
    table = analysis.trial_table(
        make_trials(make_trial(state=TrialState.FAIL), make_trial(state=TrialState.RUNNING, loss=None))
    )
    assert [len(trace.y) for trace in evolution_figure(table, BASELINES).data] == [0, 0, 0, 2, 2]
    for figure in (
        evolution_plot({"new": table}, {"new": BASELINES}),
        histogram_plot({"new": table}),
        patterns_plot({"new": table}),
    ):
        assert any("0 candidates (left out: 1 failed, 1 running)" in text for text in texts(figure))
        figure.savefig(io.BytesIO(), format="png")


def test_files_are_told_apart_in_grey(tables, curves):
    """What looks alike without colour differs in line or hatch; what is filled is light enough to read hatches on it."""
    for axes in learning_curves_plot(curves).axes:
        assert len({line.get_linestyle() for line in axes.lines}) == len(axes.lines)
    without, with_ = patterns_plot({"one": tables["Cheetah-Run"]}).axes[0].patches
    assert luminance(without.get_facecolor()[:3]) > 0.7 and luminance(with_.get_edgecolor()[:3]) < 0.4
