"""The commands ``aarl figures``: the paper's figures from stored data, each as one file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from search.cli import options
from search.cli.console import say
from search.cli.options import SearchFolders, Storage, open_studies
from search.cli.results import say_missing

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure
    from optuna import Study

app = typer.Typer(no_args_is_help=True, help="Draw the paper's figures from stored data, each as one file.")
Out = Annotated[
    Path | None,
    typer.Option(help="File that ends in .png, .pdf or .svg. Default: a .png of the figure's name in the (first) folder."),
]
Studies = dict[str, "tuple[Study, Path]"]


@app.command()
def evolution(folders: SearchFolders = None, storage: Storage = None, out: Out = None) -> None:
    """Scores of all candidates by generation, with the baselines that are trained (figures 4 and 6)."""
    from search.results.plots import evolution_plot
    from search.results.report import stored_baselines

    studies = open_studies(folders, storage)
    direction, *_ = (found.direction for found, _ in studies.values())
    lines = {name: stored_baselines(folder) for name, (_, folder) in studies.items()}
    write_figure(evolution_plot(candidates(studies), lines, direction), out, "evolution", studies)


@app.command()
def histogram(
    folders: SearchFolders = None,
    storage: Storage = None,
    out: Out = None,
) -> None:
    """Distribution of the scores of up to three searches, such as with and without pruning of the space (figure 7)."""
    from search.results.plots import histogram_plot

    studies = open_studies(folders, storage)
    write_figure(histogram_plot(candidates(studies)), out, "histogram", studies)


@app.command()
def curves(
    folder: options.Benchmark = Path("runs/benchmark"),
    out: Out = None,
) -> None:
    """Learning curves of a benchmark with their deviation over seeds (figure 9)."""
    from search.results.plots import learning_curves_plot
    from search.results.table import read_runs
    from search.studies.benchmark import read_curves

    write_figure(learning_curves_plot(read_curves(folder)), out or folder / "curves.png")
    say_missing(read_runs(folder))


@app.command()
def rankings(
    folder: options.SearchFolder = None,
    storage: Storage = None,
    out: Out = None,
) -> None:
    """Learning curves of the best candidates under three metrics (figure 10)."""
    from search.results.plots import rankings_plot

    studies = open_studies([folder], storage)
    (table,) = candidates(studies).values()
    write_figure(rankings_plot(table), out, "rankings", studies)


@app.command()
def patterns(
    folders: SearchFolders = None,
    storage: Storage = None,
    pattern: options.Patterns = None,
    out: Out = None,
) -> None:
    """Scores with and without each pattern of table 5 (figure 11)."""
    from search.results.analysis import PATTERNS
    from search.results.plots import patterns_plot

    studies = open_studies(folders, storage)
    named = {**PATTERNS, **{text: text for text in pattern or ()}}
    write_figure(patterns_plot(candidates(studies), named), out, "patterns", studies)


def candidates(studies: Studies) -> "dict[str, pd.DataFrame]":
    """The candidates of studies, as figures take them."""
    from search.results.analysis import trial_table

    return {name: trial_table(study.get_trials(deepcopy=False)) for name, (study, _) in studies.items()}


def write_figure(figure: "Figure", out: Path | None, name: str = "", studies: Studies | None = None) -> None:
    """Write a figure to a file, or under its name into the folder of the first study."""
    path = out or next(folder for _, folder in (studies or {}).values()) / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    say(f"Figure: {path}")
