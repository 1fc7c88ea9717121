"""The paper's benchmark: variants (files of hyper-parameters) x tasks x seeds, every run in a folder of its own."""

import json
import re
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, Field
from sb3_aarl.search.execution.matrix import Cell, Matrix
from sb3_aarl.search.training.config import (
    ConfigError,
    action_repeat,
    entry_of,
    import_modules,
    merge,
    read_entries,
    read_yaml,
    resolve_env_id,
    validated,
)
from sb3_aarl.search.training.folder import FREE, Run, differences
from sb3_aarl.search.training.provenance import ABOUT, read_about
from sb3_aarl.search.training.shipped import find_file

from sb3_aarl import catalog

# Environment steps at which the paper compares (tables 3, 4 and 6).
CHECKPOINTS = (100_000, 500_000, 1_000_000)
UNITS = {"": 1, "k": 1_000, "m": 1_000_000}
# The file of an experiment, and the folder of its runs beside it.
VARIANTS, RUNS = "variants.yml", "runs"


class Experiment(BaseModel, extra="forbid"):
    """
    A ``variants.yml``: hyper-parameters with names.

    :param base: Hyper-parameters by environment, as in RL-Zoo's files, or such a file: its path, relative to this one, or the
        name of a shipped one
    :param variants: For each name the hyper-parameters that differ from the base; they are merged over it
    :param runs: Folders of other experiments, relative to this file, whose runs belong into the table too
    """

    base: str | dict[str, Any]
    variants: Annotated[dict[str, dict[str, Any]], Field(min_length=1)]
    runs: tuple[str, ...] = ()


class Variant(NamedTuple):
    """Hyper-parameters by environment with a name, the file that they are from, and what messages call them."""

    name: str
    file: Path
    entries: Mapping[str, Any]
    source: str


def read_variants(path: Path) -> list[Variant]:
    """The variants in a file: those of a ``variants.yml``, or one with the name of a file of hyper-parameters."""
    entries = read_entries(path)
    if "variants" not in entries:
        return [Variant(path.stem, path, entries, str(path))]
    experiment = validated(Experiment, entries, str(path))
    base = experiment.base
    entries = read_entries(find_file(Path(base), folder=path.parent)) if isinstance(base, str) else base
    return [
        Variant(name, path, {env_id: merge(entry or {}, changes) for env_id, entry in entries.items()}, f"{path}: {name}")
        for name, changes in experiment.variants.items()
    ]


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
    names: Sequence[str] = (),
) -> Matrix:
    """
    Read the variants of a benchmark. That they can be trained is checked by ``check_matrix``.

    :param files: Files of hyper-parameters, each a variant with the name of its file, and files such as ``variants.yml``
    :param environments: Environments. Default: those that all files name
    :param checkpoints: Environment steps to compare at. Default: those of 100k, 500k and 1000k that are in every
        variant's ``n_timesteps``
    :param names: The variants to train. Default: all in the files
    """
    variants = [variant for file in files for variant in read_variants(file)]
    found = [variant.name for variant in variants]
    for name in names or found:
        if name not in found:
            raise ConfigError(f"no variant is called {name}: {', '.join(found)}")
        if found.count(name) > 1:
            raise ConfigError(f"two variants are called {name}")
    variants = [variant for variant in variants if variant.name in names or not names]
    import_modules(imports)
    ids = list(dict.fromkeys(map(resolve_env_id, environments or _common_environments(variants))))
    # SACAux's default, written out: a variant that names no loss is not one that says "none".
    hyperparameters = {
        (variant.name, env_id): {"aux_loss": "auto", **entry_of(variant.entries, env_id, variant.source)}
        for variant, env_id in product(variants, ids)
    }
    compared = {env_id: tuple(sorted(set(checkpoints))) or _default_checkpoints(env_id, hyperparameters) for env_id in ids}
    runs: dict[Cell, Run] = {}
    abouts: dict[Cell, dict[str, Any]] = {}
    # Seed by seed, so that a first run of each is there early.
    for seed, environment, variant in product(seeds, ids, variants):
        cell = Cell(variant.name, environment, seed)
        settings, steps = hyperparameters[cell[:2]], compared[environment]
        between = () if every is None else range(every, steps[-1], every)
        evaluations = tuple(sorted({*steps, *between}))
        loss = settings["aux_loss"]
        runs[cell] = Run(
            environment=environment,
            aux_loss=loss if loss in (None, "auto") else str(catalog.resolve(loss)),
            hyperparameters={key: value for key, value in settings.items() if key != "aux_loss"},
            seed=seed,
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
            "file": str(variant.file),
            "hyperparameters": json.loads(json.dumps(settings)),  # as it is read again
        }
    matrix = Matrix("benchmark", folder, runs, abouts)
    _check_folder(matrix)
    return matrix


def read_abouts(folder: Path) -> dict[Path, dict[str, Any]]:
    """
    The ``provenance.json`` of a benchmark's runs, by their folders.

    :param folder: Folder of a benchmark, or of an experiment, which has a ``variants.yml``
    :raises ValueError: when a run is there twice
    """
    abouts: dict[Path, dict[str, Any]] = {}
    folders: dict[Cell, Path] = {}
    file, runs = folder / VARIANTS, folder / RUNS
    found = [*(runs if runs.exists() else folder).glob(f"*/*/*/{ABOUT}")]
    for part in validated(Experiment, read_yaml(file), str(file)).runs if file.exists() else ():
        found += (folder / part).rglob(ABOUT)
    for path in sorted(path.parent for path in found):
        about = {"sessions": [], **read_about(path)}
        if "checkpoints" not in about:  # of another matrix
            continue
        abouts[path] = about
        cell = Cell(*(about[name] for name in Cell._fields))
        other = folders.setdefault(cell, path)
        if other != path:
            raise ValueError(f"{other} and {path} have the same run: {cell.variant} on {cell.environment}, seed {cell.seed}")
    return abouts


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


def _common_environments(variants: Sequence[Variant]) -> list[str]:
    """The environments that all variants name, in the order of the first."""
    first, *others = (variant.entries for variant in variants)
    common = [name for name in first if name != "default" and all(name in entries for entries in others)]
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
        # Runs that were trained by another program name it.
        old, new = (
            {key: values.get(key) for key in ("evaluations", "evaluation_episodes", "program", "hyperparameters")}
            for values in (stored.get(cell[:2], about), about)
        )
        for key, before, now in differences(old, new):
            if (name := key.removeprefix("hyperparameters.")) not in FREE:
                where = f"{cell.variant} on {cell.environment}"
                raise ValueError(
                    f"{matrix.folder} has runs of {where} with {name}={before!r}, not {now!r}: name another folder"
                )
