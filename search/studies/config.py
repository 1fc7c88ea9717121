"""Configuration of a search: one YAML file, checked before anything runs."""

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    NonNegativeInt,
    PlainValidator,
    PositiveInt,
    ValidationInfo,
    field_validator,
    model_validator,
)

from sb3_aarl import catalog
from sb3_aarl.aux_loss import LONGEST_HORIZON, AuxLoss
from search.evolution.sampler import AuxLossSampler
from search.evolution.space import MAX_HORIZON, loss_to_params
from search.training.config import (
    FORBID,
    ConfigError,
    action_repeat,
    check_hyperparameters,
    import_modules,
    load_hyperparameters,
    merge,
    read_yaml,
    resolve_env_id,
    validated,
)

# Arguments of AuxLossSampler, under the same names.
SAMPLER_KEYS = (
    *("population_size", "n_random", "n_prior", "parents", "replacement", "crossover", "horizon_change", "random"),
    *("max_horizon", "operators", "allow_duplicates", "screening", "seed"),
)


def _ascending(steps: tuple[int, ...]) -> tuple[int, ...]:
    if list(steps) != sorted(set(steps)):
        raise ValueError(f"must be environment steps in ascending order, not {list(steps)}")
    return steps


def _different(items: tuple[Any, ...]) -> tuple[Any, ...]:
    if len(set(items)) < len(items):
        raise ValueError(f"must be different, not {list(items)}")
    return items


def _resolved(value: Any) -> AuxLoss | None:
    return None if value in (None, "none") else catalog.resolve(value)


Checkpoints = Annotated[tuple[PositiveInt, ...], Field(min_length=1), AfterValidator(_ascending)]
Seeds = Annotated[tuple[Annotated[int, Field(ge=0, lt=2**32)], ...], Field(min_length=1), AfterValidator(_different)]
Environments = Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(_different)]


class CrossValidation(BaseModel):
    """
    Cross-validation of a search's best candidates (paper, A.4).

    :param environments: Ids of the environments
    :param seeds: Seeds of the runs on each
    :param top: How many candidates
    :param checkpoints: Environment steps of the evaluations, for environments that differ from the search's
    """

    model_config = FORBID

    environments: Environments
    seeds: Seeds = (0, 1, 2)
    top: PositiveInt = 5
    checkpoints: dict[str, Checkpoints] = {}


class OperatorSelection(BaseModel):
    """
    Comparison of the ten operators (paper, A.1.3).

    :param environments: Ids of the environments
    :param seeds: Seeds of the runs on each
    """

    model_config = FORBID

    environments: Environments
    seeds: Seeds = (0, 1, 2, 3, 4)


class Baseline(BaseModel):
    """
    A run that the candidates are compared with (the lines of the paper's figures 4 and 6).

    :param name: Its name
    :param aux_loss: Its auxiliary loss, None for none
    :param overrides: Merged over the hyper-parameters of the search
    """

    model_config = FORBID

    name: str
    aux_loss: Annotated[AuxLoss | None, PlainValidator(_resolved)] = None
    overrides: dict[str, Any] = {}


class SearchConfig(BaseModel):
    """
    A search. Defaults are the paper's.

    :param path: The file that it was read from
    :param environment: Id of the environment
    :param hyperparameters: File of hyper-parameters for ``load_hyperparameters``, relative to the file of the search
    :param checkpoints: Environment steps of the evaluations, ascending; the last one ends the run
    :param evaluation_episodes: Episodes of each evaluation
    :param generations: Number of generations of the evolution (the paper's "stages")
    :param population_size: As in ``AuxLossSampler``, and so are the next ones up to ``screening``
    :param n_random: As in ``AuxLossSampler``
    :param n_prior: As in ``AuxLossSampler``
    :param parents: As in ``AuxLossSampler``
    :param replacement: As in ``AuxLossSampler``
    :param crossover: As in ``AuxLossSampler``
    :param horizon_change: As in ``AuxLossSampler``
    :param random: As in ``AuxLossSampler``
    :param max_horizon: As in ``AuxLossSampler``
    :param operators: As in ``AuxLossSampler``
    :param allow_duplicates: As in ``AuxLossSampler``
    :param screening: As in ``AuxLossSampler``
    :param initial: Losses of the first generation, by notation or name: a list, or one of them. ``published`` and
        ``handcrafted`` stand for all losses of that kind that the search space has, and a path to a YAML file for its
        ``aux_loss``, which may be a list
    :param retries: How often a run that was killed is submitted again
    :param threads: PyTorch's threads of a run; they change the last bits of a result
    :param imports: Modules that are imported first, such as those that register environments
    :param seed: Seed of the evolution
    :param seeds: Seeds of the runs of every candidate, whose score is the mean over them
    :param pruner: ``none``, ``median`` or ``hyperband``
    :param cross_validation: Cross-validation, None where the configuration has none
    :param operator_selection: Operator selection, None where the configuration has none
    :param baselines: What the candidates are compared with
    :param overrides: Merged over the hyper-parameters of all runs
    """

    model_config = FORBID

    path: Annotated[Path, AfterValidator(Path.absolute)]
    environment: str
    hyperparameters: Path
    checkpoints: Checkpoints
    evaluation_episodes: PositiveInt = 10
    generations: PositiveInt = 7
    population_size: PositiveInt = 100
    n_random: NonNegativeInt = 100
    n_prior: NonNegativeInt = 25
    parents: float = 0.25
    replacement: float = 0.5
    crossover: float = 0.2
    horizon_change: float = 0.1
    random: float = 0.2
    max_horizon: Annotated[PositiveInt, Field(le=LONGEST_HORIZON)] = MAX_HORIZON
    operators: tuple[str, ...] | None = None
    allow_duplicates: bool = False
    screening: PositiveInt = 1
    initial: str | tuple[str | dict[str, Any], ...] = ()
    retries: NonNegativeInt = 3
    threads: PositiveInt = 1
    imports: tuple[str, ...] = ()
    seed: NonNegativeInt = 0
    seeds: Seeds = (0,)
    pruner: Literal["none", "median", "hyperband"] = "none"
    cross_validation: CrossValidation | None = None
    operator_selection: OperatorSelection | None = None
    baselines: tuple[Baseline, ...] = ()
    overrides: dict[str, Any] = {}

    @field_validator("hyperparameters")
    @classmethod
    def _relative_to_the_file(cls, path: Path, info: ValidationInfo) -> Path:
        return info.data["path"].parent / path

    @field_validator("baselines")
    @classmethod
    def _named_differently(cls, baselines: tuple[Baseline, ...]) -> tuple[Baseline, ...]:
        _different(tuple(baseline.name for baseline in baselines))
        return baselines

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, values: Any) -> Any:
        if "stages" in values:
            raise ValueError("stages: the key is called 'generations' now")
        return values

    @property
    def name(self) -> str:
        """The name of the search's study: that of its file."""
        return self.path.stem

    def hyperparameters_for(self, environment: str, overrides: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """
        The hyper-parameters of a run.

        :param environment: Id of the environment
        :param overrides: Merged over them, such as those of a baseline
        """
        merged = merge(load_hyperparameters(self.hyperparameters, environment), self.overrides)
        return check_hyperparameters(merge(merged, overrides or {}), environment, f"{self.path}: overrides")

    def checkpoints_for(self, environment: str) -> tuple[int, ...]:
        """
        The environment steps of the evaluations on an environment.

        :param environment: Id of the environment
        """
        others = self.cross_validation.checkpoints if self.cross_validation else {}
        return self.checkpoints if environment == self.environment else others.get(environment, self.checkpoints)

    def sampler_settings(self) -> dict[str, Any]:
        """The arguments of ``AuxLossSampler``, the number of generations and the initial losses included."""
        settings = {name: getattr(self, name) for name in SAMPLER_KEYS}
        initial = [self.initial] if isinstance(self.initial, str) else self.initial
        losses = [loss for value in initial for loss in self._losses(value)]
        return settings | {"n_generations": self.generations, "initial": tuple(dict.fromkeys(losses))}

    def _losses(self, value: Any) -> Sequence[AuxLoss]:
        """The losses of one entry of ``initial``."""
        if value == "published":
            return [candidate.loss for candidate in catalog.published() if self._is_searched(candidate.loss)]
        if value == "handcrafted":
            losses = [catalog.load(name) for name in catalog.names() if not name.startswith("aarl-")]
            return [loss for loss in losses if self._is_searched(loss)]
        if isinstance(value, str) and value.endswith((".yml", ".yaml")):
            path = self.path.parent / value
            losses = read_yaml(path).get("aux_loss", [])
            try:
                return [catalog.resolve(loss) for loss in (losses if isinstance(losses, list) else [losses])]
            except ValueError as error:
                raise ConfigError(f"{path}: aux_loss: {error}") from None
        return [catalog.resolve(value)]

    def _is_searched(self, loss: AuxLoss) -> bool:
        """Whether the search space has a loss."""
        try:
            loss_to_params(loss, self.operators)
        except ValueError:
            return False
        return loss.canonical().horizon <= self.max_horizon


def load_config(path: str | Path) -> SearchConfig:
    """
    Read a search's configuration, and check all that can be checked without training.

    :param path: The YAML file
    :raises ConfigError: naming the file and the key that is wrong
    """
    values = read_yaml(path)
    if "path" in values:
        raise ConfigError(f"{path}: path: unknown key")
    config = validated(SearchConfig, {"path": str(Path(path).absolute()), **values}, str(path))
    try:
        import_modules(config.imports)
        AuxLossSampler(**config.sampler_settings())
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    _check_environments(config)
    return config


def _check_environments(config: SearchConfig) -> None:
    """Refuse environments, hyper-parameters and checkpoints that do not fit, of each run of each part."""
    environments = {"environment": (config.environment,)}
    if config.cross_validation:
        environments["cross_validation.environments"] = config.cross_validation.environments
    if config.operator_selection:
        environments["operator_selection.environments"] = config.operator_selection.environments
    for key, env_ids in environments.items():
        for env_id in env_ids:
            try:
                full_id = resolve_env_id(env_id)
            except ConfigError as error:
                raise ConfigError(f"{config.path}: {key}: {error}") from None
            if full_id != env_id:
                raise ConfigError(f"{config.path}: {key}: write {full_id!r} for {env_id!r}")
            baselines = config.baselines if env_id == config.environment else ()
            for overrides in ({}, *(baseline.overrides for baseline in baselines)):
                repeat = action_repeat(config.hyperparameters_for(env_id, overrides))
                between = [step for step in config.checkpoints_for(env_id) if step % repeat]
                if between:
                    problem = f"must be multiples of the action repeat of {env_id}, {repeat}: {between} are not"
                    raise ConfigError(f"{config.path}: checkpoints: {problem}")
    if config.cross_validation:
        known = {env_id for env_ids in environments.values() for env_id in env_ids}
        for env_id in config.cross_validation.checkpoints.keys() - known:
            nearest = difflib.get_close_matches(env_id, known, n=1, cutoff=0.0)
            problem = f"{env_id!r} is not trained on, the nearest is {nearest[0]!r}"
            raise ConfigError(f"{config.path}: cross_validation.checkpoints: {problem}")
