"""Configurations of searches and hyper-parameters: plain YAML, read with a safe loader, checked before anything runs."""

import contextlib
import copy
import difflib
import functools
import inspect
import itertools
import math
import re
import reprlib
import types
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin

import gymnasium as gym
import yaml
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from stable_baselines3.sac.policies import SACPolicy
from torch.optim import Adam

from sb3_aarl import SACAux, catalog
from sb3_aarl.aux_loss import LONGEST_HORIZON, AuxLoss
from sb3_aarl.buffers import WindowReplayBuffer
from sb3_aarl.encoders import encoder_class
from sb3_aarl.envs import PREFIX, env_ids, make_dmc_env, wrap_env
from sb3_aarl.policies import SACAuxPolicy

# Values in a file, aliases written out; and numbers of candidates, stages and the like.
LARGEST = 100_000
# Characters of a file, which PyYAML reads in a second, and of an error; brackets within brackets.
LONGEST_FILE = 200_000
LONGEST_ERROR = 1000
DEEPEST = 100
PRUNERS = ("none", "median", "hyperband")
# How several environments run, under the names of RL-Zoo's option --vec-env.
VEC_ENVS: dict[str, type[DummyVecEnv] | type[SubprocVecEnv]] = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}
# What AuxLossSampler takes, under the same names.
SAMPLER_KEYS = (
    *("population_size", "n_random", "n_prior", "parents", "replacement", "crossover", "horizon_change", "random"),
    *("max_horizon", "operators", "allow_duplicates", "screening", "retries", "seed"),
)


class ConfigError(ValueError):
    """
    A configuration cannot be used; one line that names the file, the key and what is wrong with it.

    :param problem: The line. What in it cannot be printed, such as a terminal's control characters, is written out
    """

    def __init__(self, problem: str):
        line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in problem)
        super().__init__(line if len(line) <= LONGEST_ERROR else f"{line[:LONGEST_ERROR]}...")


@dataclass(frozen=True)
class CrossValidation:
    """
    Cross-validation of a search's best candidates (paper, A.4).

    :param environments: Ids of the environments
    :param seeds: Seeds of the trainings on each
    :param top: How many candidates
    :param checkpoints: Environment steps of the evaluations, for environments that differ from the search's
    """

    environments: tuple[str, ...]
    seeds: tuple[int, ...] = (0, 1, 2)
    top: int = 5
    checkpoints: dict[str, tuple[int, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class OperatorSelection:
    """
    Comparison of the ten operators (paper, A.1.3).

    :param environments: Ids of the environments
    :param seeds: Seeds of the trainings on each
    """

    environments: tuple[str, ...]
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)


@dataclass(frozen=True)
class Baseline:
    """
    A training that the candidates are compared with (the lines of the paper's figures 4 and 6).

    :param name: Its name
    :param aux_loss: Its auxiliary loss, None for none
    :param overrides: Merged over the hyper-parameters of the search
    """

    name: str
    aux_loss: AuxLoss | None = None
    overrides: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SearchConfig:
    """
    A search. Defaults are the paper's.

    :param path: The file that it was read from
    :param environment: Id of the environment
    :param hyperparameters: File of hyper-parameters, as :func:`load_hyperparameters` reads it
    :param checkpoints: Environment steps of the evaluations, ascending; the last one ends the training
    :param evaluation_episodes: Episodes of each evaluation
    :param stages: Number of stages of the evolution
    :param population_size: As in ``AuxLossSampler``, and so are the next ones up to ``seed``
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
    :param retries: As in ``AuxLossSampler``
    :param seed: Seed of the evolution
    :param seeds: Training seeds of every candidate, whose score is the mean over them
    :param pruner: One of ``PRUNERS``
    :param cross_validation: Cross-validation, None where the configuration has none
    :param operator_selection: Operator selection, None where the configuration has none
    :param baselines: What the candidates are compared with
    :param overrides: Merged over the hyper-parameters of all trainings
    """

    path: Path
    environment: str
    hyperparameters: Path
    checkpoints: tuple[int, ...]
    evaluation_episodes: int = 10
    stages: int = 7
    population_size: int = 100
    n_random: int = 100
    n_prior: int = 25
    parents: float = 0.25
    replacement: float = 0.5
    crossover: float = 0.2
    horizon_change: float = 0.1
    random: float = 0.2
    max_horizon: int = 10
    operators: tuple[str, ...] | None = None
    allow_duplicates: bool = False
    screening: int = 1
    retries: int = 10
    seed: int = 0
    seeds: tuple[int, ...] = (0,)
    pruner: str = "none"
    cross_validation: CrossValidation | None = None
    operator_selection: OperatorSelection | None = None
    baselines: tuple[Baseline, ...] = ()
    overrides: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name of the search's study: that of its file."""
        return self.path.stem

    def hyperparameters_for(self, environment: str, overrides: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """
        The hyper-parameters of a training.

        :param environment: Id of the environment
        :param overrides: Merged over them, such as those of a baseline
        """
        merged = merge(load_hyperparameters(self.hyperparameters, environment), self.overrides)
        merged = merge(merged, overrides or {})
        return _checked_hyperparameters(merged, environment, f"{self.path}: overrides")

    def checkpoints_for(self, environment: str) -> tuple[int, ...]:
        """
        The environment steps of the evaluations on an environment.

        :param environment: Id of the environment
        """
        others = self.cross_validation.checkpoints if self.cross_validation else {}
        return self.checkpoints if environment == self.environment else others.get(environment, self.checkpoints)

    def sampler_settings(self) -> dict[str, Any]:
        """The arguments of ``AuxLossSampler``, the number of stages included."""
        return {"n_stages": self.stages, **{name: getattr(self, name) for name in SAMPLER_KEYS}}


def load_config(path: str | Path) -> SearchConfig:
    """
    Read a search's configuration, and check all that can be checked without training.

    :param path: The YAML file
    :raises ConfigError: naming the file and the key that is wrong
    """
    path = Path(path)
    values = _read(path)
    if "path" in values:
        raise ConfigError(f"{path}: {_unknown('path', [item.name for item in fields(SearchConfig)][1:])}")
    config: SearchConfig = _convert({"path": str(path.absolute()), **values}, SearchConfig, str(path), path.absolute().parent)
    _check(config, str(path))
    return config


def load_hyperparameters(path: str | Path, env_id: str) -> dict[str, Any]:
    """
    Read the hyper-parameters of an environment from a file like RL-Zoo's: a mapping from environment id to arguments of
    SACAux, ``policy``, ``n_timesteps`` (agent steps), ``n_envs`` (environments that are trained on at once) and
    ``env_kwargs`` (of ``make_dmc_env``, or of ``wrap_env`` for what is not DeepMind Control). The environment's own entry
    is merged over the entry ``default``.

    As in RL-Zoo, ``n_envs`` alone makes fewer updates; ``gradient_steps: -1`` keeps one for each transition. ``vec_env`` is
    ``dummy`` (all in one process) or ``subproc`` (each in its own, faster where there are cores for them, and equal
    otherwise); RL-Zoo has it on the command line.

    Values are plain: nothing in the file is evaluated, schedules as text are refused.

    :param path: The YAML file
    :param env_id: Id of the environment
    :raises ConfigError: naming the file and the key that is wrong
    """
    path = Path(path)
    values = _read(path)
    if not {"default", env_id} & values.keys():
        raise ConfigError(f"{path}: neither {env_id!r} nor 'default' is there")
    merged: dict[str, Any] = {}
    for entry in ("default", env_id):
        own = values.get(entry, {})
        if not isinstance(own, dict):
            raise ConfigError(f"{path}: {entry} must be a mapping, not {reprlib.repr(own)}")
        merged = merge(merged, own)
    return _checked_hyperparameters(merged, env_id, str(path))


def named_environments(path: str | Path) -> list[str]:
    """
    The environments that have an entry of their own in a file of hyper-parameters.

    :param path: The YAML file
    :raises ConfigError: naming the file, when it cannot be read
    """
    return [key for key in _read(Path(path)) if key != "default"]


def load_aux_loss(path: str | Path) -> AuxLoss:
    """
    Read the loss that a cross-validation chose.

    :param path: YAML file with ``aux_loss``: a notation, a name, or the mapping of ``AuxLoss.to_dict``
    :raises ConfigError: naming the file and what is wrong with it
    """
    path = Path(path)
    loss = _mapping(_read(path), {"aux_loss": AuxLoss}, str(path), path.parent).get("aux_loss")
    if loss is None:
        raise ConfigError(f"{path}: aux_loss is missing")
    return loss


def action_repeat(hyperparameters: Mapping[str, Any]) -> int:
    """
    Environment steps of one agent step.

    :param hyperparameters: As :func:`load_hyperparameters` gives them
    """
    return (hyperparameters.get("env_kwargs") or {}).get("action_repeat", 1)


def resolve_env_id(name: str) -> str:
    """
    The id of an environment.

    :param name: A registered id, or the short form of a DeepMind Control task, such as ``cheetah-run`` or ``Cheetah-Run``
    :raises ValueError: for an unknown one, with the nearest
    """
    full = f"{PREFIX}{name.lower()}-v0"
    if full in env_ids():
        return full
    # Not gym.spec or gym.make, which import what stands before a colon.
    if name in gym.registry:
        return name
    name = name[:100]
    known = [*gym.registry, *(task.removeprefix(PREFIX).removesuffix("-v0") for task in env_ids())]
    nearest = difflib.get_close_matches(name, known, cutoff=0.4)
    raise ValueError(f"unknown environment {name!r}, nearest: {', '.join(nearest) or 'none'}")


def merge(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """
    Merge a mapping over another one, and mappings in it likewise.

    :param values: The mapping
    :param others: What wins
    """
    merged = dict(values)
    for key, value in others.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


class _Loader(yaml.SafeLoader):
    """
    Also reads ``1e-3`` as a number, which is text in YAML 1.1, refuses a key that is there twice, and merge keys (``<<``)
    that would make very much of little.
    """

    n_merged = 0

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        for key, value in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                for merged in value.value if isinstance(value, yaml.SequenceNode) else [value]:
                    if isinstance(merged, yaml.MappingNode):
                        self.flatten_mapping(merged)
                        self.n_merged += len(merged.value)
                        if self.n_merged > LARGEST:
                            raise yaml.constructor.ConstructorError(None, None, "merges too much", node.start_mark)
                    if merged.tag != "tag:yaml.org,2002:map":  # PyYAML passes over it where it is a mapping
                        raise yaml.constructor.ConstructorError(None, None, f"merges a {merged.tag}", merged.start_mark)
        super().flatten_mapping(node)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode) and key.value != "<<")
        for key, count in keys.items():
            if count > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key!r} is there twice", node.start_mark)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Writes what ``_Loader`` reads as it was: a text that looks like 1e-4 in quotes."""


_FLOAT = re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$")
for _class in (_Loader, _Dumper):
    _class.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789"))


def dump(values: Mapping[str, Any]) -> str:
    """
    YAML that is read here as it was.

    :param values: Plain values
    """
    return yaml.dump(dict(values), Dumper=_Dumper)


def _read(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file."""
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(LONGEST_FILE + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # no text, or no name of a file
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if len(text) > LONGEST_FILE:
        raise ConfigError(f"{path}: has more than {LONGEST_FILE} characters")
    try:
        return copy.deepcopy(_parse(text))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


@functools.lru_cache(maxsize=8)  # a search asks for the hyper-parameters of each environment and each baseline
def _parse(text: str) -> dict[str, Any]:
    """The mapping in a text of YAML."""
    # PyYAML looks ahead at every bracket, for seconds where they are many.
    if max(itertools.accumulate((char in "[{") - (char in "]}") for char in text), default=0) > DEEPEST:
        raise ConfigError(f"brackets are nested more than {DEEPEST} deep")
    try:
        values = yaml.load(text, _Loader)
    except Exception as error:  # beside YAMLError, PyYAML lets through whatever goes wrong with a value: 2020-13-45, !!int ""
        problem = " ".join(str(error).split()).replace('in "<unicode string>", ', "")
        raise ConfigError(f"not YAML of plain values: {problem}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"must hold a mapping, not {reprlib.repr(values)}")
    try:
        size = _size(values, {})
    except RecursionError:
        size = math.inf
    if size > LARGEST:
        raise ConfigError("an alias refers to itself, or the file is too large with all of them written out")
    return values


def _size(value: Any, known: dict[int, float]) -> float:
    """How many values there are if aliases are written out; refuses what is not plain."""
    if isinstance(value, int) and abs(value) >= 1e300:
        raise ConfigError("a number has more than 300 digits")
    if value is None or isinstance(value, (str, int, float)):
        return 1
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise ConfigError(f"keys are text, {reprlib.repr(key)} is not")
    elif not isinstance(value, list):
        raise ConfigError(f"{reprlib.repr(value)} is no plain value, but a {type(value).__name__}")
    if id(value) not in known:
        known[id(value)] = math.inf  # as long as we are inside of it
        known[id(value)] = 1 + sum(_size(item, known) for item in (value.values() if isinstance(value, dict) else value))
    return known[id(value)]


def _unknown(key: str, known: Iterable[str]) -> str:
    key = key[:100]
    nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
    return f"unknown key {key!r}, {f'nearest known key: {nearest[0]!r}' if nearest else 'there are none here'}"


def _mapping(values: Any, hints: Mapping[str, Any], where: str, folder: Path) -> dict[str, Any]:
    """A mapping whose keys are known and whose values are of the types that go with them."""
    if not isinstance(values, dict):
        raise ConfigError(f"{where} must be a mapping, not {reprlib.repr(values)}")
    for key in values:
        if key not in hints:
            raise ConfigError(f"{where}: {_unknown(key, list(hints))}")
    separator = "." if ": " in where else ": "  # a file comes first
    return {key: _convert(value, hints[key], f"{where}{separator}{key}", folder) for key, value in values.items()}


def _convert(value: Any, hint: Any, where: str, folder: Path) -> Any:
    """A plain value as the type that it is annotated with."""
    kind, arguments = get_origin(hint), get_args(hint)
    if is_dataclass(hint) and hint is not AuxLoss:
        known = {item.name: item for item in fields(hint)}
        converted = _mapping(value, {name: item.type for name, item in known.items()}, where, folder)
        for name, item in known.items():
            if name not in converted and item.default is MISSING and item.default_factory is MISSING:
                raise ConfigError(f"{where}: {name} is missing")
        assert isinstance(hint, type)
        return hint(**converted)
    if kind in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        if value == "auto" and {AuxLoss, str} <= {*arguments}:  # SACAux chooses
            return value
        nested = [argument for argument in arguments if argument is AuxLoss or is_dataclass(argument)]
        for argument in nested or arguments:
            if nested:
                return _convert(value, argument, where, folder)
            with contextlib.suppress(ConfigError):
                return _convert(value, argument, where, folder)
    elif hint is AuxLoss:
        try:
            return None if value == "none" else catalog.resolve(value)
        except ValueError as error:
            raise ConfigError(f"{where}: {error}") from None
    elif hint is Path and isinstance(value, str):
        return folder / value
    elif hint is Any or (hint in (str, bool) and isinstance(value, hint)):
        return value
    elif hint in (int, float) and isinstance(value, (int, float)) and not isinstance(value, bool):
        # 1e5 is a float to YAML; compared, not converted first: an int may be too large for a float.
        if abs(value) < 1e300 and (hint is float or value == int(value)):
            return hint(value)
    elif kind is tuple and isinstance(value, (list, tuple)):
        types_of = [arguments[0]] * len(value) if arguments[1:] == (...,) else list(arguments)
        if len(types_of) == len(value):
            return tuple(_convert(*pair, f"{where}[{i}]", folder) for i, pair in enumerate(zip(value, types_of, strict=True)))
    elif kind is list and isinstance(value, (list, tuple)):
        return [_convert(item, arguments[0], f"{where}[{i}]", folder) for i, item in enumerate(value)]
    elif (kind or hint) in (dict, Mapping) and isinstance(value, dict):
        return {key: _convert(item, (*arguments, Any, Any)[1], f"{where}.{key}", folder) for key, item in value.items()}
    if not _describe(hint):  # a class, a function
        raise ConfigError(f"{where} can be set in Python only, not to {reprlib.repr(value)}")
    raise ConfigError(f"{where} must be {_describe(hint)}, not {reprlib.repr(value)}")


def _describe(hint: Any) -> str:
    names = {int: "an integer", float: "a number", str: "text", bool: "true or false", type(None): "null", Path: "a path"}
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_describe(argument) for argument in get_args(hint) if _is_plain(argument)))
    if get_origin(hint) in (tuple, list):
        return f"a list of {' and '.join(_describe(item) for item in get_args(hint) if item is not ...)}"
    return names.get(hint, "a mapping" if _is_plain(hint) or is_dataclass(hint) else "")


def _is_plain(hint: Any) -> bool:
    """Whether YAML can say it: no objects, no functions."""
    return (get_origin(hint) or hint) in (int, float, str, bool, type(None), tuple, list, dict, Mapping)


def _arguments(*functions: Callable[..., Any], without: Iterable[str]) -> dict[str, Any]:
    """The arguments of functions, with their annotations."""
    parameters = (parameter for function in functions for parameter in inspect.signature(function).parameters.values())
    return {
        parameter.name: parameter.annotation
        for parameter in parameters
        if parameter.name not in without and parameter.kind != inspect.Parameter.VAR_KEYWORD
    }


_POLICY_ARGUMENTS = _arguments(
    SACPolicy,
    SACAuxPolicy,
    without=("observation_space", "action_space", "lr_schedule", "use_sde", "augmentation", "crop_size"),
)
# Without what SACAux sets itself.
_BUFFER_ARGUMENTS = _arguments(
    WindowReplayBuffer,
    without=(
        "buffer_size",
        "observation_space",
        "action_space",
        "device",
        "n_envs",
        "optimize_memory_usage",
        "n_steps",
        "gamma",
    ),
)
_OPTIMIZER_ARGUMENTS = _arguments(Adam, without=("params", "lr"))
_ARGUMENTS = {
    **_arguments(SACAux, without=("env", "seed", "action_noise", "replay_buffer_class", "_init_setup_model")),
    "policy": str,
    "n_timesteps": int,
    "n_envs": int,
    "vec_env": str,
    "env_kwargs": dict,
}


def _checked_hyperparameters(values: Mapping[str, Any], env_id: str, where: str) -> dict[str, Any]:
    checked = _mapping(dict(values), _ARGUMENTS, where, Path())
    make = make_dmc_env if env_id.startswith(PREFIX) else wrap_env
    for key, hints in (
        ("env_kwargs", _arguments(make, without=("env_id", "env", "seed"))),
        ("policy_kwargs", _POLICY_ARGUMENTS),
        ("replay_buffer_kwargs", _BUFFER_ARGUMENTS),
    ):
        if checked.get(key) is not None:
            checked[key] = _mapping(checked[key], hints, f"{where}: {key}", Path())
    if checked.get("aux_loss") not in (None, "auto"):
        _convert(values["aux_loss"], AuxLoss, f"{where}: aux_loss", Path())
        checked["aux_loss"] = None if values["aux_loss"] == "none" else values["aux_loss"]
    for key, number in (
        ("n_envs", checked.get("n_envs")),
        ("action_repeat", (checked.get("env_kwargs") or {}).get("action_repeat")),
    ):
        if number is not None and number < 1:
            raise ConfigError(f"{where}: {key} must be at least 1, not {number}")
    policy_kwargs = checked.get("policy_kwargs") or {}
    pixels = (checked.get("env_kwargs") or {}).get("pixels", False)
    policy = SACAux.policy_aliases.get(checked.get("policy", "CnnPolicy" if pixels else "MlpPolicy"), SACAuxPolicy)
    assert issubclass(policy, SACAuxPolicy)
    try:
        encoder = encoder_class(policy_kwargs.get("features_extractor_class") or policy.default_encoder)
    except ValueError as error:
        raise ConfigError(f"{where}: policy_kwargs: {error}") from None
    for key, hints in (
        ("features_extractor_kwargs", _arguments(encoder, without=("observation_space",))),
        ("optimizer_kwargs", _OPTIMIZER_ARGUMENTS),
    ):
        if policy_kwargs.get(key) is not None:  # it stays as RL-Zoo reads it: a list is no tuple
            _mapping(policy_kwargs[key], hints, f"{where}: policy_kwargs.{key}", Path())
    try:
        get_device(checked.get("device", "auto"))
    except RuntimeError:
        raise ConfigError(f"{where}: device must be auto, cpu, cuda or cuda:N, not {checked['device']!r}") from None
    if checked.get("vec_env", "dummy") not in VEC_ENVS:
        raise ConfigError(f"{where}: vec_env must be one of {', '.join(VEC_ENVS)}, not {checked['vec_env']!r}")
    return checked


def _check(config: SearchConfig, where: str) -> None:
    """What a whole search would stumble on after hours."""
    from search.evolution.sampler import AuxLossSampler  # not above: a training alone needs neither Optuna nor scikit-learn

    def check(holds: bool, problem: str) -> None:
        if not holds:
            raise ConfigError(f"{where}: {problem}")

    check(config.pruner in PRUNERS, f"pruner must be one of {', '.join(PRUNERS)}, not {config.pruner!r}")
    check(config.evaluation_episodes > 0, f"evaluation_episodes must be at least 1, not {config.evaluation_episodes}")
    for name in ("stages", "population_size", "n_random", "n_prior", "screening", "evaluation_episodes"):
        check(getattr(config, name) <= LARGEST, f"{name} must be at most {LARGEST}, not {getattr(config, name)}")
    check(config.max_horizon <= LONGEST_HORIZON, f"max_horizon must be at most {LONGEST_HORIZON}, not {config.max_horizon}")
    check(config.seed >= 0, f"seed must not be negative, but is {config.seed}")
    try:
        AuxLossSampler(**config.sampler_settings())
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None
    parts: dict[str, CrossValidation | OperatorSelection | None] = {
        "cross_validation": config.cross_validation,
        "operator_selection": config.operator_selection,
    }
    check(config.cross_validation is None or config.cross_validation.top > 0, "cross_validation.top must be at least 1")
    seeds = {"seeds": config.seeds} | {f"{name}.seeds": part.seeds for name, part in parts.items() if part}
    for name, numbers in seeds.items():
        good = len(set(numbers)) == len(numbers) > 0 and min(numbers) >= 0 and max(numbers) < 2**32
        check(good, f"{name} must be different numbers from 0 to 2**32 - 1, not {reprlib.repr(list(numbers))}")
    names = [baseline.name for baseline in config.baselines]
    check(len(set(names)) == len(names), f"two baselines have one name: {', '.join(names)}")

    environments: dict[str, tuple[str, ...]] = {"environment": (config.environment,)}
    environments |= {f"{name}.environments": part.environments for name, part in parts.items() if part}
    if config.cross_validation:
        trained = list(dict.fromkeys(env_id for names in environments.values() for env_id in names))
        environments["cross_validation.checkpoints"] = tuple(config.cross_validation.checkpoints)
    for key, env_ids_ in environments.items():
        check(bool(env_ids_) or key.endswith("checkpoints"), f"{key} must name at least one environment")
        check(len(set(env_ids_)) == len(env_ids_), f"{key} must name each environment once")
        for env_id in env_ids_:
            try:
                full = resolve_env_id(env_id)
            except ValueError as error:
                raise ConfigError(f"{where}: {key}: {error}") from None
            check(full == env_id, f"{key}: write {full!r} for {env_id!r}")
            if key.endswith("checkpoints"):
                nearest = difflib.get_close_matches(env_id, trained, n=1, cutoff=0.0)
                check(env_id in trained, f"{key}: {env_id!r} is not trained on, nearest: {nearest[0]!r}")
            baselines = config.baselines if env_id == config.environment else ()
            for overrides in ({}, *(baseline.overrides for baseline in baselines)):
                settings = config.hyperparameters_for(env_id, overrides)
                repeat = action_repeat(settings)
                steps = list(config.checkpoints_for(env_id))
                ascending = bool(steps) and sorted(set(steps)) == steps and steps[0] > 0
                check(ascending, f"checkpoints must be positive environment steps in ascending order, not {steps} ({env_id})")
                between = [step for step in steps if step % repeat]
                check(not between, f"checkpoints must be multiples of {env_id}'s action repeat {repeat}, {between} are not")
