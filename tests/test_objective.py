"""The objective for a user's own study.optimize: scores, reports, pruning, candidates that fail, Ctrl-C."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.pruners import BasePruner, NopPruner, ThresholdPruner
from optuna.samplers import RandomSampler
from optuna.trial import TrialState
from tiny import write_search

from sb3_aarl import AuxLoss
from sb3_aarl.callbacks import Evaluation, aulc, read_curve
from search.evolution.sampler import AuxLossSampler
from search.evolution.space import loss_to_params
from search.studies import objective
from search.studies.config import load_config
from search.studies.objective import Objective

LOSS = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
NEVER = ThresholdPruner(lower=-1e9)
ALWAYS = ThresholdPruner(lower=1e9)


def make_objective(folder: Path, **changes: Any) -> Objective:
    config = load_config(write_search(folder))
    return Objective(config.model_copy(update={"checkpoints": (50, 80), **changes}), folder)


def make_study(pruner: BasePruner = NEVER) -> optuna.Study:
    study = optuna.create_study(direction="maximize", sampler=RandomSampler(seed=0), pruner=pruner)
    study.enqueue_trial(loss_to_params(LOSS))
    return study


def curve_of(folder: Path, seed: int = 0) -> list[Evaluation]:
    return read_curve(folder / f"candidates/trial-0/seed-{seed}/curve.csv")


@pytest.mark.slow
def test_the_curves_of_all_seeds_are_the_score_and_that_of_the_first_is_reported(tmp_path: Path) -> None:
    study = make_study()
    study.optimize(make_objective(tmp_path, seeds=(2, 5)), n_trials=1)
    (trial,) = study.trials
    first, second = curve_of(tmp_path, 2), curve_of(tmp_path, 5)
    assert trial.value == pytest.approx((aulc(first) + aulc(second)) / 2)
    assert trial.intermediate_values == {evaluation.environment_steps: evaluation.mean for evaluation in first}
    assert list(trial.intermediate_values) == [50, 80]
    means = np.mean([[evaluation.mean for evaluation in curve] for curve in (first, second)], axis=0)
    assert [point[:2] for point in trial.user_attrs["curve"]] == [[50, means[0]], [80, means[1]]]
    assert trial.user_attrs["seconds"] == pytest.approx(first[-1].seconds + second[-1].seconds, abs=0.1)
    assert (trial.user_attrs["loss"], trial.user_attrs["canonical"]) == (str(LOSS), str(LOSS))
    assert trial.user_attrs["environment"] == "Pendulum-v1"


def test_a_pruned_trial_ends_early_and_is_spared_other_seeds(tmp_path: Path) -> None:
    study = make_study(ALWAYS)
    study.optimize(make_objective(tmp_path, seeds=(0, 1)), n_trials=1)
    (trial,) = study.trials
    assert trial.state == TrialState.PRUNED and list(trial.intermediate_values) == [50]
    assert len(curve_of(tmp_path)) == len(trial.user_attrs["curve"]) == 1
    assert not (tmp_path / "candidates/trial-0/seed-1").exists()


def test_after_the_last_evaluation_nothing_is_pruned(tmp_path: Path) -> None:
    study = make_study(ThresholdPruner(lower=1e9, n_warmup_steps=80))
    study.optimize(make_objective(tmp_path), n_trials=1)
    assert study.trials[0].state == TrialState.COMPLETE


def test_an_invalid_candidate_trains_nothing(tmp_path: Path) -> None:
    study = optuna.create_study(direction="maximize", sampler=RandomSampler(seed=0))
    study.enqueue_trial({**loss_to_params(LOSS), "source/s_t": False})
    study.optimize(make_objective(tmp_path), n_trials=1)
    assert study.trials[0].state == TrialState.PRUNED and not (tmp_path / "candidates").exists()


def test_a_loss_that_diverges_fails_alone(tmp_path: Path) -> None:
    study = make_study()
    study.optimize(make_objective(tmp_path, overrides={"learning_rate": 1e30}), n_trials=1, catch=(FloatingPointError,))
    (trial,) = study.trials
    assert trial.state == TrialState.FAIL and str(LOSS) in trial.user_attrs["reason"]


def test_a_finished_run_is_read_and_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = make_study()
    first.optimize(make_objective(tmp_path), n_trials=1)
    written = (tmp_path / "candidates/trial-0/seed-0/curve.csv").stat().st_mtime_ns
    again = make_study()
    again.optimize(make_objective(tmp_path), n_trials=1)
    assert again.trials[0].value == first.trials[0].value
    assert again.trials[0].intermediate_values == first.trials[0].intermediate_values
    assert (tmp_path / "candidates/trial-0/seed-0/curve.csv").stat().st_mtime_ns == written


@pytest.mark.slow
def test_with_the_sampler_it_is_resumed_after_an_interruption_and_ends_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = objective.train

    def interrupted(folder: Path, on_evaluation: Callable[[list[Evaluation]], bool]) -> list[Evaluation]:
        def interrupt(curve: list[Evaluation]) -> bool:
            raise KeyboardInterrupt

        return train(folder, on_evaluation=interrupt)

    studies = []
    for name, interruptions in (("undisturbed", 0), ("interrupted", 2)):
        folder = tmp_path / name
        folder.mkdir()
        own = make_objective(folder, generations=1, n_random=2, n_prior=0)
        sampler = AuxLossSampler(**own.config.sampler_settings())
        study = optuna.create_study(direction="maximize", sampler=sampler, pruner=NopPruner())
        for _ in range(interruptions):
            with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
                patch.setattr(objective, "train", interrupted)
                study.optimize(own)
        study.optimize(own, callbacks=[sampler.stop_when_complete])
        studies.append(study)
        assert len(list((folder / "candidates/generation-1").glob("slot-*/attempt-0/seed-0/curve.csv"))) == 2
    scores = [
        {trial.user_attrs["slot"]: (trial.user_attrs["loss"], trial.value) for trial in study.trials if trial.values}
        for study in studies
    ]
    assert scores[0] == scores[1] and len(scores[0]) == 2
    interrupted_trials = [trial for trial in studies[1].trials if trial.state == TrialState.FAIL]
    assert [trial.user_attrs.get("interrupted") for trial in interrupted_trials] == [True, True]
