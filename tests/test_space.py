"""The search space: parameters and back, validity, and the distribution of random losses and of the priors."""

import contextlib
from itertools import product
from typing import Any

import numpy as np
import optuna
import pytest
from hypothesis import given
from hypothesis import strategies as st
from optuna.distributions import CategoricalDistribution, IntDistribution
from optuna.samplers import BaseSampler, RandomSampler, TPESampler
from optuna.trial import FixedTrial, TrialState
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import (
    check_operators,
    distributions,
    forward_dynamics_prior,
    loss_of,
    loss_to_params,
    other_params,
    params_to_loss,
    random_loss,
    reward_prediction_prior,
    suggest_aux_loss,
)
from scipy.stats import binomtest, chisquare

from sb3_aarl.aux_loss import OPERATORS, AuxLoss

GENERATORS = {"random": random_loss, "forward dynamics": forward_dynamics_prior, "rewards": reward_prediction_prior}


@st.composite
def losses(draw: st.DrawFn, max_horizon: int = 4, operators: tuple[str, ...] = OPERATORS) -> AuxLoss:
    """Any valid loss."""
    horizon = draw(st.integers(1, max_horizon))
    bits = st.lists(st.booleans(), min_size=3 * horizon + 1, max_size=3 * horizon + 1)
    source, target = draw(bits.filter(lambda mask: any(mask[::3]))), draw(bits.filter(any))
    return AuxLoss(horizon, tuple(source), tuple(target), draw(st.sampled_from(operators)), draw(st.booleans()))


def test_the_parameters_are_one_boolean_for_each_token_of_the_horizon() -> None:
    tokens = ["s_t", "a_t", "r_t", "s_t+1", "a_t+1", "r_t+1", "s_t+2"]
    space = distributions(2, max_horizon=5)
    assert list(space) == ["horizon", *(f"source/{token}" for token in tokens), *(f"target/{token}" for token in tokens)]
    assert space["horizon"] == IntDistribution(1, 5)
    assert all(value == CategoricalDistribution([False, True]) for name, value in space.items() if name != "horizon")
    searched = distributions(1, operators=("mse", "inner"))
    assert searched["operator"] == CategoricalDistribution(["mse", "inner"])
    assert searched["negatives"] == CategoricalDistribution([False, True])


@given(losses())
def test_parameters_and_back(loss: AuxLoss) -> None:
    params = loss_to_params(loss, OPERATORS)
    assert params_to_loss(params) == loss
    assert params_to_loss({**params, "learning_rate": 1.0}) == loss
    assert set(params) == set(distributions(loss.horizon, operators=OPERATORS))
    without = AuxLoss(loss.horizon, loss.source, loss.target)
    plain = loss_to_params(without)
    assert params_to_loss(plain) == without
    assert set(plain) == set(distributions(loss.horizon))
    assert suggest_aux_loss(FixedTrial(params), operators=OPERATORS) == loss
    for name in plain:
        with pytest.raises(KeyError):
            params_to_loss({key: value for key, value in plain.items() if key != name})
    if loss != without:
        with pytest.raises(ValueError, match="mean squared error without negatives"):
            loss_to_params(loss)
        with pytest.raises(ValueError, match="is not in the space, whose operators are: "):
            loss_to_params(loss, [name for name in OPERATORS if name != loss.operator])


def bit_chances(generator: str, source: tuple[bool, ...], target: tuple[bool, ...]) -> list[float]:
    """The probability of each bit of horizon 1 to be as it is, from the paper's text (A.3)."""

    def chance(bit: bool, p: float) -> float:
        return p if bit else 1 - p

    if generator == "forward dynamics":
        chances = [chance(source[0], 0.2), chance(source[3], 0.2), chance(source[1], 0.8), chance(source[2], 0.5)]
        chances += [float(target[i] != source[i]) for i in (0, 3)]
        return [*chances, chance(target[1], 0.5), chance(target[2], 0.5)]
    of_target = [0.0, 0.0, 0.8, 0.0] if generator == "rewards" else [0.5] * 4
    return [chance(bit, 0.5) for bit in source] + [chance(bit, p) for bit, p in zip(target, of_target, strict=True)]


@pytest.mark.parametrize("generator", GENERATORS)
def test_joint_distribution_of_all_bits_given_that_the_loss_is_valid(generator: str) -> None:
    rng = np.random.default_rng(0)
    outcomes = {}
    for bits in product([False, True], repeat=8):
        if any(bits[:4:3]) and any(bits[4:]):
            outcomes[bits[:4], bits[4:]] = float(np.prod(bit_chances(generator, bits[:4], bits[4:])))
    outcomes = {masks: p / sum(outcomes.values()) for masks, p in outcomes.items() if p > 0}
    counts = dict.fromkeys(outcomes, 0)
    for _ in range(20_000):
        loss = GENERATORS[generator](rng, max_horizon=1)
        counts[loss.source, loss.target] += 1  # a KeyError here is an outcome that must not be
    assert chisquare(list(counts.values()), 20_000 * np.array(list(outcomes.values()))).pvalue > 0.001


@pytest.mark.parametrize("generator", GENERATORS)
def test_horizons_are_uniform_and_bits_of_long_losses_have_their_rates(generator: str) -> None:
    rng = np.random.default_rng(1)
    drawn = [GENERATORS[generator](rng) for _ in range(6000)]
    horizons = np.bincount([loss.horizon for loss in drawn], minlength=11)[1:]
    assert horizons.size == 10
    assert chisquare(horizons).pvalue > 0.001
    # Of horizon 8 and more hardly any are rejected: 0.8 ** 9 in the forward-dynamics prior concerns its source states only.
    masks = np.array([(loss.source[:25], loss.target[:25]) for loss in drawn if loss.horizon >= 8])
    some_state = 1 - 0.8 ** np.arange(9, 12)
    rates = {
        "random": [0.5] * 6,
        "forward dynamics": [np.mean(0.2 / some_state), 0.8, 0.5, 1 - np.mean(0.2 / some_state), 0.5, 0.5],
        "rewards": [0.5, 0.5, 0.5, 0, 0, 0.8],
    }[generator]
    for side in range(2):
        for kind in range(3):
            bits = masks[:, side, kind::3].ravel()
            assert binomtest(int(bits.sum()), bits.size, rates[3 * side + kind]).pvalue > 0.001, (side, kind)


def test_operators_are_drawn_uniformly_with_and_without_negatives() -> None:
    rng = np.random.default_rng(2)
    drawn = [random_loss(rng, 2, ("mse", "inner", "cosine")) for _ in range(3000)]
    counts = [
        sum(loss.operator == name and loss.negatives == negatives for loss in drawn)
        for name in ("mse", "inner", "cosine")
        for negatives in (False, True)
    ]
    assert sum(counts) == 3000
    assert chisquare(counts).pvalue > 0.001
    assert {(loss.operator, loss.negatives) for loss in (random_loss(rng) for _ in range(50))} == {("mse", False)}


@pytest.mark.parametrize("sampler", [RandomSampler(seed=0), TPESampler(seed=0, n_startup_trials=20)])
@pytest.mark.parametrize("operators", [None, ("mse", "inner")])
def test_any_sampler_works_and_what_is_invalid_never_reaches_training(
    sampler: optuna.samplers.BaseSampler, operators: tuple[str, ...] | None
) -> None:
    trained = []

    def objective(trial: optuna.Trial) -> float:
        loss = suggest_aux_loss(trial, 1, operators)
        trained.append(loss)
        assert loss == params_to_loss(trial.params)
        return sum(loss.target)

    study = optuna.create_study(sampler=sampler)
    study.optimize(objective, n_trials=60)
    by_state = {
        state: [trial.params for trial in study.get_trials(states=(state,))]
        for state in (TrialState.COMPLETE, TrialState.PRUNED)
    }
    assert len(by_state[TrialState.COMPLETE]) == len(trained) < 60
    assert len(by_state[TrialState.PRUNED]) == 60 - len(trained)
    for params in by_state[TrialState.PRUNED]:
        is_rejected = not (params["source/s_t"] or params["source/s_t+1"])
        assert is_rejected or not any(bit for name, bit in params.items() if name.startswith("target/"))
    assert {loss.operator for loss in trained} == set(operators or ("mse",))


@pytest.mark.parametrize("sampler", [RandomSampler(seed=0), None], ids=["random", "evolution"])
@pytest.mark.parametrize(
    ("enqueued", "name"),
    [
        ({"horizon": "two"}, "horizon"),
        ({"horizon": 0}, "horizon"),
        ({"horizon": 4}, "horizon"),
        ({"horizon": 2, "source/s_t": "yes"}, "source/s_t"),
        ({"horizon": 1, "operator": "l1"}, "operator"),
        ({"horizon": 1, "operator": "bilinear"}, "operator"),
    ],
    ids=str,
)
def test_an_enqueued_value_that_a_parameter_cannot_have_is_pruned(
    sampler: BaseSampler | None, enqueued: dict[str, Any], name: str
) -> None:
    sampler = sampler or AuxLossSampler(max_horizon=3, operators=["mse", "inner"], seed=0)
    study = optuna.create_study(sampler=sampler)
    study.enqueue_trial(enqueued)
    study.enqueue_trial({"horizon": 2.0, "source/s_t": True, "target/r_t": True})  # as a table has it
    reasons = []

    def objective(trial: optuna.Trial) -> float:
        try:
            return suggest_aux_loss(trial, 3, ["mse", "inner"]).horizon
        except optuna.TrialPruned as pruned:
            reasons.append(str(pruned))
            raise

    study.optimize(objective, n_trials=2)
    assert [trial.state for trial in study.trials] == [TrialState.PRUNED, TrialState.COMPLETE]
    assert len(reasons) == 1 and name in reasons[0]
    assert study.trials[1].value == study.trials[1].params["horizon"] == 2
    if isinstance(sampler, AuxLossSampler):
        # It is not another attempt of the first, which costs nothing.
        assert [(trial.user_attrs["slot"], trial.user_attrs["attempt"]) for trial in study.trials] == [(0, 0), (0, 0)]


def test_an_error_that_is_not_of_an_enqueued_value_is_raised() -> None:
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    study.enqueue_trial({"horizon": 1, "operator": "mse"})
    study.enqueue_trial({"horizon": 1, "operator": "mse"})
    first = study.ask()
    with contextlib.suppress(optuna.TrialPruned):
        suggest_aux_loss(first, 1, ["mse", "inner"])
    study.tell(first, 0.0)
    with pytest.raises(ValueError, match="dynamic value space"):
        suggest_aux_loss(study.ask(), 1, ["mse", "cosine"])


@pytest.mark.parametrize(
    ("asked", "culprit"),
    [({"max_horizon": 2}, "max_horizon=3, not 2"), ({"operators": ["inner"]}, "operators=None, not .'inner")],
)
def test_a_space_that_the_sampler_does_not_search_is_refused(asked: dict[str, Any], culprit: str) -> None:
    study = optuna.create_study(sampler=AuxLossSampler(max_horizon=3, seed=0))
    with pytest.raises(ValueError, match=culprit):
        suggest_aux_loss(study.ask(), **asked)


@pytest.mark.parametrize(("operators", "culprit"), [(("mse", "l1"), "l1"), ("mse", "mse"), ((), r"\(\)")])
def test_unknown_operators_are_named(operators: tuple[str, ...] | str, culprit: str) -> None:
    with pytest.raises(ValueError, match=culprit):
        check_operators(operators)
    with pytest.raises(ValueError, match=culprit):
        suggest_aux_loss(FixedTrial({"horizon": 1}), operators=operators)


def test_the_loss_of_a_trial() -> None:
    loss = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
    params: dict[str, Any] = loss_to_params(loss)
    no_source = params | {"source/s_t": False}
    for trial_params, expected in ((params, loss), ({}, None), ({"horizon": 1}, None), (no_source, None)):
        space = {name: distributions(1)[name] for name in trial_params}
        assert loss_of(optuna.create_trial(params=trial_params, distributions=space, value=0.0)) == expected
    own = {"operator": "adam", "negatives": 3}  # a user's, where no operator is searched
    assert (params_to_loss(params | own), other_params(params | own)) == (loss, own)


@pytest.mark.filterwarnings("ignore:The value 13 of the parameter 'horizon' is out of the range")
@pytest.mark.parametrize("sampler", [AuxLossSampler(max_horizon=15, operators=["inner"], seed=0), TPESampler(seed=0)])
def test_a_trial_that_is_trained_again_has_its_own_loss(sampler: BaseSampler) -> None:
    trained = []

    def objective(trial: optuna.trial.BaseTrial) -> float:
        trained.append(suggest_aux_loss(trial))
        return trained[-1].horizon

    study = optuna.create_study(sampler=sampler, direction="maximize")
    study.optimize(objective, n_trials=20, catch=optuna.TrialPruned)
    best = params_to_loss(study.best_params)
    objective(study.best_trial)
    objective(FixedTrial(study.best_params))
    assert trained[-2:] == [best, best] and best in trained[:-2]
    if isinstance(sampler, AuxLossSampler):
        assert best.horizon > 10 and best.operator == "inner"


@pytest.mark.parametrize("enqueued", [{"operator": "inner"}, {"negatives": True}])
def test_an_operator_that_is_enqueued_where_none_is_searched_is_pruned(enqueued: dict[str, Any]) -> None:
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    study.enqueue_trial({"horizon": 1, **enqueued})
    with pytest.raises(optuna.TrialPruned, match=r"was enqueued as"):
        suggest_aux_loss(study.ask())
