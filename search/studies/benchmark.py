"""The paper's benchmark: variants (files of hyper-parameters) x tasks x seeds, every run in a folder of its own."""

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
from sb3_aarl.search.execution.matrix import Cell, Matrix, task_name
from sb3_aarl.search.training.config import (
    ConfigError,
    action_repeat,
    check_checkpoints,
    import_modules,
    load_hyperparameters,
    read_yaml,
    resolve_env_id,
)
from sb3_aarl.search.training.folder import FREE, Run, differences, partial_curve
from sb3_aarl.search.training.provenance import ABOUT, read_about
from sb3_aarl.search.training.setup import check_run

from sb3_aarl import catalog
from sb3_aarl.envs import PREFIX

# Environment steps at which the paper compares (tables 3, 4 and 6).
CHECKPOINTS = (100_000, 500_000, 1_000_000)
UNITS = {"": 1, "k": 1_000, "m": 1_000_000}


def load_benchmark(
    files: Sequence[Path],
    environments: Sequence[str] = (),
    seeds: Sequence[int] = range(10),
    checkpoints: Sequence[int] = (),
    every: int | None = None,
    evaluation_episodes: int = 10,
    threads: int = 1,
    folder: Path = Path("runs/benchmark"),
    imports: Sequence[str] = (),
) -> Matrix:
    """
    Read the variants of a benchmark, and check all that can be checked without training. Default environments are those that
    all files name, default checkpoints those of 100k, 500k and 1000k that lie in every file's ``n_timesteps``.
    """
    for stem, count in Counter(path.stem for path in files).items():
        if count > 1:
            raise ConfigError(f"two files are called {stem}: a variant has the name of its file")
    import_modules(imports)
    names = environments or _common_environments(files)
    ids = list(dict.fromkeys(resolve_env_id(name) for name in names))
    # SACAux's default, written out: a file that names no loss is not one that says "none".
    hyperparameters = {
        (path.stem, name): {"aux_loss": "auto", **load_hyperparameters(path, name)} for path in files for name in ids
    }
    compared = {name: tuple(sorted(set(checkpoints))) or _default_checkpoints(name, hyperparameters) for name in ids}
    paths = {path.stem: str(path) for path in files}
    runs: dict[Cell, Run] = {}
    abouts: dict[Cell, dict[str, Any]] = {}
    # Seed by seed, so that a first run of each is there early.
    for seed, environment, variant in product(seeds, ids, paths):
        cell = Cell(variant, environment, seed)
        settings, steps = hyperparameters[cell[:2]], compared[cell.environment]
        between = () if every is None else range(every, steps[-1], every)
        evaluations = tuple(sorted({*steps, *between}))
        check_checkpoints(evaluations, settings, f"{cell.variant} on {environment}")
        loss = settings["aux_loss"]
        runs[cell] = Run(
            environment=cell.environment,
            aux_loss=loss if loss in (None, "auto") else str(catalog.resolve(loss)),
            hyperparameters={key: value for key, value in settings.items() if key != "aux_loss"},
            seed=cell.seed,
            checkpoints=evaluations,
            evaluation_episodes=evaluation_episodes,
            threads=threads,
            imports=tuple(imports),
        )
        # What is needed to repeat the run; where and when it was trained is added by the run.
        abouts[cell] = {
            **cell._asdict(),
            "checkpoints": list(steps),
            "evaluations": list(evaluations),
            "evaluation_episodes": evaluation_episodes,
            "file": paths[cell.variant],
            "hyperparameters": json.loads(json.dumps(settings)),  # as it is read again
        }
    matrix = Matrix("benchmark", folder, runs, abouts)
    _check_folder(matrix)
    _check_models(matrix)
    return matrix


def read_abouts(folder: Path) -> dict[Path, dict[str, Any]]:
    """The ``provenance.json`` of a benchmark's runs, by their folders, if each run is there once and all can be compared."""
    abouts: dict[Path, dict[str, Any]] = {}
    folders: dict[Cell, Path] = {}
    trained: dict[tuple[str, str], Path] = {}
    for path in sorted(file.parent for file in folder.glob(f"*/*/*/{ABOUT}")):
        about = {"sessions": [], **read_about(path)}
        if not {*Cell._fields, "checkpoints"} <= about.keys():
            raise ValueError(f"{path / ABOUT} is not that of a benchmark's run")
        abouts[path] = about
        cell = Cell(*(about[name] for name in Cell._fields))
        other = folders.setdefault(cell, path)
        if other != path:
            raise ValueError(f"{other} and {path} have the same run: {cell.variant} on {cell.environment}, seed {cell.seed}")
        other = trained.setdefault((cell.variant, cell.environment), path)
        if difference := _difference(abouts[other], about):
            raise ValueError(f"{other} and {path} cannot be compared: {'{}={!r} and {!r}'.format(*difference)}")
    return abouts


def read_curves(folder: Path) -> pd.DataFrame:
    """
    The learning curves of a benchmark's runs: one row an evaluation with ``variant``, ``env`` (short form), ``seed``,
    ``environment_steps``, ``mean`` and ``std`` (of the episodes' returns). Runs without an evaluation are skipped.
    """
    rows = [
        (about["variant"], task_name(about["environment"]), about["seed"], point.environment_steps, point.mean, point.std)
        for path, about in read_abouts(folder).items()
        for point in partial_curve(path)
    ]
    if not rows:
        raise ValueError(f"{folder} has no learning curves of a benchmark")
    return pd.DataFrame(rows, columns=["variant", "env", "seed", "environment_steps", "mean", "std"])


def parse_steps(text: str) -> tuple[int, ...]:
    """Environment steps, such as ``100k,500k,1M`` or ``20000``."""
    steps = []
    for part in text.split(","):
        match = re.fullmatch(r"([1-9]\d*)([km]?)", part.strip().lower())
        if match is None:
            raise ValueError(f"environment steps are written like 100k, 1M or 20000, not {part.strip()!r}")
        steps.append(int(match[1]) * UNITS[match[2]])
    return tuple(steps)


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds, such as ``0-9`` or ``0,3,5-7``."""
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise ValueError(f"seeds are written like 0-9 or 0,3,5, not {part.strip()!r}")
        seeds += range(int(match[1]), int(match[2] or match[1]) + 1)
    return tuple(seeds)


def _common_environments(files: Iterable[Path]) -> list[str]:
    """The environments that all files name, in the order of the first."""
    first, *others = map(read_yaml, files)
    common = [name for name in first if name != "default" and all(name in names for names in others)]
    if not common:
        raise ConfigError("the files have no entry of one environment in common: name environments")
    return common


def _default_checkpoints(environment: str, hyperparameters: Mapping[tuple[str, str], Mapping[str, Any]]) -> tuple[int, ...]:
    """The paper's checkpoints that lie in every variant's budget."""
    settings = [settings for (_, name), settings in hyperparameters.items() if name == environment]
    budget = min((s["n_timesteps"] * action_repeat(s) for s in settings if "n_timesteps" in s), default=CHECKPOINTS[-1])
    if budget < CHECKPOINTS[0]:
        raise ConfigError(f"n_timesteps ends the runs on {environment} at {budget} environment steps: name checkpoints")
    return tuple(step for step in CHECKPOINTS if step <= budget)


def _check_folder(matrix: Matrix) -> None:
    """Refuse to add runs to those of a variant on an environment that were trained in another way."""
    stored = {(about["variant"], about["environment"]): about for about in read_abouts(matrix.folder).values()}
    for cell, about in matrix.abouts.items():
        if difference := _difference(stored.get(cell[:2], about), about, "evaluations"):
            problem = "{}={!r}, not {!r}".format(*difference)
            raise ValueError(
                f"{matrix.folder} has runs of {cell.variant} on {cell.environment} with {problem}: name another folder"
            )


def _difference(one: Mapping[str, Any], other: Mapping[str, Any], *keys: str) -> tuple[str, Any, Any] | None:
    """The first setting in which two runs differ, with both values: their scores cannot be compared."""
    # Runs that were trained by another program name it.
    keys = (*keys, "evaluation_episodes", "program")
    old, new = ({key: about.get(key) for key in keys} | about.get("hyperparameters", {}) for about in (one, other))
    return next((found for found in differences(old, new) if found[0] not in FREE), None)


def _check_models(matrix: Matrix) -> None:
    """Make environment and model of each variant once, and on every environment that may be of the user's own."""
    checked = set()
    for cell, run in matrix.runs.items():
        what = cell.variant if cell.environment.startswith(PREFIX) else cell[:2]
        if what not in checked:
            checked.add(what)
            check_run(run, matrix.abouts[cell]["file"])
