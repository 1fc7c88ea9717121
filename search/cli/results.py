"""Commands that show what is stored and train nothing: table, analyze, report, dashboard."""

from contextlib import suppress
from json import dumps, loads
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.markup import escape

from search.cli import options
from search.cli.console import console, print_wide, say, show_table
from search.cli.options import Storage, open_studies, search_folder

if TYPE_CHECKING:
    import pandas as pd

    from sb3_aarl import AuxLoss

app = typer.Typer()
# The tables of an analysis in the order in which they are shown, and their titles.
ANALYSES = {
    "population": "Trials",
    "table5": "Patterns: mean score with - without (table 5; Welch's t-test: * p < 0.05, ** p < 0.01)",
    "importances": "Importances of the tokens (mean decrease of impurity), the highest",
    "horizon": "Scores by horizon; difference to all others",
    "operator": "Scores by operator; difference to all others",
    "operation": "Scores by operation; difference to all others",
    "diversity": "Diversity of the generations",
    "lineage": "Lineage of the best; gain over the better parent",
    "rank_agreement": "Agreement of the metrics; shared among the best {top}",
    "machines": "Machines and time",
}
N_IMPORTANCES = 20


@app.command()
def table(
    folder: options.Benchmark = Path("runs/benchmark"),
    number: Annotated[
        Literal["3", "4", "6"] | None,
        typer.Option("--table", help="Table of the paper. Default: that with most of the variants."),
    ] = None,
    csv: Annotated[Path | None, typer.Option(help="File to write the scores to, one line for each cell.")] = None,
    json: Annotated[Path | None, typer.Option(help="File to write all that is shown to, and every run.")] = None,
) -> None:
    """Show a benchmark beside the paper's tables, with interquartile means and probabilities of improvement."""
    show_benchmark(folder, None if number is None else int(number), csv, json)


def show_benchmark(folder: Path, number: int | None = None, csv: Path | None = None, json: Path | None = None) -> None:
    """Show the tables of a benchmark, and write them to files."""
    from search.results import table as tables

    found = tables.read_tables(folder, number)
    if csv is not None:
        found.comparison.to_csv(csv, index=False)
    if json is not None:
        json.write_text(dumps(tables.as_data(found), indent=1) + "\n", encoding="utf-8")
    for shown in tables.terminal_tables(found):
        print_wide(shown)
    for line in tables.footnotes(found):
        console.print(line, highlight=False)
    say_missing(found.runs)


def say_missing(runs: "pd.DataFrame") -> None:
    """Name the runs that a benchmark does not have, and those that should not be compared."""
    from search.results import table as tables

    for line in tables.missing(runs) + tables.mixed(runs):
        say(line, style="red")


@app.command()
def analyze(
    folders: options.SearchFolders = None,
    storage: Storage = None,
    pattern: options.Patterns = None,
    top: options.Top = 10,
    csv: Annotated[Path | None, typer.Option(help="Folder to write every table to, as NAME-TABLE.csv.")] = None,
    json: Annotated[Path | None, typer.Option(help="File to write all tables to.")] = None,
) -> None:
    """Show what searches teach about losses: patterns (table 5), importances, effects, diversity, lineage, metrics."""
    from search.results import analysis

    summaries = {
        name: analysis.summary(found.get_trials(deepcopy=False), found.direction, patterns_by_name(pattern), top)
        for name, (found, _) in open_studies(folders, storage).items()
    }
    if csv is not None:
        csv.mkdir(parents=True, exist_ok=True)
        for name, summary in summaries.items():
            for title, frame in summary.tables.items():
                frame.to_csv(csv / f"{name.replace('/', '_')}-{title}.csv")
    if json is not None:
        data = {
            name: {**{title: records(frame) for title, frame in tables.items()}, "problems": problems}
            for name, (tables, problems) in summaries.items()
        }
        json.write_text(dumps(data, indent=1) + "\n", encoding="utf-8")
    for name, summary in summaries.items():
        console.rule(escape(name))
        for title, heading in ANALYSES.items():
            if title in summary.tables:
                frame = summary.tables[title]
                frame = frame.head(N_IMPORTANCES) if title == "importances" else frame
                show_table(analysis.readable(title, frame), heading.format(top=top))
            elif title in summary.problems:
                say(f"{heading.format(top=top)}: {summary.problems[title]}")
    if len(summaries) > 1:
        layout = analysis.table5_layout({name: summary.tables["table5"] for name, summary in summaries.items()})
        layout = layout.rename_axis("study").reset_index()
        show_table(layout, "Differences of all studies, as the paper's table 5")


def patterns_by_name(others: list[str] | None) -> "dict[str, str | AuxLoss]":
    """The patterns of table 5, and others under their notation."""
    from search.results import analysis

    return {**analysis.PATTERNS, **{text: text for text in others or ()}}


def records(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """The rows of a table in plain values for JSON, names of rows included."""
    return loads(frame.reset_index().to_json(orient="records", double_precision=15))


@app.command()
def report(
    folder: options.SearchFolder = None,
    storage: Storage = None,
    benchmark: Annotated[Path | None, typer.Option(help="Folder of a benchmark whose tables and curves it shows too.")] = None,
    out: Annotated[Path | None, typer.Option(help="HTML file. Default: report.html in the folder.")] = None,
) -> None:
    """Write a report of a search as one HTML file."""
    from search.execution.matrix import stored_scores
    from search.results.report import stored_baselines, write_report

    ((searched, path),) = open_studies([folder], storage).values()
    out = out or path / "report.html"
    write_report(searched, out, stored_baselines(path), stored_scores(path / "cross-validation"), benchmark)
    say(f"Report: {out}")


@app.command()
def dashboard(
    folder: options.SearchFolder = None,
    storage: Storage = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; the default is reached from this machine only.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=1, max=65535)] = 8080,
) -> None:
    """Watch a search in optuna-dashboard. Everybody who reaches it can change and delete studies."""
    from optuna_dashboard import run_server

    from search.execution.storage import load_study, open_storage
    from search.results.dashboard import update_plots
    from search.results.report import stored_baselines
    from search.studies.search import SETTINGS_KEY

    path = search_folder(folder, storage)
    opened = open_storage(path, storage, create=False)
    for name in (found.study_name for found in opened.get_all_studies()):
        study = load_study(opened, name)
        if SETTINGS_KEY in study.user_attrs:  # a search; baselines may have been trained since its last plot
            update_plots(study, stored_baselines(path or Path("runs") / name))
    say(f"http://{host}:{port}/  (Ctrl-C to stop)")
    with suppress(KeyboardInterrupt):
        run_server(opened, host=host, port=port)
