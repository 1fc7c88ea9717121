"""One training run by hand, behind ``aarl train``: it keeps the model; and what is done with such a model."""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from sb3_aarl.search.training.config import ConfigError, action_repeat, import_modules, load_hyperparameters, resolve_env_id
from sb3_aarl.search.training.run import (
    MODEL,
    NORMALIZE,
    RUN,
    Run,
    check_run,
    checkpoint_interval,
    make_env,
    prepare_run,
    read_run,
    spread_checkpoints,
)
from sb3_aarl.search.training.shipped import find_file
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_aarl import SACAux, catalog
from sb3_aarl.envs import PREFIX

VIDEO_SIZE = 320  # pixels, height and width


def prepare_one(
    environment: str,
    aux_loss: str | None,
    config: str | Path | None,
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
    ``aux_loss=None`` is that of the file of hyper-parameters, or ``"auto"``; ``"none"`` is none.
    """
    import_modules(imports)
    environment = resolve_env_id(environment)
    file = find_file(Path(config or ("aarl_state" if environment.startswith(PREFIX) else "default")))
    hyperparameters = load_hyperparameters(file, environment)
    if config is None:
        hyperparameters.pop("policy", None)  # the one that fits the observations
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
        checkpoints=spread_checkpoints(environment_steps, n_evaluations, checkpoint_interval(hyperparameters)),
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
    if (folder / "study.db").exists():  # sb3_aarl.search.execution.storage, which has the name, needs Optuna
        raise ValueError(f"{folder} is the folder of a search: choose another folder (--folder)")
    check_run(run, str(file))
    prepare_run(folder, run)
    return folder


def load_trained(
    path: Path, environment: str | None = None, renders: bool = False, imports: Sequence[str] = ()
) -> tuple[SACAux, VecEnv]:
    """A trained model, and an environment for it: that of the run that it is from, or another one."""
    folder = path if path.is_dir() else path.parent
    model = folder / MODEL if path.is_dir() else path
    if not model.is_file():
        raise ValueError(f"{model} does not exist: name a model, or the folder of a run that has one, such as of aarl train")
    run = read_run(folder) if (folder / RUN).exists() else None
    import_modules([*(run.imports if run else ()), *imports])
    if environment is None and run is None:
        raise ValueError(f"which environment? No {RUN} is beside {model}: name it as a second argument")
    env_id = resolve_env_id(environment) if environment is not None else run.environment  # type: ignore[union-attr]
    settings = run.hyperparameters if run else {}
    env_kwargs = settings.get("env_kwargs") or {}
    if renders and env_id.startswith(PREFIX) and not env_kwargs.get("pixels"):
        env_kwargs = {"image_size": VIDEO_SIZE, **env_kwargs}
    try:
        env: VecEnv = make_vec_env(lambda: make_env(env_id, env_kwargs, settings.get("env_wrapper"), renders))
    except TypeError as error:  # Gymnasium's, for an environment that takes no render_mode
        raise ValueError(f"{env_id} cannot be made: {error}") from error
    if renders and "rgb_array" not in env.get_attr("metadata")[0].get("render_modes", ()):
        raise ValueError(f"{env_id} has no pictures: its metadata's render_modes are without rgb_array")
    if (folder / NORMALIZE).exists():
        env = VecNormalize.load(str(folder / NORMALIZE), env)
        env.training = env.norm_reward = False
    return SACAux.load(model, env), env
