"""The program: train and losses, as a user calls them."""

import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from configparser import ConfigParser
from dataclasses import replace
from pathlib import Path
from typing import Any

import optuna
import pytest
import yaml
from optuna.storages import BaseStorage
from optuna.trial import TrialState
from rich.console import Console
from typer.testing import CliRunner

from sb3_aarl import AuxLoss, SACAux, catalog
from sb3_aarl.callbacks import read_curve
from search.cli.main import ZOO, _stages_table, app, main
from search.evolution.sampler import StageProgress
from search.evolution.space import distributions, loss_to_params
from search.execution import driver as evolve
from search.execution.matrix import MAX_TRIES, Cell, Grid
from search.execution.storage import open_storage
from search.studies.cross_validation import make_grid
from search.training import run as training
from search.studies.config import load_config
from search.training.provenance import read_about, write_about

ROOT = Path(__file__).parent.parent
HYPER = {
    "default": {
        "n_timesteps": 60,
        "env_kwargs": {"action_repeat": 40},
        "buffer_size": 1000,
        "learning_starts": 20,
        "batch_size": 8,
        "predictor_width": 8,
        "policy_kwargs": {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8, "width": 8}},
    }
}


runner = CliRunner(env={"COLUMNS": "200", "TERM": "dumb"})


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the program runs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hyper.yml").write_text(yaml.safe_dump(HYPER))
    return tmp_path


def test_train_shows_the_curve_and_says_where_the_model_is(folder: Path) -> None:
    options = ("--config", "hyper.yml", "--evaluations", "2", "--episodes", "1", "--seed", "4", "--out", "here")
    # As without the extra "search".
    program = "import sys; sys.modules |= dict.fromkeys(['optuna', 'pandas', 'sklearn']); "
    program += "from search.cli.main import main; main()"
    command = [
        sys.executable,
        "-c",
        program,
        "train",
        "cartpole-balance",
        "--aux-loss",
        "{s_t} -> {r_t, s_t+1}",
        *options,
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "TERM": "dumb"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr
    curve = read_curve(folder / "here" / "curve.csv")
    # 60 agent steps of 40 environment steps each.
    assert [point.environment_steps for point in curve] == [1200, 2400]
    for point in curve:
        assert re.search(rf"{point.environment_steps:,}\D+{point.mean:.1f}\D+{point.std:.1f}", result.stdout)
    assert f"AULC {(curve[0].mean + curve[1].mean) / 2:.1f}" in result.stdout
    assert "here/model.zip" in result.stdout and "here/curve.csv" in result.stdout
    model = SACAux.load(folder / "here" / "model.zip")
    assert model.aux_loss == AuxLoss.parse("{s_t} -> {r_t, s_t+1}")
    assert (model.seed, model.num_timesteps, model.batch_size) == (4, 60, 8)
    assert "60/60" in result.stdout + result.stderr  # the progress bar


def test_train_without_an_auxiliary_loss_into_a_folder_of_its_own(folder: Path) -> None:
    options = ["--config", "hyper.yml", "--steps", "400", "--evaluations", "1", "--episodes", "1"]
    result = runner.invoke(app, ["train", "dm_control/cartpole-balance-v0", "--aux-loss", "none", *options])
    assert result.exit_code == 0, result.stderr
    (model,) = Path("runs").glob("*/model.zip")
    assert str(model) in result.stdout and "finished before" not in result.stdout
    about = json.loads((model.parent / "provenance.json").read_text())
    assert (about["aux_loss"], about["evaluations"], len(about["sessions"])) == ("None", [400], 1)
    assert about["seconds"] > 0 and about["hyperparameters"]["batch_size"] == HYPER["default"]["batch_size"]
    assert {"commit", "command", "versions", "cpu"} <= about["sessions"][0].keys()
    again = runner.invoke(app, ["train", "dm_control/cartpole-balance-v0", "--aux-loss", "none", *options])
    assert again.exit_code == 0 and "finished before" in again.stdout
    assert json.loads((model.parent / "provenance.json").read_text()) == about
    assert SACAux.load(model).aux_loss is None
    assert model.parent.name.startswith("cartpole-balance")


def test_a_training_that_goes_on_names_both_its_sessions(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments: tuple[Any, ...] = ("cartpole-balance", None, "hyper.yml", 800, 2, 1, 0, "here")

    def interrupt(path: Path, about: dict[str, Any]) -> None:
        write_about(path, about)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training, "write_about", interrupt)
        with pytest.raises(KeyboardInterrupt):
            training.train_and_keep(*arguments)
    assert len(read_about(folder / "here")["sessions"]) == 1 and not (folder / "here" / "model.zip").exists()
    run, _, was_finished = training.train_and_keep(*arguments)
    about = read_about(folder / "here")
    assert len(about["sessions"]) == 2 and len(run.curve) == 2 and not was_finished
    # What SACAux has chosen itself stands beside the curve too.
    assert about["aux_loss"] == "auto" and about["sessions"][-1]["aux_loss"] == str(catalog.load("aarl-state"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cartpole-blance"], "nearest: cartpole-balance"),
        (["cartpole-balance", "--aux-loss", "curll"], "nearest: curl"),
        (["cartpole-balance", "--aux-loss", "{s_t} -> {q_t}"], "position 10"),
        (["cartpole-balance", "--steps", "100", "--evaluations", "5"], "too few"),
        (["cartpole-balance", "--config", "missing.yml"], "missing.yml: cannot be read"),
        (["cartpole-balance", "--steps", "many"], "--steps"),
        (["CartPole-v1", "--steps", "1000"], "CartPole-v1 has no continuous actions"),
    ],
    ids=["environment", "name", "notation", "steps", "file", "number", "actions"],
)
def test_errors_are_clear_and_exit_with_2(arguments: list[str], message: str) -> None:
    if "--config" not in arguments:
        arguments = [*arguments, "--config", "hyper.yml"]
    result = runner.invoke(app, ["train", *arguments])
    assert result.exit_code == 2
    assert message in result.stderr and "Traceback" not in result.stderr
    assert not Path("runs").exists()
    if message != "--steps":  # that one is typer's own box
        assert len(result.stderr.strip().splitlines()) == 1


def test_losses_lists_the_whole_catalogue() -> None:
    result = runner.invoke(app, ["losses"])
    assert result.exit_code == 0, result.stderr
    rows = [[cell.strip() for cell in line.split("│")[1:4]] for line in result.stdout.splitlines() if line.startswith("│")]
    table: dict[str, list[str]] = {}
    for name, notation, operator in rows:
        if name:
            table[name] = [notation, operator]
        else:  # a long notation goes on in the next line
            last = table[list(table)[-1]]
            last[0] += f" {notation}"
    assert list(table) == catalog.names()
    for name, (notation, operator) in table.items():
        loss = catalog.load(name)
        measure, _, negatives = operator.partition(", ")
        assert AuxLoss.parse(notation, measure, negatives == "negatives") == loss


def test_the_default_file_of_hyperparameters_is_there_and_belongs_to_what_is_installed() -> None:
    assert (ZOO / "aarl_state.yml").is_file()
    settings = ConfigParser()
    settings.read(ROOT / "setup.cfg")
    data = settings["options.package_data"]
    installed = {
        path
        for package in settings["options"]["packages"].split()
        for pattern in ("*.py", *data.get(package, "").split())
        for path in (ROOT / package.replace(".", "/")).glob(pattern)
    }
    folders = ("sb3_aarl", "search", "zoo_configs")
    there = {path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()}
    assert installed == {path for path in there if "__pycache__" not in path.parts}


def test_the_files_of_the_readme_are_what_it_says(folder: Path) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"`(\w+\.yml)`:\n\n```yaml\n(.*?)```", readme, flags=re.DOTALL)
    assert [name for name, _ in blocks] == ["own.yml", "pendulum.yml"]
    for name, text in blocks:
        (folder / name).write_text(text)
    config = load_config("pendulum.yml")
    assert config.environment == "Pendulum-v1" and config.hyperparameters_for("Pendulum-v1")["batch_size"] == 128
    assert config.hyperparameters_for("HalfCheetah-v5")["env_kwargs"] == {"action_repeat": 2}
    # Every command that it names is there.
    for command in re.findall(r"^    aarl (figures [\w-]+|[\w-]+)", readme, flags=re.MULTILINE):
        assert runner.invoke(app, [*command.split(), "--help"]).exit_code == 0, command


@pytest.mark.parametrize("run", ["runs/some", "elsewhere/some.yml"])
def test_dashboard_finds_a_search_by_its_folder_and_by_its_file(run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    optuna.create_study(study_name="some", storage=open_storage("runs/some"))
    served = []

    def serve(storage: BaseStorage, artifacts: Path, host: str, port: int) -> None:
        served.append((optuna.get_all_study_names(storage), artifacts, host, port))

    monkeypatch.setattr("search.results.dashboard.serve", serve)
    result = runner.invoke(app, ["dashboard", run, "--port", "8123"])
    assert result.exit_code == 0, result.stderr
    assert served == [(["some"], Path("runs/some/artifacts"), "127.0.0.1", 8123)]


def test_dashboard_leaves_studies_alone_that_are_no_searches(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = open_storage("runs/some")
    for name, directions in (("one", ["minimize"]), ("two", ["minimize", "maximize"])):
        study = optuna.create_study(study_name=name, storage=storage, directions=directions)
        study.set_user_attr("config", {"learning_rate": 1e-3})
        study.add_trial(optuna.create_trial(values=[1.0] * len(directions)))
    before = [(study.user_attrs, study.system_attrs) for study in storage.get_all_studies()]
    monkeypatch.setattr("search.results.dashboard.serve", lambda *arguments: None)
    result = runner.invoke(app, ["dashboard", "runs/some"])
    assert result.exit_code == 0, result.stderr
    assert [(study.user_attrs, study.system_attrs) for study in storage.get_all_studies()] == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["search", "postgresql://me:s3cret@db/x"],
        ["search", "a.yml", "postgresql://me:s3cret@db/x"],
        ["worker", "grpc://a:s3cret@b"],
    ],
)
def test_a_storage_in_the_wrong_place_is_refused_without_its_password(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["aarl", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr()
    assert ended.value.code == 2
    assert "--storage" in said.err and "s3cret" not in said.out + said.err and len(said.err.splitlines()) == 1


def test_every_number_of_a_stage_has_a_heading() -> None:
    progress = evolve.Progress([StageProgress(1, 125, 80, 4, 3, 2), StageProgress(2, 100, 0, 0, 0, 0)], 7.0, None, None)
    table = _stages_table(progress)
    headings = [str(column.header) for column in table.columns]
    assert headings == ["stage", "places", "done", "running", "failed", "died"]
    assert [list(column.cells) for column in table.columns][5] == ["2", "0"]


SEARCH = """
environment: dm_control/cartpole-balance-v0
hyperparameters: hyper.yml
checkpoints: [400, 800]
evaluation_episodes: 1
cross_validation:
  environments: [dm_control/cartpole-balance-v0, dm_control/reacher-easy-v0]
  seeds: [1, 2]
  top: 3
baselines:
- {name: SAC}
- {name: Diverges, overrides: {learning_rate: 1.0e+30, learning_starts: 5}}
"""
LOSSES = [AuxLoss.parse(text) for text in ("{s_t} -> {s_t+1}", "{s_t} -> {r_t}", "{s_t, a_t} -> {s_t+1}")]


@pytest.fixture
def cross_validation(folder: Path) -> Grid:
    """That of a finished search; its own study has no runs yet."""
    (folder / "some.yml").write_text(SEARCH)
    study = optuna.create_study(study_name="some", storage=open_storage("runs/some"), direction="maximize")
    for value, loss in enumerate(LOSSES):
        params = loss_to_params(loss)
        study.add_trial(optuna.trial.create_trial(value=value, params=params, distributions=distributions(loss.horizon)))
    return make_grid(load_config("some.yml"), study)


def add_runs(grid: Grid, scores: dict[str, float], fails: Callable[[Cell], bool]) -> None:
    study = optuna.create_study(study_name=grid.name, storage=open_storage("runs/some"), direction="maximize")
    for cell in grid.cells:
        if fails(cell):
            attributes = {**cell._asdict(), "reason": "it burst"}
            trial = optuna.trial.create_trial(state=TrialState.FAIL, user_attrs=attributes)
            study.add_trials([trial] * MAX_TRIES)
        else:
            score = scores[cell.variant]
            attributes = {**cell._asdict(), "curve": [[400, score, 0.0], [800, score, 0.0]]}
            study.add_trial(optuna.trial.create_trial(value=score, user_attrs=attributes))


@pytest.mark.parametrize(
    ("environment", "options", "message"),
    [
        ("dm_control/cartpole-balance-v0", "--cpus-per-trial 8", "--cpus-per-trial is for workers on a Ray cluster"),
        ("dm_control/cartpole-balance-v0", "--ray-address auto", "--ray-address is for workers on a Ray cluster"),
        ("CartPole-v1", "", "CartPole-v1 has no continuous actions"),
    ],
)
def test_what_cannot_be_searched_is_refused_before_anything_is_made(
    environment: str, options: str, message: str, folder: Path
) -> None:
    (folder / "some.yml").write_text(
        f"environment: {environment}\nhyperparameters: {folder / 'hyper.yml'}\ncheckpoints: [400]\n"
    )
    result = runner.invoke(app, ["search", "some.yml", *options.split()])
    assert result.exit_code == 2
    assert message in result.stderr and len(result.stderr.strip().splitlines()) == 1
    assert not Path("runs").exists()


def test_a_cross_validation_with_a_failed_run_ranks_the_others_and_says_so(
    cross_validation: Grid, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("search.cli.main.console", Console(width=200))  # a narrow one would break lines
    worst, middle, best = map(str, LOSSES)
    failed = Cell(best, "dm_control/reacher-easy-v0", 1)
    add_runs(cross_validation, {worst: 1.0, middle: 2.0, best: 3.0}, lambda cell: cell == failed)
    result = runner.invoke(app, ["cross-validate", "some.yml"])
    assert result.exit_code == 1
    ranked, _, others = result.stdout.partition("Not ranked, because runs are missing")
    assert ranked.index(middle) < ranked.index(worst) and f"│ {best}" not in ranked
    others = others.partition("Winner")[0]
    assert re.search(rf"{re.escape(best)}\W+3\.000\W+3\.000\W+3\.000\W+0\.000\W+3 ", others) and middle not in others
    assert f"Winner: {middle}" in result.stdout
    assert AuxLoss.from_dict(yaml.safe_load(Path("runs/some/winner.yml").read_text())["aux_loss"]) == LOSSES[1]
    assert result.stderr.splitlines() == [f"Failed: {best} on dm_control/reacher-easy-v0, seed 1: it burst"]


def test_an_environment_on_which_all_fail_is_no_reason_not_to_rank(cross_validation: Grid) -> None:
    worst, middle, best = map(str, LOSSES)
    add_runs(cross_validation, {worst: 1.0, middle: 2.0, best: 3.0}, lambda cell: "reacher" in cell.environment)
    result = runner.invoke(app, ["cross-validate", "some.yml"])
    assert result.exit_code == 1
    assert f"Winner: {best}" in result.stdout and "reacher" not in result.stdout and "Not ranked" not in result.stdout
    assert len(result.stderr.splitlines()) == 6


def test_a_cross_validation_with_the_search_s_own_runs_says_so(
    cross_validation: Grid, caplog: pytest.LogCaptureFixture
) -> None:
    assert not caplog.records
    config = load_config("some.yml")
    assert config.cross_validation is not None
    own = replace(config, cross_validation=replace(config.cross_validation, seeds=(0, 1)))
    study = optuna.load_study(study_name="some", storage=open_storage("runs/some"))
    make_grid(own, study)
    assert "cross_validation.seeds has 0, as the search on dm_control/cartpole-balance-v0" in caplog.text
    caplog.clear()
    make_grid(replace(own, environment="dm_control/cheetah-run-v0"), study)
    assert not caplog.records


def test_a_cross_validation_without_any_run_has_no_winner(cross_validation: Grid) -> None:
    add_runs(cross_validation, {}, lambda cell: True)
    result = runner.invoke(app, ["cross-validate", "some.yml"])
    assert result.exit_code == 1
    assert len(result.stderr.splitlines()) == len(cross_validation.cells)
    assert "Winner" not in result.stdout and not Path("runs/some/winner.yml").exists()


def test_a_baseline_that_diverges_does_not_hide_the_others(folder: Path) -> None:
    (folder / "some.yml").write_text(SEARCH)
    result = runner.invoke(app, ["baselines", "some.yml"])
    assert result.exit_code == 1
    study = optuna.load_study(study_name="some-baselines", storage=open_storage("runs/some"))
    states = Counter((trial.user_attrs["variant"], trial.state) for trial in study.trials)
    assert states == {("SAC", TrialState.COMPLETE): 1, ("Diverges", TrialState.FAIL): MAX_TRIES}
    assert f"{study.best_value:.3f}" in result.stdout
    # What a report counts hours by.
    assert all(t.user_attrs["device"].startswith(("CPU: ", "GPU: ")) and t.user_attrs["threads"] >= 1 for t in study.trials)
    reason = [trial.user_attrs["reason"] for trial in study.trials if trial.state == TrialState.FAIL][-1]
    assert "nan" in reason
    assert result.stderr.splitlines() == [f"Failed: Diverges on dm_control/cartpole-balance-v0, seed 0: {reason}"]
