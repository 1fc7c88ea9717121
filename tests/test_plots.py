"""Plots hold exactly the data of the trials and runs."""

import io

import numpy as np
import optuna
import paper_figures
import pytest
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


def test_evolution_plot_draws_what_the_tables_say(tables):
    lines = {"Cheetah-Run": [("SAC", 150.0), ("CURL", 180.0)], "Walker-Walk": [("CURL", 230.0)]}
    figure = evolution_plot(tables, lines)
    assert legend_of(figure) == ["candidate", "best of the generation", "mean of the generation", "SAC", "CURL"]
    for axes, (name, table) in zip(figure.axes, tables.items(), strict=True):
        drawn = {line.get_label(): line for line in axes.lines}
        scores = table[table["state"] == "complete"]
        np.testing.assert_array_equal(drawn["candidate"].get_ydata(), scores["score"])
        np.testing.assert_array_equal(np.round(drawn["candidate"].get_xdata()), scores["generation"])
        by_generation = [scores["score"][scores["generation"] == generation] for generation in (1, 2, 3)]
        np.testing.assert_allclose(drawn["best of the generation"].get_ydata(), [max(each) for each in by_generation])
        np.testing.assert_allclose(drawn["mean of the generation"].get_ydata(), [np.mean(each) for each in by_generation])
        assert all(set(drawn[baseline].get_ydata()) == {score} for baseline, score in lines[name])
        assert axes.get_title() == f"{name}\n{LEFT_OUT}"
    lowest = evolution_plot(tables, direction=StudyDirection.MINIMIZE).axes[0].lines[1]
    assert lowest.get_ydata()[0] == tables["Cheetah-Run"].query("generation == 1 and state == 'complete'")["score"].min()


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
