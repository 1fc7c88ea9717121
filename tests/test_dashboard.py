"""Notes for optuna-dashboard, read through its own functions."""

import optuna
import optuna_dashboard
from sb3_aarl.search.results import dashboard

EVIL = "<script>document.title='owned'</script> ![x](https://example.org/x.png) **bold** | `code`\n# www.example.org"


def written(trial, attributes):
    for name, value in attributes.items():
        trial.set_user_attr(name, value)
    dashboard.annotate_trial(trial)
    return optuna_dashboard.get_note(trial)


def test_note_of_a_trial():
    study = optuna.create_study()
    loss = "{s_t+1, a_t+1} -> {s_t+2}"
    note = written(study.ask(), {"loss": loss, "generation": 3, "operation": "crossover", "parents": [1, 5]})
    assert note == f"### `{loss}`\n\nGeneration 3: crossover of trial 1 and trial 5."
    note = written(study.ask(), {"operation": "enqueued", "parents": [], "reason": "x" * 200 + EVIL + "y" * 10_000})
    assert "no valid loss" in note and "enqueued." in note and len(note) < 1000
    # An indented line is shown as it is.
    assert [line[:4] for line in note.splitlines() if "xxx" in line or "owned" in line] == ["    "]
