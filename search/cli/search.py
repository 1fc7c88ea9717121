"""The command ``aarl search``: it wires configuration, storage, sampler, executor, driver and notes."""

import shlex
from typing import TYPE_CHECKING, Annotated

import typer
from sb3_aarl.search.cli import options
from sb3_aarl.search.cli.console import live, say, show_costs, time_to_go
from sb3_aarl.search.cli.options import DryRun, Folder, SearchFile, Storage, Threads

if TYPE_CHECKING:
    from sb3_aarl.search.execution.driver import SearchProgress

app = typer.Typer()


@app.command(rich_help_panel="A search")
def search(
    config: SearchFile,
    storage: Storage = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Runs at the same time.", show_default="1; with Ray or Slurm those of a whole generation", min=1),
    ] = None,
    threads: Threads = None,
    generations: Annotated[int | None, typer.Option(help="Number of generations. Default: the file's.", min=1)] = None,
    folder: Folder = None,
    executor: options.ExecutorName = "local",
    ray_address: options.RayAddress = None,
    slurm: options.Slurm = None,
    cpus_per_run: options.CpusPerRun = None,
    gpus_per_run: options.GpusPerRun = None,
    dry_run: DryRun = False,
) -> None:
    """Search for losses by evolution. Ctrl-C stops it, the same command resumes it."""
    execution = options.Execution(executor, ray_address, slurm, cpus_per_run, gpus_per_run)

    from optuna import logging
    from sb3_aarl.search.studies.search import Search, planned_runs
    from sb3_aarl.search.training.provenance import hide_password

    logging.set_verbosity(logging.WARNING)
    found = Search.from_file(config, folder, storage, threads=threads, generations=generations)
    settings, path = found.config, found.folder
    at_once = execution.at_once(workers, settings.population_size * len(settings.seeds))
    if dry_run:
        show_costs(planned_runs(settings), at_once)
        return
    place = [] if storage is None else ["--storage", hide_password(storage)]
    # The study is created after the executor, which may have a wrong address.
    with execution.start(at_once, path) as running:
        say(f"Study {found.study.study_name}. To watch it: {shlex.join(['aarl', 'dashboard', str(path), *place])}")
        with live() as show:
            progress = found.run(running, at_once, lambda state: show(progress_line(state), state.generations))
    if progress.best is not None:
        say(f"Best: {progress.best_loss}, score {progress.best:.2f}")
        if settings.cross_validation:
            place += [] if folder is None else ["--folder", str(folder)]
            command = shlex.join(["aarl", "cross-validate", str(config), *place])
            say(f"Does it hold with other seeds? {command}{execution}")


def progress_line(progress: "SearchProgress") -> str:
    """Progress as one line."""
    rows = [
        f"generation {row.generation}: {row.filled}/{row.slots} done, {row.running} running, {row.failed} failed"
        for row in progress.generations
    ]
    best = "-" if progress.best is None else f"{progress.best:.2f}"
    return "; ".join([*rows, f"best {best}, {time_to_go(progress.seconds_to_go)}"])
