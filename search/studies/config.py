"""Configuration of a search: one YAML file, checked before anything runs."""

import json
from collections.abc import Mapping
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PlainValidator,
    PositiveInt,
    PrivateAttr,
    ValidationInfo,
    create_model,
    field_validator,
)
from sb3_aarl.search.evolution.candidates import Settings
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import MAX_HORIZON, loss_to_params
from sb3_aarl.search.training import config as training
from sb3_aarl.search.training.config import ConfigError, check_checkpoints
from sb3_aarl.search.training.shipped import DEFAULTS, find_file

from sb3_aarl import catalog
from sb3_aarl.aux_loss import AuxLoss


def _ascending(steps: tuple[int, ...]) -> tuple[int, ...]:
    if not steps or list(steps) != sorted(set(steps)):
        raise ValueError(f"must be environment steps in ascending order, not {list(steps)}")
    return steps


def _different(items: tuple[Any, ...]) -> tuple[Any, ...]:
    names = [getattr(item, "name", getattr(item, "environment", item)) for item in items]
    if not items or len(set(names)) < len(names):
        raise ValueError(f"must have at least one item, and none twice, not {names}")
    return items


def _is_searched(loss: AuxLoss, settings: Mapping[str, Any]) -> bool:
    try:
        loss_to_params(loss, settings.get("operators"))
    except ValueError:
        return False
    return loss.horizon <= settings.get("max_horizon", MAX_HORIZON)


def _loss_or_none(value: Any) -> AuxLoss | None:
    return None if value in (None, "none") else catalog.resolve(value)


def _without_loss(overrides: dict[str, Any]) -> dict[str, Any]:
    if "aux_loss" in overrides:
        raise ValueError("aux_loss cannot be set: a search finds losses, and a baseline has its own key aux_loss")
    return overrides


def _two(returns: tuple[float, float]) -> tuple[float, float]:
    if returns[0] >= returns[1]:
        raise ValueError(f"must be the return that counts as 0 and a higher one that counts as 1, not {list(returns)}")
    return returns


def _distribution(value: Any) -> BaseDistribution:
    """One of Optuna's, of a list of choices, or of a mapping with ``type``, ``low``, ``high``, ``log`` and ``step``."""
    kinds = {"int": IntDistribution, "float": FloatDistribution}
    try:
        if isinstance(value, list):
            # Lists and mappings as text: Optuna's plots and dashboard want choices that can be hashed.
            return CategoricalDistribution([json.dumps(item) if isinstance(item, list | dict) else item for item in value])
        return kinds[value["type"]](**{name: item for name, item in value.items() if name != "type"})
    except (KeyError, TypeError):
        wanted = "a list of choices, or {type: int or float, low: .., high: ..}, with log: true or step: .. if wanted"
        raise ValueError(f"must be {wanted}, not {value}") from None


Environment = Annotated[str, AfterValidator(training.resolve_env_id)]
Environments = Annotated[tuple[Environment, ...], AfterValidator(_different)]
Seeds = Annotated[tuple[Annotated[int, Field(ge=0, lt=2**32)], ...], AfterValidator(_different)]
Checkpoints = Annotated[tuple[PositiveInt, ...], AfterValidator(_ascending)]
Overrides = Annotated[dict[str, Any], AfterValidator(_without_loss)]
Returns = Annotated[tuple[FiniteFloat, FiniteFloat], AfterValidator(_two)]


class Task(BaseModel, frozen=True, extra="forbid"):
    """
    One of the ``environments`` of a search. A score on it is the AULC on the scale of ``returns``: the first one, such as a
    random policy's, counts as 0, the second one as 1. ``checkpoints`` and ``overrides`` are its own, beside the search's.
    """

    environment: Environment
    returns: Returns
    checkpoints: Checkpoints | None = None
    overrides: Overrides = {}


class CrossValidation(BaseModel, frozen=True, extra="forbid"):
    """
    Cross-validation of the ``top`` candidates of a search (paper, A.4), and of ``top_rated`` others that the surrogate of
    ``screening`` rates highest: a score of one seed is noisy. Without ``environments``, they are the search's. ``checkpoints``
    are the environment steps of the evaluations on each environment, where they differ from the search's. ``returns`` are
    those that count as 0 and 1 on its environments, beside those of a search over several. With a ``budget``, candidates
    race: ``seeds`` are those that each one gets; others follow for those that could still be the best, until the budget is
    spent, in which a seed on all environments counts as one.
    """

    environments: Environments = ()
    seeds: Seeds = (1, 2, 3)
    top: PositiveInt = 5
    top_rated: NonNegativeInt = 0
    checkpoints: dict[Environment, Checkpoints] = {}
    returns: dict[Environment, Returns] = {}
    budget: PositiveInt | None = None

    @field_validator("budget")
    @classmethod
    def _enough(cls, budget: int | None, info: ValidationInfo) -> int | None:
        n_losses, seeds = info.data.get("top", 0) + info.data.get("top_rated", 0), info.data.get("seeds", ())
        if budget is not None and budget < n_losses * len(seeds):
            raise ValueError(f"must be at least {n_losses * len(seeds)}: {n_losses} losses with {len(seeds)} seeds each")
        return budget


class Baseline(BaseModel, frozen=True, extra="forbid"):
    """
    A run that the candidates are compared with (the lines of the paper's figures 4 and 6), with overrides merged over the
    hyper-parameters of the search.
    """

    name: str
    aux_loss: Annotated[AuxLoss | None, PlainValidator(_loss_or_none)] = None
    overrides: Overrides = {}


# The arguments of the sampler that are keys of a search, with their types and defaults.
_OWN = ("seed", "n_generations", "initial")
_KEYS: dict[str, Any] = {item.name: (item.type, item.default) for item in fields(Settings) if item.name not in _OWN}
_Evolution: Any = create_model("_Evolution", **_KEYS)


class SearchConfig(_Evolution, BaseModel, frozen=True, extra="forbid"):
    """
    A search. Defaults are the paper's, except that no loss is trained twice. Arguments of ``AuxLossSampler``, from
    ``population_size`` to ``again``, are keys too.

    :param path: The file that it was read from
    :param imports: Modules that are imported first, such as those that register environments
    :param environment: Id of the environment, or the short form of a DeepMind Control task
    :param environments: Several of them instead, on which each candidate is trained one after the other; its score is the
        mean over them
    :param hyperparameters: File of hyper-parameters for ``load_hyperparameters``, relative to the file of the search, or the
        name of a shipped one; None for ``sac_aux``: SACAux's defaults, and the action repeat of DeepMind Control's tasks
    :param checkpoints: Environment steps of the evaluations, ascending; the last one ends the run
    :param evaluation_episodes: Episodes of each evaluation
    :param generations: Number of generations of the evolution (the paper's "stages")
    :param initial: A loss, by notation or name, or a list of losses. ``published`` and ``handcrafted`` are all losses of that
        kind in the search space, a path to a YAML file (relative to the file of the search) is its ``aux_loss``
    :param evolution_seed: Seed of the sampler
    :param seeds: Seeds of the runs of every candidate, whose score is the mean over them. A loss that is trained again has
        other ones: with each repetition a thousand more
    :param retries: How often a run that was killed is submitted again
    :param threads: PyTorch's threads of a run; they change the last bits of a result
    :param pruner: ``none``, ``median`` or ``hyperband``
    :param cross_validation: Cross-validation, None where the configuration has none
    :param baselines: Runs that the candidates are compared with
    :param overrides: Merged over the hyper-parameters of all runs
    :param space: Hyper-parameters that are searched beside the loss: by name (with dots in mappings, as ``aux_kwargs.coef``) a
        list of choices, or a mapping with ``type`` (int or float), ``low``, ``high``, and ``log`` or ``step``
    """

    # Fields are validated in this order: validators of later ones use earlier ones.
    path: Annotated[Path, AfterValidator(Path.absolute)]
    imports: Annotated[tuple[str, ...], AfterValidator(training.import_modules)] = ()
    environments: Annotated[tuple[Task, ...], AfterValidator(_different)] = ()
    environment: Annotated[Environment | None, Field(validate_default=True)] = None
    hyperparameters: Path | None = None
    checkpoints: Checkpoints
    evaluation_episodes: PositiveInt = 10
    generations: PositiveInt = 7
    initial: tuple[AuxLoss, ...] = ()
    evolution_seed: NonNegativeInt = 0
    seeds: Seeds = (0,)
    retries: NonNegativeInt = 3
    threads: PositiveInt = 1
    pruner: Literal["none", "median", "hyperband"] = "none"
    cross_validation: CrossValidation | None = None
    baselines: Annotated[tuple[Baseline, ...], AfterValidator(_different)] = ()
    overrides: Overrides = {}
    space: Annotated[dict[str, Annotated[Any, PlainValidator(_distribution)]], AfterValidator(_without_loss)] = {}
    # The file of hyper-parameters, read once, and checked hyper-parameters by environment and baseline.
    _file: dict[str, Any] = PrivateAttr(default_factory=dict)
    _checked: dict[tuple[str, str | None], dict[str, Any]] = PrivateAttr(default_factory=dict)

    @field_validator("environment")
    @classmethod
    def _one_or_several(cls, environment: str | None, info: ValidationInfo) -> str | None:
        if (environment is None) != bool(info.data.get("environments", True)):
            raise ValueError("is missing" if environment is None else "set either environment or environments")
        return environment

    @field_validator("hyperparameters")
    @classmethod
    def _relative_to_the_file(cls, path: Path | None, info: ValidationInfo) -> Path | None:
        return path and find_file(path, folder=info.data["path"].parent)

    @field_validator("initial", mode="plain")
    @classmethod
    def _losses(cls, value: Any, info: ValidationInfo) -> tuple[AuxLoss, ...]:
        if isinstance(value, list | tuple):
            return tuple(loss for item in value for loss in cls._losses(item, info))
        if isinstance(value, str) and value.lower().endswith((".yml", ".yaml")):
            return (catalog.resolve(info.data["path"].parent / value),)
        if value == "published":
            losses = [*catalog.published().values()]
        elif value == "handcrafted":
            losses = [catalog.load(name) for name in catalog.names() if not name.startswith("aarl-")]
        else:
            return (catalog.resolve(value),)
        return tuple(loss for loss in losses if _is_searched(loss, info.data))

    @property
    def name(self) -> str:
        """The name of the search's study: that of its file."""
        return self.path.stem

    @property
    def tasks(self) -> dict[str, Task | None]:
        """The environments of the search, None for one that has no settings of its own."""
        return {self.environment: None} if self.environment else {task.environment: task for task in self.environments}

    def checkpoints_on(self, environment: str) -> tuple[int, ...]:
        """The checkpoints of a candidate's run on an environment."""
        task = self.tasks.get(environment)
        return self.checkpoints if task is None or task.checkpoints is None else task.checkpoints

    @property
    def returns(self) -> dict[str, tuple[float, float]]:
        """The returns that count as 0 and 1 in the search, by environment; without any, returns count as they are."""
        return {task.environment: task.returns for task in self.environments}

    def hyperparameters_for(self, environment: str, baseline: Baseline | None = None) -> dict[str, Any]:
        """The hyper-parameters of a run on an environment, with a baseline's overrides merged over them."""
        key = environment, None if baseline is None else baseline.name
        if key not in self._checked:
            if baseline is None:
                task = self.tasks.get(environment)
                values, of_whom = self._entry(environment), f"{environment}: " if task else ""
                overrides = training.merge(self.overrides, task.overrides) if task else self.overrides
            else:
                values, overrides = self.hyperparameters_for(environment), baseline.overrides
                of_whom = f"baseline {baseline.name}: "
            if overrides:
                merged = training.merge(values, overrides)
                values = training.check_hyperparameters(merged, environment, f"{self.path}: {of_whom}overrides")
            self._checked[key] = values
        return dict(self._checked[key])

    def _entry(self, environment: str) -> dict[str, Any]:
        file = self.hyperparameters or DEFAULTS
        if not self._file:
            self._file.update(training.read_entries(file))
        return training.entry_of(self._file, environment, str(file))

    def sampler_settings(self) -> dict[str, Any]:
        """The arguments of ``AuxLossSampler``, the number of generations included."""
        others = {"n_generations": self.generations, "seed": self.evolution_seed, "initial": self.initial}
        return {**others, **{name: getattr(self, name) for name in _KEYS}}


def load_config(path: str | Path, **changes: Any) -> SearchConfig:
    """
    Read and check the configuration of a search.

    :param path: The YAML file
    :param changes: Values over those of the file, unless they are None
    :raises ConfigError: naming the file and the key that is wrong
    """
    values = training.read_yaml(path)
    if "path" in values:
        raise ConfigError(f"{path}: path: unknown key")
    values |= {"path": str(path)} | {key: value for key, value in changes.items() if value is not None}
    config = training.validated(SearchConfig, values, str(path))
    try:
        AuxLossSampler(**config.sampler_settings())
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    section = config.cross_validation
    validated = (section.environments or tuple(config.tasks)) if section else ()
    for env_id in config.tasks:
        check_checkpoints(config.checkpoints_on(env_id), config.hyperparameters_for(env_id), f"{path}: {env_id}")
    for env_id in dict.fromkeys([*config.tasks, *validated]):
        for baseline in (None, *config.baselines):
            config.hyperparameters_for(env_id, baseline)
    returns = config.returns | (section.returns if section else {})
    if returns and (missing := ", ".join(env_id for env_id in validated if env_id not in returns)):
        raise ConfigError(f"{path}: cross_validation.returns: {missing} is missing, with the returns that count as 0 and 1")
    for name, given in (("checkpoints", section.checkpoints), ("returns", section.returns)) if section else ():
        if unused := ", ".join(sorted(given.keys() - set(validated))):
            raise ConfigError(f"{path}: cross_validation.{name}: {unused} is none of its environments")
    for env_id, corner in product(config.tasks, corners(config.space)):
        for name in corner:
            values = merge_space(config.hyperparameters_for(env_id), {name: corner[name]})
            training.check_hyperparameters(values, env_id, f"{path}: space.{name}")
    return config


def corners(space: Mapping[str, Any]) -> list[dict[str, Any]]:
    """As many values of all parameters together as have every choice, and both ends of every range, at least once."""
    ends = {name: getattr(item, "choices", None) or (item.low, item.high) for name, item in space.items()}
    return [{name: some[i % len(some)] for name, some in ends.items()} for i in range(max(map(len, ends.values()), default=1))]


def merge_space(hyperparameters: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Hyper-parameters with the values of a search's ``space`` merged over them, by names with dots."""
    merged = dict(hyperparameters)
    for name, value in values.items():
        if isinstance(value, str) and value.startswith(("[", "{")):
            value = json.loads(value)
        for part in reversed(name.split(".")):
            value = {part: value}
        merged = training.merge(merged, value)
    return merged
