"""Commands for one run: train with a loss, list the losses that have a name; evaluate and film what was trained."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table
from sb3_aarl.search.cli.console import console, errors, say, time_to_go
from sb3_aarl.search.cli.options import SHIPPED, Imports, modules
from sb3_aarl.search.training.shipped import find_file

if TYPE_CHECKING:
    from sb3_aarl.callbacks import Evaluation

app = typer.Typer()
FPS = 30  # pictures a second of a video
Trained = Annotated[Path, typer.Argument(help="Folder of a run, such as aarl train makes.")]


@app.command(rich_help_panel="One agent")
def train(
    env: Annotated[str, typer.Argument(help="Such as cheetah-run, dm_control/cheetah-run-v0 or Pendulum-v1.")],
    aux_loss: Annotated[
        str | None,
        typer.Option(help="Notation, name, YAML file of a winner, 'none' or 'auto'. Default: the file's, or auto."),
    ] = None,
    hyperparams: Annotated[
        Path | None,
        typer.Option(help=f"Hyper-parameters: {SHIPPED}. Default: sac_aux, SACAux's own."),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(help="Environment steps (agent steps x action repeat). Default: the file's n_timesteps.", min=1),
    ] = None,
    evaluations: Annotated[int, typer.Option(help="Number of evaluations, equally spaced.", min=1)] = 5,
    episodes: Annotated[int, typer.Option(help="Episodes of each evaluation.", min=1)] = 10,
    seed: Annotated[int, typer.Option(help="Seed of the run.", min=0)] = 0,
    threads: Annotated[int, typer.Option(help="Threads of PyTorch.", min=1)] = 1,
    folder: Annotated[Path | None, typer.Option(help="Folder for model and learning curve. Default: in runs/.")] = None,
    imports: Imports = "",
) -> None:
    """Train with one auxiliary loss. After a kill the same command resumes from the last evaluation."""
    from sb3_aarl.search.execution.queue import seconds_to_go
    from sb3_aarl.search.studies.single import prepare_one
    from sb3_aarl.search.training.folder import is_finished, read_run
    from sb3_aarl.search.training.run import train as train_run

    from sb3_aarl.callbacks import aulc

    def show(curve: "list[Evaluation]") -> None:
        point = curve[-1]
        to_go = seconds_to_go([point.seconds / len(curve)], evaluations - len(curve), 1)
        errors.print(f"{point.environment_steps:,} environment steps: {point.mean:.1f} ± {point.std:.1f}, {time_to_go(to_go)}")

    path = prepare_one(env, aux_loss, hyperparams, steps, evaluations, episodes, seed, threads, folder, modules(imports))
    if is_finished(path):
        errors.print(f"{path} is finished: this is its result")
    else:
        planned = ", ".join(f"{point:,}" for point in read_run(path).checkpoints)
        errors.print(f"Into {path}; evaluations, from which it can be resumed, at {planned} environment steps")
    curve = train_run(path, show)
    title = f"Mean of the evaluations (AULC) {aulc(curve):.1f}"
    table = Table("environment steps", "mean return", "deviation", "seconds", title=title)
    for column in table.columns:
        column.justify = "right"
    for point in curve:
        table.add_row(f"{point.environment_steps:,}", f"{point.mean:.1f}", f"{point.std:.1f}", f"{point.seconds:.0f}")
    console.print(table)
    say(f"Model: {path / 'model.zip'}\nCurve: {path / 'curve.csv'}")


@app.command(rich_help_panel="One agent")
def losses(
    published: Annotated[bool, typer.Option("--published", help="The paper's candidates too.")] = False,
) -> None:
    """List the losses that have a name."""
    from sb3_aarl import catalog

    names = [*catalog.names(), *(catalog.published() if published else ())]
    table = Table("name", "notation")
    table.columns[1].overflow = "fold"
    for name in names:
        table.add_row(name, escape(str(catalog.load(name))))
    console.print(table)


@app.command(rich_help_panel="A search")
def init(path: Annotated[Path, typer.Argument(help="File to write, such as own.yml.")]) -> None:
    """Write the configuration of a search on an environment of your own, with comments, to edit."""
    with path.open("x", encoding="utf-8") as file:
        file.write(find_file(Path("template"), searches=True).read_text(encoding="utf-8"))
    say(f"{path}: a search on Pendulum-v1, to edit. What it costs: aarl search {path} --dry-run")


@app.command(rich_help_panel="One agent")
def evaluate(
    folder: Trained,
    episodes: Annotated[int, typer.Option(help="How many episodes.", min=1)] = 10,
    seed: Annotated[int, typer.Option(help="Seed of the first episode.", min=0)] = 0,
) -> None:
    """Show the return of a trained model: mean and deviation of episodes with its best actions."""
    import numpy as np

    returns = play(folder, episodes, seed)
    say(f"{np.mean(returns):.1f} ± {np.std(returns):.1f}, mean and deviation over episodes: {episodes}")


@app.command(rich_help_panel="One agent")
def video(
    folder: Trained,
    out: Annotated[
        Path | None,
        typer.Option(help="Such as film.gif or film.mp4 (pip install imageio-ffmpeg). Default: video.gif in the folder."),
    ] = None,
) -> None:
    """Film an episode of a trained model, whose environment takes render_mode, at 30 pictures a second."""
    import imageio.v3 as imageio

    path, frames = out or (folder if folder.is_dir() else folder.parent) / "video.gif", list[Any]()
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise ValueError(f"--out: {path} must end in .gif or .mp4")
    returns = play(folder, 1, 0, frames)
    frames.pop()  # of the next episode: the environment is reset before a picture is taken
    # GIF counts in milliseconds, and repeats.
    imageio.imwrite(path, frames, **({"duration": 1000 / FPS, "loop": 0} if path.suffix.lower() == ".gif" else {"fps": FPS}))
    say(f"Video: {path}, {len(frames)} pictures, return {returns[0]:.1f}")


def play(folder: Path, episodes: int, seed: int, frames: list[Any] | None = None) -> list[float]:
    """The returns of a model's episodes, and, where wanted, their pictures."""
    from sb3_aarl.search.training.setup import load_trained
    from stable_baselines3.common.evaluation import evaluate_policy

    model, env = load_trained(folder, renders=frames is not None)
    env.seed(seed)
    film = None if frames is None else lambda *_: frames.append(env.render())
    returns: Any = evaluate_policy(model, env, episodes, callback=film, return_episode_rewards=True)[0]
    env.close()
    return returns
