"""Commands that show what is stored and train nothing: table, status, report, dashboard."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer
from sb3_aarl.search.cli import options
from sb3_aarl.search.cli.console import say, show_table
from sb3_aarl.search.cli.options import Storage, open_study, search_folder

app = typer.Typer()


@app.command(rich_help_panel="Many agents")
def table(folder: options.Benchmark = options.BENCHMARK) -> None:
    """Show a benchmark: means and deviations, interquartile means and probabilities of improvement."""
    from sb3_aarl.search.results import table as tables

    found = tables.read_tables(folder)
    for title, shown in tables.text_tables(found).items():
        show_table(shown, title)
    for line in tables.missing(found.runs) + tables.mixed(found.runs):
        say(line, style="red")


@app.command(rich_help_panel="A search")
def status(
    search: Annotated[Path | None, typer.Argument(help="Folder of a search or a benchmark, or a search's file.")] = None,
    storage: Storage = None,
) -> None:
    """Show how far a search, with its baselines and cross-validation, or a benchmark is."""
    from sb3_aarl.search.cli.search import progress_line
    from sb3_aarl.search.execution.storage import STUDY_FILE, open_storage
    from sb3_aarl.search.studies.search import SETTINGS_KEY
    from sb3_aarl.search.studies.status import PARTS, matrix_status, search_status

    path = search_folder(search)
    found = False
    if storage is not None or path is None or (path / STUDY_FILE).exists():
        study, path = open_study(path, storage)
        progress, runs = search_status(study, open_storage(path, storage, create=False), path)
        is_over = all(row.filled == row.slots for row in progress.generations)
        hint = (
            ""
            if runs or is_over or SETTINGS_KEY not in study.user_attrs
            else "\nNo driver runs here: the same aarl search resumes it."
        )
        loss = "" if progress.best_loss is None else f", {progress.best_loss}"
        say(f"Search {path}\n{progress_line(progress).replace('; ', chr(10))}{loss}{hint}")
        found = True
    for part in ("", *PARTS):
        variants = matrix_status(path / part)
        if not variants.empty:
            show_table(variants.astype(str), str(path / part))
            found = True
    if not found:
        raise ValueError(f"{path} has neither a search nor a benchmark. aarl search starts one")


@app.command(rich_help_panel="A search")
def report(
    search: options.SearchFolder = None,
    storage: Storage = None,
    out: Annotated[Path | None, typer.Option(help="HTML file. Default: report.html in the folder.")] = None,
) -> None:
    """Write a report of a search as one HTML file: best losses, cross-validation, patterns (table 5), lineage."""
    from sb3_aarl.search.execution.matrix import stored_scores
    from sb3_aarl.search.results.report import stored_baselines, write_report

    searched, path = open_study(search, storage)
    out = out or path / "report.html"
    write_report(searched, out, stored_baselines(path), stored_scores(path / "cross-validation"))
    say(f"Report: {out}")


@app.command(rich_help_panel="A search")
def dashboard(
    search: options.SearchFolder = None,
    storage: Storage = None,
    port: Annotated[int, typer.Option(help="Port to listen on.", min=1, max=65535)] = 8080,
) -> None:
    """Watch a search in optuna-dashboard, from this machine. Who opens it can change and delete studies."""
    from optuna_dashboard import run_server
    from sb3_aarl.search.execution.storage import open_storage

    opened = open_storage(search_folder(search), storage, create=False)
    say(f"http://127.0.0.1:{port}/  (Ctrl-C to stop; --port for another port)")
    with suppress(KeyboardInterrupt):
        run_server(opened, host="127.0.0.1", port=port)
