"""Commands that train a matrix of runs and show its tables: baselines, cross-validation, benchmark."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from sb3_aarl.search.cli import options
from sb3_aarl.search.cli.console import errors, live, say, show_costs, show_table, time_to_go
from sb3_aarl.search.cli.options import Folder, SearchFile, Storage, Threads, Workers, modules
from sb3_aarl.search.training.shipped import find_file

if TYPE_CHECKING:
    import pandas as pd
    from sb3_aarl.search.execution.matrix import Matrix
    from sb3_aarl.search.training.folder import Run


app = typer.Typer()


def train_matrix(
    matrix: "Matrix",
    execution: options.Execution,
    workers: int | None,
    retries: int = 3,
    config: Path | str = "",
    parts: "Iterable[Matrix] | None" = None,
) -> None:
    """
    Train the runs of a matrix that are not finished, part by part, once it is known that they can be, and show the progress.
    """
    from sb3_aarl.search.execution.matrix import check_matrix, run_matrix

    check_matrix(matrix, str(config))
    at_once = execution.at_once(workers, len(matrix.runs))
    with execution.start(at_once, matrix.folder) as executor, live() as show:
        for number, part in enumerate([matrix] if parts is None else parts, 1):
            name = matrix.name if len(part.runs) == len(matrix.runs) else f"{matrix.name}, round {number}"
            for progress in run_matrix(part, executor, at_once, retries):
                counts = f"{progress.finished}/{progress.total} runs, {progress.failed} failed"
                show(f"{name}: {counts}, {time_to_go(progress.seconds_to_go)}", counts)


def unfinished(matrix: "Matrix") -> "dict[str, list[Run]]":
    """The runs of a matrix that are not finished, by variant and environment."""
    from sb3_aarl.search.execution.matrix import cell_folder, task_name
    from sb3_aarl.search.training.folder import is_finished

    kinds: dict[str, list[Run]] = {}
    for cell, run in matrix.runs.items():
        if not is_finished(cell_folder(matrix.folder, cell)):
            kinds.setdefault(f"{cell.variant}, {task_name(cell.environment)}", []).append(run)
    return kinds


def compare(matrix: "Matrix", title: str) -> "pd.DataFrame":
    """Show the ranking of the variants that can be compared, and return it."""
    from sb3_aarl.search.execution.matrix import scores, task_name
    from sb3_aarl.search.studies.cross_validation import ranking

    ranked = ranking(scores(matrix))
    if not ranked.empty:
        shown = ranked.map("{:.3f}".format).replace("nan", "-").assign(runs=ranked["runs"].map(str))
        title += ", AULC: posterior mean, 95 % interval, probability to be the best"
        show_table(shown.rename(columns=task_name).reset_index(), title)
    return ranked


def exit_if_failed(matrix: "Matrix") -> None:
    """Name the runs that failed, in one line each; exit code 1 if there are any."""
    from sb3_aarl.search.execution.matrix import cell_folder
    from sb3_aarl.search.training.folder import read_outcome

    outcomes = {cell: read_outcome(cell_folder(matrix.folder, cell)) for cell in matrix.runs}
    reasons = {cell: outcome.failure for cell, outcome in outcomes.items() if outcome and outcome.failure is not None}
    for cell, reason in reasons.items():
        line = f"Failed: {cell.variant} on {cell.environment}, seed {cell.seed}: {reason}"
        errors.print(line, style="red", markup=False, highlight=False)
    if reasons:
        raise typer.Exit(1)


@app.command(rich_help_panel="A search")
def baselines(
    config: SearchFile,
    storage: Storage = None,
    workers: Workers = None,
    threads: Threads = None,
    folder: Folder = None,
    executor: options.ExecutorName = "local",
    ray_address: options.RayAddress = None,
    slurm: options.Slurm = None,
    cpus_per_run: options.CpusPerRun = None,
    gpus_per_run: options.GpusPerRun = None,
) -> None:
    """Train the baselines of a search, which its candidates are compared with."""
    execution = options.Execution(executor, ray_address, slurm, cpus_per_run, gpus_per_run)

    from optuna import get_all_study_names
    from sb3_aarl.search.execution.storage import STUDY_FILE, load_study
    from sb3_aarl.search.studies import search

    searched = search.Search.from_file(config, folder, storage, threads=threads)
    settings = searched.config
    if not settings.baselines:
        raise ValueError(f"{config} names no baselines")
    is_started = settings.name in get_all_study_names(searched.storage) if storage else (searched.folder / STUDY_FILE).exists()
    if is_started:
        search.check_study(load_study(searched.storage, settings.name), settings, free=("threads",))
    matrix = search.baselines(settings, searched.folder)
    train_matrix(matrix, execution, workers, settings.retries, config)
    compare(matrix, "Baselines")
    exit_if_failed(matrix)


@app.command(rich_help_panel="A search")
def cross_validate(
    config: SearchFile,
    with_baselines: Annotated[
        bool, typer.Option("--baselines", help="Train the file's baselines too, with the same environments and seeds.")
    ] = False,
    storage: Storage = None,
    workers: Workers = None,
    threads: Threads = None,
    folder: Folder = None,
    executor: options.ExecutorName = "local",
    ray_address: options.RayAddress = None,
    slurm: options.Slurm = None,
    cpus_per_run: options.CpusPerRun = None,
    gpus_per_run: options.GpusPerRun = None,
) -> None:
    """Train the best candidates of a search on several environments, and write the winner as YAML."""
    execution = options.Execution(executor, ray_address, slurm, cpus_per_run, gpus_per_run)

    from sb3_aarl.search.evolution.space import described
    from sb3_aarl.search.execution.storage import load_study, open_storage
    from sb3_aarl.search.studies import cross_validation
    from sb3_aarl.search.studies.search import Search

    found = Search.from_file(config, folder, threads=threads)
    settings, path = found.config, found.folder
    searched = load_study(open_storage(path, storage, create=False), settings.name)
    matrix = cross_validation.make_matrix(settings, searched, path, settings.baselines if with_baselines else ())
    train_matrix(matrix, execution, workers, settings.retries, config, cross_validation.rounds(settings, matrix))
    table = compare(matrix, "Cross-validation")
    names = [baseline.name for baseline in settings.baselines]
    if not (candidates := table.drop(index=names, errors="ignore")).empty:
        values = cross_validation.searched_values(settings, searched)
        winner = cross_validation.write_winner(candidates, path / "winner.yml", values)
        say(f"Winner: {described(winner, values[winner])}\nAs YAML: {path / 'winner.yml'}")
        if table["mean"].iloc[0] > candidates["mean"].iloc[0]:
            say(f"The mean of {table.index[0]}, a baseline, is higher.")
    exit_if_failed(matrix)


@app.command(rich_help_panel="Many agents")
def benchmark(
    configs: Annotated[
        list[Path],
        typer.Argument(
            callback=lambda paths: [find_file(path) for path in paths],
            help=f"Hyper-parameters, one for each variant: {options.SHIPPED}; or a variants.yml.",
        ),
    ],
    variants: Annotated[str | None, typer.Option(help="Names of variants, such as aarl_state. Default: all.")] = None,
    envs: Annotated[
        str | None, typer.Option(help="Such as cheetah-run,Pendulum-v1. Default: those that all files have an entry for.")
    ] = None,
    seeds: Annotated[str, typer.Option(help="Such as 0-9 or 0,3.")] = "0-9",
    checkpoints: Annotated[
        str | None,
        typer.Option(
            help="Environment steps to compare at; the last ends the run.",
            show_default="100k,500k,1000k as far as the files' n_timesteps",
        ),
    ] = None,
    every: Annotated[
        str | None, typer.Option(help="Evaluate, and save a checkpoint, after so many environment steps too, such as 20k.")
    ] = None,
    episodes: Annotated[int, typer.Option(help="Episodes of each evaluation.", min=1)] = 10,
    workers: Workers = None,
    threads: Annotated[int, typer.Option(help="Threads of each run.", min=1)] = 1,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the benchmark; more variants, tasks and seeds may be added to it. Default: runs/ beside a "
            f"variants.yml, else {options.BENCHMARK}."
        ),
    ] = None,
    imports: options.Imports = "",
    executor: options.ExecutorName = "local",
    ray_address: options.RayAddress = None,
    slurm: options.Slurm = None,
    cpus_per_run: options.CpusPerRun = None,
    gpus_per_run: options.GpusPerRun = None,
    dry_run: options.DryRun = False,
) -> None:
    """Train variants on tasks with seeds, as for the paper's tables, and show them. The same command resumes it."""
    execution = options.Execution(executor, ray_address, slurm, cpus_per_run, gpus_per_run)

    from sb3_aarl.search.cli.results import table
    from sb3_aarl.search.execution.matrix import check_matrix
    from sb3_aarl.search.studies.benchmark import RUNS, VARIANTS, load_benchmark, parse_seeds, parse_steps

    names, wanted = ([name.strip() for name in text.split(",")] if text else [] for text in (envs, variants))
    is_experiment = configs[0].name == VARIANTS
    folder = folder or (configs[0].parent / RUNS if is_experiment else options.BENCHMARK)
    steps = parse_steps(checkpoints) if checkpoints else ()
    between = parse_steps(every) if every else (None,)
    if len(between) != 1:
        raise ValueError(f"--every is one number of environment steps, not {every}")
    matrix = load_benchmark(
        configs, names, parse_seeds(seeds), steps, between[0], episodes, threads, folder, modules(imports), wanted
    )
    if dry_run:
        check_matrix(matrix)
        show_costs(unfinished(matrix), execution.at_once(workers, len(matrix.runs)))
        return
    train_matrix(matrix, execution, workers)
    table(folder)
    exit_if_failed(matrix)
