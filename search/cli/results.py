"""Commands that show what is stored and train nothing: table, analyze, status, report, dashboard, figures."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.markup import escape
from sb3_aarl.search.cli import options
from sb3_aarl.search.cli.console import console, print_wide, records, say, say_json, show_table, time_to_go
from sb3_aarl.search.cli.options import Folder, Storage, open_studies, search_folder

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

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
    "rank_agreement": "Rank correlations of the metrics (Spearman)",
    "machines": "Machines and time",
}
N_IMPORTANCES = 20


@app.command(rich_help_panel="Many agents")
def table(
    folder: options.Benchmark = options.BENCHMARK,
    json: options.Json = False,
) -> None:
    """Show a benchmark: means and deviations, interquartile means and probabilities of improvement."""
    from sb3_aarl.search.results import table as tables

    found = tables.read_tables(folder)
    if json:
        say_json(tables.as_data(found))
        return
    for shown in tables.terminal_tables(found):
        print_wide(shown)
    for line in tables.footnotes(found):
        console.print(line, highlight=False)
    say_missing(found.runs)


def say_missing(runs: "pd.DataFrame") -> None:
    """Name the runs that a benchmark does not have, and those that should not be compared."""
    from sb3_aarl.search.results import table as tables

    for line in tables.missing(runs) + tables.mixed(runs):
        say(line, style="red")


@app.command(rich_help_panel="A search")
def analyze(
    folders: options.SearchFolders = None,
    storage: Storage = None,
    pattern: options.Patterns = None,
    json: options.Json = False,
) -> None:
    """Show what searches teach about losses: patterns (table 5), importances, effects, diversity, lineage, metrics."""
    from sb3_aarl.search.results import analysis

    patterns = {**analysis.PATTERNS, **{text: text for text in pattern or ()}}
    summaries = {
        name: analysis.summary(study.get_trials(deepcopy=False), study.direction, patterns)
        for name, (study, _) in open_studies(folders, storage).items()
    }
    if json:
        data = {
            name: {**{title: records(frame) for title, frame in tables.items()}, "problems": problems}
            for name, (tables, problems) in summaries.items()
        }
        say_json(data)
        return
    for name, summary in summaries.items():
        console.rule(escape(name))
        for title, heading in ANALYSES.items():
            if title in summary.tables:
                frame = summary.tables[title]
                frame = frame.head(N_IMPORTANCES) if title == "importances" else frame
                show_table(analysis.readable(title, frame), heading)
            elif title in summary.problems:
                say(f"{heading}: {summary.problems[title]}")
    if len(summaries) > 1:
        layout = analysis.table5_layout({name: summary.tables["table5"] for name, summary in summaries.items()})
        layout = layout.rename_axis("study").reset_index()
        show_table(layout, "Differences of all studies, as the paper's table 5")


@app.command(rich_help_panel="A search")
def status(
    search: Annotated[
        Path | None, typer.Argument(help="Folder of a search or a benchmark, or a search's file. Default: the only search.")
    ] = None,
    storage: Storage = None,
    folder: Folder = None,
    json: options.Json = False,
) -> None:
    """Show how far a search, what belongs to it, or a benchmark is: runs done, running, failed, best so far, time to go."""
    import pandas as pd
    from sb3_aarl.search.execution.storage import STUDY_FILE, open_storage
    from sb3_aarl.search.studies.status import PARTS, matrix_status, search_status

    folder = folder or search
    path = search_folder(folder, storage)
    data: dict[str, Any] = {}
    lines = []
    tables: dict[str, pd.DataFrame] = {}
    if storage is not None or path is None or (path / STUDY_FILE).exists():
        ((study, path),) = open_studies([folder], storage).values()
        progress, runs = search_status(study, open_storage(path, storage, create=False), path)
        data["search"] = {**progress._asdict(), "generations": [row._asdict() for row in progress.generations], "runs": runs}
        rows = [(f"generation {row.generation}", *row[1:]) for row in progress.generations]
        tables["search"] = pd.DataFrame(rows, columns=["variant", "runs", "done", "running", "failed"])
        best = "nothing yet" if progress.best is None else f"{progress.best_loss}, score {progress.best:.2f}"
        complete = all(row.filled == row.slots for row in progress.generations)
        how = (
            time_to_go(progress.seconds_to_go) if runs or complete else "no driver runs here: the same aarl search resumes it"
        )
        lines.append(f"Search: best {best}; {how}")
    for part in ("", *PARTS):
        variants, to_go = matrix_status(path / part)
        if not variants.empty:
            name = part or "benchmark"
            data[name] = {"variants": records(variants.set_index("variant")), "seconds_to_go": to_go}
            tables[name] = variants.assign(score=variants["score"].map("{:.2f}".format).replace("nan", "-"))
            lines.append(f"{name.capitalize()}: {time_to_go(to_go)}")
    if not tables:
        raise ValueError(f"{path} has neither a search nor a benchmark. aarl search starts one")
    if json:
        say_json(data)
        return
    for title, table in tables.items():
        show_table(table.astype(str), f"{path}, {title}")
    for line in lines:
        say(line)


@app.command(rich_help_panel="A search")
def report(
    search: options.SearchFolder = None,
    storage: Storage = None,
    folder: Folder = None,
    out: Annotated[Path | None, typer.Option(help="HTML file. Default: report.html in the folder.")] = None,
) -> None:
    """Write a report of a search as one HTML file."""
    from sb3_aarl.search.execution.matrix import stored_scores
    from sb3_aarl.search.results.report import stored_baselines, write_report

    ((searched, path),) = open_studies([folder or search], storage).values()
    out = out or path / "report.html"
    write_report(searched, out, stored_baselines(path), stored_scores(path / "cross-validation"))
    say(f"Report: {out}")


@app.command(rich_help_panel="A search")
def dashboard(
    search: options.SearchFolder = None,
    storage: Storage = None,
    folder: Folder = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; the default is reached from this machine only.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=1, max=65535)] = 8080,
) -> None:
    """Watch a search in optuna-dashboard. Everybody who reaches it can change and delete studies."""
    from optuna_dashboard import run_server
    from sb3_aarl.search.execution.storage import open_storage

    opened = open_storage(search_folder(folder or search, storage), storage, create=False)
    say(f"http://{host}:{port}/  (Ctrl-C to stop; --port for another port)")
    with suppress(KeyboardInterrupt):
        run_server(opened, host=host, port=port)


@app.command(rich_help_panel="Many agents")
def figures(
    kind: Annotated[
        Literal["evolution", "histogram", "curves", "rankings", "patterns"],
        typer.Argument(
            help="Scores by generation, beside the baselines (the paper's figures 4 and 6); their distribution in up to three "
            "searches (7); learning curves of a benchmark (9), or of the best candidates under three metrics (10); scores "
            "with and without each pattern of table 5 (11).",
        ),
    ],
    folders: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders of searches, or their configuration files; for curves that of a benchmark. Default: the only search "
            f"in runs/, or {options.BENCHMARK}."
        ),
    ] = None,
    storage: Storage = None,
    pattern: options.Patterns = None,
    out: Annotated[
        Path | None,
        typer.Option(help="File that ends in .png, .pdf or .svg. Default: a .png of the figure's name in the (first) folder."),
    ] = None,
) -> None:
    """Draw a figure of the paper from stored data, as one file."""
    from sb3_aarl.search.results import analysis, plots
    from sb3_aarl.search.results.report import stored_baselines
    from sb3_aarl.search.results.table import read_runs
    from sb3_aarl.search.studies.benchmark import read_curves

    if pattern and kind != "patterns":
        raise ValueError("--pattern is for aarl figures patterns")
    if kind in ("curves", "rankings", "patterns") and len(folders or ()) > 1:
        raise ValueError(f"aarl figures {kind} takes one folder")
    if kind == "curves":
        folder = folders[0] if folders else options.BENCHMARK
        write_figure(plots.learning_curves_plot(read_curves(folder)), out or folder / "curves.png")
        say_missing(read_runs(folder))
        return
    studies = open_studies(folders, storage)
    tables = {name: analysis.trial_table(study.get_trials(deepcopy=False)) for name, (study, _) in studies.items()}
    study, folder = next(iter(studies.values()))
    table = next(iter(tables.values()))
    if kind == "evolution":
        lines = {name: stored_baselines(path) for name, (_, path) in studies.items()}
        figure = plots.evolution_plot(tables, lines, study.direction)
    elif kind == "histogram":
        figure = plots.histogram_plot(tables)
    elif kind == "rankings":
        figure = plots.learning_curves_plot(analysis.leaders(table), "candidate")
    else:
        figure = plots.patterns_plot(table, {**analysis.PATTERNS, **{text: text for text in pattern or ()}})
    write_figure(figure, out or folder / f"{kind}.png")


def write_figure(figure: "Figure", path: Path) -> None:
    """Write a figure to a file, whose folder is made if it is not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    say(f"Figure: {path}")
