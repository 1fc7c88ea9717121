"""Notes for optuna-dashboard, read through its own functions and in a real browser."""

import socket
import threading
from urllib.error import URLError
from urllib.request import urlopen

import optuna
import optuna_dashboard
import pytest
from browser import open_browser, requested
from optuna.trial import TrialState
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import loss_of, suggest_aux_loss
from sb3_aarl.search.execution.storage import open_storage
from sb3_aarl.search.results import dashboard
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

EVIL = "<script>document.title='owned'</script> ![x](https://example.org/x.png) **bold** | `code`\n# www.example.org"


def test_note_of_a_trial():
    study = optuna.create_study()
    loss = "{s_t+1, a_t+1} -> {s_t+2}"
    note = written(study.ask(), {"loss": loss, "generation": 3, "operation": "crossover", "parents": [1, 5]})
    assert note == f"### `{loss}`\n\nGeneration 3: crossover of trial 1 and trial 5."
    note = written(study.ask(), {"operation": "enqueued", "parents": [], "reason": "x" * 10_000 + EVIL})
    assert "no valid loss" in note and "enqueued." in note and len(note) < 1000
    assert all(line.startswith("    ") for line in note.splitlines() if "xxx" in line)


def written(trial, attributes):
    for name, value in attributes.items():
        trial.set_user_attr(name, value)
    dashboard.annotate_trial(trial)
    return optuna_dashboard.get_note(trial)


def search_in_miniature(storage):
    """A finished search of two generations with a failed trial, annotated as its driver does."""
    sampler = AuxLossSampler(population_size=6, n_random=4, n_prior=2, seed=0, n_generations=2)
    study = optuna.create_study(storage=storage, study_name="miniature", direction="maximize", sampler=sampler)
    while sampler.free_slots(study):
        trial = study.ask()
        loss = suggest_aux_loss(trial)
        trial.set_user_attr("loss", str(loss))
        dashboard.annotate_trial(trial)
        score = 100.0 - 5 * loss.horizon + trial.number
        if trial.number == 2:
            trial.set_user_attr("reason", EVIL)
        dashboard.annotate_trial(trial)
        study.tell(trial, *([None, TrialState.FAIL] if trial.number == 2 else [score]))
    dashboard.annotate_study(study)
    return study


def reachable(url):
    try:
        return urlopen(url, timeout=5).status == 200
    except URLError:
        return False


@pytest.mark.slow
def test_in_a_real_browser(tmp_path):
    storage = open_storage(tmp_path)
    study = search_in_miniature(storage)
    trials = study.get_trials(deepcopy=False)
    child = next(trial for trial in trials if trial.user_attrs["parents"])
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

        browser.get(f"{url}/dashboard/studies/{study._study_id}/note")
        wait.until(lambda _: "Each trial trains one candidate" in text())

        for trial in (child, trials[2]):
            browser.get(f"{url}/dashboard/studies/{study._study_id}/trials?numbers={trial.number}")
            wait.until(lambda _: browser.find_elements(By.TAG_NAME, "h3"))
            assert browser.find_element(By.TAG_NAME, "h3").text == str(loss_of(trial))
            assert f"{len(trials)} Trials" in text() and f"Generation {trial.user_attrs['generation']}:" in text()
        assert " ".join(EVIL.split()) in text()  # shown as it is, not obeyed
        assert browser.title != "owned"
        assert [address for address in requested(browser) if not address.startswith(url)] == []
        assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
