"""One HTML file that says what a search found: self-contained, and readable without JavaScript but for its plots to click."""

import io
from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import jinja2
import pandas as pd
import plotly.graph_objects as go
from markupsafe import Markup
from matplotlib.figure import Figure
from optuna import Study, get_all_study_names
from optuna.storages import BaseStorage
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from plotly.io import to_html
from rich.table import Table
from rich.text import Text

from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.callbacks import replace_text
from search.evolution.sampler import SETTINGS_KEY
from search.execution import matrix as grid
from search.execution.storage import load_study
from search.execution.workers import DIED_KEY
from search.results import analysis
from search.results import table as tables
from search.results.notation import mathml
from search.results.plots import evolution_figure, learning_curves_figure, learning_curves_plot, patterns_plot, rankings_plot
from search.results.trials import lineage, loss_of, operation_of, parents_of, ranked, score_of, stage_of
from search.studies import cross_validation
from search.studies.benchmark import read_curves, task_name

N_BEST = 10
N_CURVES = 5
N_IMPORTANCES = 12


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
    settings = study._storage.get_study_system_attrs(study._study_id).get(SETTINGS_KEY)
    for trial in study.get_trials(deepcopy=False):
        # A worker that asks for more than there is left leaves a trial that never had a place. Other samplers have no stages.
        is_invalid = trial.state == TrialState.PRUNED and loss_of(trial) is None  # that costs nothing
        if not is_invalid and (settings is None or "stage" in trial.user_attrs or trial.state == TrialState.WAITING):
            stages.setdefault(stage_of(trial), []).append(trial)
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


def stored_runs(storage: BaseStorage, name: str) -> pd.DataFrame:
    """
    What a grid's study has finished, as ``grid.scores`` gives it; empty if there is no such study.

    :param storage: The storage of the search
    :param name: Name of the study, such as ``NAME-baselines`` or ``NAME-cross-validation``
    """
    if name not in get_all_study_names(storage):
        return pd.DataFrame(columns=[*grid.Cell._fields, "score", "last"])
    study = load_study(storage, name)
    fields = grid.Cell._fields
    of_trials = [trial.user_attrs for trial in study.get_trials(deepcopy=False)]
    cells = [grid.Cell(*(attrs[field] for field in fields)) for attrs in of_trials if set(fields) <= attrs.keys()]
    return grid.scores(study, cells)


def stored_baselines(storage: BaseStorage, name: str) -> list[tuple[str, float]]:
    """
    Name and mean score of the baselines of a search that are trained.

    :param storage: The storage of the search
    :param name: Name of the search's study
    """
    runs = stored_runs(storage, f"{name}-baselines")
    return [(str(name), float(score)) for name, score in runs.groupby("variant")["score"].mean().items()]


def time_spent(trials: Iterable[FrozenTrial]) -> timedelta:
    """
    How long all finished trials took together, without those whose workers died: nobody knows when.

    :param trials: The trials
    """
    durations = (trial.duration for trial in trials if DIED_KEY not in trial.user_attrs)
    return sum((duration for duration in durations if duration is not None), timedelta())


def write_report(
    study: Study,
    path: str | Path,
    baselines: Iterable[tuple[str, float]] = (),
    settings: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
    validation: pd.DataFrame | None = None,
    benchmark: Path | None = None,
) -> None:
    """
    Write the report of a study, finished or not.

    :param study: The study
    :param path: Where the HTML file goes; its folder is made if it is not there
    :param baselines: Names and scores to compare with
    :param settings: Names and values of the search's settings; None for what the study itself has noted
    :param provenance: Of the report, as ``search.training.provenance.provenance`` gives it
    :param validation: Runs of the cross-validation, as :func:`stored_runs` gives them
    :param benchmark: Folder of a benchmark whose tables and learning curves are shown too
    :raises ValueError: when there is no benchmark in the folder
    """
    trials = study.get_trials(deepcopy=False)
    baselines = list(baselines)
    best = ranked(trials, study.direction)
    plots = []
    if best:
        plots.append(evolution_figure(trials, baselines, study.direction))
        curves = learning_curves_figure(best[:N_CURVES])
        plots += [curves] if curves.data else []
    if settings is None:
        settings = study.user_attrs.get(grid.TRAINING_KEY, {}).get("candidates", {})
    winner = best[0] if best else None
    n_seeds = len(settings.get("seeds", ()))
    machines = analysis.machines(trials)
    html = _TEMPLATE.render(
        study=study,
        trials=trials,
        counts=Counter(trial.state.name.lower() for trial in trials),
        time=_duration(time_spent(trials)),
        stages=stage_rows(study),
        diversity=analysis.diversity(analysis.trial_table(trials)).to_dict("index"),
        plots=_plots(plots),
        baselines=baselines,
        best=[_row(trial) for trial in best[:N_BEST]],
        winner=_row(winner) if winner else None,
        trainings=f"mean of {n_seeds} trainings" if n_seeds > 1 else "one training",
        lineage=[_row(other) for other in sorted(lineage(winner, trials), key=lambda other: -other.number)] if winner else [],
        validation=_validation(validation),
        taught=_taught(study, trials),
        benchmark=None if benchmark is None else _benchmark(benchmark),
        n_importances=N_IMPORTANCES,
        machines=analysis.readable("machines", machines) if len(machines) else None,
        begun=min((_minute(trial.datetime_start) for trial in trials if trial.datetime_start), default=""),
        ended=max((_minute(trial.datetime_complete) for trial in trials if trial.datetime_complete), default=""),
        sampler=study._storage.get_study_system_attrs(study._study_id).get(SETTINGS_KEY, {}),
        settings=dict(settings),
        versions=dict(Counter(str(trial.user_attrs["versions"]) for trial in trials if "versions" in trial.user_attrs)),
        provenance=dict(provenance or {}),
    )
    replace_text(Path(path), html)


def _validation(runs: pd.DataFrame | None) -> tuple[pd.DataFrame, int] | None:
    """The ranking of the candidates that have all runs, their losses typeset; and how many are left out."""
    compared = None if runs is None or runs.empty else grid.comparable(runs)
    if runs is None or compared is None or compared.empty:
        return None
    ranking = cross_validation.ranking(compared)
    text = ranking.map("{:.1f}".format).assign(runs=ranking["runs"].map("{:.0f}".format))
    text = text.rename(columns=lambda column: task_name(str(column)))
    text.insert(0, "Loss", [_typeset(AuxLoss.parse(str(name))) for name in ranking.index])
    return text, runs["variant"].nunique() - len(ranking)


def _taught(study: Study, trials: Sequence[FrozenTrial]) -> dict[str, Any] | None:
    """Tables and pictures of what the trials teach about losses, None if there is nothing to compare."""
    table = analysis.trial_table(trials)
    n_analysed = len(analysis.analysed(table))
    if not n_analysed:
        return None
    summary = analysis.summary(trials, study.direction)
    problem, rankings = "", None
    try:
        rankings = _picture(rankings_plot(table))
    except ValueError as error:
        problem = str(error)
    return {
        "n": n_analysed,
        "tables": {name: analysis.readable(name, table) for name, table in summary.tables.items()},
        "problems": summary.problems | {"rankings": problem},
        "patterns": _picture(patterns_plot({study.study_name: table})),
        "rankings": rankings,
    }


def _benchmark(folder: Path) -> dict[str, Any]:
    """The tables of a benchmark and its learning curves."""
    number, runs, comparison, iqm, better = tables.read_tables(folder)
    shown = tables.statistics_tables(iqm, better)
    return {
        "folder": folder,
        "tables": [(str(table.title), _frame(table)) for table in (*tables.score_tables(comparison), *shown)],
        "footnotes": tables.footnotes(number, comparison, iqm, better),
        "missing": tables.missing(runs) + tables.mixed(runs),
        "curves": _picture(learning_curves_plot(read_curves(folder))),
    }


def _frame(table: Table) -> pd.DataFrame:
    """A table of the terminal, for the page."""
    columns = [[Text.from_markup(str(cell)).plain for cell in column.cells] for column in table.columns]
    headings = [Text.from_markup(str(column.header)).plain for column in table.columns]
    return pd.DataFrame(zip(*columns, strict=True), columns=headings)


def _picture(figure: Figure) -> str:
    """A picture as an address that holds all of it."""
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    return f"data:image/svg+xml;base64,{b64encode(file.getvalue()).decode()}"


def _typeset(loss: AuxLoss | None) -> Markup:
    """A loss as the paper prints it, and its plain notation to copy."""
    if loss is None:
        return Markup("no loss")
    return Markup('<div class="loss">{}</div><code>{}</code>').format(Markup(mathml(loss)), str(loss))


def _row(trial: FrozenTrial) -> dict[str, Any]:
    return {
        "number": trial.number,
        "stage": stage_of(trial),
        "operation": operation_of(trial),
        "parents": ", ".join(map(str, parents_of(trial))),
        "score": score_of(trial),
        "loss": _typeset(loss_of(trial)),
    }


def _plots(figures: Sequence[go.Figure]) -> list[Markup]:
    """The plots as HTML; the first of them brings plotly.js along."""
    # Without the button that would send the data to plotly's cloud.
    config = {"displaylogo": False, "responsive": True, "modeBarButtonsToRemove": ["sendChartToCloud"]}
    return [
        Markup(to_html(figure, config=config, include_plotlyjs=position == 0, full_html=False, default_height="520px"))
        for position, figure in enumerate(figures)
    ]


def _minute(time: datetime) -> str:
    return time.strftime("%Y-%m-%d %H:%M")


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
figure { margin: 1rem 0; }
figure img { max-width: 100%; }
figcaption, .note { color: #555; font-size: .92rem; }
h3 { font-size: 1.05rem; margin: 1.6rem 0 .4rem; }
.wide { overflow-x: auto; }
.winner { padding: .8rem 1rem; border-left: 4px solid #1f4e79; background: #f4f6f9; }
@media print { .plotly-graph-div, figure, tr { break-inside: avoid; } }
</style>
</head>
<body>
{% macro number(value) %}
{% if value is none or value != value %}–{% else %}{{ "%.1f" | format(value) }}{% endif %}
{% endmacro %}
{% macro candidates(rows) %}
<table>
<thead><tr><th class="n">Score</th><th class="n">Trial</th><th class="n">Stage</th><th>Operation</th><th>Parents</th>
<th>Loss</th></tr></thead>
<tbody>
{% for row in rows %}
<tr><td class="n">{{ number(row.score) }}</td><td class="n">{{ row.number }}</td><td class="n">{{ row.stage }}</td>
<td>{{ row.operation.replace("_", " ") }}</td><td>{{ row.parents or "–" }}</td><td>{{ row.loss }}</td></tr>
{% endfor %}
</tbody>
</table>
{% endmacro %}
{% macro table(frame) %}
<div class="wide"><table>
<thead><tr>
{% for column in frame.columns %}
<th{% if not loop.first %} class="n"{% endif %}>{{ column }}</th>
{% endfor %}
</tr></thead>
<tbody>
{% for row in frame.itertuples(index=False, name=None) %}
<tr>{% for cell in row %}<td{% if not loop.first %} class="n"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</tbody>
</table></div>
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
{% if settings.environment and settings.checkpoints %}
<p>Candidates are trained on <strong>{{ settings.environment }}</strong> and evaluated at
{% for step in settings.checkpoints %}{{ "{:,}".format(step) }}{{ ", " if not loop.last }}{% endfor %} environment steps
{% if settings.evaluation_episodes %}with {{ settings.evaluation_episodes }} episodes{% endif %}.</p>
{% endif %}
{% if trials %}
<p>{{ trials | length }} trials: {{ counts.complete }} completed, {{ counts.pruned }} pruned, {{ counts.fail }} failed,
{{ counts.running + counts.waiting }} running or waiting. The finished ones took {{ time }} together.</p>
{% else %}
<p><strong>This study is empty: no trial has begun yet.</strong></p>
{% endif %}
{% if winner %}
<div class="winner"><strong>Best so far: {{ number(winner.score) }}</strong> (trial {{ winner.number }}, {{ trainings }}; the
top candidates should be trained again with other seeds)
{{ winner.loss }}</div>
{% elif trials %}
<p><strong>No trial has a score yet.</strong></p>
{% endif %}

{% if stages %}
<h2>Stages</h2>
<table>
<thead><tr><th class="n">Stage</th><th class="n">Places</th><th class="n">Completed</th><th class="n">Pruned</th>
<th class="n">Failed</th><th class="n">Running</th><th class="n">Best</th><th class="n">Mean</th>
<th class="n">Distinct</th><th class="n">Distance</th></tr></thead>
<tbody>
{% for row in stages %}
<tr><td class="n">{{ row.stage }}</td><td class="n">{{ row.places }}</td><td class="n">{{ row.completed }}</td>
<td class="n">{{ row.pruned }}</td><td class="n">{{ row.failed }}</td><td class="n">{{ row.running }}</td>
<td class="n">{{ number(row.best) }}</td><td class="n">{{ number(row.mean) }}</td>
{% set of_stage = diversity.get(row.stage, {}) %}
<td class="n">{% if of_stage %}{{ "{:.0%}".format(of_stage.distinct) }}{% else %}–{% endif %}</td>
<td class="n">{{ number(of_stage.get("hamming")) }}</td></tr>
{% endfor %}
</tbody>
</table>
<p class="note">Distinct: share of different losses. Distance: tokens in which two losses of the stage differ, on average.</p>
{% endif %}
{% if baselines %}
<h2>Baselines</h2>
<table><tbody>
{% for name, score in baselines %}
<tr><td class="name">{{ name }}</td><td>{{ number(score) }}</td></tr>
{% endfor %}
</tbody></table>
{% endif %}
{% if plots %}
<h2>Evolution</h2>
{{ plots[0] }}
{% endif %}
{% if best %}
<h2>Best losses</h2>
{{ candidates(best) }}
{% endif %}
{% if plots | length > 1 %}
<h2>Learning curves</h2>
{{ plots[1] }}
{% endif %}
{% if validation %}
<h2>Cross-validation</h2>
<p>The best of the search, trained again: AULC on each environment, their mean, and its deviation over the seeds.
{% if validation[1] %}{{ validation[1] }} without all runs are left out.{% endif %}</p>
{{ table(validation[0]) }}
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
{% if taught %}
<h2>Patterns</h2>
<p>Do losses with a pattern score better than those without? Differences of the mean scores of {{ taught.n }} completed
candidates (the paper's table 5); * where p &lt; 0.05 and ** where p &lt; 0.01 in Welch's t-test. Candidates descend from each
other, and the p-values are not corrected for the number of tests: they are too low.</p>
{{ table(taught.tables.table5) }}
<figure><img src="{{ taught.patterns }}" alt="Histograms of the scores with and without each pattern">
<figcaption>Scores with and without each pattern (the paper's figure 11).</figcaption></figure>
<h2>What matters in a loss</h2>
<h3>Importances of the tokens</h3>
{% if taught.problems.importances %}
<p>{{ taught.problems.importances }}.</p>
{% else %}
<p>How much of the scores each parameter explains, by the mean decrease of impurity; the difference is that of the mean scores
with and without the token.</p>
{{ table(taught.tables.importances.head(n_importances)) }}
{% endif %}
{% for name in ("horizon", "operator", "operation") if name in taught.tables %}
<h3>By {{ name }}</h3>
{{ table(taught.tables[name]) }}
{% endfor %}
<p class="note">Difference: that of the mean score to all other candidates.</p>
<h2>Would other metrics choose other losses?</h2>
{% if taught.rankings %}
<figure><img src="{{ taught.rankings }}" alt="Learning curves of the best candidates under three metrics">
<figcaption>Learning curves of the best candidates under three metrics (the paper's figure 10): AULC, the return at the first
checkpoint, the return at the last one.</figcaption></figure>
{{ table(taught.tables.rank_agreement) }}
{% else %}
<p>{{ taught.problems.rankings }}.</p>
{% endif %}
{% endif %}
{% if benchmark %}
<h2>Benchmark</h2>
<p>Mean and deviation over the seeds, as measured in {{ benchmark.folder }}.</p>
{% for line in benchmark.footnotes %}
<p class="note">{{ line }}</p>
{% endfor %}
{% for line in benchmark.missing %}
<p><strong>{{ line }}</strong></p>
{% endfor %}
{% for title, frame in benchmark.tables %}
<h3>{{ title }}</h3>
{{ table(frame) }}
{% endfor %}
<figure><img src="{{ benchmark.curves }}" alt="Learning curves of the benchmark">
<figcaption>Learning curves over the seeds (the paper's figure 9).</figcaption></figure>
{% endif %}
{% if machines is not none %}
<h2>Machines and time</h2>
{{ table(machines) }}
<p class="note">Hours of all finished trials, one after the other: GPU hours where a GPU trained. Core hours are hours
× threads. The first trial began on {{ begun }}, the last one so far ended on {{ ended }}.</p>
{% endif %}
{{ values("Settings", settings) }}
{{ values("Settings of the sampler", sampler) }}
{{ values("Versions of packages, by trials", versions) }}
{{ values("What wrote this report", provenance) }}
</body>
</html>
""")
