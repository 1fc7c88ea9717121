"""The search for auxiliary losses (paper, sections 2.2 and 3): its study, its sampler and the runs of its candidates."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import optuna
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.storages import BaseStorage
from optuna.study import StudyDirection

from sb3_aarl.aux_loss import AuxLoss
from search.evolution.sampler import AuxLossSampler
from search.evolution.space import distributions
from search.execution.matrix import Cell, Matrix, scores
from search.studies.config import SearchConfig
from search.training.run import Run

# User attribute of a study: what decides the losses and the scores of its candidates.
SETTINGS_KEY = "settings"
# Settings that change no score. A search may also get more generations.
SCORELESS = ("n_timesteps", "device", "n_generations")
MISSING = "missing"


def make_run(
    config: SearchConfig,
    environment: str,
    aux_loss: AuxLoss | None,
    seed: int,
    overrides: Mapping[str, Any] | None = None,
) -> Run:
    """
    A training run with the settings of a search.

    :param config: The search
    :param environment: Id of the environment
    :param aux_loss: The auxiliary loss, None for none
    :param seed: Seed of the run
    :param overrides: Merged over the hyper-parameters of the search
    """
    hyperparameters = dict(config.hyperparameters_for(environment, overrides or {}))
    hyperparameters.pop("aux_loss", None)
    return Run(
        environment=environment,
        aux_loss=None if aux_loss is None else str(aux_loss),
        hyperparameters=hyperparameters,
        seed=seed,
        checkpoints=tuple(config.checkpoints_for(environment)),
        evaluation_episodes=config.evaluation_episodes,
        threads=config.threads,
        imports=tuple(config.imports),
    )


def runs_of(config: SearchConfig) -> Callable[[AuxLoss], list[Run]]:
    """
    What is trained for a candidate: one run for each training seed.

    :param config: The search
    :return: A function from a loss to its runs
    """
    template = make_run(config, config.environment, None, config.seeds[0])

    def make_runs(aux_loss: AuxLoss) -> list[Run]:
        return [template.model_copy(update={"aux_loss": str(aux_loss), "seed": seed}) for seed in config.seeds]

    return make_runs


def open_search(config: SearchConfig, storage: BaseStorage) -> tuple[optuna.Study, AuxLossSampler]:
    """
    Create or load the study of a search.

    :param config: The search
    :param storage: Storage of the study
    :return: The study and its sampler
    :raises ValueError: naming the setting that differs, when a study of this name was started with other settings
    """
    sampler = AuxLossSampler(**config.sampler_settings())
    study = optuna.create_study(
        storage=storage,
        sampler=sampler,
        pruner=make_pruner(config),
        study_name=config.name,
        direction="maximize",
        load_if_exists=True,
    )
    problem = _other_parameters(study, config) or _other_settings(study, config)
    if problem is not None:
        raise ValueError(
            f"study {study.study_name!r} is not this search: {problem}. Another search needs a file of another name, or "
            "another storage"
        )
    study.set_user_attr(SETTINGS_KEY, _decisive(config))
    return study, sampler


def make_pruner(config: SearchConfig) -> BasePruner:
    """
    Optuna's pruner of a configuration.

    :param config: The search
    """
    if config.pruner == "median":
        return MedianPruner()
    if config.pruner == "hyperband":
        return HyperbandPruner(min_resource=config.checkpoints[0], max_resource=config.checkpoints[-1])
    return NopPruner()


def is_search(study: optuna.Study) -> bool:
    """
    Whether a study was started by :func:`open_search`.

    :param study: Any study
    """
    return SETTINGS_KEY in study.user_attrs


def baselines(config: SearchConfig, folder: Path) -> Matrix:
    """
    The runs that the candidates are compared with, on the environment and the seeds of the search.

    :param config: The search
    :param folder: Folder of the search; the runs are in its folder ``baselines``
    """
    runs = {
        Cell(baseline.name, config.environment, seed): make_run(
            config, config.environment, baseline.aux_loss, seed, baseline.overrides
        )
        for seed in config.seeds
        for baseline in config.baselines
    }
    return Matrix(f"{config.name}-baselines", folder / "baselines", runs)


def baseline_scores(config: SearchConfig, folder: Path) -> list[tuple[str, float]]:
    """
    Name and mean score of the baselines that have finished runs.

    :param config: The search
    :param folder: Folder of the search
    """
    means = scores(baselines(config, folder)).groupby("variant")["score"].mean()
    return [(str(name), float(score)) for name, score in means.items()]


def settings(config: SearchConfig) -> dict[str, Any]:
    """
    What notes and reports show of a search: its settings and its hyper-parameters in plain values.

    :param config: The search
    """
    return {**_decisive(config), "pruner": config.pruner, "retries": config.retries}


def _decisive(config: SearchConfig) -> dict[str, Any]:
    """All that decides losses and scores, as JSON gives it back."""
    run = make_run(config, config.environment, None, config.seeds[0]).model_dump(mode="json")
    hyperparameters = run.pop("hyperparameters")
    for key in ("aux_loss", "seed", "keep_model"):
        run.pop(key)
    sampler = config.sampler_settings()
    sampler["initial"] = [str(loss) for loss in sampler["initial"]]
    return json.loads(json.dumps({**run, "seeds": list(config.seeds), **sampler, **hyperparameters}))


def _other_settings(study: optuna.Study, config: SearchConfig) -> str | None:
    """The first setting that differs from those that a study was started with."""
    asked = _decisive(config)
    stored = study.user_attrs.get(SETTINGS_KEY, asked)
    for key in stored | asked:
        old, new = stored.get(key, MISSING), asked.get(key, MISSING)
        if old != new and key not in SCORELESS:
            return f"it was started with {key}={old!r}, not {new!r}"
    return None


def _other_parameters(study: optuna.Study, config: SearchConfig) -> str | None:
    """What of a study's direction and parameters is not of this search's space."""
    if study.directions != [StudyDirection.MAXIMIZE]:
        return f"its directions are {[direction.name.lower() for direction in study.directions]}, not one to maximize"
    space = distributions(config.max_horizon, config.max_horizon, config.operators)
    for trial in study.get_trials(deepcopy=False):
        for name, distribution in trial.distributions.items():
            if distribution != space.get(name):
                return f"trial {trial.number} has the parameter {name!r}, {distribution}, not {space.get(name, MISSING)}"
    return None
