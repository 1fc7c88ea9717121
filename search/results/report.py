"""One HTML file on what a search found: self-contained, and readable without JavaScript but for its plots to click."""

import io
import re
from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
import plotly.graph_objects as go
from markupsafe import Markup
from matplotlib.figure import Figure
from optuna import Study
from optuna.trial import FrozenTrial
from plotly.io import to_html

from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.callbacks import replace_text
from search.execution.matrix import comparable, stored_scores, task_name
from search.results import analysis
from search.results.plots import evolution_figure, patterns_plot, rankings_plot
from search.results.trials import lineage, ranked
from search.studies import cross_validation
from search.studies.search import SETTINGS_KEY
from search.training.provenance import provenance

N_BEST = 10
N_IMPORTANCES = 12


def stored_baselines(folder: Path) -> list[tuple[str, float]]:
    """Name and mean score of the baselines that have finished runs, from the folder of a search."""
    means = stored_scores(folder / "baselines").groupby("variant")["score"].mean()
    return [(str(name), float(score)) for name, score in means.items()]


def generation_table(table: pd.DataFrame) -> pd.DataFrame:
    """
    What became of the trials of every generation: trials by state, ``average``, ``lowest`` and ``highest`` score (NaN
    without any), ``distinct`` and ``hamming`` as in :func:`search.results.analysis.diversity`.
    """
    # Other samplers than ours may propose what is no valid loss: it is pruned at once, and costs nothing.
    trials = table[(table["state"] != "pruned") | table["loss"].notna()]
    scores = trials.groupby("generation")["score"].agg(average="mean", lowest="min", highest="max")
    states = pd.crosstab(trials["generation"], trials["state"])
    return states.join(scores).join(analysis.diversity(table)[["distinct", "hamming"]])


def write_report(
    study: Study,
    path: str | Path,
    baselines: Iterable[tuple[str, float]] = (),
    validation: pd.DataFrame | None = None,
) -> None:
    """Write the report of a study, finished or not, with baselines and the runs of its cross-validation as one HTML file."""
    trials = study.get_trials(deepcopy=False)
    table = analysis.trial_table(trials)
    best = ranked(trials, study.direction)
    baselines = list(baselines)
    machines = analysis.machines(trials)
    started = [f"{trial.datetime_start:%Y-%m-%d %H:%M}" for trial in trials if trial.datetime_start]
    ended = [f"{trial.datetime_complete:%Y-%m-%d %H:%M}" for trial in trials if trial.datetime_complete]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    html = environment.get_template("report.html").render(
        study=study,
        settings=study.user_attrs.get(SETTINGS_KEY, {}),
        counts=Counter(table["state"]),
        hours=machines["hours"].sum(),
        generations=analysis.readable("generations", generation_table(table)),
        baselines=baselines,
        evolution=_plot(evolution_figure(table, baselines, study.direction)) if best else None,
        best=_candidates(best[:N_BEST]),
        winner=_candidates(best[:1]).to_dict("records"),
        lineage=_candidates(sorted(lineage(best[0], trials), key=lambda trial: -trial.number)) if best else None,
        validation=_validation(validation),
        taught=_taught(study, table),
        machines=analysis.readable("machines", machines),
        started=min(started, default=""),
        ended=max(ended, default=""),
        versions=Counter(trial.user_attrs["versions"] for trial in trials if "versions" in trial.user_attrs),
        provenance=provenance(),
    )
    replace_text(Path(path), html)


def _candidates(trials: Sequence[FrozenTrial]) -> pd.DataFrame:
    """Trials with their losses typeset, and their plain notation to copy."""
    table = analysis.trial_table(trials)
    text = analysis.readable("candidates", table.set_index("number")[["score", "generation", "operation", "parents"]])
    text.insert(0, "Loss", [_typeset(loss) for loss in table["loss"]])
    return text


def mathml(loss: AuxLoss) -> str:
    """The loss as the paper prints it, for HTML: one ``math`` element a token, as browsers break no line inside of one."""

    def token(match: re.Match[str]) -> str:
        offset = f"<mo>+</mo><mn>{match[2]}</mn>" if match[2] else ""
        return f"<math><msub><mi>{match[1]}</mi><mrow><mi>t</mi>{offset}</mrow></msub></math>"

    return re.sub(r"\b([sar])_t(?:\+(\d+))?", token, escape(str(loss).replace("->", "→")))


def _typeset(loss: AuxLoss | None) -> Markup:
    if loss is None:
        return Markup("no loss")
    return Markup('<div class="loss">{}</div><code>{}</code>').format(Markup(mathml(loss)), str(loss))


def _variant(name: str) -> Markup:
    """A candidate or a baseline."""
    return _typeset(AuxLoss.parse(name)) if "->" in name else Markup.escape(name)


def _validation(runs: pd.DataFrame | None) -> dict[str, Any] | None:
    """The ranking of the candidates that have all runs, and how many are left out."""
    if runs is None or comparable(runs).empty:
        return None
    ranking = cross_validation.ranking(comparable(runs))
    text = ranking.map("{:.1f}".format).assign(runs=ranking["runs"].map("{:.0f}".format)).rename(columns=task_name)
    text.insert(0, "Loss", [_variant(str(name)) for name in ranking.index])
    return {"ranking": text, "left_out": runs["variant"].nunique() - len(ranking)}


def _taught(study: Study, table: pd.DataFrame) -> dict[str, Any] | None:
    """Tables and figures of what the trials teach about losses, None if there is nothing to compare."""
    n_analysed = len(analysis.analysed(table))
    if not n_analysed:
        return None
    summary = analysis.summary(study.get_trials(deepcopy=False), study.direction)
    texts = {name: analysis.readable(name, frame) for name, frame in summary.tables.items()}
    if "importances" in texts:
        texts["importances"] = texts["importances"].head(N_IMPORTANCES)
    return {
        "n": n_analysed,
        "tables": texts,
        "problems": summary.problems,
        "patterns": _picture(patterns_plot({study.study_name: table})),
        "rankings": None if "rank_agreement" in summary.problems else _picture(rankings_plot(table)),
    }


def _picture(figure: Figure) -> str:
    """A picture as an address that holds all of it."""
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    return f"data:image/svg+xml;base64,{b64encode(file.getvalue()).decode()}"


def _plot(figure: go.Figure) -> Markup:
    """A plot as HTML that contains plotly.js."""
    # Without the button that would send the data to plotly's cloud.
    config = {"displaylogo": False, "responsive": True, "modeBarButtonsToRemove": ["sendChartToCloud"]}
    return Markup(to_html(figure, config=config, full_html=False, default_height="520px"))
