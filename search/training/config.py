"""Hyper-parameters of a run: plain YAML, read with a safe loader, checked before anything runs."""

import difflib
import functools
import importlib
import inspect
import json
import pydoc
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args

import gymnasium as gym
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PositiveInt, ValidationError, create_model
from sb3_aarl.search.training.shipped import DEFAULTS
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_aarl import SACAux, catalog
from sb3_aarl.envs import NEEDS_DMC, PREFIX, env_ids, find_task, make_dmc_env, wrap_env
from sb3_aarl.files import ConfigError, read_yaml

# How several environments run, under the names of RL-Zoo's option --vec-env.
VEC_ENVS: dict[str, type[DummyVecEnv] | type[SubprocVecEnv]] = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}

# A learning rate that falls to 0, as RL-Zoo writes it.
LINEAR = Annotated[str, Field(pattern=r"^lin_[0-9]*\.?[0-9]+([eE][-+]?[0-9]+)?$")]

Model = TypeVar("Model", bound=BaseModel)


def load_hyperparameters(path: str | Path, env_id: str) -> dict[str, Any]:
    """
    Read the hyper-parameters of an environment from a file like RL-Zoo's: arguments of SACAux, ``n_timesteps`` (agent steps),
    ``n_envs``, ``vec_env`` (``dummy`` or ``subproc``), ``env_kwargs`` (of ``make_dmc_env``, or of ``wrap_env`` for what is not
    DeepMind Control), ``env_wrapper`` (see :func:`env_wrappers`) and ``normalize`` (true, or arguments of ``VecNormalize``).
    The environment's own entry, which may be under a task's short name, is merged over the entry ``default``. Nothing in the
    file is evaluated.

    :raises ConfigError: naming the file and the key that is wrong
    """
    return entry_of(read_yaml(path), env_id, str(path))


def read_entries(path: Path) -> dict[str, Any]:
    """Hyper-parameters by environment. Those of SACAux's defaults name no policy: it is the one that fits the observations."""
    entries = read_yaml(path)
    if not path.samefile(DEFAULTS):
        return entries
    return {env_id: {key: value for key, value in entry.items() if key != "policy"} for env_id, entry in entries.items()}


def entry_of(entries: Mapping[str, Any], env_id: str, source: str) -> dict[str, Any]:
    """The hyper-parameters of an environment in the contents of a file."""
    is_dmc = env_id.startswith(PREFIX)
    own = [name for name in entries if name == env_id or (is_dmc and find_task(name) == env_id)]
    if not own and "default" not in entries:
        hint = ": it is the file of a search" if "environment" in entries else ", under which hyper-parameters are expected"
        raise ConfigError(f"{source}: neither {env_id!r} nor 'default' is there{hint}")
    merged: dict[str, Any] = {}
    for name in ("default", *own):
        entry = {} if entries.get(name) is None else entries[name]
        if not isinstance(entry, dict):
            raise ConfigError(f"{source}: {name} must be a mapping, not {entry!r}")
        merged = merge(merged, entry)
    return check_hyperparameters(merged, env_id, source)


def check_hyperparameters(values: Mapping[str, Any], env_id: str, source: str) -> dict[str, Any]:
    """
    Hyper-parameters with the types of SACAux's arguments: lists are tuples where an argument is one. What is in their mappings
    is checked where a model is made, unless it is of the environment.
    """
    model = _hyperparameters_model(env_id.startswith(PREFIX))
    return validated(model, values, source).model_dump(exclude_unset=True)


def env_wrappers(value: Any) -> list[tuple[type[gym.Wrapper], dict[str, Any]]]:
    """
    Class and arguments of each wrapper of ``env_wrapper``, the innermost first: a name such as
    ``gymnasium.wrappers.TimeAwareObservation``, a mapping from one name to arguments, or a list of both.
    """
    wrappers = []
    for item in value if isinstance(value, list) else [] if value is None else [value]:
        ((name, arguments),) = item.items() if isinstance(item, Mapping) and len(item) == 1 else [(item, {})]
        try:
            kind = pydoc.locate(str(name))
        except pydoc.ErrorDuringImport as error:  # no ValueError
            raise ValueError(str(error)) from error
        if not (isinstance(kind, type) and issubclass(kind, gym.Wrapper) and isinstance(arguments, Mapping | None)):
            raise ValueError(f"must name a gymnasium.Wrapper that can be imported, or map one to its arguments, not {item!r}")
        wrappers.append((kind, dict(arguments or {})))
    return wrappers


def action_repeat(hyperparameters: Mapping[str, Any]) -> int:
    """Environment steps of one agent step."""
    return (hyperparameters.get("env_kwargs") or {}).get("action_repeat", 1)


def checkpoint_interval(hyperparameters: Mapping[str, Any], source: str) -> int:
    """Environment steps of one rollout with these hyper-parameters: every checkpoint is a multiple of them."""
    train_freq = hyperparameters.get("train_freq", 1)
    number, unit = (train_freq, "step") if isinstance(train_freq, int) else train_freq
    if number < 1 or (unit == "episode" and number > 1):
        raise ConfigError(f"{source}: train_freq must be a positive number of steps or 1 episode, not {train_freq}")
    return number * hyperparameters.get("n_envs", 1) * action_repeat(hyperparameters)


def check_checkpoints(checkpoints: Iterable[int], hyperparameters: Mapping[str, Any], source: str) -> None:
    """Check that every checkpoint is the end of a rollout."""
    interval = checkpoint_interval(hyperparameters, source)
    if between := [steps for steps in sorted(checkpoints) if steps % interval]:
        rollout = f"{interval} (train_freq x n_envs x action repeat)"
        raise ConfigError(f"{source}: checkpoints must be multiples of {rollout}, {between} are not")


def spread_checkpoints(environment_steps: int, n_evaluations: int, interval: int = 1) -> tuple[int, ...]:
    """Equally spaced checkpoints, multiples of an interval; the last is a little early where they do not divide the run."""
    every = environment_steps // n_evaluations // interval * interval
    if every == 0:
        steps = f"{environment_steps} environment steps, {interval} at a time"
        raise ValueError(f"{steps}, are too few for {n_evaluations} evaluations")
    return tuple(every * (i + 1) for i in range(n_evaluations))


def resolve_env_id(name: str) -> str:
    """The id of an environment, registered or the short form of a DeepMind Control task, such as ``Cheetah-Run``."""
    if name in gym.registry:
        return name
    if (task := find_task(name)) is not None:
        return task
    known = [*gym.registry, *(task.removeprefix(PREFIX).removesuffix("-v0") for task in env_ids())]
    nearest = ", ".join(difflib.get_close_matches(name, known))
    hint = f", nearest: {nearest}" if nearest else ""
    if not env_ids():
        hint += f". {NEEDS_DMC}"
    raise ConfigError(f"unknown environment {name!r}{hint}. Imports (--imports, or imports: in the file) register your own")


def import_modules(names: Sequence[str]) -> Sequence[str]:
    """Import a user's own modules, which register environments, those in the working directory too; return their names."""
    if str(Path.cwd()) not in sys.path:  # it is there for `python -m`, and not for the program `aarl`
        sys.path.append(str(Path.cwd()))
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:  # a user's module may raise anything
            kind = "" if isinstance(error, ImportError) else f"{type(error).__name__}: "
            raise ConfigError(f"{name} cannot be imported: {kind}{error}") from error
    return names


def merge(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Merge a mapping over another one, and mappings in it likewise."""
    merged = dict(values)
    for key, value in others.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def validated(model_class: type[Model], values: Mapping[str, Any], source: str) -> Model:
    """A model of plain values. Types are strict (a number in quotes is text), except that a list may stand for a tuple."""
    try:
        # Pydantic's strict mode takes a list for a tuple in JSON only.
        return model_class.model_validate_json(json.dumps(values, default=str), strict=True)
    except ValidationError as error:
        problems: dict[str, list[str]] = {}
        for item in error.errors():
            problem = item["msg"].removeprefix("Value error, ").removeprefix("Input ")
            if item["type"] == "extra_forbidden":
                problem = _unknown_key(item["loc"], model_class)
            elif item["type"] == "missing":
                problem = "is missing"
            elif item["type"] == "needs_python_object":
                problem = "cannot be set in a file"
            elif problem.startswith("should be"):
                problem = f"{problem.replace('valid array', 'list').replace('an object', 'a mapping')}, not {item['input']!r}"
            problems.setdefault(_key(values, item["loc"]), []).append(problem)
        lines = (f"{source}: {key}{': ' if key else ''}{', or '.join(items)}" for key, items in problems.items())
        raise ConfigError("\n".join(lines)) from None


def _key(values: Any, location: Sequence[str | int]) -> str:
    """A key as a user writes it. Pydantic's location names the members of a union too, which are not in the values."""
    key = ""
    for i, part in enumerate(location):
        is_item = isinstance(part, int) and isinstance(values, Sequence)
        if is_item or (isinstance(values, Mapping) and (part in values or i + 1 == len(location))):
            key += f"[{part}]" if is_item else f".{part}" if key else str(part)
            present = range(len(values)) if is_item else values
            values = values[part] if part in present else None  # type: ignore[index]
    return key


def _unknown_key(location: Sequence[str | int], model: Any) -> str:
    """The message for an unknown key, with the nearest one of the part that it is in."""
    for part in location[:-1]:
        if isinstance(part, str):
            annotation = model.model_fields[part].annotation
            model = next(kind for kind in (annotation, *get_args(annotation)) if hasattr(kind, "model_fields"))
    nearest = difflib.get_close_matches(str(location[-1]), model.model_fields, n=1)
    return f"unknown key{f', the nearest known is {nearest[0]!r}' if nearest else ''}"


def _model(name: str, function: Callable[..., Any], without: Collection[str], **kinds: Any) -> Any:
    """The arguments of a function as a model without required keys; ``kinds`` are other types, and other keys."""
    fields: dict[str, Any] = {key: item.annotation for key, item in inspect.signature(function).parameters.items()} | kinds
    for key in without:
        fields.pop(key, None)
    for key, kind in fields.items():
        members = tuple(LINEAR if member == Schedule else member for member in get_args(kind))
        fields[key] = (Union[members] if Schedule in get_args(kind) else kind, None)  # noqa: UP007
    config = ConfigDict(extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True)
    return create_model(name, __config__=config, **fields)


def _check_env_wrapper(value: Any) -> Any:
    env_wrappers(value)
    return value


def _check_aux_loss(value: Any) -> Any:
    if value not in (None, "auto", "none"):
        catalog.resolve(value)
    return None if value == "none" else value


@functools.cache
def _hyperparameters_model(is_dmc: bool) -> type[BaseModel]:
    """The model of an environment's hyper-parameters."""
    function = make_dmc_env if is_dmc else wrap_env
    env_kwargs = _model("EnvKwargs", function, without=("env_id", "env", "seed"), action_repeat=PositiveInt)
    return _model(
        "Hyperparameters",
        SACAux,
        without=("env", "seed", "_init_setup_model"),
        policy=Literal[tuple(SACAux.policy_aliases)],
        aux_loss=Annotated[str | None, AfterValidator(_check_aux_loss)],
        n_timesteps=PositiveInt,
        n_envs=PositiveInt,
        vec_env=Literal[tuple(VEC_ENVS)],
        env_kwargs=env_kwargs | None,
        env_wrapper=Annotated[Any, AfterValidator(_check_env_wrapper)],
        normalize=bool | dict[str, Any],
    )
