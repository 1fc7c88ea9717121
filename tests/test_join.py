"""Workers that join a search: all they need is in its storage."""

import contextlib
import signal
import threading
from dataclasses import replace
from pathlib import Path

import optuna
import pytest
from optuna.trial import FrozenTrial, TrialState
from optuna_dashboard._note import get_note_from_system_attrs
from program import aarl, start
from typer.testing import CliRunner

from search.cli.main import app
from search.evolution.sampler import AuxLossSampler
from search.evolution.space import params_to_loss, suggest_aux_loss
from search.execution import driver as evolve
from search.execution import workers
from search.studies.config import Baseline, SearchConfig, load_config

CONFIGS = sorted((Path(__file__).parent.parent / "zoo_configs" / "search").glob("*.yml"))
TINY = """\
environment: Pendulum-v1
hyperparameters: own.yml
checkpoints: [40, 80]
evaluation_episodes: 1
stages: 2
n_random: 3
n_prior: 1
population_size: 4
parents: 0.5
max_horizon: 2
"""
HYPERPARAMETERS = """\
default:
  policy: MlpPolicy
  n_timesteps: 80
  learning_starts: 20
  batch_size: 8
  policy_kwargs: {net_arch: [8], features_extractor_class: mlp, features_extractor_kwargs: {features_dim: 4}}
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A search of seconds."""
    (tmp_path / "own.yml").write_text(HYPERPARAMETERS)
    (tmp_path / "tiny.yml").write_text(TINY)
    return tmp_path / "tiny.yml"


def complete(where: str) -> list[tuple[int, int]]:
    """Stage and place of the trials that are complete."""
    study = optuna.load_study(study_name="tiny", storage=evolve.open_storage(where, create=False))
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return sorted((trial.user_attrs["stage"], trial.user_attrs["place"]) for trial in trials)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_configuration_comes_back_from_a_study_as_it_was(path: Path, tmp_path: Path) -> None:
    # Texts that look like numbers, to one version of YAML or the other.
    named = [Baseline(name, None, {"ent_coef": name}) for name in ("1e-4", "3E5", "1.5", "0x1")]
    config = replace(load_config(path), stages=3, pruner="median", baselines=tuple(named))
    study = optuna.create_study(study_name=config.name)
    evolve.keep_config(study, config)
    stored = evolve.stored_config(study, tmp_path)

    def without_paths(config: SearchConfig) -> SearchConfig:
        return replace(config, path=Path(), hyperparameters=Path())

    assert without_paths(stored) == without_paths(config)
    assert stored.name == config.name
    environments = [config.environment, *(config.cross_validation.environments if config.cross_validation else ())]
    for environment in environments:
        assert stored.hyperparameters_for(environment) == config.hyperparameters_for(environment)


@pytest.mark.parametrize(
    ("texts", "problem"),
    [
        (None, "begin it"),
        ("environment: Pendulum-v1", "another kind"),
        ({"../evil.yml": "", "x-hyperparameters.yml": ""}, "another kind"),
        ({"x.yml": 1, "x-hyperparameters.yml": ""}, "another kind"),
        ({"x.yml": "!!python/object/apply:os.system [touch evil]", "x-hyperparameters.yml": ""}, "not YAML of plain values"),
        ({"x.yml": "environmen: Pendulum-v1", "x-hyperparameters.yml": ""}, "nearest known key: 'environment'"),
    ],
    ids=["none", "text", "name", "number", "code", "key"],
)
def test_what_a_foreign_study_says_is_refused(
    texts: object, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    study = optuna.create_study(study_name="x")
    if texts is not None:
        study.set_user_attr(evolve.CONFIG_KEY, texts)
    with pytest.raises(ValueError, match=problem):
        evolve.stored_config(study, tmp_path / "folder")
    assert not list(tmp_path.rglob("*evil*"))


def test_a_study_whose_name_is_a_path_writes_nothing_elsewhere(tmp_path: Path) -> None:
    study = optuna.create_study(study_name="../evil")
    study.set_user_attr(evolve.CONFIG_KEY, {"../evil.yml": TINY, "../evil-hyperparameters.yml": HYPERPARAMETERS})
    with pytest.raises(ValueError, match="another kind"):
        evolve.stored_config(study, tmp_path / "folder")
    assert not list(tmp_path.rglob("*evil*"))


def test_a_study_called_like_the_folder_above_writes_nothing_there(tmp_path: Path) -> None:
    study = optuna.create_study(study_name="..")
    study.set_user_attr(evolve.CONFIG_KEY, {"...yml": TINY, "..-hyperparameters.yml": HYPERPARAMETERS})
    with pytest.raises(ValueError, match="another kind"):
        evolve.stored_config(study, tmp_path / "runs" / "..")
    assert not list(tmp_path.iterdir())


def test_a_worker_waits_for_the_configuration_of_a_study_that_is_being_begun(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = str(tmp_path / "run")
    study = optuna.create_study(study_name="tiny", storage=evolve.open_storage(where), direction="maximize")
    monkeypatch.setattr(evolve, "WAIT_SECONDS", 0.2)
    begun = threading.Timer(1.0, evolve.keep_config, (study, load_config(config)))
    begun.start()
    progress = next(evolve.join(where, "tiny", tmp_path / "elsewhere", lambda *_: contextlib.nullcontext(), wait=30))
    assert [stage.places for stage in progress.stages] == [4, 4]
    begun.join()
    empty = str(tmp_path / "empty")
    optuna.create_study(study_name="tiny", storage=evolve.open_storage(empty), direction="maximize")
    with pytest.raises(ValueError, match="has no configuration"):
        next(evolve.join(empty, "tiny", tmp_path / "elsewhere", lambda *_: contextlib.nullcontext(), wait=0.5))


def test_workers_need_nothing_but_the_storage(config: Path, tmp_path: Path) -> None:
    where = f"sqlite:///{tmp_path / 'study.db'}"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    watching = start("search", config, "--storage", where, "--workers", 0, folder=tmp_path)
    for line in watching.stdout or ():
        if "stage 1: 0/4 done" in line:
            break
    config.unlink()
    output = aarl("worker", "--storage", where, "--study", "tiny", "--workers", 2, "--threads", 1, folder=elsewhere)
    assert "stage 2: 4/4 done" in output
    output, _ = watching.communicate(timeout=60)
    assert watching.returncode == 0 and "stage 2: 4/4 done" in output, output
    assert complete(where) == [(stage, place) for stage in (1, 2) for place in range(4)]
    assert (elsewhere / "runs/tiny/candidates").is_dir() and not (tmp_path / "runs/tiny/candidates").exists()


def note_of(study: optuna.Study, trial: FrozenTrial) -> str:
    attrs = study._storage.get_study_system_attrs(study._study_id)
    return get_note_from_system_attrs(attrs, trial._trial_id)["body"]


def test_the_end_of_a_clusters_job_is_an_interruption(config: Path, tmp_path: Path) -> None:
    config.write_text(TINY.replace("[40, 80]", "[40, 4000]"))
    (tmp_path / "own.yml").write_text(HYPERPARAMETERS.replace("80", "4000"))
    process = start("search", config, "--threads", 1, folder=tmp_path)
    for line in process.stdout or ():
        if "1 running" in line:
            break
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130 and "Interrupted" in output and "Traceback" not in output, output
    study = optuna.load_study(study_name="tiny", storage=evolve.open_storage(tmp_path / "runs/tiny", create=False))
    (trial,) = study.trials
    assert trial.state == TrialState.FAIL and trial.user_attrs["interrupted"]
    note = note_of(study, trial)
    assert f"Notation: `{params_to_loss(trial.params)}`" in note and "**State:** fail" in note


def test_an_unknown_study_is_one_line(config: Path, tmp_path: Path) -> None:
    where = f"sqlite:///{tmp_path / 'study.db'}"
    optuna.create_study(study_name="other", storage=where)
    for name, problem in (("tiny", "no study 'tiny': the storage has other"), ("other", "no configuration")):
        result = CliRunner().invoke(app, ["worker", "--storage", where, "--study", name, "--folder", str(tmp_path)])
        assert result.exit_code == 2 and problem in " ".join(result.output.split()), result.output


def test_a_search_on_ray(config: Path, tmp_path: Path) -> None:
    output = aarl("search", config, "--launcher", "ray", "--workers", 2, "--cpus-per-trial", 0.5, folder=tmp_path)
    assert "stage 2: 4/4 done" in output
    assert complete(str(tmp_path / "runs/tiny")) == [(stage, place) for stage in (1, 2) for place in range(4)]


def test_a_worker_may_come_before_the_search(config: Path, tmp_path: Path) -> None:
    where = f"sqlite:///{tmp_path / 'study.db'}"
    worker = start("worker", "--storage", where, "--study", "tiny", "--threads", 1, "--wait", 100, folder=tmp_path)
    for line in worker.stdout or ():
        if "Waiting for the search" in line:
            break
    aarl("search", config, "--storage", where, "--workers", 0, folder=tmp_path)
    output, _ = worker.communicate(timeout=100)
    assert worker.returncode == 0 and "stage 2: 4/4 done" in output, output


def test_a_worker_that_died_before_it_had_a_name_keeps_no_place(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config.write_text(TINY.replace("stages: 2", "stages: 1"))
    study = optuna.create_study(study_name="tiny", direction="maximize", storage=evolve.open_storage(tmp_path / "runs/tiny"))
    evolve.keep_config(study, load_config(config))
    monkeypatch.setattr(workers, "UNNAMED_SECONDS", 5.0)
    sampler = AuxLossSampler(**load_config(config).sampler_settings())
    begun = optuna.load_study(study_name="tiny", storage=study._storage, sampler=sampler)
    begun.optimize(lambda trial: float(sum(suggest_aux_loss(trial, 2).target)), n_trials=3)
    study._storage.create_new_trial(study._study_id)  # by a worker that is killed at this moment
    evolve.run_worker("tiny", tmp_path / "runs/tiny", str(tmp_path / "runs/tiny"), 60)
    assert complete(str(tmp_path / "runs/tiny")) == [(1, place) for place in range(4)]
    (orphan,) = study.get_trials(states=(TrialState.FAIL,))
    assert orphan.user_attrs["reason"] == "its worker died"


def test_a_study_never_gets_fewer_stages(config: Path, tmp_path: Path) -> None:
    study = optuna.create_study(study_name="tiny")
    evolve.keep_config(study, load_config(config))
    with pytest.raises(ValueError, match="begun with 2 stages"):
        evolve.keep_config(study, replace(load_config(config), stages=1))
    evolve.keep_config(study, replace(load_config(config), stages=3))
    assert evolve.stored_config(study, tmp_path).stages == 3


def test_a_study_keeps_its_seed(config: Path, tmp_path: Path) -> None:
    study = optuna.create_study(study_name="tiny")
    for seed in (5, 6):  # no candidate is drawn yet
        evolve.keep_config(study, replace(load_config(config), seed=seed))
    study.ask()
    evolve.keep_config(study, replace(load_config(config), seed=6, stages=3))
    with pytest.raises(ValueError, match="begun with seed=6, which it keeps: not 5"):
        evolve.keep_config(study, replace(load_config(config), seed=5, stages=3))
    assert (evolve.stored_config(study, tmp_path).seed, evolve.stored_config(study, tmp_path).stages) == (6, 3)
