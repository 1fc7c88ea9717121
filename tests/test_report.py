"""The report of a study: parsed, and opened in a real browser."""

import shutil
from collections import Counter
from datetime import datetime, timedelta

import lxml.html
import numpy as np
import optuna
import pytest
from browser import open_browser, requested
from optuna.distributions import FloatDistribution
from optuna.samplers import RandomSampler
from optuna.trial import FrozenTrial, TrialState
from sb3_aarl.search.evolution.space import distributions, loss_to_params, random_loss, suggest_aux_loss
from sb3_aarl.search.execution.matrix import Cell, cell_folder, stored_scores
from sb3_aarl.search.results import analysis
from sb3_aarl.search.results.report import generation_table, stored_baselines, write_report
from sb3_aarl.search.training.provenance import write_about
from sb3_aarl.search.training.run import Run, prepare_run
from selenium.webdriver.common.by import By

from sb3_aarl.callbacks import Evaluation, write_curve

START = datetime(2026, 1, 1)
EVIL = "<script>document.title='owned'</script><img src=https://example.org/x.png>"


def make_trial(number, state, value, duration, loss=None, **attrs):
    loss = loss or random_loss(np.random.default_rng(number), 3)
    return FrozenTrial(
        number=number,
        state=state,
        value=value,
        datetime_start=START,
        datetime_complete=START + timedelta(seconds=duration) if state.is_finished() else None,
        params=loss_to_params(loss),
        distributions=distributions(loss.horizon),
        user_attrs={"seconds": float(duration)} | attrs if state.is_finished() and "interrupted" not in attrs else attrs,
        system_attrs={},
        intermediate_values={},
        trial_id=number,
    )


@pytest.fixture(scope="module")
def study():
    """30 trials over three generations: every fourth failed, every fifth of the others pruned, the last two run."""
    study = optuna.create_study(study_name=f"study {EVIL}", direction="maximize")
    rng = np.random.default_rng(3)
    for number in range(30):
        state = TrialState.FAIL if number % 4 == 3 else TrialState.PRUNED if number % 5 == 4 else TrialState.COMPLETE
        state = TrialState.RUNNING if number >= 28 else state
        generation = number // 10 + 1
        value = float(rng.normal(100 * generation, 50)) if state == TrialState.COMPLETE else None
        attrs = {"generation": generation, "operation": "horizon_change" if generation > 1 else "random"}
        parents = [int(rng.integers(10 * (generation - 2), 10 * (generation - 1)))] if generation > 1 else []
        attrs |= {"slot": number % 10 % 8, "attempt": 0, "parents": parents}
        attrs |= {"device": "GPU: some", "threads": 9} if number % 2 else {"device": "CPU: 2 cores", "threads": 2}
        attrs |= {"curve": [[1000, 10.0, 1.0], [2000, 20.0, 2.0]]} if number % 3 == 0 else {"versions": f"torch {generation}"}
        trial = make_trial(number, state, value, 60 + number, **attrs)
        trial.user_attrs["loss"] = str(random_loss(np.random.default_rng(number), 3))
        study.add_trial(trial)
    stored = {"environment": EVIL, "checkpoints": [2000, 40000], "evaluation_episodes": 3, "seeds": [0, 1]}
    study.set_user_attr("settings", stored)
    return study


def completed(study):
    return sorted((t for t in study.trials if t.state == TrialState.COMPLETE), key=lambda trial: -trial.value)


def read_page(path):
    page = lxml.html.parse(str(path)).getroot()
    assert not page.xpath("//script")
    return page


def table_after(page, heading):
    table = page.xpath(f"//h2[normalize-space()='{heading}']/following::table[1]")[0]
    return [[cell.text_content().strip() for cell in row.xpath("./td")] for row in table.xpath(".//tr[td]")]


def test_generations(study):
    rows = generation_table(analysis.trial_table(study.trials))
    assert list(rows.index) == [1, 2, 3]
    for generation, row in rows.iterrows():
        trials = [trial for trial in study.trials if trial.user_attrs["generation"] == generation]
        scores = [trial.value for trial in trials if trial.state == TrialState.COMPLETE]
        states = Counter(trial.state.name.lower() for trial in trials)
        assert {name: row[name] for name in ("complete", "pruned", "fail", "running")} == {
            **dict.fromkeys(row.index[:4], 0),
            **states,
        }
        assert (row["lowest"], row["highest"], row["average"]) == pytest.approx((min(scores), max(scores), np.mean(scores)))


def test_what_is_no_loss_was_not_stopped_early():
    study = optuna.create_study(sampler=RandomSampler(seed=0), direction="maximize")
    study.optimize(lambda trial: float(suggest_aux_loss(trial, 1).horizon), n_trials=40)
    states = Counter(trial.state for trial in study.trials)
    assert min(states[TrialState.PRUNED], states[TrialState.COMPLETE]) > 0
    (row,) = generation_table(analysis.trial_table(study.trials)).to_dict("records")
    assert row["complete"] == states[TrialState.COMPLETE] and "pruned" not in row


def test_hours_of_interrupted_trials_are_not_known():
    trials = [
        make_trial(0, TrialState.COMPLETE, 1.0, 9, device="CPU: some", seconds=3600.0, threads=2),
        make_trial(1, TrialState.FAIL, None, 3600, interrupted=True),
    ]
    (row,) = analysis.machines(trials).reset_index().to_dict("records")
    assert row == {"device": "CPU: some", "commit": "not noted", "trials": 1, "hours": 1.0, "core_hours": 2.0}


@pytest.fixture(scope="module")
def path(study, tmp_path_factory):
    """The file of its report."""
    path = tmp_path_factory.mktemp("report") / "deep" / "report.html"
    write_report(study, path, [("SAC & co", 150.0)])
    return path


@pytest.fixture
def page(path):
    return read_page(path)


def test_what_the_report_says(study, page):
    text = " ".join(page.text_content().split())
    best = completed(study)
    states = [trial.state for trial in study.trials]
    counts = [states.count(state) for state in (TrialState.COMPLETE, TrialState.PRUNED, TrialState.FAIL, TrialState.RUNNING)]
    summary = "30 trials: {} completed, {} pruned, {} failed, {} running or waiting.".format(*counts)
    assert summary in text and "took 0.57 hours together" in text
    rows = table_after(page, "Best losses")
    assert len(rows) == 10
    for row, trial in zip(rows, best, strict=False):
        operation, parents = trial.user_attrs["operation"].replace("_", " "), ", ".join(map(str, trial.user_attrs["parents"]))
        expected = [str(trial.number), f"{trial.value:.2f}", str(trial.user_attrs["generation"]), operation, parents or "–"]
        assert row[1:] == expected and row[0].endswith(str(analysis.loss_of(trial)))
    parents, number = [], best[0].number
    while study.trials[number].user_attrs["parents"]:
        number = study.trials[number].user_attrs["parents"][0]
        parents.append(str(number))
    assert parents and [row[1] for row in table_after(page, "Lineage of the best")] == parents
    assert len(table_after(page, "Patterns")) == 8
    assert f"Best so far: {best[0].value:.2f}" in text and "Baselines: SAC & co 150.00" in text
    assert table_after(page, "Settings") == [[name, str(value)] for name, value in study.user_attrs["settings"].items()]
    assert f"trained on {EVIL} and evaluated at 2,000, 40,000 environment steps with 3 episodes." in text
    assert "mean of 2 runs" in text
    assert dict(table_after(page, "What wrote this report")).keys() >= {"commit", "cpu", "versions"}
    versions = Counter(trial.user_attrs["versions"] for trial in study.trials if "versions" in trial.user_attrs)
    assert dict(table_after(page, "Versions of packages, by trials")) == {name: str(n) for name, n in versions.items()}
    assert not page.xpath("//link | //iframe")
    addresses = page.xpath("//@src | //@href")
    assert len(addresses) == 1 and all(address.startswith("data:image/svg+xml;base64,") for address in addresses)


def test_machines_and_hours(page):
    rows = table_after(page, "Machines and time")
    hours = [sum(60 + number for number in range(begin, 28, 2)) / 3600 for begin in (0, 1)]
    assert rows == [
        ["CPU: 2 cores", "not noted", "14", f"{hours[0]:.2f}", f"{2 * hours[0]:.2f}"],
        ["GPU: some", "not noted", "14", f"{hours[1]:.2f}", "–"],
    ]


def plant(folder, variant, environment, seed, score):
    """A run of a matrix that was evaluated once, of two evaluations if it has no score."""
    path = cell_folder(folder, Cell(variant, environment, seed))
    checkpoints = (1, 2) if score is None else (1,)
    run = Run(environment=environment, aux_loss=None, hyperparameters={}, seed=seed, checkpoints=checkpoints)
    prepare_run(path, run)
    write_about(path, {"variant": variant, "environment": environment, "seed": seed})
    write_curve(path / "curve.csv", [Evaluation(1, 99.0 if score is None else score, 0.0, 1, 1.0)])


def test_baselines_and_cross_validation_are_read_from_their_folders(tmp_path):
    """Of the cross-validation, the candidates of which no run failed are ranked."""
    losses = ["{s_t} -> {s_t+1}", "{s_t} -> {r_t}", "{s_t} -> {a_t}"]
    runs = [
        (loss, f"dm_control/{env}-v0", seed, 10.0 * i + seed)
        for i, loss in enumerate(losses)
        for env in "ab"
        for seed in (0, 1)
    ]
    for *cell, score in runs:
        plant(tmp_path / "cross-validation", *cell, None if (*cell, score) == runs[-1] else score)
    failed = cell_folder(tmp_path / "cross-validation", Cell(*cell))
    (failed / "failed.json").write_text('{"reason": "it burst", "retry": false}')
    for seed, score in ((0, 3.0), (1, 4.0), (2, None)):
        plant(tmp_path / "baselines", "SAC", "a", seed, score)
    for seed, score in ((0, 9.0), (1, None)):
        plant(tmp_path / "baselines", "CURL", "a", seed, score)
    shutil.copy(failed / "failed.json", cell_folder(tmp_path / "baselines", Cell("CURL", "a", 1)))
    assert stored_baselines(tmp_path) == [("SAC", 3.5)] and stored_baselines(tmp_path / "nothing") == []
    validation = stored_scores(tmp_path / "cross-validation")
    found = validation.dropna()[["variant", "environment", "seed", "score"]].itertuples(index=False, name=None)
    assert sorted(found) == sorted(runs[:-1])
    study = optuna.create_study()
    write_report(study, tmp_path / "report.html", validation=validation)
    page = read_page(tmp_path / "report.html")
    rows = table_after(page, "Cross-validation")
    assert [row[0].endswith(loss) for row, loss in zip(rows, losses[1::-1], strict=True)] == [True, True]
    assert [(*row[1:3], row[-1]) for row in rows] == [("10.5", "10.5", "4"), ("0.5", "0.5", "4")]
    for (mean, low, high), truth in zip([map(float, row[3:6]) for row in rows], (10.5, 0.5), strict=True):
        assert low < truth < high and abs(mean - truth) < 1
    assert float(rows[0][6]) + float(rows[1][6]) == pytest.approx(1)
    assert "1 with runs that failed, or without all environments, are left out." in " ".join(page.text_content().split())
    write_report(study, tmp_path / "report.html", validation=stored_scores(tmp_path / "nothing"))
    assert "Cross-validation" not in read_page(tmp_path / "report.html").text_content()


def test_report_of_scores_that_are_all_alike(tmp_path):
    study = optuna.create_study(study_name="a $x_{ $ b", direction="maximize")
    for number in range(4):
        study.add_trial(make_trial(number, TrialState.COMPLETE, 1.0, 1, curve=[[1 + number % 2, 1.0, 0.0]]))
    write_report(study, tmp_path / "report.html")
    assert "What matters in a loss" in read_page(tmp_path / "report.html").text_content()


@pytest.mark.parametrize("states", [[], [TrialState.FAIL, TrialState.RUNNING]])
def test_report_of_nothing(tmp_path, states):
    study = optuna.create_study(study_name="nothing")
    for number, state in enumerate(states):
        study.add_trial(make_trial(number, state, None, 1))
    write_report(study, tmp_path / "report.html")
    text = " ".join(read_page(tmp_path / "report.html").text_content().split())
    expected = "No trial has a score yet." if states else "This study is empty: no trial has started yet."
    assert expected in text
    assert ("1 failed, 1 running or waiting" in text) == bool(states)
    assert "Best losses" not in text


def test_report_of_another_sampler(tmp_path):
    """Trials without a loss, a generation or an operation have a report too; the lowest is the best here."""
    study = optuna.create_study(direction="minimize")
    for value in (2.0, 1.0):
        trial = study.ask({"x": FloatDistribution(0.5, 0.5)})
        study.tell(trial, value)
    write_report(study, tmp_path / "report.html")
    rows = table_after(read_page(tmp_path / "report.html"), "Best losses")
    assert rows == [["no loss", "x=0.5", "1", "1.00", "1", "-", "–"], ["no loss", "x=0.5", "0", "2.00", "1", "-", "–"]]


@pytest.mark.slow
def test_in_a_real_browser(study, path, tmp_path):
    best = completed(study)
    with open_browser(tmp_path / "profile") as browser:
        browser.get(path.as_uri())
        assert browser.title.startswith("study <script>")
        # Table 5 is shown as it is, and the pictures are drawn, none wider than the text.
        patterns = browser.find_element(By.XPATH, "//h2[.='Patterns']/following-sibling::div[1]")
        assert "Action, n_target > n_source" in patterns.text and patterns.is_displayed()
        pictures = browser.find_elements(By.CSS_SELECTOR, "figure img")
        assert len(pictures) == 1 and all(picture.get_attribute("alt") for picture in pictures)
        for picture in pictures:
            assert int(picture.get_attribute("naturalWidth")) > 300
            assert 500 < picture.rect["width"] <= patterns.rect["width"] + 1 and picture.rect["height"] > 200
        assert [trial.number for trial in best[:10]] == [
            int(row.find_elements(By.TAG_NAME, "td")[1].text)
            for row in browser.find_elements(By.XPATH, "//h2[.='Best losses']/following::table[1]/tbody/tr")
        ]
        width = browser.execute_script("return [document.documentElement.scrollWidth, window.innerWidth]")
        assert width[0] <= width[1]  # nothing runs out of the page
        assert requested(browser) == [path.as_uri()]
        assert browser.get_log("browser") == []
