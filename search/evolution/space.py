"""The search space: AuxLoss to and from Optuna parameters, and losses drawn at random and from the paper's priors."""

import contextlib
import math
from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, IntDistribution
from optuna.trial import BaseTrial, FixedTrial, FrozenTrial, TrialState

from sb3_aarl.aux_loss import LONGEST_HORIZON, OPERATORS, AuxLoss, Token

MAX_HORIZON = 10  # paper, section 2.1
SEED_INDEX_KEY = "seed_index"  # user attribute of a trial: 0, or k where it repeats a loss for the k-th time
SLOT_KEY = "AuxLossSampler:slot"  # system attribute of a trial: its slot, its planned loss and the space, in one piece


def check_operators(operators: Sequence[str] | None) -> None:
    """Raise a ValueError that names what is no operator; None is where the operator is not searched."""
    unknown = [name for name in operators or () if name not in OPERATORS]
    if unknown or (operators is not None and (isinstance(operators, str) or not len(operators))):
        culprit = repr(unknown[0]) if unknown else repr(operators)
        raise ValueError(f"operators must be a list of {', '.join(OPERATORS)}, or None; {culprit} is not")


@cache
def token_names(horizon: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the parameters of the source's bits, and of the target's. Raises a ValueError for what is no horizon."""
    if horizon not in range(1, LONGEST_HORIZON + 1):
        raise ValueError(f"a horizon is a whole number from 1 to {LONGEST_HORIZON}, not {horizon!r}")
    tokens = [Token.of(index) for index in range(3 * int(horizon) + 1)]
    return tuple(f"source/{token}" for token in tokens), tuple(f"target/{token}" for token in tokens)


def distributions(
    horizon: int, max_horizon: int = MAX_HORIZON, operators: Sequence[str] | None = None
) -> dict[str, BaseDistribution]:
    """
    Optuna's parameters of a loss: ``horizon``, one boolean for each token that it has (``source/s_t+1``), ``operator`` and
    ``negatives``; without ``operators``, mean squared error without negatives (paper, 2.2).
    """
    space: dict[str, BaseDistribution] = {"horizon": IntDistribution(1, max_horizon)}
    source, target = token_names(horizon)
    space |= {name: CategoricalDistribution([False, True]) for name in source + target}
    if operators is not None:
        space["operator"] = CategoricalDistribution(list(operators))
        space["negatives"] = CategoricalDistribution([False, True])
    return space


def values(distribution: BaseDistribution) -> Sequence[Any]:
    """The values that a parameter of :func:`distributions` can have."""
    if isinstance(distribution, IntDistribution):
        return range(distribution.low, distribution.high + 1)
    return distribution.choices if isinstance(distribution, CategoricalDistribution) else ()


def loss_to_params(loss: AuxLoss, operators: Sequence[str] | None = None) -> dict[str, Any]:
    """
    The parameters of a loss, for ``study.enqueue_trial`` and the sampler.

    :raises ValueError: when its operator, or negatives, are not in the space of :func:`distributions`
    """
    is_in_space = (loss.operator, loss.negatives) == ("mse", False) if operators is None else loss.operator in operators
    if not is_in_space:
        searched = "mean squared error without negatives" if operators is None else ", ".join(operators)
        raise ValueError(f"{loss} is not in the space, whose operators are: {searched}")
    source, target = token_names(loss.horizon)
    params = {"horizon": loss.horizon, **dict(zip(source + target, loss.source + loss.target, strict=True))}
    return params if operators is None else {**params, "operator": loss.operator, "negatives": loss.negatives}


def params_to_loss(params: Mapping[str, Any]) -> AuxLoss:
    """
    The loss of a trial's parameters; others are ignored.

    :raises KeyError: when parameters are missing
    :raises ValueError: when the loss is not valid
    """
    horizon = params["horizon"]
    source, target = (tuple(params[name] for name in names) for names in token_names(horizon))
    operator = (params["operator"], params["negatives"]) if _has_operator(params) else ()
    return AuxLoss(int(horizon), source, target, *operator)


def _has_operator(params: Mapping[str, Any]) -> bool:
    """Whether the operator was searched; else parameters of these names are a user's own."""
    return params.get("operator") in OPERATORS and isinstance(params.get("negatives"), bool)


def other_params(params: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a trial beside those of its loss."""
    own = ("horizon", "operator", "negatives") if _has_operator(params) else ("horizon",)
    return {name: value for name, value in params.items() if name not in own and not name.startswith(("source/", "target/"))}


def values_text(values: Mapping[str, Any]) -> str:
    """Such values as text, numbers rounded."""
    return ", ".join(
        f"{name}={value:.4g}" if isinstance(value, float) else f"{name}={value}" for name, value in values.items()
    )


def described(loss: AuxLoss | None, values: Mapping[str, Any]) -> str:
    """A loss as text, with the values that were searched beside it."""
    return f"{loss}, with {values_text(values)}" if values else str(loss)


def score_of(trial: FrozenTrial) -> float:
    """
    The value of a trial; NaN if it is not complete or violates a constraint, or the value is not finite. That of a pruned
    trial is its last report, which is not the mean of a whole curve.
    """
    is_scored = trial.state == TrialState.COMPLETE and all(value <= 0 for value in trial.constraints.values())
    return trial.value if is_scored and trial.value is not None and math.isfinite(trial.value) else math.nan


def loss_of(trial: FrozenTrial) -> AuxLoss | None:
    """The loss of a trial; None if it was never asked for one, or has parameters that are no valid loss."""
    try:
        return params_to_loss(trial.params)
    except (KeyError, ValueError):
        return None


def suggest_aux_loss(trial: BaseTrial, max_horizon: int | None = None, operators: Sequence[str] | None = None) -> AuxLoss:
    """
    Suggest the parameters of a loss, with any sampler of Optuna. A trial that has them already, such as ``study.best_trial``,
    returns its loss. AuxLossSampler has its own space: these arguments may be left out.

    :param max_horizon: Longest horizon of the space; None for 10
    :param operators: Operators to search too, with and without negatives; None for mean squared error without
    :raises ValueError: when an AuxLossSampler searches another space, naming the argument
    :raises optuna.TrialPruned: when what the sampler proposes, or a user enqueued, is not valid; nothing was trained then
    """
    check_operators(operators)
    if isinstance(trial, FrozenTrial) and "horizon" in trial.params:
        return _loss_or_pruned(trial.params)
    has_slot, longest, searched = _space_of(trial, max_horizon, operators)
    params: dict[str, Any] = {"horizon": trial.suggest_int("horizon", 1, longest)}
    if not has_slot:  # the sampler is another one, perhaps with an AuxLossSampler as its independent_sampler
        _, longest, searched = _space_of(trial, max_horizon, operators)
    if params["horizon"] > longest and isinstance(trial, optuna.Trial):
        raise optuna.TrialPruned(f"horizon is {params['horizon']}, longer than {longest}")
    for name, distribution in distributions(params["horizon"], longest, searched).items():
        if isinstance(distribution, CategoricalDistribution):
            params[name] = trial.suggest_categorical(name, distribution.choices)
    if searched is None and isinstance(trial, FixedTrial):
        with contextlib.suppress(ValueError):  # it has no operator
            params["operator"] = trial.suggest_categorical("operator", OPERATORS)
            params["negatives"] = trial.suggest_categorical("negatives", [False, True])
    return _loss_or_pruned(params)


def _loss_or_pruned(params: Mapping[str, Any]) -> AuxLoss:
    try:
        return params_to_loss(params)
    except ValueError as error:
        raise optuna.TrialPruned(str(error)) from None


def _space_of(
    trial: BaseTrial, max_horizon: int | None, operators: Sequence[str] | None
) -> tuple[bool, int, Sequence[str] | None]:
    """
    Whether an AuxLossSampler has given the trial its slot, and the space of that sampler, else the arguments. It is not read
    from ``study.sampler``, which may be a sampler around that one.
    """
    longest = MAX_HORIZON if max_horizon is None else max_horizon
    if not isinstance(trial, optuna.Trial):
        return True, longest, operators
    attributes = trial.study.get_trials(deepcopy=False)[trial.number].system_attrs
    if (slot := attributes.get(SLOT_KEY)) is not None:
        longest, searched = slot["max_horizon"], slot["operators"]
        if max_horizon not in (None, longest):
            raise ValueError(
                f"the AuxLossSampler has max_horizon={longest}, not {max_horizon}: leave it out, or change it there"
            )
        if operators is not None and list(operators) != list(searched or ()):
            raise ValueError(f"the AuxLossSampler has operators={searched}, not {operators}: leave it out, or change it there")
        operators = searched
    _check_enqueued(attributes.get("fixed_params", {}), longest, operators)
    return slot is not None, longest, operators


def _check_enqueued(enqueued: Mapping[str, Any], max_horizon: int, operators: Sequence[str] | None) -> None:
    """Optuna raises for some values that a parameter cannot have, only warns of others, and ignores what is not searched."""
    space = distributions(max_horizon, max_horizon, ("mse",) if operators is None else operators)
    if operators is None:
        space["negatives"] = CategoricalDistribution([False])
    for name, distribution in space.items():
        if name in enqueued and enqueued[name] not in values(distribution):
            allowed = list(values(distribution))
            raise optuna.TrialPruned(f"{name} was enqueued as {enqueued[name]!r}, it must be one of {allowed}")


def random_operator(rng: np.random.Generator, operators: Sequence[str] | None) -> tuple[str, bool]:
    """An operator and whether it has negatives, uniform over all."""
    if operators is None:
        return "mse", False
    return operators[int(rng.integers(len(operators)))], bool(rng.integers(2))


def random_loss(
    rng: np.random.Generator,
    max_horizon: int = MAX_HORIZON,
    operators: Sequence[str] | None = None,
    source: Sequence[float] = (0.5, 0.5, 0.5),
    target: Sequence[float] = (0.5, 0.5, 0.5),
    flips_states: bool = False,
) -> AuxLoss:
    """
    A loss whose horizon is uniform, and whose states, actions and rewards are in source and target with given probabilities
    (paper, A.3), invalid ones redrawn. ``flips_states``: states of the target are those that are not in the source.
    """
    # The horizon is drawn once: redrawing it with rejected masks would favour long ones.
    horizon = int(rng.integers(1, max_horizon + 1))
    chances = np.array([np.resize(kinds, 3 * horizon + 1) for kinds in (source, target)])
    while True:
        masks = rng.random(chances.shape) < chances
        if flips_states:
            masks[1, ::3] = ~masks[0, ::3]
        if masks[0, ::3].any() and masks[1].any():  # the paper's loss rejection (A.3)
            of_source, of_target = map(tuple, masks.tolist())
            return AuxLoss(horizon, of_source, of_target, *random_operator(rng, operators))


# Losses that resemble forward dynamics and reward prediction (paper, A.3). The paper prints "target" for the 0.2; only with
# "source" does its third rule, states of the target are those that are not in the source, make sense.
forward_dynamics_prior = partial(random_loss, source=(0.2, 0.8, 0.5), flips_states=True)
reward_prediction_prior = partial(random_loss, target=(0.0, 0.0, 0.8))
PRIORS = (forward_dynamics_prior, reward_prediction_prior)
