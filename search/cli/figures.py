"""The command ``aarl figures``: the paper's figures from stored data, each as one file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from search.cli import options
from search.cli.console import say
from search.cli.options import Storage, open_studies
from search.cli.results import say_missing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

app = typer.Typer()
BENCHMARK = Path("runs/benchmark")


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
            f"in runs/, or {BENCHMARK}."
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
    from search.results import analysis, plots
    from search.results.report import stored_baselines
    from search.results.table import read_runs
    from search.studies.benchmark import read_curves

    if pattern and kind != "patterns":
        raise ValueError("--pattern is for aarl figures patterns")
    if kind in ("curves", "rankings") and len(folders or ()) > 1:
        raise ValueError(f"aarl figures {kind} takes one folder")
    if kind == "curves":
        folder = folders[0] if folders else BENCHMARK
        write_figure(plots.learning_curves_plot(read_curves(folder)), out or folder / "curves.png")
        say_missing(read_runs(folder))
        return
    studies = open_studies(folders, storage)
    tables = {name: analysis.trial_table(study.get_trials(deepcopy=False)) for name, (study, _) in studies.items()}
    first, folder = next(iter(studies.values()))
    if kind == "evolution":
        lines = {name: stored_baselines(path) for name, (_, path) in studies.items()}
        figure = plots.evolution_plot(tables, lines, first.direction)
    elif kind == "histogram":
        figure = plots.histogram_plot(tables)
    elif kind == "rankings":
        figure = plots.rankings_plot(next(iter(tables.values())))
    else:
        figure = plots.patterns_plot(tables, {**analysis.PATTERNS, **{text: text for text in pattern or ()}})
    write_figure(figure, out or folder / f"{kind}.png")


def write_figure(figure: "Figure", path: Path) -> None:
    """Write a figure to a file, whose folder is made if it is not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    say(f"Figure: {path}")
