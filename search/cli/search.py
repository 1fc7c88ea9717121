"""The command ``aarl search``: it wires configuration, storage, sampler, executor, driver and notes."""

import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from sb3_aarl.search.cli.console import live, say, show_costs, time_to_go
from sb3_aarl.search.cli.options import DryRun, Folder, SearchFile, Storage, Threads, read_config, run_folder

if TYPE_CHECKING:
    from optuna import Trial
    from sb3_aarl.search.execution.driver import SearchProgress
    from sb3_aarl.search.studies.config import SearchConfig
    from sb3_aarl.search.training.folder import Run

app = typer.Typer()
# Seconds between two drawings of the evolution, which holds every candidate.
PLOT_SECONDS = 60.0


@app.command(rich_help_panel="A search")
def search(
    config: SearchFile,
    storage: Storage = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Runs at the same time.", show_default="1; with Ray those of a whole generation", min=1),
    ] = None,
    threads: Threads = None,
    generations: Annotated[int | None, typer.Option(help="Number of generations. Default: the file's.", min=1)] = None,
    pruner: Annotated[
        Literal["none", "median", "hyperband"] | None, typer.Option(help="Optuna's pruner. Default: the file's.")
    ] = None,
    folder: Folder = None,
    executor: Annotated[
        Literal["local", "ray"], typer.Option(help="Where runs are executed: on this machine, or on Ray.")
    ] = "local",
    ray_address: Annotated[
        str | None, typer.Option(help="A running Ray cluster: auto, or host:port. Default: a Ray of its own on this machine.")
    ] = None,
    cpus_per_run: Annotated[float | None, typer.Option(help="With Ray: cores of each run.", min=0, show_default="1")] = None,
    gpus_per_run: Annotated[
        float | None, typer.Option(help="With Ray: GPUs of each run, such as 0.25.", min=0, show_default="0")
    ] = None,
    dry_run: DryRun = False,
) -> None:
    """Search for losses by evolution. Ctrl-C stops it, the same command resumes it."""
    of_ray = {"ray-address": ray_address, "cpus-per-run": cpus_per_run, "gpus-per-run": gpus_per_run}
    if executor == "local" and (named := [name for name, value in of_ray.items() if value is not None]):
        raise ValueError(f"--{named[0]} needs --executor ray")

    from optuna import get_all_study_names, logging
    from optuna_dashboard import save_note
    from sb3_aarl.search.execution.driver import Driver
    from sb3_aarl.search.execution.executors import LocalExecutor
    from sb3_aarl.search.execution.storage import STUDY_FILE, open_storage
    from sb3_aarl.search.results.dashboard import HOW_TO_READ, annotate_trial, update_plots
    from sb3_aarl.search.results.report import stored_baselines
    from sb3_aarl.search.studies.search import open_search, runs_of
    from sb3_aarl.search.training.provenance import hide_password

    logging.set_verbosity(logging.WARNING)
    settings = read_config(config, threads=threads, generations=generations, pruner=pruner)
    at_once = workers or (settings.population_size * len(settings.seeds) if executor == "ray" else 1)
    path = run_folder(config, folder)
    if dry_run:
        show_costs(planned(settings), at_once)
        if (path / STUDY_FILE).exists():
            say(f"This counts all that the file says, also what is done: aarl status {path}")
        return
    opened = open_storage(path, storage)
    others = {name for name in get_all_study_names(opened) if name != settings.name} if storage is None else ()
    if others:
        raise ValueError(f"{path} is the folder of the search {', '.join(others)}: choose another folder (--folder)")
    study, _ = open_search(settings, opened)
    options = "" if storage is None else f" --storage {hide_password(storage)}"
    say(f"Study {settings.name}. To watch it: aarl dashboard {path}{options}")
    running: Any
    if executor == "ray":
        from sb3_aarl.search.execution.ray import RayExecutor

        running = RayExecutor(ray_address, 1 if cpus_per_run is None else cpus_per_run, gpus_per_run or 0)
    else:
        running = LocalExecutor(at_once)
    save_note(study, HOW_TO_READ)
    drawn = -PLOT_SECONDS

    def annotate(trial: "Trial") -> None:
        nonlocal drawn
        annotate_trial(trial)
        if time.monotonic() - drawn > PLOT_SECONDS:
            drawn = time.monotonic()
            update_plots(study, stored_baselines(path))

    progresses: Any = iter(
        Driver(study, opened, runs_of(settings), running, path, at_once, settings.retries, on_change=annotate)
    )
    with running, closing(progresses), live() as show:
        for shown in progresses:
            show(progress_line(shown), shown.generations)
    update_plots(study, stored_baselines(path))
    if shown.best is not None:
        say(f"Best: {shown.best_loss}, score {shown.best:.2f}")
        if settings.cross_validation:
            options += "" if folder is None else f" --folder {folder}"
            say(f"Does it hold with other seeds? aarl cross-validate {config}{options}")


def planned(config: "SearchConfig") -> "dict[str, list[Run]]":
    """All runs of a search's file by kind: candidates, baselines, cross-validation."""
    from sb3_aarl.search.execution.matrix import task_name
    from sb3_aarl.search.studies import cross_validation
    from sb3_aarl.search.studies.search import all_runs, baselines

    kinds = {config.name: all_runs(config)}
    for cell, run in baselines(config, Path()).runs.items():
        kinds.setdefault(f"baselines: {cell.variant}", []).append(run)
    names = {baseline.name for baseline in config.baselines}
    for cell, run in cross_validation.all_runs(config).items() if config.cross_validation else ():
        baseline = f", {cell.variant}" if cell.variant in names else ""
        kinds.setdefault(f"cross-validate: {task_name(cell.environment)}{baseline}", []).append(run)
    return kinds


def progress_line(progress: "SearchProgress") -> str:
    """Progress as one line."""
    rows = [
        f"generation {row.generation}: {row.filled}/{row.slots} done, {row.running} running, {row.failed} failed"
        for row in progress.generations
    ]
    best = "-" if progress.best is None else f"{progress.best:.2f}"
    return "; ".join([*rows, f"best {best}, {time_to_go(progress.seconds_to_go)}"])
