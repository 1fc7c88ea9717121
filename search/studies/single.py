"""One training run by hand, behind ``aarl train``: it keeps the model."""

import hashlib
import re
from pathlib import Path

from sb3_aarl import catalog
from sb3_aarl.callbacks import Evaluation
from sb3_aarl.envs import PREFIX
from search.training.config import ConfigError, action_repeat, load_aux_loss, load_hyperparameters, resolve_env_id
from search.training.run import Run, check_run, checkpoint_interval, is_finished, prepare_run, spread_checkpoints, train


def train_one(
    environment: str,
    aux_loss: str | None,
    config: str | Path,
    environment_steps: int | None = None,
    n_evaluations: int = 5,
    evaluation_episodes: int = 10,
    seed: int = 0,
    threads: int = 1,
    folder: str | Path | None = None,
) -> tuple[list[Evaluation], Path, bool]:
    """
    Train with one loss in this process, with a progress bar, and keep model, learning curve and ``provenance.json``.

    :param environment: Id of the environment, or the short form of a DeepMind Control task
    :param aux_loss: Notation, name, or YAML file of ``load_aux_loss``; ``"none"`` for none; None for what the file of
        hyper-parameters says, or ``"auto"``
    :param config: File of hyper-parameters
    :param environment_steps: Environment steps of the run, None for the file's ``n_timesteps``
    :param folder: Folder of the run, None for one in ``runs`` named after environment, loss and settings
    :return: The learning curve, the folder, and whether the run was finished before
    :raises ValueError: when something is unknown or does not fit, or the folder has another run
    """
    environment = resolve_env_id(environment)
    hyperparameters = load_hyperparameters(config, environment)
    from_file = hyperparameters.pop("aux_loss", "auto")
    loss = from_file if aux_loss is None else aux_loss
    if isinstance(loss, str) and Path(loss).suffix in (".yml", ".yaml"):
        loss = load_aux_loss(loss)
    if loss in (None, "none"):
        loss = None
    elif loss != "auto":
        loss = str(catalog.resolve(loss))
    if environment_steps is None:
        if "n_timesteps" not in hyperparameters:
            raise ConfigError(f"how many steps? {config} has no n_timesteps for {environment}")
        environment_steps = hyperparameters["n_timesteps"] * action_repeat(hyperparameters)
    run = Run(
        environment=environment,
        aux_loss=loss,
        hyperparameters=hyperparameters,
        seed=seed,
        checkpoints=spread_checkpoints(environment_steps, n_evaluations, checkpoint_interval(hyperparameters)),
        evaluation_episodes=evaluation_episodes,
        threads=threads,
        keep_model=True,
    )
    if folder is None:
        # A notation may be longer than the name of a file may be.
        label = re.sub(r"[^a-z0-9]+", "-", f"{environment.removeprefix(PREFIX)} {aux_loss or 'auto'}".lower())[:80].strip("-")
        folder = Path("runs") / f"{label}-{hashlib.sha256(run.model_dump_json().encode()).hexdigest()[:8]}-seed-{seed}"
    folder = Path(folder)
    check_run(run)
    prepare_run(folder, run)
    was_finished = is_finished(folder)
    return train(folder, progress_bar=True), folder, was_finished
