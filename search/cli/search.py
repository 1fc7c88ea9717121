"""The command ``aarl search``: it wires configuration, storage, sampler, executor, driver and notes."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
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
    executor: Annotated[
        Literal["local", "ray", "slurm"], typer.Option(help="Where runs are executed: on this machine, on Ray, or on Slurm.")
    ] = "local",
    ray_address: Annotated[
        str | None, typer.Option(help="A running Ray cluster: auto, or host:port. Default: a Ray of its own on this machine.")
    ] = None,
    slurm: Annotated[
        list[str] | None,
        typer.Option(help="A parameter of submitit's jobs, such as slurm_partition=gpu or timeout_min=600; may be repeated."),
    ] = None,
    cpus_per_run: Annotated[
        int | None, typer.Option(help="With Ray or Slurm: cores of each run.", min=1, show_default="1")
    ] = None,
    gpus_per_run: Annotated[
        float | None, typer.Option(help="With Ray or Slurm: GPUs of each run; on Ray also 0.25.", min=0, show_default="0")
    ] = None,
    dry_run: DryRun = False,
) -> None:
    """Search for losses by evolution. Ctrl-C stops it, the same command resumes it."""
    values = {"--ray-address": ray_address, "--slurm": slurm, "--cpus-per-run": cpus_per_run, "--gpus-per-run": gpus_per_run}
    meaningless = {"local": set(values), "ray": {"--slurm"}, "slurm": {"--ray-address"}}[executor]
    for name in meaningless:
        if values[name] is not None:
            raise ValueError(f"{name} has no meaning with --executor {executor}")
    if executor == "slurm" and not float(gpus_per_run or 0).is_integer():
        raise ValueError(f"--gpus-per-run: Slurm's jobs get whole GPUs, not {gpus_per_run}")

    from optuna import logging
    from sb3_aarl.search.studies.search import Search, planned_runs
    from sb3_aarl.search.training.provenance import hide_password

    logging.set_verbosity(logging.WARNING)
    found = Search.from_file(config, folder, storage, threads=threads, generations=generations)
    settings, path = found.config, found.folder
    at_once = workers or (1 if executor == "local" else settings.population_size * len(settings.seeds))
    if dry_run:
        show_costs(planned_runs(settings), at_once)
        return
    options = "" if storage is None else f" --storage {hide_password(storage)}"
    say(f"Study {found.study.study_name}. To watch it: aarl dashboard {path}{options}")
    running: Any
    cpus, gpus = cpus_per_run or 1, gpus_per_run or 0
    if executor == "ray":
        from sb3_aarl.search.execution.ray import RayExecutor

        running = RayExecutor(ray_address, cpus, gpus)
    elif executor == "slurm":
        from sb3_aarl.search.execution.slurm import SlurmExecutor

        parameters = (item.partition("=")[::2] for item in slurm or [])
        options_of_jobs: dict[str, Any] = {name: int(value) if value.isdigit() else value for name, value in parameters}
        running = SlurmExecutor(path / "slurm", cpus, int(gpus), **options_of_jobs)
    else:
        from sb3_aarl.search.execution.executors import LocalExecutor

        running = LocalExecutor(at_once)
    with running, live() as show:
        progress = found.run(running, at_once, lambda state: show(progress_line(state), state.generations))
    if progress.best is not None:
        say(f"Best: {progress.best_loss}, score {progress.best:.2f}")
        if settings.cross_validation:
            options += "" if folder is None else f" --folder {folder}"
            say(f"Does it hold with other seeds? aarl cross-validate {config}{options}")


def progress_line(progress: "SearchProgress") -> str:
    """Progress as one line."""
    rows = [
        f"generation {row.generation}: {row.filled}/{row.slots} done, {row.running} running, {row.failed} failed"
        for row in progress.generations
    ]
    best = "-" if progress.best is None else f"{progress.best:.2f}"
    return "; ".join([*rows, f"best {best}, {time_to_go(progress.seconds_to_go)}"])
