"""Notes and plots for optuna-dashboard, read through its own functions and in a real browser."""

import socket
import threading
from urllib.error import URLError
from urllib.request import urlopen

import optuna
import optuna_dashboard
import pytest
from browser import open_browser, requested
from optuna.trial import TrialState
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from sb3_aarl.aux_loss import AuxLoss
from search.evolution.sampler import AuxLossSampler
from search.evolution.space import loss_of, loss_to_params, suggest_aux_loss
from search.execution.storage import open_storage
from search.results import dashboard
from search.results.trials import lineage

EVIL = "<script>document.title='owned'</script> ![x](https://example.org/x.png) **bold** | `code`\n# www.example.org"
BASELINES = [("SAC", 90.0), ("CURL", 110.0)]


FORWARD = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
SHIFTED = AuxLoss.parse("{s_t+1, a_t+1} -> {s_t+2}")


def start(study, loss, **attrs):
    """A trial that runs, as the driver has it."""
    study.enqueue_trial(loss_to_params(loss))
    trial = study.ask()
    assert suggest_aux_loss(trial) == loss
    for name, value in attrs.items():
        trial.set_user_attr(name, value)
    return trial


def chain(*losses, **attrs):
    """A study whose last trial runs; each candidate descends from the one before."""
    study = optuna.create_study(direction="maximize")
    for number, loss in enumerate(losses):
        parents = [number - 1] if number else []
        trial = start(study, loss, generation=number + 1, operation="replacement", parents=parents, **attrs)
        if number < len(losses) - 1:
            study.tell(trial, float(number))
    return study, trial


def test_note_of_a_trial():
    study, trial = chain(FORWARD, FORWARD, SHIFTED, curve=[[1000, 5.25, 1.0], [2000, 7.5, 2.0]])
    dashboard.annotate_trial(study, trial)
    note = optuna_dashboard.get_note(trial)
    assert f"```latex\n{SHIFTED.latex()}\n```" in note
    assert f"### `{SHIFTED}`" in note and f"Canonical: `{FORWARD}`" in note
    assert "**Generation:** 3. **Operation:** replacement of trial 1." in note
    assert "| 1000 | 5.2 | 1.0 |" in note and "| 2000 | 7.5 | 2.0 |" in note
    assert "| 1 | 2 | replacement 0 | 1.0 | `{s_t, a_t} -> {s_t+1}` |" in note
    ancestors = [line.split(" |")[0] for line in note.splitlines() if "replacement" in line and line[0] == "|"]
    assert ancestors == ["| 1", "| 0"]
    study, trial = chain(FORWARD)
    trial.report(7.0, 400)  # one of several seeds is not finished yet
    dashboard.annotate_trial(study, trial)
    note = optuna_dashboard.get_note(trial)
    assert "canonical form" in note and "Lineage" not in note and "| 400 | 7.0 | - |" in note


def test_notes_stay_small():
    """All tokens of the longest horizon, many ancestors, many evaluations."""
    longest = AuxLoss(10, (True,) * 31, (True,) * 31)
    study, trial = chain(*[longest] * 20, curve=[[step, 1000.0, 100.0] for step in range(1, 1002)], reason="x" * 10_000)
    dashboard.annotate_trial(study, trial)
    note = optuna_dashboard.get_note(trial)
    assert len(note) < 5000
    assert "| 1001 | 1000.0 | 100.0 |" in note and "7 more ancestors" in note
    assert note.count(" | 1000.0 | ") <= 20


def test_trial_without_a_loss():
    study = optuna.create_study()
    trial = study.ask()
    for name in ("reason", "operation"):
        trial.set_user_attr(name, EVIL)
    dashboard.annotate_trial(study, trial)
    note = optuna_dashboard.get_note(trial)
    assert "no valid loss" in note and "Reason of the failure" in note
    assert "<script>" not in note and "![x](" not in note and "\n# " not in note


def test_note_of_the_study():
    study = optuna.create_study(study_name="cheetah_run")
    dashboard.annotate_study(study, {"generations": 7, "a|b": EVIL}, {"commit": "abc123+changes"})
    note = optuna_dashboard.get_note(study)
    assert "cheetah\\_run" in note and "| generations | 7 |" in note and "abc123\\+changes" in note
    assert "<script>" not in note and "a\\|b" in note


def test_plot_is_replaced():
    study, _ = chain(FORWARD, SHIFTED)
    for baselines in (BASELINES, []):
        dashboard.update_plots(study, baselines)
        attrs = study._storage.get_study_system_attrs(study._study_id)
        plots = optuna_dashboard._custom_plot_data.get_plotly_graph_objects(attrs)
        assert list(plots) == ["evolution"]
        assert ("CURL" in plots["evolution"]) == bool(baselines)


def search_in_miniature(storage):
    """A finished search of two generations with a failed trial, annotated as its driver does."""
    sampler = AuxLossSampler(population_size=6, n_random=4, n_prior=2, seed=0, n_generations=2)
    study = optuna.create_study(storage=storage, study_name="miniature", direction="maximize", sampler=sampler)
    while sampler.free_slots(study):
        trial = study.ask()
        loss = suggest_aux_loss(trial)
        dashboard.annotate_trial(study, trial)
        score = 100.0 - 5 * loss.horizon + trial.number
        trial.set_user_attr("curve", [[1000, score / 2, 3.0], [2000, score, 4.0]])
        if trial.number == 2:
            trial.set_user_attr("reason", EVIL)
        dashboard.annotate_trial(study, trial)
        study.tell(trial, *([None, TrialState.FAIL] if trial.number == 2 else [score]))
    dashboard.annotate_study(study, {"environment": "dm_control/cheetah-run-v0", "remark": EVIL}, {"commit": "abc123"})
    dashboard.update_plots(study, BASELINES)
    return study


def reachable(url):
    try:
        return urlopen(url, timeout=5).status == 200
    except URLError:
        return False


def read_trial(browser):
    """What a trial's page shows, read in one go because it is redrawn now and then; None until its note is there."""
    return browser.execute_script("""
        if (!document.querySelector("code.language-latex")) return null;
        return {
            text: document.body.innerText,
            heading: document.querySelector("h3").innerText,
            latex: document.querySelector("code.language-latex").innerText,
            rows: [...document.querySelectorAll("table tr")].map(
                row => [...row.cells].map(cell => cell.innerText.trim()).join(" ")),
        };
    """)


@pytest.mark.slow
def test_in_a_real_browser(tmp_path):
    storage = open_storage(tmp_path)
    study = search_in_miniature(storage)
    trials = study.get_trials(deepcopy=False)
    completed = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    assert len(completed) == 12
    child = next(trial for trial in completed if trial.user_attrs["parents"])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    served = {"storage": storage, "host": "127.0.0.1", "port": port}
    threading.Thread(target=optuna_dashboard.run_server, kwargs=served, daemon=True).start()

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
        assert all(name in plot for name in ("Evolution of auxiliary losses", "Generation", "SAC", "CURL"))

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
            assert page["heading"] == str(loss)
            assert " ".join(page["latex"].split()) == loss.latex()
            rows = page["rows"]
            curve = trial.user_attrs["curve"]
            assert {f"{steps} {mean:.1f} {std:.1f}" for steps, mean, std in curve} <= set(rows)
            for ancestor in lineage(trial, trials):
                assert any(row.startswith(f"{ancestor.number} {ancestor.user_attrs['generation']} ") for row in rows)
        assert " ".join(EVIL.split()) in page["text"]
        assert browser.title != "owned"
        assert [address for address in requested(browser) if not address.startswith(url)] == []
        assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
