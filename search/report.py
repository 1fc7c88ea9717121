"""One HTML file that says what a search found: self-contained, and readable without JavaScript but for the plots."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import jinja2
import plotly.graph_objects as go
from markupsafe import Markup
from optuna import Study
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from plotly.io import to_html

from search.notation import mathml
from search.plots import evolution_figure, learning_curves_figure
from search.sampler import SETTINGS_KEY
from search.trials import lineage, loss_of, operation_of, parents_of, ranked, score_of, stage_of

N_BEST = 10
N_CURVES = 5


class StageRow(NamedTuple):
    """
    :param stage: Number of the stage
    :param places: How many candidates it has
    :param completed: Trials with a score
    :param pruned: Trials that were stopped early
    :param failed: Failed trials, whose places were given out again
    :param running: Trials that run or wait
    :param best: Best score, None where there is none
    :param mean: Mean score
    """

    stage: int
    places: int
    completed: int
    pruned: int
    failed: int
    running: int
    best: float | None
    mean: float | None


def stage_rows(study: Study) -> list[StageRow]:
    """
    What became of every stage's trials.

    :param study: The study
    """
    stages: dict[int, list[FrozenTrial]] = {}
    for trial in study.get_trials(deepcopy=False):
        stages.setdefault(stage_of(trial), []).append(trial)
    settings = study._storage.get_study_system_attrs(study._study_id).get(SETTINGS_KEY)
    best = max if study.direction == StudyDirection.MAXIMIZE else min
    rows = []
    for stage, trials in sorted(stages.items()):
        states = Counter(trial.state for trial in trials)
        scores = [score for score in map(score_of, trials) if score is not None]
        places = len({trial.user_attrs.get("place", trial.number) for trial in trials})
        if settings is not None:
            places = settings["n_random"] + settings["n_prior"] if stage == 1 else settings["population_size"]
        row = StageRow(
            stage,
            places,
            states[TrialState.COMPLETE],
            states[TrialState.PRUNED],
            states[TrialState.FAIL],
            states[TrialState.RUNNING] + states[TrialState.WAITING],
            best(scores) if scores else None,
            fmean(scores) if scores else None,
        )
        rows.append(row)
    return rows


def time_spent(trials: Iterable[FrozenTrial]) -> timedelta:
    """
    How long all finished trials took together.

    :param trials: The trials
    """
    durations = (trial.duration for trial in trials)
    return sum((duration for duration in durations if duration is not None), timedelta())


def write_report(
    study: Study,
    path: str | Path,
    baselines: Iterable[tuple[str, float]] = (),
    settings: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """
    Write the report of a study, finished or not.

    :param study: The study
    :param path: Where the HTML file goes; its folder is made if it is not there
    :param baselines: Names and scores to compare with
    :param settings: Names and values of the search's settings
    :param provenance: As ``search.provenance.provenance`` gives it
    """
    trials = study.get_trials(deepcopy=False)
    baselines = list(baselines)
    best = ranked(trials, study.direction)
    figures = []
    if best:
        figures.append(evolution_figure(trials, baselines, study.direction))
        curves = learning_curves_figure(best[:N_CURVES])
        figures += [curves] if curves.data else []
    sampler_settings = study._storage.get_study_system_attrs(study._study_id).get(SETTINGS_KEY, {})
    winner = best[0] if best else None
    html = _TEMPLATE.render(
        study=study,
        trials=trials,
        counts=Counter(trial.state.name.lower() for trial in trials),
        time=_duration(time_spent(trials)),
        stages=stage_rows(study),
        figures=_plots(figures),
        baselines=baselines,
        best=[_row(trial) for trial in best[:N_BEST]],
        winner=_row(winner) if winner else None,
        lineage=[_row(other) for other in sorted(lineage(winner, trials), key=lambda other: -other.number)] if winner else [],
        sampler=sampler_settings,
        settings=dict(settings or {}),
        provenance=dict(provenance or {}),
    )
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(html, encoding="utf-8")


def _row(trial: FrozenTrial) -> dict[str, Any]:
    loss = loss_of(trial)
    return {
        "number": trial.number,
        "stage": stage_of(trial),
        "operation": operation_of(trial),
        "parents": ", ".join(map(str, parents_of(trial))),
        "score": score_of(trial),
        "typeset": Markup(mathml(loss)) if loss else "no loss",
        "notation": str(loss) if loss else "",
    }


def _plots(figures: Sequence[go.Figure]) -> list[Markup]:
    """The plots as HTML; the first of them brings plotly.js along."""
    # Without the button that would send the data to plotly's cloud.
    config = {"displaylogo": False, "responsive": True, "modeBarButtonsToRemove": ["sendChartToCloud"]}
    return [
        Markup(to_html(figure, config=config, include_plotlyjs=position == 0, full_html=False, default_height="520px"))
        for position, figure in enumerate(figures)
    ]


def _duration(time: timedelta) -> str:
    seconds = round(time.total_seconds())
    hours, minutes = divmod(seconds // 60, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds % 60} s"


# The policy in the head makes sure of it: this page asks nobody for anything.
_TEMPLATE = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<meta http-equiv="Content-Security-Policy"
      content="default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:">
<title>{{ study.study_name }}: search for auxiliary losses</title>
<style>
body { margin: 2.5rem auto; max-width: 62rem; padding: 0 1.5rem; background: #fff; color: #222;
       font: 16px/1.5 system-ui, "Segoe UI", "Noto Sans", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.8rem; line-height: 1.2; margin-bottom: .4rem; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .6rem; padding-bottom: .2rem; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { padding: .35rem .7rem; text-align: left; vertical-align: top; border-bottom: 1px solid #e2e2e2; }
th { border-bottom: 2px solid #888; white-space: nowrap; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.name { width: 14rem; color: #555; }
td.value { overflow-wrap: anywhere; }
code { font: .82rem/1.35 ui-monospace, "DejaVu Sans Mono", monospace; color: #555; overflow-wrap: anywhere; }
.loss { line-height: 1.7; }
.lead { font-size: 1.05rem; }
.winner { padding: .8rem 1rem; border-left: 4px solid #1f4e79; background: #f4f6f9; }
@media print { .plotly-graph-div { break-inside: avoid; } }
</style>
</head>
<body>
{% macro number(value) %}{% if value is none %}–{% else %}{{ "%.1f" | format(value) }}{% endif %}{% endmacro %}
{% macro loss(row) %}
<div class="loss">{{ row.typeset }}</div>{% if row.notation %}<code>{{ row.notation }}</code>{% endif %}
{% endmacro %}
{% macro candidates(rows) %}
<table>
<thead><tr><th class="n">Score</th><th class="n">Trial</th><th class="n">Stage</th><th>Operation</th><th>Parents</th>
<th>Loss</th></tr></thead>
<tbody>
{% for row in rows %}
<tr><td class="n">{{ number(row.score) }}</td><td class="n">{{ row.number }}</td><td class="n">{{ row.stage }}</td>
<td>{{ row.operation.replace("_", " ") }}</td><td>{{ row.parents or "–" }}</td><td>{{ loss(row) }}</td></tr>
{% endfor %}
</tbody>
</table>
{% endmacro %}
{% macro values(title, mapping) %}
{% if mapping %}
<h2>{{ title }}</h2>
<table><tbody>
{% for name, value in mapping.items() %}
<tr><td class="name">{{ name }}</td><td class="value">{{ value }}</td></tr>
{% endfor %}
</tbody></table>
{% endif %}
{% endmacro %}

<h1>Search for auxiliary losses: {{ study.study_name }}</h1>
<p class="lead">What is searched: which states, actions and rewards of a short window of experience (the source) an agent
should learn to predict which others from (the target), so that it learns its task faster. A candidate's score is the area
under its learning curve (AULC): the mean evaluation return.</p>
{% if trials %}
<p>{{ trials | length }} trials: {{ counts.complete }} completed, {{ counts.pruned }} pruned, {{ counts.fail }} failed,
{{ counts.running + counts.waiting }} running or waiting. The finished ones took {{ time }} together.</p>
{% else %}
<p><strong>This study is empty: no trial has begun yet.</strong></p>
{% endif %}
{% if winner %}
<div class="winner"><strong>Best so far: {{ number(winner.score) }}</strong> (trial {{ winner.number }}, one training; the top
candidates should be trained again with other seeds)
{{ loss(winner) }}</div>
{% elif trials %}
<p><strong>No trial has a score yet.</strong></p>
{% endif %}

{% if stages %}
<h2>Stages</h2>
<table>
<thead><tr><th class="n">Stage</th><th class="n">Places</th><th class="n">Completed</th><th class="n">Pruned</th>
<th class="n">Failed</th><th class="n">Running</th><th class="n">Best</th><th class="n">Mean</th></tr></thead>
<tbody>
{% for row in stages %}
<tr><td class="n">{{ row.stage }}</td><td class="n">{{ row.places }}</td><td class="n">{{ row.completed }}</td>
<td class="n">{{ row.pruned }}</td><td class="n">{{ row.failed }}</td><td class="n">{{ row.running }}</td>
<td class="n">{{ number(row.best) }}</td><td class="n">{{ number(row.mean) }}</td></tr>
{% endfor %}
</tbody>
</table>
{% endif %}
{% if baselines %}
<h2>Baselines</h2>
<table><tbody>
{% for name, score in baselines %}
<tr><td class="name">{{ name }}</td><td>{{ number(score) }}</td></tr>
{% endfor %}
</tbody></table>
{% endif %}
{% if figures %}
<h2>Evolution</h2>
{{ figures[0] }}
{% endif %}
{% if best %}
<h2>Best losses</h2>
{{ candidates(best) }}
{% endif %}
{% if figures | length > 1 %}
<h2>Learning curves</h2>
{{ figures[1] }}
{% endif %}
{% if winner %}
<h2>Lineage of the best</h2>
{% if lineage %}
<p>Trial {{ winner.number }} is a {{ winner.operation.replace("_", " ") }} of {{ winner.parents }}. Its ancestors, the
latest first:</p>
{{ candidates(lineage) }}
{% else %}
<p>Trial {{ winner.number }} has no ancestors ({{ winner.operation.replace("_", " ") }}).</p>
{% endif %}
{% endif %}
{{ values("Settings", settings) }}
{{ values("Settings of the sampler", sampler) }}
{{ values("Where it comes from", provenance) }}
</body>
</html>
""")
