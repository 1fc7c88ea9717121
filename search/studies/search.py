"""The search for auxiliary losses (paper, sections 2.2 and 3): its study, its sampler and the runs of its candidates."""

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import CategoricalDistribution, IntDistribution, distribution_to_json
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.storages import BaseStorage
from optuna.study import StudyDirection
from optuna.trial import TrialState
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import suggest_aux_loss
from sb3_aarl.search.execution.driver import Driver, SearchProgress
from sb3_aarl.search.execution.executors import Executor
from sb3_aarl.search.execution.matrix import Cell, Matrix, cell_folder, task_name
from sb3_aarl.search.execution.storage import has_driver, open_storage
from sb3_aarl.search.studies.config import Baseline, SearchConfig, corners, load_config, merge_space
from sb3_aarl.search.training.folder import FREE, Run, differences, prepare_run
from sb3_aarl.search.training.setup import check_run

from sb3_aarl import catalog
from sb3_aarl.aux_loss import AuxLoss

logger = logging.getLogger(__name__)

SETTINGS_KEY = "settings"  # user attribute of a study
# Settings of a search that may differ when it is resumed; those of its runs are in FREE.
FREE_OF_SEARCH = ("imports", "n_generations", "pruner")
# Of the repetitions of a loss: far from those of a cross-validation.
SEEDS_APART = 1000
ADVICE = "Another search needs a file of another name, another folder or another storage"


def make_run(
    config: SearchConfig,
    environment: str,
    aux_loss: AuxLoss | None,
    seed: int,
    baseline: Baseline | None = None,
) -> Run:
    """A training run with the settings of a search, and a baseline's overrides merged over its hyper-parameters."""
    hyperparameters = config.hyperparameters_for(environment, baseline)
    hyperparameters.pop("aux_loss", None)
    return Run(
        environment=environment,
        aux_loss=None if aux_loss is None else str(aux_loss),
        hyperparameters=hyperparameters,
        seed=seed,
        checkpoints=config.checkpoints_on(environment),
        evaluation_episodes=config.evaluation_episodes,
        threads=config.threads,
        imports=tuple(config.imports),
    )


def runs_of(config: SearchConfig) -> Callable[[optuna.Trial], list[Run]]:
    """A function from a trial to its candidate's runs: on each environment, one for each seed."""
    templates = [make_run(config, environment, None, config.seeds[0]) for environment in config.tasks]

    def make_runs(trial: optuna.Trial) -> list[Run]:
        changes = {"aux_loss": str(suggest_aux_loss(trial))}
        more = SEEDS_APART * AuxLossSampler.seed_index(trial)
        values = {name: _suggest(trial, name, distribution) for name, distribution in config.space.items()}
        runs = []
        for template, seed in product(templates, config.seeds):
            hyperparameters = merge_space(template.hyperparameters, values)
            runs.append(template.model_copy(update={**changes, "hyperparameters": hyperparameters, "seed": seed + more}))
        return runs

    return make_runs


def _suggest(trial: optuna.Trial, name: str, distribution: Any) -> Any:
    """The value of a hyper-parameter that is searched beside the loss."""
    if isinstance(distribution, CategoricalDistribution):
        return trial.suggest_categorical(name, distribution.choices)
    suggest: Any = trial.suggest_int if isinstance(distribution, IntDistribution) else trial.suggest_float
    return suggest(name, distribution.low, distribution.high, step=distribution.step, log=distribution.log)


def planned_runs(config: SearchConfig) -> dict[str, list[Run]]:
    """The runs of a search without failures, by kind and environment, all with one loss, to estimate the cost."""
    operations, section = AuxLossSampler(**config.sampler_settings()).operations, config.cross_validation
    n_slots = sum(len(operations(number + 1)) for number in range(config.generations))
    kinds: list[Any] = [(config.name, n_slots * len(config.seeds), config.tasks, {})]
    kinds.append(("baselines", len(config.baselines) * len(config.seeds), config.tasks, {}))
    if section:
        n_runs = section.budget or (section.top + section.top_rated) * len(section.seeds)
        n_runs += len(config.baselines) * len(section.seeds)
        kinds.append(("cross-validation", n_runs, section.environments or config.tasks, section.checkpoints))
    runs = {}
    for kind, n_runs, environments, checkpoints in kinds:
        for environment in environments if n_runs else ():
            run = make_run(config, environment, catalog.load("forward-dynamics"), 0)
            run = run.model_copy(update={"checkpoints": checkpoints.get(environment, run.checkpoints)})
            runs[f"{kind}, {task_name(environment)}"] = [run] * n_runs
    return runs


class Search:
    """
    A search: its configuration, its study and the folder of its runs::

        search = Search.from_file("own.yml")
        with LocalExecutor(workers=2) as executor:
            search.run(executor, workers=2)
        print(search.study.best_trial.user_attrs["loss"])

    :param config: Its configuration
    :param folder: Folder of its runs; None for ``runs/`` and its name
    :param storage: A storage of Optuna, or the URL of a database; None for SQLite in the folder
    """

    def __init__(self, config: SearchConfig, folder: Path | None = None, storage: BaseStorage | str | None = None):
        self.config = config
        self.folder = Path("runs") / config.name if folder is None else folder
        self._given = storage

    @classmethod
    def from_file(
        cls, path: str | Path, folder: Path | None = None, storage: BaseStorage | str | None = None, **changes: Any
    ) -> "Search":
        """
        Read a configuration, and try out runs of candidates. ``changes`` are values over those of the file.

        :raises ConfigError: naming the file, when it cannot be used, or no run can be trained
        """
        config = load_config(path, **changes)
        for environment in config.tasks:
            run = make_run(config, environment, catalog.load("forward-dynamics"), config.seeds[0])
            for values in corners(config.space):
                changes = {"hyperparameters": merge_space(run.hyperparameters, values)}
                setup = check_run(run.model_copy(update=changes), f"{path}: space {values}" if values else str(path))
            if setup.episode_steps is not None and setup.episode_steps < (longest := config.max_horizon * setup.action_repeat):
                message = "max_horizon is %d environment steps, episodes have %d: losses with longer horizons have no window"
                logger.warning(message, longest, setup.episode_steps)
        return cls(config, folder, storage)

    @cached_property
    def storage(self) -> BaseStorage:
        """The storage of its study. A file of SQLite is created if it does not exist."""
        return self._given if isinstance(self._given, BaseStorage) else open_storage(self.folder, self._given)

    @cached_property
    def study(self) -> optuna.Study:
        """
        Its study, created if it does not exist.

        :raises ValueError: if it was started with other settings, naming the first one
        """
        config, names = self.config, optuna.get_all_study_names(self.storage) if self._given is None else []
        if others := ", ".join(name for name in names if name != config.name):
            raise ValueError(f"{self.folder} is the folder of the search {others}: choose another folder (--folder)")
        sampler = AuxLossSampler(**config.sampler_settings())
        study = optuna.create_study(
            storage=self.storage,
            sampler=sampler,
            pruner=make_pruner(config),
            study_name=config.name,
            direction="maximize",
            load_if_exists=True,
        )
        check_study(study, config)
        if SETTINGS_KEY not in study.user_attrs and any(trial.state != TrialState.WAITING for trial in study.trials):
            raise ValueError(f"study {study.study_name!r} is not this search: it has trials of another program. {ADVICE}")
        if SETTINGS_KEY not in study.user_attrs:
            matrix = baselines(config, self.folder)
            for cell, run in matrix.runs.items():
                if (path := cell_folder(matrix.folder, cell)).exists():
                    prepare_run(path, run)  # refuses that of other settings, with which nothing could be compared
        sampler.progress(study)  # refuses a study with other settings of the sampler
        if not has_driver(self.storage, config.name, self.folder):  # which has its own, such as more generations
            study.set_user_attr(SETTINGS_KEY, settings(config))
        return study

    def run(
        self, executor: Executor, workers: int = 1, on_progress: Callable[[SearchProgress], object] = lambda progress: None
    ) -> SearchProgress:
        """
        Run the search to its end; if it was interrupted, resume it.

        :param executor: Where runs are executed
        :param workers: Number of runs at the executor at the same time
        :param on_progress: Called about twice a second
        :raises RunFailed: after ten candidates that failed one after the other
        """
        runs, retries = runs_of(self.config), self.config.retries
        driver = Driver(self.study, self.storage, runs, executor, self.folder, workers, retries, self.config.returns)
        with closing(iter(driver)) as progresses:
            for progress in progresses:
                on_progress(progress)
        return progress


def make_pruner(config: SearchConfig) -> BasePruner:
    """Optuna's pruner of a configuration."""
    if config.pruner == "median":
        return MedianPruner()
    if config.pruner == "hyperband":
        # Steps of reports: environments that are done, or environment steps where there is one environment.
        steps = [*range(1, len(config.tasks) + 1)] if len(config.tasks) > 1 else config.checkpoints_on(*config.tasks)
        return HyperbandPruner(min_resource=steps[0], max_resource=steps[-1])
    return NopPruner()


def baselines(config: SearchConfig, folder: Path) -> Matrix:
    """The runs that the candidates are compared with, on the environments and the seeds of the search."""
    variants = {baseline.name: baseline for baseline in config.baselines}
    cells = [Cell(name, environment, seed) for seed, environment, name in product(config.seeds, config.tasks, variants)]
    return search_matrix(config, f"{config.name}-baselines", folder / "baselines", cells, variants, config.returns)


def search_matrix(
    config: SearchConfig,
    name: str,
    folder: Path,
    cells: Sequence[Cell],
    variants: Mapping[str, Baseline],
    returns: Mapping[str, Any],
) -> Matrix:
    """A matrix of runs with the settings of a search. ``returns`` are those that count as 0 and 1, by environment."""
    runs, abouts = {}, {}
    for cell in cells:
        variant = variants[cell.variant]
        runs[cell] = make_run(config, cell.environment, variant.aux_loss, cell.seed, variant)
        abouts[cell] = {"returns": returns.get(cell.environment)}
    return Matrix(name, folder, runs, abouts)


def settings(config: SearchConfig) -> dict[str, Any]:
    """The settings that decide the scores of a search, as plain values. The sampler stores its own."""
    runs = {environment: make_run(config, environment, None, 0) for environment in config.tasks}
    exclude = {"aux_loss", "hyperparameters", "keep_model", "seed"}
    exclude |= {"environment", "checkpoints"} if config.environments else set()
    values = next(iter(runs.values())).model_dump(exclude=exclude)
    values |= {
        "evolution_seed": config.evolution_seed,
        "seeds": config.seeds,
        "n_generations": config.generations,
        "pruner": config.pruner,
    }
    if config.space:
        values["space"] = {name: distribution_to_json(distribution) for name, distribution in config.space.items()}
    if config.environments:
        values["environments"] = {
            environment: {"returns": config.returns[environment], "checkpoints": run.checkpoints, **run.hyperparameters}
            for environment, run in runs.items()
        }
    else:
        values |= next(iter(runs.values())).hyperparameters
    return json.loads(json.dumps(values))


def stored_settings(study: optuna.Study) -> dict[str, Any]:
    """The settings that a study was started with, its sampler's included; empty for a study of another program."""
    return AuxLossSampler.stored_settings(study) | study.user_attrs.get(SETTINGS_KEY, {})


def check_study(study: optuna.Study, config: SearchConfig, free: Sequence[str] = ()) -> None:
    """Raise a ValueError that names the first setting in which a study differs from a file."""
    stored, problem = study.user_attrs.get(SETTINGS_KEY), None
    if study.directions != [StudyDirection.MAXIMIZE]:
        problem = f"its directions are {[direction.name.lower() for direction in study.directions]}, not one to maximize"
    elif stored is not None:
        found = [
            item
            for item in differences(stored, settings(config))
            if item[0].rpartition(".")[2] not in (*FREE, *FREE_OF_SEARCH, *free)
        ]
        problem = next((f"it was started with {key}={old!r}, not {new!r}" for key, old, new in found), None)
    if problem is not None:
        raise ValueError(f"study {study.study_name!r} is not this search: {problem}. {ADVICE}")
