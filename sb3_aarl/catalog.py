"""The losses with a name: handcrafted ones, AARL-Pixel and AARL-State, and every candidate that the paper published."""

import difflib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import yaml

from sb3_aarl.aux_loss import AuxLoss, Token
from sb3_aarl.files import read_yaml


class PublishedLoss(NamedTuple):
    """
    A candidate of the paper's appendix D.2.

    :param loss: The candidate
    :param table: Number of the paper's table: 9, 12, 13 or 14
    :param environment: The task that it was searched on, such as ``Cheetah-Run``
    :param observation: ``pixel`` or ``state``
    :param generation: Generation of the evolution (the paper says "stage"), from 1
    :param rank: Rank among the generation's best, from 1
    """

    loss: AuxLoss
    table: int
    environment: str
    observation: str
    generation: int
    rank: int

    @property
    def name(self) -> str:
        """The name for :func:`load`: task, observation, generation and rank, such as ``cheetah-run-state-4-1``."""
        return f"{self.environment.lower()}-{self.observation}-{self.generation}-{self.rank}"


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
    candidates = {candidate.name: candidate.loss for candidate in published()}
    if key not in candidates:
        nearest = difflib.get_close_matches(key[:100], [*names(), *candidates])
        hint = f"nearest: {', '.join(nearest)}" if nearest else f"known: {', '.join(names())}"
        raise ValueError(f"unknown auxiliary loss {name!r}, {hint}")
    return candidates[key]


@cache
def published() -> tuple[PublishedLoss, ...]:
    """Every candidate of the paper's tables 9, 12, 13 and 14, in their order."""
    return tuple(
        PublishedLoss(AuxLoss.parse(notation), table["table"], table["environment"], table["observation"], generation, rank)
        for table in _read()["published"]
        for generation, candidates in table["generations"].items()
        for rank, notation in enumerate(candidates, start=1)
    )


def resolve(value: "AuxLoss | str | Path | Mapping[str, Any]") -> AuxLoss:
    """
    The loss that a user means: an AuxLoss, a notation, a name of the catalogue, the mapping of ``AuxLoss.to_dict``, or a YAML
    file (``.yml``, ``.yaml``) whose key ``aux_loss`` has one of these, such as a cross-validation's ``winner.yml``.

    :param value: A value from code, YAML or the command line
    :raises ValueError: when it is none of these, with the file's name where it is one
    """
    if isinstance(value, AuxLoss):
        return value
    if isinstance(value, Path) or (isinstance(value, str) and value.lower().endswith((".yml", ".yaml"))):
        loss = read_yaml(value)
        try:
            return resolve(loss)
        except ValueError as error:
            raise ValueError(f"{value}: {error}") from None
    if isinstance(value, Mapping):
        return resolve(value["aux_loss"]) if value.keys() == {"aux_loss"} else AuxLoss.from_dict(value)
    if not isinstance(value, str):
        raise ValueError(f"an auxiliary loss is an AuxLoss, a notation, a name or a mapping, not {value!r}")
    return AuxLoss.parse(value) if "{" in value or ">" in value else load(value)
