"""The losses with a name: handcrafted ones, AARL-Pixel and AARL-State, and every candidate that the paper published."""

import difflib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from sb3_aarl.aux_loss import AuxLoss, Token
from sb3_aarl.files import read_yaml


@cache
def _read() -> dict[str, Any]:
    return yaml.safe_load(resources.files("sb3_aarl").joinpath("catalog.yml").read_text(encoding="utf-8"))


@cache
def _named() -> Mapping[str, AuxLoss]:
    losses = {name: AuxLoss.parse(notation) for name, notation in _read()["named"].items()}
    for k in range(1, 11):
        now = Token("s", 0)
        actions = [Token("a", i) for i in range(k)]
        future = [Token("s", i) for i in range(1, k + 1)]
        losses[f"atc-{k}"] = AuxLoss.from_tokens([now], future, "bilinear", negatives=True)
        losses[f"spr-{k}"] = AuxLoss.from_tokens([now, *actions], future, "n_mse")
    return MappingProxyType(losses)


def names() -> list[str]:
    """The names of all losses but the published candidates, sorted; numbers in them by value."""
    return sorted(_named(), key=lambda name: (name.rstrip("0123456789"), len(name), name))


def load(name: str) -> AuxLoss:
    """
    The loss of that name.

    :param name: One of :func:`names`, or a published candidate's; in any case
    :raises ValueError: for an unknown name, with the nearest ones
    """
    key = str(name).strip().lower()
    if key in _named():
        return _named()[key]
    if key not in published():
        nearest = difflib.get_close_matches(key[:100], [*names(), *published()])
        hint = f"nearest: {', '.join(nearest)}" if nearest else f"known: {', '.join(names())}"
        raise ValueError(f"unknown auxiliary loss {name!r}, {hint}")
    return published()[key]


@cache
def published() -> Mapping[str, AuxLoss]:
    """
    Every candidate of the paper's tables 9, 12, 13 and 14, in their order. The names are of task, observation, generation
    (the paper says "stage") and rank among its best, such as ``cheetah-run-state-4-1``.
    """
    losses = {
        f"{table['environment'].lower()}-{table['observation']}-{generation}-{rank}": AuxLoss.parse(notation)
        for table in _read()["published"]
        for generation, candidates in table["generations"].items()
        for rank, notation in enumerate(candidates, start=1)
    }
    return MappingProxyType(losses)


def resolve(value: Any) -> AuxLoss:
    """
    The loss that a user means: an AuxLoss, a notation, a name of the catalogue, or a YAML file (``.yml``, ``.yaml``) whose key
    ``aux_loss`` has one of these, such as a cross-validation's ``winner.yml``.

    :param value: A value from code, YAML or the command line
    :raises ValueError: when it is none of these, with the file's name where it is one
    """
    if isinstance(value, AuxLoss):
        return value
    if isinstance(value, Path) or (isinstance(value, str) and value.lower().endswith((".yml", ".yaml"))):
        loss = read_yaml(value)
        try:
            return resolve(loss.get("aux_loss"))
        except ValueError as error:
            raise ValueError(f"{value}: aux_loss: {error}") from None
    if not isinstance(value, str):
        raise ValueError(f"an auxiliary loss is an AuxLoss, a notation, a name or a YAML file, not {value!r}")
    return AuxLoss.parse(value) if "{" in value or ">" in value else load(value)
