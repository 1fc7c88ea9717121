"""Lists of runs as studies: what a second program does, and what an older configuration left."""

import itertools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import optuna
import pandas as pd
import pytest
from optuna.trial import TrialState
from optuna_dashboard._note import get_note_from_system_attrs

from sb3_aarl import catalog
from search.execution import driver as evolve
from search.execution import local as pool
from search.execution import matrix as grid
from search.execution import workers
from search.execution.local import WorkerError
from search.execution.storage import load_study, open_storage
from search.studies import cross_validation, objective, operator_selection
from search.training import run as training
from search.training.config import CrossValidation, SearchConfig

HYPERPARAMETERS = Path(__file__).parent.parent / "zoo_configs" / "demo.yml"
CONFIG = SearchConfig(Path("some.yml"), "dm_control/cartpole-balance-v0", HYPERPARAMETERS, (400, 800))
GRID = grid.Grid("some-grid", CONFIG, {"SAC": grid.Variant(None)}, [CONFIG.environment], [0])


def make_study(folder: Path) -> optuna.Study:
    return optuna.create_study(study_name=GRID.name, storage=open_storage(folder), direction="maximize")


def finished(cell: grid.Cell, value: float) -> optuna.trial.FrozenTrial:
    curve = [[400, value, 0.0], [800, 2 * value, 0.0]]
    return optuna.trial.create_trial(value=value, user_attrs={**cell._asdict(), "curve": curve})


class NoPool:
    """Workers that find nothing to do."""

    def __init__(self, *arguments: object):
        pass

    def __enter__(self) -> "NoPool":
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def check(self, progressed: bool) -> bool:
        return False


class SameProcess(NoPool):
    """Works while it begins."""

    def __init__(self, worker: Callable[..., None], arguments: tuple[Any, ...], *others: object):
        worker(*arguments)


class Stub:
    """An objective that costs nothing."""

    def __init__(self, *arguments: object):
        pass

    def train(self, trial: optuna.Trial, *arguments: object) -> float:
        trial.set_user_attr("curve", [[400, 1.0, 0.0]])
        return 1.0


def test_runs_that_another_program_has_are_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.1)
    study = make_study(tmp_path)
    (cell,) = GRID.cells
    study.enqueue_trial({}, user_attrs=cell._asdict())
    other = study.ask()
    other.set_user_attr(workers.WORKER_KEY, workers.identity())  # alive
    monkeypatch.setattr(grid, "WorkerPool", NoPool)
    counts = []
    for count in grid.run(GRID, tmp_path, str(tmp_path)):
        counts.append(count)
        if len(counts) == 5:
            study.tell(other, 7.0)
    assert counts == [*[(0, 0)] * 5, (1, 0)]  # waits, and trains nothing a second time
    assert len(study.trials) == 1


def test_the_run_of_a_worker_that_died_before_it_gave_its_name_is_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "UNNAMED_SECONDS", 0.5)
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.1)
    monkeypatch.setattr(grid, "WorkerPool", SameProcess)
    monkeypatch.setattr(grid, "Objective", Stub)
    study = make_study(tmp_path)
    (cell,) = GRID.cells
    study.enqueue_trial({}, user_attrs=cell._asdict())
    study.ask()  # all that it did
    assert list(grid.run(GRID, tmp_path, str(tmp_path)))[-1] == (1, 1)
    assert [trial.state for trial in study.trials] == [TrialState.FAIL, TrialState.COMPLETE]


def test_a_run_that_two_programs_enqueued_at_the_same_moment_is_trained_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.1)
    monkeypatch.setattr(grid, "WorkerPool", SameProcess)
    monkeypatch.setattr(grid, "Objective", Stub)
    study = make_study(tmp_path)
    two = replace(GRID, seeds=[0, 1])
    for cell in two.cells * 2:
        study.enqueue_trial({}, user_attrs=cell._asdict())
    other = study.ask()
    other.set_user_attr(workers.WORKER_KEY, workers.identity())
    for finished, _ in grid.run(two, tmp_path, str(tmp_path)):
        if finished == 1:  # the other program still has its run
            other.set_user_attr("curve", [[400, 1.0, 0.0]])
            study.tell(other, 1.0)
    states = [trial.state for trial in study.trials]
    assert states == [TrialState.COMPLETE] * 2 + [TrialState.PRUNED] * 2


def test_runs_that_keep_failing_are_given_up_with_the_last_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grid, "WorkerPool", SameProcess)
    monkeypatch.setattr(grid, "Objective", Stub)
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.0)
    study = make_study(tmp_path)
    for number in range(grid.MAX_TRIES):
        attributes = {**GRID.cells[0]._asdict(), "reason": f"reason {number}"}
        study.add_trial(optuna.trial.create_trial(state=TrialState.FAIL, user_attrs=attributes))
    two = replace(GRID, seeds=[0, 1])
    assert list(grid.run(two, tmp_path, str(tmp_path)))[-1] == (1, 3)  # the other one is trained
    assert grid.given_up(study, two.cells) == {GRID.cells[0]: "reason 2"}
    assert grid.given_up(study, [two.cells[1]]) == {}


def test_deaths_of_workers_are_not_the_runs_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It goes on from its checkpoint each time; but what kills every worker ends somewhere."""
    monkeypatch.setattr(grid, "WorkerPool", SameProcess)
    monkeypatch.setattr(grid, "Objective", Stub)
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.0)
    study = make_study(tmp_path)
    dead = optuna.trial.create_trial(
        state=TrialState.FAIL, user_attrs=GRID.cells[0]._asdict() | {"reason": "its worker died", workers.DIED_KEY: True}
    )
    study.add_trials([dead] * (grid.MAX_DEATHS - 1))
    assert list(grid.run(GRID, tmp_path, str(tmp_path)))[-1] == (1, grid.MAX_DEATHS - 1)
    other = replace(GRID, name="other")
    study = optuna.create_study(study_name="other", storage=open_storage(tmp_path), direction="maximize")
    study.add_trials([dead] * grid.MAX_DEATHS)
    assert list(grid.run(other, tmp_path, str(tmp_path)))[-1] == (0, grid.MAX_DEATHS)
    assert grid.given_up(study, GRID.cells) == {GRID.cells[0]: "its worker died"}


def test_a_worker_that_slept_while_another_program_failed_its_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Sleeper(Stub):
        slept = 0

        def train(self, trial: optuna.Trial, *arguments: object) -> float:
            value = super().train(trial)
            if not Sleeper.slept:
                Sleeper.slept += 1
                workers.fail(trial.study, trial.study.trials[trial.number], "no sign of life")
            return value

    monkeypatch.setattr(grid, "WorkerPool", SameProcess)
    monkeypatch.setattr(grid, "Objective", Sleeper)
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.0)
    two = replace(GRID, seeds=[0, 1])
    assert list(grid.run(two, tmp_path, str(tmp_path)))[-1] == (2, 1)
    states = Counter(trial.state for trial in load_study(open_storage(tmp_path), GRID.name).trials)
    assert states == {TrialState.FAIL: 1, TrialState.COMPLETE: 2}


def test_notes_say_what_was_trained_on_which_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grid, "WorkerPool", SameProcess)
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.0)
    curl, hyper = catalog.load("curl"), {"learning_starts": 10, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    own = replace(GRID, config=replace(CONFIG, evaluation_episodes=1, overrides=hyper))
    variants = {"CURL": grid.Variant(curl), "SAC": grid.Variant(None), "diverges": grid.Variant(None, {"learning_rate": 1e30})}
    list(grid.run(replace(own, variants=variants), tmp_path, str(tmp_path)))
    study = load_study(open_storage(tmp_path), GRID.name)
    outcomes = Counter((trial.user_attrs["variant"], trial.state) for trial in study.trials)
    assert outcomes == {
        ("CURL", TrialState.COMPLETE): 1,
        ("SAC", TrialState.COMPLETE): 1,
        ("diverges", TrialState.FAIL): grid.MAX_TRIES,
    }
    attrs = study._storage.get_study_system_attrs(study._study_id)
    note = get_note_from_system_attrs(attrs, None)["body"]
    assert "Trainings: some\\-grid" in note and "CURL\\, SAC" in note and "learning\\_starts" in note and "commit" in note
    for trial in study.trials:
        note = get_note_from_system_attrs(attrs, trial._trial_id)["body"]
        variant = trial.user_attrs["variant"]
        assert f"**Variant:** {variant}. **Environment:** dm\\_control\\/cartpole\\-balance\\-v0. **Seed:** 0." in note
        if variant == "CURL":
            assert f"Notation: `{curl}`" in note and "latex" in note
        if trial.state == TrialState.COMPLETE:
            assert f"**Score:** {trial.value:.2f}" in note and "| 800 |" in note and "![Learning curve]" in note
        else:
            assert "**State:** fail" in note and "**Reason:**" in note
        assert ("No auxiliary loss." in note) == (variant != "CURL")
    assert len(list((tmp_path / "artifacts").iterdir())) >= 2


def test_variants_are_compared_that_have_all_runs_that_any_has() -> None:
    cells = [*itertools.product(("all", "also all"), ("a", "b"), (0, 1)), ("some", "a", 0), ("some", "a", 1), ("some", "b", 1)]
    runs = pd.DataFrame(cells, columns=["variant", "environment", "seed"])
    assert grid.comparable(runs).equals(runs[:8])
    assert grid.comparable(runs[8:]).equals(runs[8:])
    assert grid.comparable(runs[6:]).empty  # each lacks one of the other
    assert grid.comparable(runs[:0]).empty


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        # Mean of both -600, -200: each divided by that, its sign kept. Sample deviations of two numbers.
        ({"a": [-300.0, -100.0], "b": [-900.0, -300.0]}, {"a": (-0.5, 0.0), "b": (-1.5, 0.0)}),
        # 200 and -600: a is 0.5 and -0.5, b 1.5 and -1.5.
        ({"a": [100.0, -300.0], "b": [300.0, -900.0]}, {"a": (0.0, 0.5 * 2**0.5), "b": (0.0, 1.5 * 2**0.5)}),
        ({"a": [100.0, 30.0], "b": [300.0, 90.0]}, {"b": (1.0, 0.0), "a": (1 / 3, 0.0)}),
        ({"a": [0.0, 0.0], "b": [0.0, 0.0]}, {"a": (0.0, 0.0), "b": (0.0, 0.0)}),
    ],
    ids=["negative", "both signs", "positive", "zero"],
)
def test_normalized_returns_rank_the_higher_one_first(
    returns: dict[str, list[float]], expected: dict[str, tuple[float, float]]
) -> None:
    rows = [(variant, task, last) for variant, of in returns.items() for task, last in zip("xy", of, strict=True)]
    table = operator_selection.table(pd.DataFrame(rows, columns=["variant", "environment", "last"]))
    assert list(table.index) == list(expected)
    for variant, numbers in expected.items():
        assert tuple(table.loc[variant, ["mean", "std"]]) == pytest.approx(numbers)


def test_a_ranking_deviates_over_seeds_not_over_environments() -> None:
    scores = {("x", 0): 99.0, ("x", 1): 101.0, ("y", 0): 899.0, ("y", 1): 905.0}
    rows = [("a", environment, seed, score) for (environment, seed), score in scores.items()]
    table = cross_validation.ranking(pd.DataFrame(rows, columns=["variant", "environment", "seed", "score"]))
    row = table.loc["a"]
    assert (row["x"], row["y"], row["mean"], row["runs"]) == (100.0, 902.0, 501.0, 4)
    assert row["std"] == pytest.approx(np.std([499.0, 503.0], ddof=1))


def test_scores_are_those_of_the_runs_asked_for(tmp_path: Path) -> None:
    study = make_study(tmp_path)
    (cell,) = GRID.cells
    for other in (cell, cell._replace(seed=9), cell._replace(environment="gone"), cell._replace(variant="renamed")):
        study.add_trial(finished(other, 5.0))
    study.add_trial(finished(cell, 6.0))  # two programs trained it
    scores = grid.scores(study, GRID.cells)
    assert scores.to_dict("records") == [{**cell._asdict(), "score": 5.0, "last": 10.0}]


def test_what_an_interrupted_grid_left_is_passed_over_until_it_is_asked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grid, "WorkerPool", SameProcess)
    monkeypatch.setattr(grid, "Objective", Stub)
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.0)
    study = make_study(tmp_path)
    larger = replace(GRID, variants={**GRID.variants, "more": grid.Variant(None)})
    for cell in larger.cells:
        study.enqueue_trial({}, user_attrs=cell._asdict())
    for asked_for in (GRID, larger):
        assert list(grid.run(asked_for, tmp_path, str(tmp_path)))[-1] == (len(asked_for.cells), 0)
        assert len(grid.scores(study, asked_for.cells)) == len(asked_for.cells)
    assert sum(trial.state == TrialState.COMPLETE for trial in study.trials) == 2


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"environment": "dm_control/cartpole-swingup-v0"}, "environment"),
        ({"checkpoints": (800, 1600)}, "checkpoints"),
        ({"evaluation_episodes": 3}, "evaluation_episodes"),
        ({"seeds": (1,)}, "seeds"),
        ({"overrides": {"batch_size": 16}}, "batch_size"),
    ],
    ids=str,
)
def test_a_search_that_trains_otherwise_is_another_one(tmp_path: Path, changed: dict, name: str) -> None:
    (tmp_path / "hyperparameters.yml").write_text("default: {batch_size: 8, policy_kwargs: {net_arch: [8]}}\n")
    values = {**vars(CONFIG), "hyperparameters": tmp_path / "hyperparameters.yml"}
    for accepted in ({}, {"stages": 9}, {"stages": 9, "overrides": {"device": "cpu"}}):
        next(evolve.search(SearchConfig(**{**values, **accepted}), tmp_path, str(tmp_path), None))
    with pytest.raises(ValueError, match=f"'some' was begun with {name}=.* no score yet: delete it"):
        next(evolve.search(SearchConfig(**{**values, **changed}), tmp_path, str(tmp_path), None))
    assert load_study(open_storage(tmp_path), "some").user_attrs[grid.TRAINING_KEY]["candidates"]["batch_size"] == 8


OTHER = "dm_control/reacher-easy-v0"


def with_checkpoints(*checkpoints: int) -> SearchConfig:
    """The search, whose cross-validation on the other environment is evaluated there."""
    return replace(CONFIG, cross_validation=CrossValidation((CONFIG.environment, OTHER), checkpoints={OTHER: checkpoints}))


@dataclass(frozen=True)
class Broken:
    """Runs on a machine whose GPU is broken."""

    name = "broken"
    cells = (grid.Cell("SAC", "Pendulum-v1", 0), grid.Cell("SAC", "Pendulum-v1", 1), grid.Cell("SAC", "Pendulum-v1", 2))
    trainings: ClassVar[dict[str, Any]] = {}

    def train(self, trial: optuna.Trial, cell: grid.Cell, folder: Path) -> float:
        with objective.end_noted(trial):
            raise training.DeviceError("the GPU failed: CUDA error")


def test_a_broken_gpu_does_not_use_up_the_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "MAX_DEATHS", 1)
    with pytest.raises(WorkerError, match=r"2 workers died one after the other \(the GPU failed: CUDA error\)"):
        list(grid.run(Broken(), tmp_path, str(tmp_path)))
    states = [trial.state for trial in load_study(open_storage(tmp_path), "broken").trials]
    assert states == [TrialState.FAIL, TrialState.FAIL, TrialState.WAITING]


@pytest.mark.parametrize("value", ["yesterday", {"candidates": "all of them"}])
def test_a_study_of_another_program_is_no_grid(value: Any, tmp_path: Path) -> None:
    study = optuna.create_study(study_name=GRID.name, storage=open_storage(tmp_path), direction="maximize")
    study.set_user_attr(grid.TRAINING_KEY, value)
    with pytest.raises(ValueError, match="'some-grid' is not of this program"):
        next(grid.run(GRID, tmp_path, str(tmp_path)))
    assert study.user_attrs[grid.TRAINING_KEY] == value


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"variants": {"SAC": grid.Variant(None, {"gamma": 0.9})}}, r"gamma=default, not 0\.9 \(SAC\)"),
        ({"variants": {"CURL": grid.Variant(catalog.load("curl"), {"gamma": 0.5})}}, r"gamma=0\.9, not 0\.5 \(CURL\)"),
        ({"variants": {"CURL": grid.Variant(None, {"gamma": 0.9})}}, r"aux_loss=.*, not None \(CURL\)"),
        ({"variants": {"CURL": grid.Variant(catalog.load("curl"))}}, r"gamma=0\.9, not default \(CURL\)"),
        ({"config": with_checkpoints(400, 1600)}, rf"checkpoints=\[400, 1200\], not \[400, 1600\] \({OTHER}\)"),
        ({"config": replace(CONFIG, evaluation_episodes=3)}, "evaluation_episodes=10, not 3"),
        ({"config": replace(CONFIG, overrides={"batch_size": 16})}, "batch_size=64, not 16"),
    ],
)
def test_a_grid_whose_runs_were_trained_otherwise_is_another_one(tmp_path: Path, changed: dict, name: str) -> None:
    variants = {"SAC": grid.Variant(None), "CURL": grid.Variant(catalog.load("curl"), {"gamma": 0.9})}
    begun = replace(GRID, config=with_checkpoints(400, 1200), variants=variants, environments=[CONFIG.environment, OTHER])
    grown = replace(
        begun, variants={**variants, "more": grid.Variant(None)}, environments=[OTHER, "Pendulum-v1"], seeds=[0, 1]
    )
    for accepted in (replace(begun, environments=[OTHER]), begun, grown, replace(GRID, config=begun.config)):
        next(grid.run(accepted, tmp_path, str(tmp_path)))
    with pytest.raises(ValueError, match=f"'some-grid' was begun with {name}"):
        next(grid.run(replace(begun, **changed), tmp_path, str(tmp_path)))
