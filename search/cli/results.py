"""The program ``aarl``. What the commands do lies elsewhere; imports that take seconds are made when they are needed."""

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.progress import MofNCompleteColumn
from rich.progress import Progress as ProgressBar
from rich.table import Table

from search.execution.passwords import storage_name, without_password

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure
    from optuna import Study

    from sb3_aarl import AuxLoss
    from search.execution.driver import Launch, Progress
    from search.execution.matrix import Cell, Runs

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
console = Console()
errors = Console(stderr=True, soft_wrap=True)

YAML = (".yml", ".yaml")
# What training alone does without, and commands import when they are called.
OF_SEARCH = ("grpc", "joblib", "optuna", "optuna_dashboard", "plotly", "psutil", "sklearn", "threadpoolctl")
ZOO = Path(__file__).parents[2] / "zoo_configs"


@app.callback()
def program() -> None:
    """Auxiliary losses for reinforcement learning: train with one, search for better ones."""


@contextlib.contextmanager
def clear_errors() -> Iterator[None]:
    """What a user can mend is one line and exit code 2, not a traceback; Ctrl-C is exit code 130."""
    # Clusters announce the end of a job with SIGTERM: what is there is put away as after Ctrl-C.
    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except Exception as error:
        text = _one_line(error)
        if text is None:
            raise
        errors.print(f"Error: {text}", style="red", markup=False, highlight=False)
        raise typer.Exit(2) from None
    except KeyboardInterrupt:
        errors.print("Interrupted. The same command goes on from the last checkpoint.", markup=False)
        raise typer.Exit(130) from None


def _one_line(error: Exception) -> str | None:
    """What a user is told of an error that he can mend, without passwords; None for others."""
    from search.training.run import TrainingError

    line = without_password(" ".join(str(error).split()))
    if isinstance(error, (ValueError, OSError, TrainingError)):
        return line
    if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] in OF_SEARCH:
        return f"{line}: pip install 'sb3-aarl[search]'"
    if "search.execution.local" in sys.modules:  # else it is not of Optuna, which a training alone does without
        from optuna.exceptions import StorageInternalError

        from search.execution.local import WorkerError, message

        if isinstance(error, WorkerError):
            return line
        if isinstance(error, StorageInternalError):
            return message(error)
    return None


@app.command()
def train(
    env: Annotated[str, typer.Argument(help="Such as cheetah-run, dm_control/cheetah-run-v0 or Pendulum-v1.")],
    aux_loss: Annotated[
        str | None,
        typer.Option(help="Notation, name, YAML file of a winner, 'none' or 'auto'. Default: the file's, or auto."),
    ] = None,
    config: Annotated[Path, typer.Option(help="File of hyper-parameters.", show_default="zoo_configs/aarl_state.yml")] = ZOO
    / "aarl_state.yml",
    steps: Annotated[
        int | None,
        typer.Option(help="Environment steps (agent steps x action repeat). Default: the file's n_timesteps."),
    ] = None,
    evaluations: Annotated[int, typer.Option(help="Number of evaluations, equally spaced.", min=1)] = 5,
    episodes: Annotated[int, typer.Option(help="Episodes of each evaluation.", min=1)] = 10,
    seed: Annotated[int, typer.Option(help="Seed of the training.", min=0)] = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for model and learning curve. Default: in runs/."),
    ] = None,
) -> None:
    """Train with one auxiliary loss. Killed, the same command goes on from its last evaluation."""
    with clear_errors():
        from search.training.run import train_and_keep

        run, folder, was_finished = train_and_keep(env, aux_loss, config, steps, evaluations, episodes, seed, out)
        table = Table("environment steps", "mean return", "deviation", "seconds", title=f"AULC {run.aulc:.1f}")
        for column in table.columns:
            column.justify = "right"
        for point in run.curve:
            table.add_row(f"{point.environment_steps:,}", f"{point.mean:.1f}", f"{point.std:.1f}", f"{point.seconds:.0f}")
        console.print(table)
        if was_finished:
            console.print("This training was finished before: it trains again in another folder (--out).", soft_wrap=True)
        console.print(f"Model: {folder / 'model.zip'}\nCurve: {folder / 'curve.csv'}", soft_wrap=True, highlight=False)


@app.command()
def losses(
    published: Annotated[bool, typer.Option("--published", help="The paper's candidates too.")] = False,
) -> None:
    """List the losses that have a name."""
    from sb3_aarl import catalog

    table = Table("name", "notation", "operator")
    table.columns[1].overflow = "fold"
    for name in [*catalog.names(), *(candidate.name for candidate in catalog.published() if published)]:
        loss = catalog.load(name)
        operator = f"{loss.operator}, negatives" if loss.negatives else loss.operator
        # The brackets behind a notation hold the operator; rich would take them for markup.
        table.add_row(name, str(loss).partition(" [")[0], operator)
    console.print(table)


Storage = Annotated[
    str | None,
    typer.Option(help="URL of a database, such as sqlite:///study.db. Default: a journal in the folder."),
]
Folder = Annotated[
    Path | None,
    typer.Option(help="Folder of the search. Default: runs/NAME, NAME being that of the configuration file."),
]
Workers = Annotated[int, typer.Option(help="Processes that train at the same time.", min=1)]
Threads = Annotated[
    int | None,
    typer.Option(help="Threads of each process; 1 may be fastest for small networks. Default: its share of the cores.", min=1),
]
Heartbeat = Annotated[
    int,
    typer.Option(
        help="Seconds between two signs of life of a worker; on another machine, one that has given none for twice as long "
        "has died.",
        min=1,
    ),
]
SearchFile = Annotated[Path, typer.Argument(help="Configuration of a search, such as zoo_configs/search/demo.yml.")]


def run_folder(config: Path, folder: Path | None) -> Path:
    """Where a search keeps what it makes."""
    return Path("runs") / config.stem if folder is None else folder


@app.command()
def search(
    config: SearchFile,
    storage: Storage = None,
    workers: Annotated[
        int | None,
        typer.Option(
            help="Processes that train at the same time; 0 to begin the study and watch workers that are started elsewhere.",
            show_default="1; with Ray as many as the cluster has room for",
            min=0,
        ),
    ] = None,
    threads: Threads = None,
    stages: Annotated[int | None, typer.Option(help="Number of stages. Default: the file's.", min=1)] = None,
    pruner: Annotated[
        Literal["none", "median", "hyperband"] | None, typer.Option(help="Optuna's pruner. Default: the file's.")
    ] = None,
    folder: Folder = None,
    heartbeat: Heartbeat = 60,
    launcher: Annotated[
        Literal["local", "ray"], typer.Option(help="Where workers run: on this machine, or on Ray.")
    ] = "local",
    ray_address: Annotated[
        str | None, typer.Option(help="A running Ray cluster: auto, or host:port. Default: a Ray of its own on this machine.")
    ] = None,
    cpus_per_trial: Annotated[
        float | None, typer.Option(help="With Ray: cores of each worker.", min=0, show_default="1")
    ] = None,
    gpus_per_trial: Annotated[
        float | None, typer.Option(help="With Ray: GPUs of each worker, such as 0.25.", min=0, show_default="0")
    ] = None,
) -> None:
    """Search for losses by evolution. Ctrl-C stops it, the same command goes on with it."""
    with clear_errors():
        from functools import partial

        from search.execution import driver as evolve
        from search.execution.local import WorkerPool
        from search.training.config import load_config

        changes: dict[str, Any] = {"stages": stages, "pruner": pruner}
        settings = replace(load_config(config), **{key: value for key, value in changes.items() if value is not None})
        path = run_folder(config, folder)
        where = storage or str(path)
        launch: Launch | None = None
        of_ray = {"ray-address": ray_address, "cpus-per-trial": cpus_per_trial, "gpus-per-trial": gpus_per_trial}
        if launcher != "ray" and (given := [name for name, value in of_ray.items() if value is not None]):
            raise ValueError(f"--{given[0]} is for workers on a Ray cluster: say --launcher ray too")
        if launcher == "ray" and workers != 0:
            from search.execution.ray import RayPool

            if threads is not None:
                raise ValueError("--threads is for workers of this machine: with Ray, say --cpus-per-trial")
            launch = partial(
                RayPool,
                n_workers=workers,
                cpus_per_trial=1 if cpus_per_trial is None else cpus_per_trial,
                gpus_per_trial=gpus_per_trial or 0,
                address=ray_address,
                storage=where,
            )
        elif workers != 0:
            launch = partial(WorkerPool, n_workers=workers or 1, threads=threads)
        console.print(f"Study {settings.name} in {storage_name(where)}", soft_wrap=True, markup=False)
        shown = _show_progress(evolve.search(settings, path, where, launch, heartbeat))
        if shown is not None and shown.best is not None:
            console.print(f"Best so far: {shown.best_loss}, score {shown.best:.2f}", markup=False, soft_wrap=True)
        option = "" if storage is None else f" --storage {storage_name(storage)}"
        console.print(f"To watch it: aarl dashboard {path}{option}", markup=False, soft_wrap=True)


@app.command()
def worker(
    storage: Annotated[
        str, typer.Option(help="Storage of the search: a URL such as postgresql://host/db or grpc://host:port, or a folder.")
    ],
    study: Annotated[str | None, typer.Option(help="Study of the search. Default: the only search there.")] = None,
    workers: Workers = 1,
    threads: Threads = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="Folder for checkpoints; shared by the machines if a candidate shall go on on another one. "
            "Default: runs/NAME."
        ),
    ] = None,
    heartbeat: Heartbeat = 60,
    wait: Annotated[float, typer.Option(help="Seconds to wait for the search to be begun.", min=0)] = 0,
) -> None:
    """Join a search from any machine, until it is complete. It needs nothing but the storage."""
    with clear_errors():
        from functools import partial

        from search.execution import driver as evolve
        from search.execution.local import WorkerPool

        console.print(f"Working for {storage_name(storage)}", soft_wrap=True, markup=False)
        launch = partial(WorkerPool, n_workers=workers, threads=threads)
        _show_progress(evolve.join(storage, study, folder, launch, heartbeat, wait))


@app.command()
def proxy(
    storage: Annotated[str, typer.Option(help="URL of the database, such as postgresql://user@host/db.")],
    host: Annotated[
        str, typer.Option(help="Address to listen on; the default is reached from this machine only. There is no password.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=1, max=65535)] = 13000,
) -> None:
    """Serve a database to many workers through Optuna's gRPC proxy; they take --storage grpc://host:port."""
    with clear_errors():
        from search.execution.storage import serve_proxy

        console.print(f"grpc://{host}:{port}  (Ctrl-C to stop)", highlight=False)
        serve_proxy(storage, host, port)


def _show_progress(progresses: "Iterator[Progress]") -> "Progress | None":
    """Show how far a search is until it ends; the last state."""
    shown: Progress | None = None
    with live() as show:
        for progress in progresses:
            # Without a terminal there is a line for everything that has changed.
            if console.is_terminal or shown is None or progress.stages != shown.stages:
                show(_stages_table(progress) if console.is_terminal else _stages_line(progress))
            shown = progress
    return shown


@contextlib.contextmanager
def live() -> Iterator[Callable[[RenderableType], None]]:
    """Something that shows what it is given: in one place of a terminal, line by line elsewhere."""
    if not console.is_terminal:
        yield lambda shown: console.print(shown, soft_wrap=True, highlight=False)
        return
    with Live(console=console, refresh_per_second=2) as display:
        yield display.update


def _stages_table(progress: "Progress") -> Table:
    togo = "?" if progress.seconds_to_go is None else str(timedelta(seconds=round(progress.seconds_to_go)))
    best = "-" if progress.best is None else f"{progress.best:.2f}"
    table = Table("stage", "places", "done", "running", "failed", "died", title=f"best {best}, {togo} to go")
    for column in table.columns:
        column.justify = "right"
    for stage in progress.stages:
        table.add_row(*(str(number) for number in stage))
    return table


def _stages_line(progress: "Progress") -> str:
    stages = (f"stage {s.stage}: {s.filled}/{s.places} done, {s.running} running, {s.failed} failed" for s in progress.stages)
    best = "" if progress.best is None else f"; best {progress.best:.2f}"
    return "; ".join(stages) + best


def _train_grid(
    grid: "Runs", folder: Path, storage: str | None, workers: int, threads: int | None
) -> "tuple[pd.DataFrame, dict[Cell, str]]":
    """Train the runs of a grid that are missing, with a progress bar; scores of all, and what had to be given up."""
    from search.execution import matrix as grids
    from search.execution.storage import load_study, open_storage

    where = storage or str(folder)
    n_runs = len(grid.cells)
    with ProgressBar(*ProgressBar.get_default_columns(), MofNCompleteColumn(), console=console) as bar:
        task = bar.add_task(grid.name, total=n_runs)
        for finished, failed in grids.run(grid, folder, where, workers, threads):
            bar.update(task, completed=finished, description=f"{grid.name}, {failed} failed" if failed else grid.name)
    study = load_study(open_storage(where, create=False), grid.name)
    return grids.scores(study, grid.cells), grids.given_up(study, grid.cells)


def _compare(runs: "pd.DataFrame", table: "Callable[[pd.DataFrame], pd.DataFrame]", title: str) -> "pd.DataFrame | None":
    """Show a table of what can be compared and return it, None if that is nothing; and show what there is beside it."""
    from search.execution import matrix as grids
    from search.studies import cross_validation

    compared = grids.comparable(runs)
    others = runs.drop(compared.index)
    ranked = None if compared.empty else table(compared)
    if ranked is not None:
        _show(ranked, title)
    if not others.empty:
        _show(cross_validation.ranking(others), "Not ranked, because runs are missing. AULC of those that are there")
    return ranked


def _stop_if_failed(failures: "dict[Cell, str]") -> None:
    """Name what is missing in a table; exit code 1."""
    for cell, reason in failures.items():
        text = f"Failed: {cell.variant} on {cell.environment}, seed {cell.seed}: {reason}"
        errors.print(text, style="red", markup=False, highlight=False)
    if failures:
        raise typer.Exit(1)


def _show(frame: "pd.DataFrame", title: str) -> None:
    """A table of numbers by name."""
    table = Table(str(frame.index.name), title=title)
    table.columns[0].overflow = "fold"
    for column in frame.columns:
        table.add_column(str(column).removeprefix("dm_control/").removesuffix("-v0"), justify="right", no_wrap=True)
    for name, row in frame.iterrows():
        cells = (f"{value:.0f}" if column == "runs" else f"{value:.3f}" for column, value in row.items())
        table.add_row(escape(str(name)), *("-" if cell == "nan" else cell for cell in cells))
    console.print(table)


@app.command()
def baselines(
    config: SearchFile, storage: Storage = None, workers: Workers = 1, threads: Threads = None, folder: Folder = None
) -> None:
    """Train the baselines of a search, which the evolution is compared with."""
    with clear_errors():
        from optuna import get_all_study_names

        from search.execution import driver as evolve
        from search.execution.storage import load_study, open_storage
        from search.results.dashboard import update_plots
        from search.studies import cross_validation
        from search.training.config import load_config

        settings = load_config(config)
        if not settings.baselines:
            raise ValueError(f"{config} names no baselines")
        runs, failures = _train_grid(evolve.baselines(settings), run_folder(config, folder), storage, workers, threads)
        _compare(runs, cross_validation.ranking, "Baselines, AULC")
        opened = open_storage(storage or str(run_folder(config, folder)))
        if settings.name in get_all_study_names(opened):
            update_plots(load_study(opened, settings.name), evolve.baseline_scores(settings, opened))
        _stop_if_failed(failures)


@app.command("select-operator")
def select_operator(
    config: SearchFile, storage: Storage = None, workers: Workers = 1, threads: Threads = None, folder: Folder = None
) -> None:
    """Compare the ten operators on forward dynamics, as in the paper's table 2."""
    with clear_errors():
        from search.studies import operator_selection
        from search.training.config import load_config

        settings = load_config(config)
        grid = operator_selection.make_grid(settings)
        runs, failures = _train_grid(grid, run_folder(config, folder), storage, workers, threads)
        _compare(runs, operator_selection.table, "Normalized returns at the last checkpoint (paper, table 2)")
        _stop_if_failed(failures)


@app.command("cross-validate")
def cross_validate(
    config: SearchFile,
    study: Annotated[str | None, typer.Option(help="Study of the search. Default: the configuration file's name.")] = None,
    top: Annotated[int | None, typer.Option(help="How many candidates. Default: the file's.", min=1)] = None,
    storage: Storage = None,
    workers: Workers = 1,
    threads: Threads = None,
    folder: Folder = None,
) -> None:
    """Train the best candidates of a search on several environments, and write the winner as YAML."""
    with clear_errors():
        from search.execution.storage import load_study, open_storage
        from search.studies import cross_validation
        from search.training.config import load_config

        settings = load_config(config)
        path = run_folder(config, folder)
        searched = load_study(open_storage(storage or str(path), create=False), study or settings.name)
        grid = cross_validation.make_grid(settings, searched, top)
        runs, failures = _train_grid(grid, path, storage, workers, threads)
        table = _compare(runs, cross_validation.ranking, "Cross-validation, AULC")
        if table is not None:
            winner = cross_validation.write_winner(table, path / "winner.yml")
            console.print(f"Winner: {winner}\nAs YAML: {path / 'winner.yml'}", markup=False, soft_wrap=True, highlight=False)
        _stop_if_failed(failures)


@app.command()
def benchmark(
    configs: Annotated[
        list[Path], typer.Argument(help="Files of hyper-parameters, one for each variant, such as zoo_configs/aarl_state.yml.")
    ],
    envs: Annotated[
        str | None, typer.Option(help="Such as cheetah-run,Pendulum-v1. Default: those that all files have an entry for.")
    ] = None,
    seeds: Annotated[str, typer.Option(help="Such as 0-9 or 0,3.")] = "0-9",
    checkpoints: Annotated[
        str | None,
        typer.Option(
            help="Environment steps to compare at; the last ends the training.",
            show_default="100k,500k,1000k as far as the files' n_timesteps",
        ),
    ] = None,
    every: Annotated[
        str | None, typer.Option(help="Evaluate, and save for going on, after so many environment steps too, such as 20k.")
    ] = None,
    episodes: Annotated[int, typer.Option(help="Episodes of each evaluation.", min=1)] = 10,
    workers: Workers = 1,
    threads: Threads = None,
    out: Annotated[
        Path, typer.Option(help="Folder of the benchmark; more variants, tasks and seeds may be added to it.")
    ] = Path("runs/benchmark"),
) -> None:
    """Train variants on tasks with seeds, as for the paper's tables, and show them. The same command goes on with it."""
    with clear_errors():
        from search.studies.benchmark import load_benchmark, note_failures, parse_seeds, parse_steps

        names = [name.strip() for name in envs.split(",")] if envs else []
        steps = parse_steps(checkpoints) if checkpoints else ()
        between = parse_steps(every) if every else (None,)
        if len(between) != 1:
            raise ValueError(f"--every is one number of environment steps, not {every}")
        grid = load_benchmark(configs, names, parse_seeds(seeds), steps, between[0], episodes)
        grid.prepare(out)
        _, failures = _train_grid(grid, out, None, workers, threads)
        note_failures(out, failures)
        _show_benchmark(out, None)
        _stop_if_failed(failures)


@app.command()
def table(
    folder: Annotated[Path, typer.Argument(help="Folder of a benchmark.")] = Path("runs/benchmark"),
    number: Annotated[
        Literal["3", "4", "6"] | None,
        typer.Option("--table", help="Table of the paper. Default: that with most of the variants."),
    ] = None,
    csv: Annotated[Path | None, typer.Option(help="File to write the scores to, one line for each cell.")] = None,
    json: Annotated[Path | None, typer.Option(help="File to write all that is shown to, and every run.")] = None,
) -> None:
    """Show a benchmark beside the paper's tables, with interquartile means and probabilities of improvement."""
    with clear_errors():
        _show_benchmark(folder, None if number is None else int(number), csv, json)


def _show_benchmark(folder: Path, number: int | None, csv: Path | None = None, json: Path | None = None) -> None:
    """The tables of a benchmark, and the same as files."""
    from json import dumps

    from search.results import table as tables

    number, runs, comparison, iqm, better = tables.read_tables(folder, number)
    if csv is not None:
        comparison.to_csv(csv, index=False)
    if json is not None:
        json.write_text(dumps(tables.as_data(number, comparison, iqm, better, runs), indent=1) + "\n", encoding="utf-8")
    wide = Console(width=1000)  # as wide as a table is: cut numbers are wrong ones
    for shown in [*tables.score_tables(comparison), *tables.statistics_tables(iqm, better)]:
        wide.print(shown)
    for line in tables.footnotes(number, comparison, iqm, better):
        console.print(line, highlight=False)
    _show_missing(runs)


def _show_missing(runs: "pd.DataFrame") -> None:
    """What a benchmark was asked for and does not have, and what in it should not be compared."""
    from search.results import table as tables

    for line in tables.missing(runs) + tables.mixed(runs):
        console.print(line, style="red", markup=False, soft_wrap=True, highlight=False)


Run = Annotated[
    Path | None,
    typer.Argument(
        help="Folder of a search, or its configuration file. Not needed with --storage (but pictures of notes lie there), "
        "nor if there is only one in runs/."
    ),
]

StudyName = Annotated[str | None, typer.Option(help="Name of the study. Default: the folder's name.")]


@app.command()
def dashboard(
    folder: Run = None,
    storage: Storage = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; the default is reached from this machine only.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=1, max=65535)] = 8080,
) -> None:
    """Watch a search in optuna-dashboard."""
    with clear_errors():
        from search.execution.driver import is_search
        from search.execution.storage import load_study, open_storage
        from search.results.dashboard import ARTIFACTS, serve, update_plots
        from search.results.report import stored_baselines

        folder = _search_folder(folder, storage)
        opened = open_storage(storage or str(folder), create=False)
        for found in opened.get_all_studies():
            name = found.study_name
            if is_search(found):  # one that was interrupted has an old plot
                update_plots(load_study(opened, name), stored_baselines(opened, name))
        console.print(f"http://{host}:{port}/  (Ctrl-C to stop)", highlight=False)
        serve(opened, (folder or Path("runs")) / ARTIFACTS, host, port)


@app.command()
def report(
    folder: Run = None,
    storage: Storage = None,
    study: StudyName = None,
    config: Annotated[
        Path | None, typer.Option(help="Configuration of the search. Default: what the study has noted of it.")
    ] = None,
    benchmark: Annotated[Path | None, typer.Option(help="Folder of a benchmark whose tables and curves it shows too.")] = None,
    out: Annotated[Path | None, typer.Option(help="HTML file. Default: report.html in the folder.")] = None,
) -> None:
    """Write a report of a search as one HTML file."""
    with clear_errors():
        from search.execution import driver as evolve
        from search.execution.storage import load_study, open_storage
        from search.results.report import stored_baselines, stored_runs, write_report
        from search.training.config import load_config
        from search.training.provenance import provenance

        if config is None and folder is not None and folder.suffix in YAML:
            config = folder
        folder = _search_folder(folder, storage, benchmarks=False)
        opened = open_storage(storage or str(folder), create=False)
        settings = None if config is None else load_config(config)
        searched = load_study(opened, study or (None if folder is None else folder.name))
        path = out or (folder or Path()) / "report.html"
        name = searched.study_name
        lines = stored_baselines(opened, name) if settings is None else evolve.baseline_scores(settings, opened)
        shown = None if settings is None else evolve.settings(settings)
        write_report(searched, path, lines, shown, provenance(), stored_runs(opened, f"{name}-cross-validation"), benchmark)
        console.print(f"Report: {path}", markup=False, soft_wrap=True, highlight=False)


Searches = Annotated[
    list[Path] | None,
    typer.Argument(help="Folders of searches, or their configuration files. Default: the only one in runs/."),
]
Studies = Annotated[
    list[str] | None,
    typer.Option(help="Name of a study in the folder or the --storage; may be given again. Default: the folder's name."),
]
Patterns = Annotated[
    list[str] | None,
    typer.Option(help='A pattern beside those of table 5, in notation or by name, such as "{s_t} -> {r_t}". Again for more.'),
]
Ties = Annotated[bool, typer.Option("--ties-without", help="Count n_target = n_source as not n_target > n_source.")]
Top = Annotated[int, typer.Option(help="How many of the best candidates the metrics are compared on.", min=1)]


# The tables of an analysis in the order in which they are shown, and their titles.
ANALYSES = {
    "population": "Trials",
    "table5": "Patterns: mean score with - without (table 5; Welch's t-test: * p < 0.05, ** p < 0.01)",
    "importances": "Importances of the tokens (mean decrease of impurity), the highest",
    "horizon": "Scores by horizon; difference to all others",
    "operator": "Scores by operator; difference to all others",
    "operation": "Scores by operation; difference to all others",
    "diversity": "Diversity of the stages",
    "lineage": "Lineage of the best; gain over the better parent",
    "rank_agreement": "Agreement of the metrics; shared among the best {top}",
    "machines": "Machines and time",
}
N_IMPORTANCES = 20


@app.command()
def analyze(
    folders: Searches = None,
    storage: Storage = None,
    study: Studies = None,
    pattern: Patterns = None,
    ties_without: Ties = False,
    top: Top = 10,
    csv: Annotated[Path | None, typer.Option(help="Folder to write every table to, as NAME-TABLE.csv.")] = None,
    json: Annotated[Path | None, typer.Option(help="File to write all tables to.")] = None,
) -> None:
    """Show what searches teach about losses: patterns (table 5), importances, effects, diversity, lineage, metrics."""
    with clear_errors():
        from json import dumps

        from search.results import analysis

        summaries = {
            name: analysis.summary(of.get_trials(deepcopy=False), of.direction, _patterns(pattern), ties_without, top)
            for name, (of, _) in _open_studies(folders, storage, study).items()
        }
        if csv is not None:
            csv.mkdir(parents=True, exist_ok=True)
            for name, summary in summaries.items():
                for title, frame in summary.tables.items():
                    frame.to_csv(csv / f"{name.replace('/', '_')}-{title}.csv")
        if json is not None:
            data = {
                name: {**{title: _records(frame) for title, frame in tables.items()}, "problems": problems}
                for name, (tables, problems) in summaries.items()
            }
            json.write_text(dumps(data, indent=1) + "\n", encoding="utf-8")
        for name, summary in summaries.items():
            console.rule(escape(name))
            for title, heading in ANALYSES.items():
                if title in summary.tables:
                    frame = summary.tables[title]
                    frame = frame.head(N_IMPORTANCES) if title == "importances" else frame
                    _show_text(analysis.readable(title, frame), heading.format(top=top))
                elif title in summary.problems:
                    console.print(f"{heading.format(top=top)}: {summary.problems[title]}", markup=False, soft_wrap=True)
        if len(summaries) > 1:
            layout = analysis.table5_layout({name: summary.tables["table5"] for name, summary in summaries.items()})
            _show_text(layout.rename_axis("study").reset_index(), "Differences of all studies, as the paper's table 5")


def _records(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """The rows of a table in plain values for JSON, names of rows included."""
    from json import loads

    return loads(frame.reset_index().to_json(orient="records", double_precision=15))


def _show_text(frame: "pd.DataFrame", title: str) -> None:
    """A table of texts, as wide as it is: cut numbers are wrong ones. Losses are folded where the terminal ends."""
    table = Table(title=title, title_justify="left")
    for position, column in enumerate(frame.columns):
        folds = column == "Loss"
        table.add_column(
            escape(str(column)),
            justify="left" if folds or position == 0 else "right",
            overflow="fold",
            no_wrap=not folds,
            max_width=max(40, console.width - 60) if folds else None,
        )
    for row in frame.itertuples(index=False, name=None):
        table.add_row(*map(escape, row))
    Console(width=1000).print(table)


figures = typer.Typer(no_args_is_help=True, help="Draw the paper's figures from stored data, each as one file.")
app.add_typer(figures, name="figures")
Out = Annotated[
    Path | None,
    typer.Option(help="File that ends in .png, .pdf or .svg. Default: a .png of the figure's name in the (first) folder."),
]


@figures.command()
def evolution(folders: Searches = None, storage: Storage = None, study: Studies = None, out: Out = None) -> None:
    """Scores of all candidates by stage, with baselines where they are trained (figures 4 and 6)."""
    with clear_errors():
        from search.results import analysis, plots
        from search.results.report import stored_baselines

        studies = _open_studies(folders, storage, study)
        lines = {name: stored_baselines(of._storage, of.study_name) for name, (of, _) in studies.items()}
        directions = {of.direction for of, _ in studies.values()}
        if len(directions) > 1:
            raise ValueError(f"some of {', '.join(studies)} are maximized and some minimized: draw them apart")
        tables = {name: analysis.trial_table(of.get_trials(deepcopy=False)) for name, (of, _) in studies.items()}
        _save(plots.evolution_plot(tables, lines, directions.pop()), out, "evolution", studies)


@figures.command()
def histogram(
    folders: Searches = None,
    storage: Storage = None,
    study: Studies = None,
    bins: Annotated[int, typer.Option(help="Number of bins.", min=1)] = 25,
    out: Out = None,
) -> None:
    """Distribution of the scores of up to three searches, such as with and without pruning of the space (figure 7)."""
    with clear_errors():
        from search.results import analysis, plots

        studies = _open_studies(folders, storage, study)
        tables = {name: analysis.trial_table(of.get_trials(deepcopy=False)) for name, (of, _) in studies.items()}
        _save(plots.histogram_plot(tables, bins), out, "histogram", studies)


@figures.command()
def curves(
    folder: Annotated[Path, typer.Argument(help="Folder of a benchmark.")] = Path("runs/benchmark"),
    smooth: Annotated[int, typer.Option(help="Evaluations over which each run is averaged, centred.", min=1)] = 1,
    out: Out = None,
) -> None:
    """Learning curves of a benchmark with their deviation over seeds (figure 9)."""
    with clear_errors():
        from search.results import plots
        from search.results import table as tables
        from search.studies.benchmark import read_curves

        _write_figure(plots.learning_curves_plot(read_curves(folder), smooth), out or folder / "curves.png")
        _show_missing(tables.read_runs(folder))


@figures.command()
def rankings(folder: Run = None, storage: Storage = None, study: StudyName = None, top: Top = 10, out: Out = None) -> None:
    """Learning curves of the best candidates under three metrics (figure 10)."""
    with clear_errors():
        from search.results import analysis, plots

        studies = _open_studies(None if folder is None else [folder], storage, None if study is None else [study])
        ((of, _),) = studies.values()
        _save(plots.rankings_plot(analysis.trial_table(of.get_trials(deepcopy=False)), top), out, "rankings", studies)


@figures.command()
def patterns(
    folders: Searches = None,
    storage: Storage = None,
    study: Studies = None,
    pattern: Patterns = None,
    ties_without: Ties = False,
    out: Out = None,
) -> None:
    """Scores with and without each pattern of table 5 (figure 11)."""
    with clear_errors():
        from search.results import analysis, plots

        studies = _open_studies(folders, storage, study)
        tables = {name: analysis.trial_table(of.get_trials(deepcopy=False)) for name, (of, _) in studies.items()}
        _save(plots.patterns_plot(tables, _patterns(pattern), ties_without), out, "patterns", studies)


def _patterns(others: list[str] | None) -> "dict[str, str | AuxLoss]":
    """Those of table 5, and others under their notation."""
    from search.results import analysis

    return {**analysis.PATTERNS, **{text: text for text in others or ()}}


def _save(figure: "Figure", out: Path | None, name: str, studies: "dict[str, tuple[Study, Path]]") -> None:
    """Write a figure of some studies."""
    first = next(folder for _, folder in studies.values())
    _write_figure(figure, out or first / f"{name}.png")


def _write_figure(figure: "Figure", path: Path) -> None:
    kinds = figure.canvas.get_supported_filetypes()
    if path.suffix.removeprefix(".") not in kinds:
        raise ValueError(f"{path}: figures are written as .{', .'.join(sorted(kinds))}")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    console.print(f"Figure: {path}", markup=False, soft_wrap=True, highlight=False)


def _open_studies(folders: list[Path] | None, storage: str | None, names: list[str] | None) -> "dict[str, tuple[Study, Path]]":
    """Studies and their folders by name, one of each folder or several of one storage; by folder where names are alike."""
    from search.execution.storage import load_study, open_storage

    given: list[Path | None] = [*folders] if folders else [None]
    places = [_search_folder(folder, storage, benchmarks=False) for folder in given]
    if names and len(places) > 1:
        raise ValueError(f"--study names studies of one folder or --storage, but there are {len(places)} folders")
    found = []
    for place in places:
        opened = open_storage(storage or str(place), create=False)
        of_place = None if place is None else place.name
        found += [(load_study(opened, name), place or Path()) for name in (names or (of_place,))]
    alike = len({study.study_name for study, _ in found}) < len(found)
    studies = {str(place) if alike else study.study_name: (study, place) for study, place in found}
    if len(studies) < len(found):
        raise ValueError(f"a study is named twice: {', '.join(study.study_name for study, _ in found)}")
    return studies


def _search_folder(run: Path | None, storage: str | None, benchmarks: bool = True) -> Path | None:
    """
    The folder of a search, which its configuration file may name too; if nothing is named, the only one in runs/.

    Benchmarks leave a study too, of runs without candidates, which can be watched but teach nothing about losses.
    """
    from search.training.provenance import ABOUT

    def is_benchmark(folder: Path) -> bool:
        return any(folder.glob(f"*/*/*/{ABOUT}"))

    if run is not None:
        if not benchmarks and is_benchmark(run):
            raise ValueError(
                f"{run} is a benchmark, no search: see aarl table {run}, aarl figures curves {run}, "
                f"aarl report SEARCH --benchmark {run}"
            )
        return run_folder(run, None) if run.suffix in YAML else run
    if storage is not None:
        return None
    folders = sorted(path.parent for path in Path("runs").glob("*/journal.log"))
    folders = [folder for folder in folders if benchmarks or not is_benchmark(folder)]
    if len(folders) != 1:
        there = ", ".join(map(str, folders)) or "none"
        raise ValueError(f"name the folder of a search, or its --storage; there are: {there}")
    return folders[0]


def main() -> None:
    """Run the program."""
    for before, argument in pairwise(sys.argv):
        # Refused here: what does not fit is repeated in error messages.
        is_option = before == "--storage" or argument.startswith("--storage=")
        if "://" in argument and not is_option and storage_name(argument) != "".join(argument.split()):
            errors.print(f"Error: {storage_name(argument)}: a storage goes behind --storage", style="red", markup=False)
            sys.exit(2)
    app()


if __name__ == "__main__":
    main()
