"""One training run by hand, behind ``aarl train``."""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from sb3_aarl.search.training.config import (
    ConfigError,
    action_repeat,
    checkpoint_interval,
    entry_of,
    import_modules,
    read_entries,
    resolve_env_id,
    spread_checkpoints,
)
from sb3_aarl.search.training.folder import Run, prepare_run
from sb3_aarl.search.training.setup import check_run
from sb3_aarl.search.training.shipped import DEFAULTS, find_file

from sb3_aarl import catalog
from sb3_aarl.envs import PREFIX


def prepare_one(
    environment: str,
    aux_loss: str | None,
    hyperparams: str | Path | None,
    environment_steps: int | None = None,
    n_evaluations: int = 5,
    evaluation_episodes: int = 10,
    seed: int = 0,
    threads: int = 1,
    folder: str | Path | None = None,
    imports: Sequence[str] = (),
) -> Path:
    """
    Prepare the folder of a run with one loss, which keeps its model, for ``training.run.train``, and return it.
    ``aux_loss=None`` is that of the file ``hyperparams``, or ``"auto"``; ``"none"`` is none.
    """
    import_modules(imports)
    environment = resolve_env_id(environment)
    file = find_file(Path(hyperparams or DEFAULTS))
    hyperparameters = entry_of(read_entries(file), environment, str(file))
    from_file = hyperparameters.pop("aux_loss", "auto")
    named = loss = from_file if aux_loss is None else aux_loss
    if loss in (None, "none"):
        loss = None
    elif loss != "auto":
        loss = str(catalog.resolve(loss))
    if environment_steps is None:
        if "n_timesteps" not in hyperparameters:
            raise ConfigError(f"how many steps? {file} has no n_timesteps for {environment}")
        environment_steps = hyperparameters["n_timesteps"] * action_repeat(hyperparameters)
    run = Run(
        environment=environment,
        aux_loss=loss,
        hyperparameters=hyperparameters,
        seed=seed,
        checkpoints=spread_checkpoints(environment_steps, n_evaluations, checkpoint_interval(hyperparameters, str(file))),
        evaluation_episodes=evaluation_episodes,
        threads=threads,
        keep_model=True,
        imports=tuple(imports),
    )
    if folder is None:
        # A notation may be longer than the name of a file may be.
        label = re.sub(r"[^a-z0-9]+", "-", f"{environment.removeprefix(PREFIX)} {named or 'none'}".lower())[:80].strip("-")
        folder = Path("runs") / f"{label}-{hashlib.sha256(run.model_dump_json().encode()).hexdigest()[:8]}-seed-{seed}"
    folder = Path(folder)
    check_run(run, str(file))
    prepare_run(folder, run)
    return folder
