"""Notes and plots for optuna-dashboard, read through its own functions and in a real browser."""

import socket
import threading
from urllib.error import URLError
from urllib.request import urlopen

import numpy as np
import optuna
import optuna_dashboard
import pytest
from browser import open_browser, requested
from optuna.artifacts import FileSystemArtifactStore, get_all_artifact_meta
from optuna.trial import TrialState, create_trial
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from sb3_aarl.aux_loss import AuxLoss
from search.evolution.sampler import AuxLossSampler, SearchComplete
from search.evolution.space import distributions, loss_to_params, suggest_aux_loss
from search.execution import workers
from search.execution.storage import open_storage
from search.results import dashboard
from search.results.notation import subscripts
from search.results.trials import lineage, loss_of

EVIL = "<script>document.title='owned'</script> ![x](https://example.org/x.png) **bold** | `code`\n# www.example.org"
BASELINES = [("SAC", 90.0), ("CURL", 110.0)]


def note_of(study, number):
    attrs = study._storage.get_study_system_attrs(study._study_id)
    trial_id = study.get_trials(deepcopy=False)[number]._trial_id
    return optuna_dashboard._note.get_note_from_system_attrs(attrs, trial_id)["body"]


@pytest.fixture
def store(tmp_path):
    (tmp_path / "artifacts").mkdir()
    return FileSystemArtifactStore(str(tmp_path / "artifacts"))


def finished_study(*losses, **attrs):
    """A study in memory; each candidate stems from the one before."""
    study = optuna.create_study(direction="maximize")
    for number, loss in enumerate(losses):
        parents = [number - 1] if number else []
        trial = create_trial(
            value=float(number),
            params=loss_to_params(loss),
            distributions=distributions(loss.horizon),
            user_attrs={"stage": number + 1, "operation": "replacement", "parents": parents, **attrs},
        )
        study.add_trial(trial)
    return study


FORWARD = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
SHIFTED = AuxLoss.parse("{s_t+1, a_t+1} -> {s_t+2}")


def test_note_of_a_trial():
    study = finished_study(FORWARD, SHIFTED, FORWARD, curve=[[1000, 5.25, 1.0], [2000, 7.5, 2.0]])
    for number in range(3):
        dashboard.annotate_trial(study, number)
    note = note_of(study, 1)
    assert "{sₜ₊₁, aₜ₊₁} → {sₜ₊₂}" in note
    assert f"```latex\n{SHIFTED.latex()}\n```" in note
    assert f"Notation: `{SHIFTED}`" in note and f"Canonical: `{FORWARD}`" in note
    assert "**Score:** 1.00. **Stage:** 2. **Operation:** replacement of trial 0." in note
    assert "| 1000 | 5.2 | 1.0 |" in note and "| 2000 | 7.5 | 2.0 |" in note
    assert "| 0 | 1 | replacement | 0.0 | `{s_t, a_t} -> {s_t+1}` |" in note
    assert "canonical form" in note_of(study, 0) and "Lineage" not in note_of(study, 0)
    ancestors = [line.split(" |")[0] for line in note_of(study, 2).splitlines() if "replacement" in line and line[0] == "|"]
    assert ancestors == ["| 1", "| 0"]


def test_notes_stay_small():
    """All tokens of the longest horizon, many ancestors, many evaluations."""
    longest = AuxLoss(10, (True,) * 31, (True,) * 31)
    study = finished_study(*[longest] * 40, curve=[[step, 1000.0, 100.0] for step in range(1, 1002)], reason="x" * 10_000)
    dashboard.annotate_trial(study, 39)
    note = note_of(study, 39)
    assert len(note) < 5000
    assert "| 1001 | 1000.0 | 100.0 |" in note and "more ancestors" in note
    assert note.count(" | 1000.0 | ") <= 20


def test_trial_without_a_loss():
    study = optuna.create_study()
    study.add_trial(create_trial(state=TrialState.FAIL, user_attrs={"reason": EVIL, "operation": EVIL}))
    dashboard.annotate_trial(study, 0)
    note = note_of(study, 0)
    assert "no valid loss" in note and "**State:** fail" in note
    assert "<script>" not in note and "![x](" not in note and "\n# " not in note


def test_who_died_gets_a_note_too(store):
    study = finished_study(FORWARD, SHIFTED)
    for number in (2, 3):
        trial = study.ask(distributions(1))
        trial.report(7.0, 400)
        dashboard.annotate_trial(study, number, store)
        assert "**State:** begun" in note_of(study, number)
    workers.fail(study, study.trials[2], "its worker died")
    dashboard.annotate_ended(study, store)
    assert "**State:** begun" in note_of(study, 3)  # it runs
    note = note_of(study, 2)
    assert "**State:** fail" in note and "**Reason:** its worker died" in note and "| 400 | 7.0 | - |" in note
    dashboard.save_note(dashboard._noted(study, study.trials[2]), "changed")
    dashboard.annotate_ended(study, store)
    assert note_of(study, 2) == "changed"


def test_picture_is_uploaded_once_for_each_length_of_the_curve(store, tmp_path):
    study = optuna.create_study(sampler=AuxLossSampler(seed=0))  # others may propose what is no valid loss
    trial = study.ask()
    suggest_aux_loss(trial)

    def pictures():
        return len(list((tmp_path / "artifacts").iterdir()))

    dashboard.annotate_trial(study, trial.number, store)
    assert pictures() == 0
    for length, expected in ((1, 1), (1, 1), (2, 2)):
        trial.set_user_attr("curve", [[1000 * (step + 1), 1.0, 0.0] for step in range(length)])
        dashboard.annotate_trial(study, trial.number, store)
        assert pictures() == expected
    assert {meta.filename for meta in get_all_artifact_meta(trial)} == {"learning-curve-1000.png", "learning-curve-2000.png"}
    trial.set_user_attr("curve", [[3000, 1.0, 0.0]])
    study.tell(trial, 1.0)
    for _ in range(2):  # Optuna lets nobody write to a finished trial; the picture is its own in the dashboard all the same
        dashboard.annotate_trial(study, study.trials[0], store)
        assert pictures() == 3
    path = note_of(study, 0).partition("![Learning curve](")[2].partition(")")[0]
    assert path.startswith(f"/artifacts/{study._study_id}/{study.trials[0]._trial_id}/")
    assert (tmp_path / "artifacts" / path.rpartition("/")[2]).read_bytes().startswith(b"\x89PNG")


def test_note_of_the_study():
    study = optuna.create_study(study_name="cheetah_run")
    dashboard.annotate_study(study, {"stages": 7, "a|b": EVIL}, {"commit": "abc123+changes"})
    note = optuna_dashboard.get_note(study)
    assert "cheetah\\_run" in note and "| stages | 7 |" in note and "abc123\\+changes" in note
    assert "<script>" not in note and "a\\|b" in note


def test_plot_is_replaced():
    study = finished_study(FORWARD, SHIFTED)
    for baselines in (BASELINES, []):
        dashboard.update_plots(study, baselines)
        attrs = study._storage.get_study_system_attrs(study._study_id)
        plots = optuna_dashboard._custom_plot_data.get_plotly_graph_objects(attrs)
        assert list(plots) == ["evolution"]
        assert ("CURL" in plots["evolution"]) == bool(baselines)


def test_served_to_this_machine_only(monkeypatch, tmp_path):
    calls = []
    monkeypatch.setattr(dashboard, "run_server", lambda storage, **kwargs: calls.append(kwargs))
    dashboard.serve(open_storage(tmp_path), tmp_path / "deep" / "artifacts")
    assert calls[0]["host"] == "127.0.0.1" and calls[0]["port"] == 8080
    assert (tmp_path / "deep" / "artifacts").is_dir()


def search_in_miniature(storage, store):
    """A finished search of two stages with a failed trial, annotated while and after the trials ran."""
    sampler = AuxLossSampler(population_size=6, n_random=4, n_prior=2, seed=0, n_stages=2)
    study = optuna.create_study(storage=storage, study_name="miniature", direction="maximize", sampler=sampler)

    def objective(trial):
        loss = suggest_aux_loss(trial)
        score = 100.0 - 5 * loss.horizon + trial.number
        trial.set_user_attr("curve", [[1000, score / 2, 3.0], [2000, score, 4.0]])
        if trial.number == 2:
            trial.set_user_attr("reason", EVIL)
            raise FloatingPointError
        if trial.number % 2:
            dashboard.annotate_trial(study, trial.number, store)
        return score

    with pytest.raises(SearchComplete):
        study.optimize(objective, n_trials=30, catch=(FloatingPointError,))
    for trial in study.get_trials(deepcopy=False)[:13]:
        dashboard.annotate_trial(study, trial, store)
    dashboard.annotate_study(study, {"environment": "dm_control/cheetah-run-v0", "remark": EVIL}, {"commit": "abc123"})
    dashboard.update_plots(study, BASELINES)
    return study


def reachable(url):
    try:
        return urlopen(url, timeout=5).status == 200
    except URLError:
        return False


def read_trial(browser):
    """What a trial's page shows, read in one go because it is drawn anew now and then; None until its picture is there."""
    return browser.execute_script("""
        const picture = document.querySelector("img[alt='Learning curve']");
        if (!picture || picture.naturalWidth != 640) return null;
        return {
            text: document.body.innerText,
            heading: document.querySelector("h3").innerText,
            latex: document.querySelector("code.language-latex").innerText,
            rows: [...document.querySelectorAll("table tr")].map(
                row => [...row.cells].map(cell => cell.innerText.trim()).join(" ")),
        };
    """)


def test_in_a_real_browser(tmp_path, store):
    storage = open_storage(tmp_path)
    study = search_in_miniature(storage, store)
    trials = study.get_trials(deepcopy=False)
    completed = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    assert len(completed) == 12
    child = next(trial for trial in completed if trial.user_attrs["parents"])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    served = {"storage": storage, "artifact_path": tmp_path / "artifacts", "port": port}
    threading.Thread(target=dashboard.serve, kwargs=served, daemon=True).start()

    with open_browser(tmp_path / "profile") as browser:
        wait = WebDriverWait(browser, 30)
        wait.until(lambda _: reachable(url))

        def text():
            return browser.find_element(By.TAG_NAME, "body").text

        browser.get(f"{url}/dashboard/studies/{study._study_id}")
        plot_id = f"user-defined-plot:{dashboard.PLOT_ID}"
        points = f"[id='{plot_id}'] .scatterlayer .trace:first-child .points path"
        wait.until(lambda _: len(browser.find_elements(By.CSS_SELECTOR, points)) == len(completed))
        plot = browser.find_element(By.ID, plot_id).text
        assert all(name in plot for name in ("Evolution of auxiliary losses", "Stage", "SAC", "CURL"))

        browser.get(f"{url}/dashboard/studies/{study._study_id}/note")
        wait.until(lambda _: "dm_control/cheetah-run-v0" in text())
        assert "abc123" in text() and "Each trial trains one candidate" in text()
        assert " ".join(EVIL.split()) in text()  # shown as it is, not obeyed

        for trial in (child, trials[2]):
            loss = loss_of(trial)
            browser.get(f"{url}/dashboard/studies/{study._study_id}/trials?numbers={trial.number}")
            page = wait.until(lambda _: read_trial(browser))
            assert f"{len(trials)} Trials" in page["text"]
            assert all(f"Trial {other.number}\n" in page["text"] for other in trials)
            assert page["heading"] == subscripts(loss)
            assert f"Notation: {loss}" in page["text"]
            assert " ".join(page["latex"].split()) == loss.latex()
            rows = page["rows"]
            curve = trial.user_attrs["curve"]
            assert {f"{steps} {mean:.1f} {std:.1f}" for steps, mean, std in curve} <= set(rows)
            for ancestor in lineage(trial, trials):
                assert any(row.startswith(f"{ancestor.number} {ancestor.user_attrs['stage']} ") for row in rows)
        assert " ".join(EVIL.split()) in page["text"]
        assert browser.title != "owned"
        assert [address for address in requested(browser) if not address.startswith(url)] == []
        assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def test_a_note_is_cheap_in_a_long_study(tmp_path):
    """What a note costs the storage does not grow with the study: a few attributes, whatever there is already."""
    rng = np.random.default_rng(0)
    losses = [AuxLoss(10, (True, *(rng.random(30) < 0.5)), (*(rng.random(30) < 0.5), True)) for _ in range(30)]
    study = optuna.create_study(storage=open_storage(tmp_path), direction="maximize")
    study.add_trials(finished_study(*losses, curve=[[1000, 1.0, 0.5]]).trials)
    journal = tmp_path / "journal.log"

    def written(number):
        before = journal.stat().st_size
        dashboard.annotate_trial(study, number)
        return journal.stat().st_size - before

    sizes = [written(number) for number in range(30)]
    assert max(sizes) < 15_000
    assert max(sizes[15:]) < 1.5 * max(sizes[:15])
