"""The search for real: the program aarl, worker processes, trainings on dm_control, SIGKILL and Ctrl-C."""

import json
import os
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import optuna
import pytest
import yaml
from optuna.trial import TrialState
from optuna_dashboard._custom_plot_data import get_plotly_graph_objects
from program import aarl, start
from typer.testing import CliRunner

from sb3_aarl import AuxLoss
from search.cli.main import app
from search.evolution.space import params_to_loss
from search.execution.storage import open_storage

HYPERPARAMETERS = """
default:
  env_kwargs: {action_repeat: 8}
  learning_starts: 20
  batch_size: 8
  predictor_width: 8
  policy_kwargs: {net_arch: [8], features_extractor_kwargs: {features_dim: 8, width: 8}}
"""
SEARCH = """
environment: dm_control/cartpole-balance-v0
hyperparameters: hyperparameters.yml
checkpoints: [400, 800]
evaluation_episodes: 1
stages: 2
n_random: 3
n_prior: 1
population_size: 4
parents: 0.5
max_horizon: 3
seed: 3
cross_validation:
  environments: [dm_control/cartpole-balance-v0, dm_control/reacher-easy-v0]
  seeds: [0, 1]
  top: 2
operator_selection:
  environments: [dm_control/cartpole-balance-v0]
  seeds: [0]
baselines:
- {name: CURL, aux_loss: curl}
- {name: SAC}
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    (tmp_path / "hyperparameters.yml").write_text(HYPERPARAMETERS)
    path = tmp_path / "small.yml"
    path.write_text(SEARCH)
    return path


def trials(folder: Path, study: str = "small") -> list[optuna.trial.FrozenTrial]:
    storage = open_storage(folder / "runs/small", create=False)
    if study not in optuna.get_all_study_names(storage):
        return []
    return optuna.load_study(study_name=study, storage=storage).get_trials(deepcopy=False)


def wait_for(folder: Path, process: subprocess.Popen[str], finished: int) -> None:
    """Until so many candidates are complete and others are being trained."""
    for _ in range(600):
        time.sleep(0.1)
        assert process.poll() is None, process.communicate()[0]
        if (folder / "runs/small/journal.log").exists():
            states = Counter(trial.state for trial in trials(folder))
            if states[TrialState.COMPLETE] >= finished and states[TrialState.RUNNING]:
                return
    raise AssertionError("the search made no progress")


def places(folder: Path) -> dict[tuple[int, int], tuple[AuxLoss, float | None]]:
    """The loss and the score of every filled place; each is filled once."""
    complete = [trial for trial in trials(folder) if trial.state == TrialState.COMPLETE]
    filled = {(t.user_attrs["stage"], t.user_attrs["place"]): (params_to_loss(t.params), t.value) for t in complete}
    assert len(filled) == len(complete)
    return filled


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    """Numbers of the worker processes (multiprocessing's own helper beside them is none)."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(pid) for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def test_search_survives_kill_and_interrupt_and_ends_as_if_nothing_had_been(config: Path, tmp_path: Path) -> None:
    undisturbed = tmp_path / "undisturbed"
    undisturbed.mkdir()
    aarl("search", config, "--threads", 1, folder=undisturbed)

    process = start("search", config, "--workers", 2, "--threads", 1, folder=tmp_path)
    wait_for(tmp_path, process, finished=1)
    os.kill(workers_of(process)[0], signal.SIGKILL)  # one worker: the program starts another one
    wait_for(tmp_path, process, finished=2)
    os.killpg(process.pid, signal.SIGKILL)  # everything
    process.communicate()

    process = start("search", config, "--workers", 2, "--threads", 1, folder=tmp_path)
    wait_for(tmp_path, process, finished=5)
    os.killpg(process.pid, signal.SIGINT)  # Ctrl-C
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130 and "Interrupted" in output and "Traceback" not in output, output

    output = aarl("search", config, "--workers", 2, "--threads", 1, folder=tmp_path)
    assert "stage 1: 4/4 done" in output and "stage 2: 4/4 done" in output
    assert places(tmp_path).keys() == {(stage, place) for stage in (1, 2) for place in range(4)}
    # Losses and scores, to the bit: trainings that went on from a checkpoint are those that were not disturbed.
    assert places(tmp_path) == places(undisturbed)
    for trial in trials(tmp_path):
        assert trial.state in (TrialState.COMPLETE, TrialState.FAIL)
        if trial.state == TrialState.COMPLETE:
            curve = trial.user_attrs["curve"]
            assert [point[0] for point in curve] == [400, 800]
            assert trial.intermediate_values == {point[0]: point[1] for point in curve}
            assert trial.value == pytest.approx(sum(point[1] for point in curve) / 2)
    # Checkpoints with their replay buffers are gone, curves are there.
    assert not list((tmp_path / "runs").rglob("replay_buffer.pkl"))
    assert len(list((tmp_path / "runs/small/candidates").rglob("curve.csv"))) == 8


def test_the_other_procedures_on_a_finished_search(config: Path, tmp_path: Path) -> None:
    aarl("search", config, "--workers", 2, folder=tmp_path)

    assert "CURL" in aarl("baselines", config, "--workers", 2, folder=tmp_path)
    scores = {trial.user_attrs["variant"]: trial.value for trial in trials(tmp_path, "small-baselines")}
    assert scores.keys() == {"CURL", "SAC"}
    # They are in the plot of the search although it was over before.
    study = optuna.load_study(study_name="small", storage=open_storage(tmp_path / "runs/small"))
    plots = get_plotly_graph_objects(study._storage.get_study_system_attrs(study._study_id))
    assert all(name in plots["evolution"] for name in scores)

    output = aarl("cross-validate", config, "--study", "small", "--top", 2, "--workers", 2, folder=tmp_path)
    runs = trials(tmp_path, "small-cross-validation")
    cells = Counter((t.user_attrs["variant"], t.user_attrs["environment"], t.user_attrs["seed"]) for t in runs)
    assert len(cells) == 2 * 2 * 2 and set(cells.values()) == {1}
    ranked = sorted(trials(tmp_path), key=lambda trial: -trial.value)
    assert {variant for variant, _, _ in cells} == {str(params_to_loss(t.params).canonical()) for t in ranked[:2]}
    means = {variant: sum(t.value for t in runs if t.user_attrs["variant"] == variant) / 4 for variant, _, _ in cells}
    winner = max(means, key=lambda variant: means[variant])
    assert f"Winner: {winner}" in output
    written = yaml.safe_load((tmp_path / "runs/small/winner.yml").read_text())
    assert AuxLoss.from_dict(written["aux_loss"]) == AuxLoss.parse(winner)

    out = tmp_path / "trained"
    hyperparameters = tmp_path / "hyperparameters.yml"
    winner_file = tmp_path / "runs/small/winner.yml"
    aarl(
        *("train", "cartpole-balance", "--config", hyperparameters, "--aux-loss", winner_file),
        *("--steps", 800, "--evaluations", 1, "--episodes", 1, "--out", out),
        folder=tmp_path,
    )
    assert json.loads((out / "run.json").read_text())["loss"] == winner and (out / "model.zip").exists()

    aarl("report", "runs/small", "--config", config, folder=tmp_path)
    report = (tmp_path / "runs/small/report.html").read_text()
    assert "CURL" in report and str(params_to_loss(ranked[0].params)).replace(">", "&gt;") in report

    output = aarl("select-operator", config, "--workers", 2, folder=tmp_path)
    runs = trials(tmp_path, "small-operators")
    assert len({trial.user_attrs["variant"] for trial in runs}) == len(runs) == 10
    best = max(runs, key=lambda trial: trial.user_attrs["curve"][-1][1])
    first = next(line for line in output.splitlines() if "negative samples" in line)
    assert best.user_attrs["variant"] in first and "1.000" in first


def test_unusable_input_is_one_line(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    aarl("search", config, "--stages", 1, folder=tmp_path)
    config.write_text(config.read_text().replace("population_size: 4", "population_size: 6"))
    (tmp_path / "runs/other").mkdir()
    (tmp_path / "runs/other/journal.log").touch()
    for arguments, culprit in (
        (("search", config), "population_size"),
        (("cross-validate", config, "--study", "smal"), "'smal'"),
        (("cross-validate", config, "--folder", "elsewhere"), "elsewhere"),
        (("report", "elsewhere"), "elsewhere"),
        (("report",), "runs/other, runs/small"),
        (("search", tmp_path / "missing.yml"), "missing.yml"),
        (("search", config, "--storage", "postgresql://me:secret@127.0.0.1:1/nothing"), "me:***"),
    ):
        result = CliRunner(env={"COLUMNS": "200"}).invoke(app, [*map(str, arguments)])
        assert result.exit_code == 2 and culprit in result.output and "secret" not in result.output, result.output
        assert len(result.output.strip().splitlines()) <= 2 and "Traceback" not in result.output, result.output
    assert not (tmp_path / "elsewhere").exists()
