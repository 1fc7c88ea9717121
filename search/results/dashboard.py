"""optuna-dashboard for searches: notes of the study and its trials."""

from optuna import Study, Trial
from optuna_dashboard import save_note
from sb3_aarl.search.execution.matrix import task_name

# Notes are attributes of the study, of which every page of the dashboard reads all.
MAX_REASON = 300

HOW_TO_READ = """\
## Search for auxiliary losses

- Each **trial** trains one candidate: an auxiliary loss `{source} -> {target}`, from which tokens of a window of \
experience which others are predicted. Its value is the area under its learning curve, its note describes it.
- **Generations**: the best quarter of a generation are the parents of the next. The trials' user attributes `generation`, \
`operation` and `parents` show where a candidate comes from, the study's `settings` what is searched.
- The parameters are one boolean for every token, so that their importances are the tokens'. `aarl report` draws the \
scores by generation."""


def annotate_study(study: Study) -> None:
    """Write or replace the note of a study: how to read its pages."""
    save_note(study, HOW_TO_READ)


def annotate_trial(trial: Trial) -> None:
    """Write or replace the note of a running trial: its loss, where it comes from, and why it failed."""
    attributes = trial.user_attrs
    parents = " and trial ".join(map(str, attributes.get("parents", ())))
    origin = attributes.get("operation", "-") + (f" of trial {parents}" if parents else "")
    note = [f"### `{attributes.get('loss', 'no valid loss')}`", f"Generation {attributes.get('generation', 1)}: {origin}."]
    if "scores" in attributes:  # of several environments
        note.append(", ".join(f"{task_name(name)}: {score:.3f}" for name, score in attributes["scores"].items()))
    if "reason" in attributes:
        # Indented, a text is shown as it is.
        note += ["Reason of the failure:", "    " + " ".join(attributes["reason"].split())[:MAX_REASON]]
    save_note(trial, "\n\n".join(note))
