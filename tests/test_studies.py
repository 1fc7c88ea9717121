"""The paper's procedures: the study of a search, its runs, baselines, cross-validation, operators."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
import pytest
from executors import Planted
from optuna.pruners import HyperbandPruner, MedianPruner, NopPruner
from optuna.storages import InMemoryStorage
from optuna.trial import create_trial
from sb3_aarl.search.evolution.racing import standings
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import SEED_INDEX_KEY, distributions, loss_of, loss_to_params, random_loss
from sb3_aarl.search.evolution.surrogate import TokenModel
from sb3_aarl.search.execution.driver import SearchProgress
from sb3_aarl.search.execution.matrix import Cell, run_matrix, scores
from sb3_aarl.search.execution.storage import driver_lock
from sb3_aarl.search.results.report import stored_baselines
from sb3_aarl.search.studies import cross_validation
from sb3_aarl.search.studies.config import SearchConfig, load_config, merge_space
from sb3_aarl.search.studies.search import (
    SETTINGS_KEY,
    Search,
    baselines,
    make_pruner,
    planned_runs,
    runs_of,
    stored_settings,
)
from sb3_aarl.search.training import config as training
from sb3_aarl.search.training.config import ConfigError
from tiny import SEARCH, write_search

from sb3_aarl import AuxLoss, catalog

PARTS = """\
cross_validation:
  environments: [Pendulum-v1, MountainCarContinuous-v0]
  seeds: [1, 2]
  top: 2
  checkpoints: {MountainCarContinuous-v0: [100]}
baselines:
- {name: CURL, aux_loss: curl}
- {name: SAC, overrides: {gamma: 0.9}}
"""
LOSSES = [AuxLoss.parse(text) for text in ("{s_t} -> {s_t+1}", "{s_t, a_t} -> {r_t}", "{s_t+1} -> {s_t+2}")]


@pytest.fixture
def config(tmp_path: Path) -> SearchConfig:
    return load_config(write_search(tmp_path, SEARCH + PARTS))


def add_trials(study: optuna.Study, scores: list[float]) -> None:
    for loss, score in zip(LOSSES, scores, strict=True):
        study.add_trial(create_trial(params=loss_to_params(loss), distributions=distributions(loss.horizon, 3), value=score))


# The study of a search.


def test_a_search_is_opened_again(config: SearchConfig, tmp_path: Path) -> None:
    storage = InMemoryStorage()
    study = Search(config, storage=storage).study
    study.enqueue_trial(loss_to_params(LOSSES[0]))
    more = {"generations": 9, "retries": 1, "overrides": {"device": "cpu"}, "pruner": "median", "imports": ["json"]}
    again = Search(load_config(config.path, **more), storage=storage).study
    assert again.study_name == "small" and len(again.trials) == 1
    assert study.direction == optuna.study.StudyDirection.MAXIMIZE and isinstance(study.sampler, AuxLossSampler)
    assert isinstance(again.pruner, MedianPruner)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"environment": "MountainCarContinuous-v0"}, "environment='Pendulum-v1', not 'MountainCarContinuous-v0'"),
        ({"checkpoints": (200, 600)}, r"checkpoints=\[200, 400\], not \[200, 600\]"),
        ({"evaluation_episodes": 3}, "evaluation_episodes=1, not 3"),
        ({"seeds": (1,)}, r"seeds=\[0\], not \[1\]"),
        ({"threads": 2}, "threads=1, not 2"),
        ({"overrides": {"batch_size": 16}}, "batch_size=8, not 16"),
        ({"population_size": 6}, "population_size=3, not 6"),
        ({"initial": (LOSSES[1],)}, r"initial=\[\], not \['{s_t, a_t} -> {r_t}'\]"),
        ({"evolution_seed": 4}, "evolution_seed=3, not 4"),
    ],
    ids=str,
)
def test_a_search_with_other_settings_is_another_one(
    config: SearchConfig, tmp_path: Path, changed: dict[str, Any], message: str
) -> None:
    storage = InMemoryStorage()
    study = Search(config, storage=storage).study
    stored = study.user_attrs
    with pytest.raises(ValueError, match=f"this (search: it|study) was started with {message}"):
        _ = Search(load_config(config.path, **changed), storage=storage).study
    assert optuna.load_study(study_name="small", storage=storage).user_attrs == stored


def test_a_study_of_another_kind_is_refused_and_stays_as_it_is(config: SearchConfig, tmp_path: Path) -> None:
    storage = InMemoryStorage()
    study = optuna.create_study(storage=storage, study_name="small")
    with pytest.raises(ValueError, match=r"directions are \['minimize'\]"):
        _ = Search(config, storage=storage).study
    optuna.delete_study(study_name="small", storage=storage)
    study = optuna.create_study(storage=storage, study_name="small", direction="maximize")
    study.tell(study.ask({"learning_rate": optuna.distributions.FloatDistribution(0, 1)}), 0.0)
    with pytest.raises(ValueError, match="'small' is not this search: it has trials of another program"):
        _ = Search(config, storage=storage).study
    assert SETTINGS_KEY not in study.user_attrs


def test_a_search_from_python(config: SearchConfig, tmp_path: Path, executor: Planted) -> None:
    with pytest.raises(ConfigError, match=r"small.yml: Pendulum-v1 cannot be trained"):
        Search.from_file(config.path, overrides={"stats_window_size": -1})
    with pytest.raises(ConfigError, match=r"space {'gamma': 2.0}: .* gamma must be between 0 and 1"):
        Search.from_file(config.path, space={"gamma": {"type": "float", "low": 0.5, "high": 2.0}})
    search = Search.from_file(config.path, tmp_path / "mine", generations=1)
    assert not (tmp_path / "mine").exists()
    progresses: list[SearchProgress] = []
    last = search.run(executor, workers=2, on_progress=progresses.append)
    assert progresses[-1] == last and [generation.filled for generation in last.generations] == [3]
    assert last.best == search.study.best_value == 1.0 and last.seconds_to_go == 0
    # Another program's is refused while one runs, and changes nothing. Later it resumes the search, with more generations.
    more = Search.from_file(config.path, tmp_path / "mine")
    with driver_lock(search.storage, "small", tmp_path / "mine"), pytest.raises(ValueError, match="another program runs"):
        more.run(executor)
    assert stored_settings(search.study)["n_generations"] == 1
    assert [generation.filled for generation in more.run(executor).generations] == [3, 3]
    assert len(executor.runs) == 6


def test_a_file_is_read_once_and_its_settings_are_checked_once(
    config: SearchConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, executor: Planted
) -> None:
    read, checked = [], []

    def count(name: str, calls: list[Any]) -> None:
        function = getattr(training, name)
        monkeypatch.setattr(training, name, lambda *arguments: calls.append(arguments) or function(*arguments))

    count("read_yaml", read)
    count("check_hyperparameters", checked)
    search = Search.from_file(config.path, tmp_path / "mine", generations=1)
    search.run(executor)
    baselines(search.config, tmp_path)
    assert [Path(path).name for (path,) in read] == ["small.yml", "hyperparameters.yml"]
    # Two environments, and the overrides of a baseline on both.
    assert len(checked) == 4


def test_runs_of_a_candidate_differ_in_their_seeds(config: SearchConfig) -> None:
    study = optuna.create_study(sampler=AuxLossSampler(**config.sampler_settings()))
    make_runs = runs_of(config.model_copy(update={"seeds": (4, 9), "imports": ("json",), "threads": 2}))
    trial = study.ask()
    runs = make_runs(trial)
    assert [run.seed for run in runs] == [4, 9]
    for run in runs:
        assert (run.environment, run.aux_loss) == ("Pendulum-v1", str(loss_of(trial)))
        assert (run.checkpoints, run.evaluation_episodes, run.threads, run.imports) == ((200, 400), 1, 2, ("json",))
        assert run.hyperparameters["policy_kwargs"]["net_arch"] == [8]
    for index, seeds in ((1, [1004, 1009]), (2, [2004, 2009])):  # trained again
        trial = study.ask()
        trial.set_user_attr(SEED_INDEX_KEY, index)
        assert [run.seed for run in make_runs(trial)] == seeds


def test_returns_of_a_cross_validation_scale_nothing_else(config: SearchConfig, tmp_path: Path, executor: Planted) -> None:
    for returns, score in ({"Pendulum-v1": [0, 2]}, 0.5), ({}, 1.0):  # removed, they do not stay with finished runs
        search = Search.from_file(config.path, tmp_path / "mine", cross_validation={"top": 1, "returns": returns})
        search.run(executor)
        assert {trial.value for trial in search.study.trials} == {1.0}
        list(run_matrix(baselines(search.config, tmp_path / "mine"), executor))
        assert {found for _, found in stored_baselines(tmp_path / "mine")} == {1.0}
        matrix = cross_validation.make_matrix(search.config, search.study, tmp_path / "mine")
        list(run_matrix(matrix, executor))
        assert set(scores(matrix)["score"]) == {score * 2, score * 3, score * 4}  # of seeds 1, 2, 3


SEVERAL = """\
environments:
- {environment: Pendulum-v1, returns: [0, 2]}
- environment: MountainCarContinuous-v0
  returns: [-3, 1]
  checkpoints: [100, 200]
  overrides: {gamma: 0.9}
space:
  batch_size: [8, 16]
  learning_rate: {type: float, low: 1e-4, high: 1e-2, log: true}
  policy_kwargs.net_arch: [[8], [8, 8]]
baselines:
- {name: CURL, aux_loss: curl}
cross_validation: {top: 1}
"""


def test_a_search_on_several_environments_and_of_hyperparameters(tmp_path: Path, executor: Planted) -> None:
    path = write_search(tmp_path, SEARCH.replace("environment: Pendulum-v1\n", SEVERAL))
    search = Search.from_file(path, tmp_path / "mine", generations=1)
    search.run(executor, workers=2)
    tasks = list(search.config.tasks)
    for trial in search.study.trials:
        runs = [run for run in executor.runs if run.aux_loss == trial.user_attrs["loss"]]
        assert [run.environment for run in runs] == tasks and [run.checkpoints[-1] for run in runs] == [400, 200]
        for run, gamma in zip(runs, (None, 0.9), strict=True):
            assert run.hyperparameters.get("gamma") == gamma
            assert all(run.hyperparameters[name] == trial.params[name] for name in ("batch_size", "learning_rate"))
            assert run.hyperparameters["policy_kwargs"]["net_arch"] in ([8], [8, 8])
        assert {*trial.distributions.values()}  # Optuna's plots and dashboard hash them
        # The AULC is 1 on both: a half, and 1.
        assert trial.user_attrs["scores"] == dict(zip(tasks, (0.5, 1.0), strict=True)) and trial.value == 0.75
    assert {trial.params["batch_size"] for trial in search.study.trials} <= {8, 16}
    # The best is cross-validated with the values that it had.
    matrix = cross_validation.make_matrix(search.config, search.study, tmp_path)
    best = search.study.best_trial
    values = cross_validation.searched_values(search.config, search.study)[loss_of(best).canonical()]
    assert values == {name: best.params[name] for name in search.config.space}
    assert len(matrix.runs) == 6
    for run in matrix.runs.values():
        assert merge_space(run.hyperparameters, values) == run.hyperparameters

    for changes, message in (
        ({"overrides": {"gamma": 0.8}}, "environments.Pendulum-v1.gamma=None, not 0.8"),
        (
            {"environments": [{"environment": task, "returns": [0, 2]} for task in tasks]},
            "environments.MountainCar.*returns=.* not",
        ),
        ({"space": {}}, "space="),
    ):
        with pytest.raises(ValueError, match=f"was started with {message}"):
            _ = Search(load_config(path, **changes), tmp_path / "mine").study

    matrix = baselines(search.config, tmp_path / "mine")
    assert list(matrix.runs) == [Cell("CURL", task, 0) for task in tasks]
    list(run_matrix(matrix, executor))
    assert stored_baselines(tmp_path / "mine") == [("CURL", 0.75)]
    validation = cross_validation.make_matrix(search.config, search.study, tmp_path / "mine")
    assert [cell[1:] for cell in validation.runs] == [(task, seed) for seed in (1, 2, 3) for task in tasks]
    assert [run.checkpoints[-1] for run in validation.runs.values()] == [400, 200] * 3


def test_pruners(config: SearchConfig) -> None:
    pruners = [make_pruner(config.model_copy(update={"pruner": name})) for name in ("none", "median", "hyperband")]
    assert [type(pruner) for pruner in pruners] == [NopPruner, MedianPruner, HyperbandPruner]


# Matrices.


def test_baselines_have_the_settings_of_the_search_and_their_own(config: SearchConfig, tmp_path: Path) -> None:
    matrix = baselines(config, tmp_path)
    cells = [Cell("CURL", "Pendulum-v1", 0), Cell("SAC", "Pendulum-v1", 0)]
    assert list(matrix.runs) == cells and matrix.folder == tmp_path / "baselines"
    curl, sac = (matrix.runs[cell] for cell in cells)
    assert curl.aux_loss is not None and "gamma" not in curl.hyperparameters
    assert sac.aux_loss is None and sac.hyperparameters["gamma"] == 0.9 and sac.checkpoints == (200, 400)


def test_cross_validation_of_the_best(config: SearchConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    study = Search(config, storage=InMemoryStorage()).study
    with pytest.raises(ValueError, match="no completed candidate"):
        cross_validation.make_matrix(config, study, tmp_path)
    add_trials(study, [5.0, 9.0, 8.0])
    assert cross_validation.top_losses(study, 9) == [LOSSES[1], LOSSES[0]]  # the last is the first, a step later
    matrix = cross_validation.make_matrix(config, study, tmp_path)
    environments = ["Pendulum-v1", "MountainCarContinuous-v0"]
    expected = [Cell(str(loss), name, seed) for seed in (1, 2) for name in environments for loss in (LOSSES[1], LOSSES[0])]
    assert list(matrix.runs) == expected and matrix.folder == tmp_path / "cross-validation"
    assert {run.environment: run.checkpoints for run in matrix.runs.values()} == {
        "Pendulum-v1": (200, 400),
        "MountainCarContinuous-v0": (100,),
    }
    assert config.cross_validation is not None and "seeds of the search" not in caplog.text
    longer = config.cross_validation.model_copy(update={"checkpoints": {"Pendulum-v1": (800,)}})
    matrix = cross_validation.make_matrix(config.model_copy(update={"cross_validation": longer}), study, tmp_path)
    assert {run.checkpoints for run in matrix.runs.values() if run.environment == "Pendulum-v1"} == {(800,)}
    same = config.cross_validation.model_copy(update={"seeds": (0, 2)})
    more = {"cross_validation": same, "threads": 2, "generations": 3}
    cross_validation.make_matrix(config.model_copy(update=more), study, tmp_path)
    assert "seeds has seeds of the search" in caplog.text
    with pytest.raises(ConfigError, match="cross_validation is missing"):
        cross_validation.make_matrix(config.model_copy(update={"cross_validation": None}), study, tmp_path)


@pytest.mark.parametrize("changed", [{"overrides": {"batch_size": 16}}, {"evaluation_episodes": 2}], ids=str)
def test_a_file_that_differs_from_its_study_is_not_cross_validated(
    config: SearchConfig, tmp_path: Path, changed: dict[str, Any]
) -> None:
    study = Search(config, storage=InMemoryStorage()).study
    add_trials(study, [5.0, 9.0, 8.0])
    (key,) = changed.get("overrides", changed)
    with pytest.raises(ValueError, match=f"study 'small' is not this search: it was started with {key}="):
        cross_validation.make_matrix(load_config(config.path, **changed), study, tmp_path)


def test_finalists_that_the_surrogate_rates_highest() -> None:
    rng = np.random.default_rng(0)
    losses = list(dict.fromkeys(random_loss(rng, 3).canonical() for _ in range(40)))
    scores = [100.0 * len(loss.target_tokens) + 100 * rng.normal() for loss in losses]
    study = optuna.create_study(direction="maximize")
    for loss, score in zip(losses, scores, strict=True):
        study.add_trial(create_trial(params=loss_to_params(loss), distributions=distributions(loss.horizon, 3), value=score))
    model = TokenModel(3)
    model.add(losses, scores)
    ratings = model.posterior(losses)[0]
    by_score = np.argsort(scores)[::-1]
    others = sorted(by_score[4:], key=lambda index: -ratings[index])
    assert cross_validation.top_losses(study, 4, 3) == [losses[i] for i in (*by_score[:4], *others[:3])]


def test_a_ranking_is_of_the_means_over_environments_with_intervals(tmp_path: Path) -> None:
    rows = [(str(LOSSES[0]), *cell) for cell in [("x", 0, 99.0), ("x", 1, 101.0), ("y", 0, 899.0), ("y", 1, 905.0)]]
    rows += [(str(LOSSES[1]), environment, seed, 0.0) for _, environment, seed, _ in rows]
    rows += [("failed", "x", 0, 999.0), ("failed", "y", 0, math.nan), ("one environment", "x", 0, 999.0)]
    table = cross_validation.ranking(pd.DataFrame(rows, columns=["variant", "environment", "seed", "score"]))
    assert list(table.index) == [str(loss) for loss in LOSSES[:2]]
    row, expected = table.iloc[0], standings(np.array([[0.0, 0.0], [499.0, 503.0]]))
    assert (row["x"], row["y"], row["runs"]) == (100.0, 902.0, 4)
    assert [row[name] for name in expected._fields] == [values[1] for values in expected]
    assert cross_validation.write_winner(table, tmp_path / "winner.yml") == LOSSES[0]
    assert catalog.resolve(tmp_path / "winner.yml") == LOSSES[0]


def test_new_seeds_go_to_those_that_could_still_be_the_best(config: SearchConfig, tmp_path: Path, executor: Planted) -> None:
    config = load_config(config.path, seeds=[4])
    losses = [AuxLoss.parse(f"{{s_t}} -> {{{target}}}") for target in ("s_t+1", "s_t, a_t", "r_t", "a_t", "s_t")]
    study = Search(config, storage=InMemoryStorage()).study
    for loss in losses:
        study.add_trial(create_trial(params=loss_to_params(loss), distributions=distributions(loss.horizon, 3), value=1.0))
    executor.scores = dict(zip(map(str, losses), (100.0, 101.0, 0.0, 999.0, math.nan), strict=True))
    executor.fails = lambda run: run.aux_loss == str(losses[3]) and run.environment != "Pendulum-v1"
    section = {"environments": ["Pendulum-v1", "MountainCarContinuous-v0"], "seeds": [1, 2], "top": 5, "budget": 14}
    raced = load_config(config.path, seeds=[4], cross_validation=section)
    matrix = cross_validation.make_matrix(raced, study, tmp_path, baselines=config.baselines[:1])
    for part in cross_validation.rounds(raced, matrix):
        list(run_matrix(part, executor))
        if len(executor.runs) > 25:  # it is killed, and started again
            break
    for part in cross_validation.rounds(raced, matrix):
        list(run_matrix(part, executor))
    assert 3 in {cell.seed for cell in matrix.runs} and 4 not in {cell.seed for cell in matrix.runs}  # the search's
    table = cross_validation.ranking(scores(matrix))
    # Both seeds on both environments; the rest of the budget, which is two environments each, is of the best two.
    runs = table["runs"].to_dict()
    assert runs[str(losses[2])] == runs["CURL"] == 4 and not runs.keys() & {*map(str, losses[3:])}
    assert runs[str(losses[0])] > 6 and runs[str(losses[1])] > 6
    assert sum(runs.values()) - runs["CURL"] == 2 * 14
    assert table["p_best"].nlargest(2).sum() > 0.99
    planned = [run for kind, some in planned_runs(raced).items() if kind.startswith("cross-validation") for run in some]
    assert len(planned) == 2 * 14 + 2 * 2 * 2
