"""Plots hold exactly the data of the trials and runs."""

import io
import warnings

import numpy as np
import optuna
import pandas as pd
import paper_figures
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from optuna.study import StudyDirection
from optuna.trial import TrialState, create_trial
from sb3_aarl.search.evolution.space import distributions, loss_to_params, random_loss
from sb3_aarl.search.execution.storage import open_storage
from sb3_aarl.search.results import analysis
from sb3_aarl.search.results.plots import evolution_plot

LEFT_OUT = "80 candidates, 4 trials without a comparable score left out"


def study_table(*trials):
    study = optuna.create_study(direction="maximize")
    study.add_trials(trials)
    return analysis.trial_table(study.get_trials(deepcopy=False))


@pytest.fixture(scope="module")
def tables():
    """Two studies with learning curves, and trials of all other kinds."""
    studies = {}
    for seed, name in enumerate(["Cheetah-Run", "Walker-Walk"]):
        rng = np.random.default_rng(seed)
        trials = [create_trial(state=TrialState.FAIL)] * 2
        trials += [create_trial(state=TrialState.PRUNED, value=1e6), create_trial(state=TrialState.RUNNING)]
        for i in range(80):
            loss = random_loss(rng, 2)
            curve = [[100_000 * (j + 1), float(rng.normal(100 * j + 50 * seed, 20)), 5.0] for j in range(5)]
            value = float(np.mean([mean for _, mean, _ in curve]))
            attrs = {"generation": 1 + i // 30, "curve": curve}
            params, space = loss_to_params(loss), distributions(loss.horizon)
            trials.append(create_trial(value=value, params=params, distributions=space, user_attrs=attrs))
        studies[name] = study_table(*trials)
    return studies


def legend_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def check_drawing(figure):
    """It can be drawn, and nothing that is written lies outside the picture or on top of something else."""
    figure.savefig(io.BytesIO(), format="png")
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [legend.get_window_extent(renderer) for legend in figure.legends]
    for axes in figure.axes:
        for text in (axes.title, axes.xaxis.label, axes.yaxis.label):
            if text.get_text():
                boxes.append(text.get_window_extent(renderer))
    for i, box in enumerate(boxes):
        assert box.x0 >= -1 and box.y0 >= -1 and box.x1 <= figure.bbox.x1 + 1 and box.y1 <= figure.bbox.y1 + 1
        assert not any(box.overlaps(other) for other in boxes[:i])


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
        np.testing.assert_allclose(drawn["best of the generation"].get_ydata(), [max(each) for each in by_generation])
        np.testing.assert_allclose(drawn["mean of the generation"].get_ydata(), [np.mean(each) for each in by_generation])
        for baseline, score in lines[name]:
            assert set(drawn[baseline].get_ydata()) == {score}
            looks.setdefault(baseline, set()).add((drawn[baseline].get_linestyle(), drawn[baseline].get_color()))
        assert axes.get_title() == f"{name}\n{LEFT_OUT}"
    # One look a baseline in all panels, and none like another's in grey.
    assert {len(look) for look in looks.values()} == {1} and len({style for look in looks.values() for style, _ in look}) == 2
    check_drawing(figure)
    lowest = evolution_plot(tables, direction=StudyDirection.MINIMIZE).axes[0].lines[1]
    assert lowest.get_ydata()[0] == tables["Cheetah-Run"].query("generation == 1 and state == 'complete'")["score"].min()


def test_histogram_is_in_percent_of_each_study(tables):
    figure = paper_figures.histogram_plot(tables)
    (axes,) = figure.axes
    both = np.concatenate([table["score"][table["state"] == "complete"] for table in tables.values()])
    edges = np.linspace(both.min(), both.max(), 21)
    for name, table in tables.items():
        scores = table["score"][table["state"] == "complete"]
        path = next(patch.get_xy() for patch in axes.patches if patch.get_label() == name)
        for count, left, right in zip(np.histogram(scores, edges)[0], edges[:-1], edges[1:], strict=True):
            middle = np.isclose(path[:, 0], left) | np.isclose(path[:, 0], right)
            assert np.isclose(path[middle, 1], 100 * count / 80).sum() >= 2
        mean = next(line for line in axes.lines if line.get_label() == f"{name}, mean")
        assert set(mean.get_xdata()) == {scores.mean()}
    assert [bool(patch.get_hatch()) for patch in axes.patches] == [False, True]
    assert axes.get_title() == f"Cheetah-Run: {LEFT_OUT}\nWalker-Walk: {LEFT_OUT}"
    check_drawing(figure)


def test_patterns_plot_has_a_panel_for_each_column_of_table_5(tables):
    table = tables["Cheetah-Run"]
    figure = paper_figures.patterns_plot(table)
    for axes, (name, row) in zip(figure.axes, analysis.table5(table).iterrows(), strict=True):
        assert axes.get_title() == f"{name}\nn = {row['n_with']:.0f} with, {row['n_without']:.0f} without"
        means = {line.get_label(): line.get_xdata()[0] for line in axes.lines}
        assert means["with, mean"] == row["mean_with"] and means["without, mean"] == row["mean_without"]
    assert legend_of(figure) == ["without", "without, mean", "with", "with, mean"]
    assert figure.get_suptitle() == LEFT_OUT
    check_drawing(figure)


def test_leaders_are_the_best_of_each_metric(tables):
    figure = paper_figures.rankings_plot(paper_figures.rankings(tables["Cheetah-Run"]), 6)
    curves = np.array([[mean for _, mean, _ in curve] for curve in tables["Cheetah-Run"]["curve"] if curve])
    (axes,) = figure.axes
    for line, values in zip(axes.lines, (curves.mean(axis=1), curves[:, 0], curves[:, -1]), strict=True):
        np.testing.assert_allclose(line.get_ydata(), curves[np.argsort(-values)[:6]].mean(axis=0))
    assert legend_of(figure) == ["by AULC", "by the first evaluation", "by the last evaluation"]
    assert axes.get_title() == "The best 6 candidates\n6 candidates"


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
    figure = paper_figures.learning_curves_plot(curves)
    titles = [axes.get_title() for axes in figure.axes]
    assert set(titles) == {"cheetah\n1 to 4 seeds (shade of one: its episodes)", "walker\n4 seeds"}
    for axes in figure.axes:
        env = axes.get_title().partition("\n")[0]
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
            looks.add(line.get_linestyle())
        assert len(looks) == 3
    check_drawing(figure)


def test_many_variants_are_told_apart_and_leave_room_for_the_curves(curves):
    one = curves.query("env == 'walker' and variant == 'aarl'")
    many = pd.concat([one.assign(variant=f"a_variant_with_a_long_name_{number}") for number in range(14)])
    figure = paper_figures.learning_curves_plot(many)
    (axes,) = figure.axes
    # In grey too; of dashes of one's own get_linestyle() says "--" only.
    assert len({(str(line._unscaled_dash_pattern), line.get_marker()) for line in axes.lines}) == 14
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # matplotlib's, that nothing is left of the axes
        check_drawing(figure)
    assert axes.get_window_extent().height > 150


@pytest.mark.filterwarnings("error")
def test_plots_of_a_study_without_scores():
    table = study_table(create_trial(state=TrialState.FAIL), create_trial(state=TrialState.RUNNING))
    evolution_plot({"one": table}).savefig(io.BytesIO(), format="png")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["evolution", "histogram", "rankings", "patterns"])
def test_figures_of_the_paper_from_a_folder(kind, tmp_path, monkeypatch):
    study = optuna.create_study(storage=open_storage(tmp_path), direction="maximize")
    for seed in range(20):
        loss = random_loss(np.random.default_rng(seed), 2)
        attrs = {"curve": [[1000, seed - 1.0, 1.0], [2000, seed + 1.0, 1.0]]}
        space = distributions(loss.horizon)
        study.add_trial(create_trial(value=float(seed), params=loss_to_params(loss), distributions=space, user_attrs=attrs))
    monkeypatch.setattr("sys.argv", ["paper_figures.py", kind, str(tmp_path)])
    paper_figures.main()
    assert (tmp_path / f"{kind}.png").read_bytes().startswith(b"\x89PNG")
