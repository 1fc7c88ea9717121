"""A training run: a value, ``Run``, and a folder with ``run.json``, from which it is trained, and ``curve.csv``."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pydantic
from sb3_aarl.search.training.config import validated

from sb3_aarl.callbacks import Evaluation, read_curve
from sb3_aarl.files import replace_text

RUN = "run.json"
CURVE = "curve.csv"
MODEL = "model.zip"
NORMALIZE = "vecnormalize.pkl"
FAILED = "failed.json"
STOP = "stop"
LOCK = "lock"
# Hyper-parameters that may differ when a run is resumed: its length is that of the checkpoints.
FREE = ("n_timesteps", "device")


class Run(pydantic.BaseModel, frozen=True, extra="forbid"):
    """
    One training run.

    :param aux_loss: Notation, name of the catalogue, or ``"auto"``; None for no auxiliary loss
    :param hyperparameters: As returned by ``load_hyperparameters``
    :param checkpoints: Environment steps of the evaluations, ascending; the run is resumed from there
    :param threads: Threads that PyTorch uses; they change the last bits
    :param imports: Modules that are imported first, such as those that register environments
    :param keep_model: Whether to leave the trained model as ``model.zip``
    """

    environment: str
    aux_loss: str | None
    hyperparameters: dict[str, Any]
    seed: int
    checkpoints: tuple[int, ...]
    evaluation_episodes: int = 10
    threads: int = 1
    imports: tuple[str, ...] = ()
    keep_model: bool = False


class Outcome(NamedTuple):
    """How a run ended: its curve, the reason in one line if it failed, and whether it is worth another try."""

    curve: list[Evaluation]
    failure: str | None
    retry: bool


def prepare_run(folder: Path, run: Run) -> None:
    """
    Create the folder of a run, or reuse it: files that ended the run before are deleted. A run that was stopped may have more
    checkpoints than it had, unless its learning rates depend on its length.

    :raises ValueError: when the folder has another run, naming the key that differs
    """
    folder.mkdir(parents=True, exist_ok=True)
    values = run.model_dump(mode="json")
    if (folder / RUN).exists():
        stored = read_run(folder).model_dump(mode="json")
        free = ["imports", *(f"hyperparameters.{name}" for name in FREE)]
        is_longer = values["checkpoints"][: len(stored["checkpoints"])] == stored["checkpoints"]
        if is_longer and '"lin_' not in json.dumps(stored["hyperparameters"]) and not is_finished(folder):
            free.append("checkpoints")
        for key, ours, theirs in differences(values, stored):
            if key not in free:
                old, new = ("not set" if value is None else repr(value) for value in (theirs, ours))
                raise ValueError(
                    f"{folder} has another run: {key} is {old} there, {new} here. Choose another --folder, or delete it"
                )
    replace_text(folder / RUN, json.dumps(values, indent=1) + "\n")
    for name in (STOP, FAILED):
        (folder / name).unlink(missing_ok=True)


def read_outcome(folder: Path) -> Outcome | None:
    """How a run ended, None if it has neither finished nor failed."""
    curve = partial_curve(folder)
    if is_finished(folder):
        return Outcome(curve, None, False)
    if not (folder / FAILED).exists():
        return None
    failed = json.loads((folder / FAILED).read_text(encoding="utf-8"))
    return Outcome(curve, failed["reason"], failed["retry"])


def partial_curve(folder: Path) -> list[Evaluation]:
    """The learning curve of a run so far."""
    return read_curve(folder / CURVE) if (folder / CURVE).exists() else []


def is_finished(folder: Path) -> bool:
    """Whether a run has its complete curve, and its model if that is kept."""
    if not (folder / RUN).exists():
        return False
    run = read_run(folder)
    steps = tuple(evaluation.environment_steps for evaluation in partial_curve(folder))
    return steps == run.checkpoints and (not run.keep_model or (folder / MODEL).exists())


def read_run(folder: Path) -> Run:
    """The run of a folder."""
    path = folder / RUN
    return validated(Run, json.loads(path.read_text(encoding="utf-8")), str(path))


def differences(one: Any, other: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Keys with dots, and both values, where two plain values differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in {**one, **other}:
            yield from differences(one.get(name), other.get(name), f"{key}.{name}" if key else name)
    elif one != other:
        yield key, one, other


def one_line(error: BaseException) -> str:
    """Kind and message of an error, for ``failed.json`` and messages."""
    return " ".join(f"{type(error).__name__}: {error}".split())
