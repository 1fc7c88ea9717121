"""One HTML file on what a search found: self-contained, without JavaScript."""

import io
from base64 import b64encode
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure
from optuna import Study
from sb3_aarl.search.evolution.space import values_text
from sb3_aarl.search.execution.matrix import stored_scores, task_name
from sb3_aarl.search.results import analysis
from sb3_aarl.search.results.plots import evolution_plot
from sb3_aarl.search.studies import cross_validation
from sb3_aarl.search.studies.search import stored_settings
from sb3_aarl.search.training.provenance import provenance

from sb3_aarl.files import replace_text

N_BEST = 10


def stored_baselines(folder: Path) -> list[tuple[str, float]]:
    """Name and mean score of the baselines with runs on all environments, none failed, from the folder of a search."""
    runs = cross_validation.without_failed(stored_scores(folder / "baselines"))
    means = runs.pivot_table(index="variant", columns="environment", values="score").dropna().mean(axis=1)
    return [(str(name), float(score)) for name, score in means.items()]


def generation_table(table: pd.DataFrame) -> pd.DataFrame:
    """What became of the trials of every generation."""
    # Other samplers than ours may propose what is no valid loss: it is pruned at once, and costs nothing.
    trials = table[(table["state"] != "pruned") | table["loss"].notna()]
    scores = trials.groupby("generation")["score"].agg(average="mean", lowest="min", highest="max")
    states = pd.crosstab(trials["generation"], trials["state"])
    return states.join(scores)


def write_report(
    study: Study,
    path: str | Path,
    baselines: Iterable[tuple[str, float]] = (),
    validation: pd.DataFrame | None = None,
) -> None:
    """Write the report of a study, finished or not, with baselines and the runs of its cross-validation as one HTML file."""
    trials = study.get_trials(deepcopy=False)
    table = analysis.trial_table(trials)
    best = analysis.ranked(table, study.direction)
    if stored_settings(study).get("again") and len(best):  # the mean of the runs of each loss
        best["score"] = best.groupby("canonical", sort=False)["score"].transform("mean")
        order = cross_validation.top_losses(study, len(best))
        best = best.drop_duplicates("canonical").sort_values("canonical", key=lambda losses: losses.map(order.index))
    title, baselines = study.study_name, list(baselines)
    tables = analysis.summary(trials, study.direction, int(best["number"].iloc[0]) if len(best) else None)
    started = [f"{trial.datetime_start:%Y-%m-%d %H:%M}" for trial in trials if trial.datetime_start]
    ended = [f"{trial.datetime_complete:%Y-%m-%d %H:%M}" for trial in trials if trial.datetime_complete]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    html = environment.get_template("report.html").render(
        study=study,
        settings=stored_settings(study),
        counts=Counter(table["state"]),
        hours=tables["machines"]["hours"].sum(),
        generations=analysis.readable(generation_table(table)),
        baselines=baselines,
        evolution=_picture(evolution_plot({title: table}, {title: baselines}, study.direction)) if len(best) else None,
        best=_candidates(best[:N_BEST]),
        winner=_candidates(best[:1]).to_dict("records"),
        lineage=_candidates(table.loc[tables["lineage"].index[1:]]) if len(best) else None,
        validation=_validation(validation),
        n_analysed=len(analysis.analysed(table)),
        tables={name: analysis.readable(frame) for name, frame in tables.items()},
        started=min(started, default=""),
        ended=max(ended, default=""),
        versions=Counter(trial.user_attrs["versions"] for trial in trials if "versions" in trial.user_attrs),
        provenance=provenance(),
    )
    replace_text(Path(path), html)


def _candidates(table: pd.DataFrame) -> pd.DataFrame:
    """Trials with their losses."""
    text = analysis.readable(table.set_index("number")[["score", "generation", "operation", "parents"]])
    text.insert(0, "Loss", [Markup("<code>{}</code>").format(loss or "no loss") for loss in table["loss"]])
    if any(table["others"]):
        text.insert(1, "With", [values_text(others) for others in table["others"]])
    return text


def _validation(runs: pd.DataFrame | None) -> dict[str, Any] | None:
    """The ranking of the candidates, and how many are left out."""
    if runs is None or (ranking := cross_validation.ranking(runs)).empty:
        return None
    text = ranking.map("{:.4g}".format).replace("nan", "-").assign(runs=ranking["runs"].map("{:.0f}".format))
    text = text.rename(columns=task_name)
    losses = [Markup("<code>{}</code>").format(name) if "->" in name else f"Baseline: {name}" for name in ranking.index]
    text.insert(0, "Loss", losses)
    return {"ranking": text, "left_out": runs["variant"].nunique() - len(ranking)}


def _picture(figure: Figure) -> str:
    """A picture as an address that holds all of it."""
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    return f"data:image/svg+xml;base64,{b64encode(file.getvalue()).decode()}"
