"""optuna-dashboard for searches: notes of the study and its trials, and the evolution plot."""

import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from optuna import Study, Trial
from optuna.trial import FrozenTrial
from optuna_dashboard import save_note, save_plotly_graph_object

from sb3_aarl.aux_loss import AuxLoss
from search.evolution.space import loss_of
from search.results.analysis import trial_table
from search.results.plots import evolution_figure
from search.results.trials import lineage, score_of

PLOT_ID = "evolution"
# Notes are attributes of the study, of which every page of the dashboard reads all.
MAX_ANCESTORS = 12
MAX_CURVE_ROWS = 20
MAX_TEXT = 300

HOW_TO_READ = """\
- Each **trial** trains one candidate: an auxiliary loss `{source} -> {target}`, from which tokens of a window of \
experience which others are predicted. Its value is the area under its learning curve, its note describes it.
- **Generations**: the best quarter of a generation are the parents of the next. The trials' user attributes `generation`, \
`operation` and `parents` show where a candidate comes from.
- The plot **evolution** shows the scores of all candidates by generation. The parameters are one boolean for every token, \
so that their importances are the tokens'."""


def annotate_study(study: Study, settings: Mapping[str, Any], provenance: Mapping[str, Any]) -> None:
    """Write the study's note: what is searched, with which settings, on which commit, and how to read it."""
    note = [f"## Search for auxiliary losses: {_escape(study.study_name)}", HOW_TO_READ]
    for heading, values in (("Settings", settings), ("Where it comes from", provenance)):
        rows = [(_escape(name), _escape(value)) for name, value in values.items()]
        note += [f"### {heading}", _table(("name", "value"), rows)]
    save_note(study, "\n\n".join(note))


def annotate_trial(study: Study, trial: Trial) -> None:
    """
    Write or replace the note of a running trial: its loss, where it comes from, and its learning curve so far. State, score
    and the plot of intermediate values are shown beside it by the dashboard.
    """
    trials = study.get_trials(deepcopy=False)
    frozen = trials[trial.number]
    # Until all seeds are finished there is what was reported to Optuna, which has no deviations.
    reported = [(step, mean, math.nan) for step, mean in sorted(frozen.intermediate_values.items())]
    loss, curve = loss_of(frozen), frozen.user_attrs.get("curve") or reported
    note = [*_loss_lines(frozen, loss), _origin(frozen)]
    if "reason" in frozen.user_attrs:
        note.append(f"**Reason of the failure:** {_escape(frozen.user_attrs['reason'])}")
    if curve:
        # The last evaluation is always among the rows.
        points = curve[:: -len(curve) // MAX_CURVE_ROWS][::-1]
        rows = [(steps, f"{mean:.1f}", "-" if math.isnan(std) else f"{std:.1f}") for steps, mean, std in points]
        note += ["#### Learning curve", _table(("environment steps", "mean", "std"), rows)]
    if ancestors := lineage(frozen, trials):
        nearest = sorted(ancestors[:MAX_ANCESTORS], key=lambda ancestor: -ancestor.number)
        header = ("trial", "generation", "from", "score", "loss")
        note += ["#### Lineage", _table(header, [_ancestor(ancestor) for ancestor in nearest])]
        if len(ancestors) > len(nearest):
            note.append(f"… and {len(ancestors) - len(nearest)} more ancestors.")
    save_note(trial, "\n\n".join(note))


def update_plots(study: Study, baselines: Iterable[tuple[str, float]] = ()) -> None:
    """Write or replace the evolution plot of the study, with names and scores of baselines as horizontal lines."""
    figure = evolution_figure(trial_table(study.get_trials(deepcopy=False)), baselines, study.direction)
    save_plotly_graph_object(study, figure, graph_object_id=PLOT_ID)


def _loss_lines(trial: FrozenTrial, loss: AuxLoss | None) -> list[str]:
    # The dashboard shows no HTML in notes, unless it is configured to trust all of them with scripts: no MathML there.
    if loss is None:
        return [f"### Trial {trial.number}", "It has no valid loss."]
    canonical = f"Canonical: `{loss.canonical()}`" if loss.canonical() != loss else "This is its canonical form."
    latex = textwrap.fill(loss.latex(), 80, break_long_words=False, break_on_hyphens=False)
    return [f"### `{loss}`", f"```latex\n{latex}\n```", canonical]


def _origin(trial: FrozenTrial) -> str:
    attributes = trial.user_attrs
    parents = " and trial ".join(map(str, attributes.get("parents", ())))
    operation = _escape(attributes.get("operation", "-")) + (f" of trial {parents}" if parents else "")
    return f"**Generation:** {attributes.get('generation', 1)}. **Operation:** {operation}."


def _ancestor(trial: FrozenTrial) -> tuple[Any, ...]:
    score, loss, attributes = score_of(trial), loss_of(trial), trial.user_attrs
    origin = _escape(" ".join([attributes.get("operation", "-"), *map(str, attributes.get("parents", ()))]))
    notation = f"`{textwrap.shorten(str(loss), 100, placeholder=' …')}`" if loss else "-"
    return trial.number, attributes.get("generation", 1), origin, "-" if score is None else f"{score:.1f}", notation


def _escape(text: object) -> str:
    """Text as it is, whatever Markdown or HTML would make of it: one line, of bounded length."""
    line = " ".join(str(text).split())
    line = line if len(line) <= MAX_TEXT else line[:MAX_TEXT] + "…"
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", line)


def _table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
