"""Commands for one run: train with a loss, list the losses that have a name."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from search.cli.console import console, say
from search.cli.options import ZOO

app = typer.Typer()


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
        int | None, typer.Option(help="Environment steps (agent steps x action repeat). Default: the file's n_timesteps.")
    ] = None,
    evaluations: Annotated[int, typer.Option(help="Number of evaluations, equally spaced.", min=1)] = 5,
    episodes: Annotated[int, typer.Option(help="Episodes of each evaluation.", min=1)] = 10,
    seed: Annotated[int, typer.Option(help="Seed of the run.", min=0)] = 0,
    threads: Annotated[int, typer.Option(help="Threads of PyTorch.", min=1)] = 1,
    folder: Annotated[Path | None, typer.Option(help="Folder for model and learning curve. Default: in runs/.")] = None,
) -> None:
    """Train with one auxiliary loss. After a kill the same command resumes from the last evaluation."""
    from sb3_aarl.callbacks import aulc
    from search.studies.single import train_one

    curve, path, was_finished = train_one(env, aux_loss, config, steps, evaluations, episodes, seed, threads, folder)
    table = Table("environment steps", "mean return", "deviation", "seconds", title=f"AULC {aulc(curve):.1f}")
    for column in table.columns:
        column.justify = "right"
    for point in curve:
        table.add_row(f"{point.environment_steps:,}", f"{point.mean:.1f}", f"{point.std:.1f}", f"{point.seconds:.0f}")
    console.print(table)
    if was_finished:
        say("This run was finished before. To train again, name another folder (--folder).")
    say(f"Model: {path / 'model.zip'}\nCurve: {path / 'curve.csv'}")


@app.command()
def losses(published: Annotated[bool, typer.Option("--published", help="The paper's candidates too.")] = False) -> None:
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
