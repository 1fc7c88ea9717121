"""optuna-dashboard for searches: notes of the study and its trials, and the evolution plot."""

import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from pathlib import Path

from optuna import Study, Trial
from optuna_dashboard import save_note, save_plotly_graph_object
from sb3_aarl.search.results.analysis import trial_table
from sb3_aarl.search.results.plots import evolution_figure
from sb3_aarl.search.results.report import stored_baselines

PLOT_ID = "evolution"
# Notes are attributes of the study, of which every page of the dashboard reads all.
MAX_REASON = 300
# Seconds between two drawings of the evolution, which holds every candidate.
PLOT_SECONDS = 60.0

HOW_TO_READ = """\
## Search for auxiliary losses

- Each **trial** trains one candidate: an auxiliary loss `{source} -> {target}`, from which tokens of a window of \
experience which others are predicted. Its value is the area under its learning curve, its note describes it.
- **Generations**: the best quarter of a generation are the parents of the next. The trials' user attributes `generation`, \
`operation` and `parents` show where a candidate comes from, the study's `settings` what is searched.
- The plot **evolution** shows the scores of all candidates by generation. The parameters are one boolean for every token, \
so that their importances are the tokens'."""


def annotate_trial(trial: Trial) -> None:
    """Write or replace the note of a running trial: its loss, where it comes from, and why it failed."""
    attributes = trial.user_attrs
    parents = " and trial ".join(map(str, attributes.get("parents", ())))
    origin = attributes.get("operation", "-") + (f" of trial {parents}" if parents else "")
    note = [f"### `{attributes.get('loss', 'no valid loss')}`", f"Generation {attributes.get('generation', 1)}: {origin}."]
    if "reason" in attributes:
        # Indented, a text is shown as it is.
        note += ["Reason of the failure:", "    " + " ".join(attributes["reason"].split())[:MAX_REASON]]
    save_note(trial, "\n\n".join(note))


def update_plots(study: Study, baselines: Iterable[tuple[str, float]] = ()) -> None:
    """Write or replace the evolution plot of the study, with names and scores of baselines as horizontal lines."""
    figure = evolution_figure(trial_table(study.get_trials(deepcopy=False)), baselines, study.direction)
    save_plotly_graph_object(study, figure, graph_object_id=PLOT_ID)


@contextmanager
def annotator(study: Study, folder: Path) -> Generator[Callable[[Trial], None]]:
    """A function that keeps note and plots up to date while trials change, with the baselines in the folder of the search."""
    drawn = -PLOT_SECONDS

    def annotate(trial: Trial) -> None:
        nonlocal drawn
        annotate_trial(trial)
        if time.monotonic() - drawn > PLOT_SECONDS:
            drawn = time.monotonic()
            update_plots(study, stored_baselines(folder))

    save_note(study, HOW_TO_READ)
    yield annotate
    update_plots(study, stored_baselines(folder))
