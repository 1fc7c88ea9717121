"""The program: train, losses, search and matrices, as a user calls them."""

import json
import re
import shutil
import socket
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path
from unittest.mock import Mock

import optuna
import pytest
import yaml
from executors import Planted
from optuna.trial import TrialState, create_trial
from sb3_aarl.search.cli.main import app
from sb3_aarl.search.evolution.space import distributions, loss_to_params
from sb3_aarl.search.execution.queue import Queue
from sb3_aarl.search.execution.storage import open_storage
from sb3_aarl.search.studies.search import Search
from sb3_aarl.search.training.shipped import ZOO
from tiny import SEARCH, YAML, write_search
from typer.testing import CliRunner

from sb3_aarl import AuxLoss, SACAux, catalog
from sb3_aarl.callbacks import read_curve

ROOT = Path(__file__).parent.parent
runner = CliRunner(env={"COLUMNS": "200", "TERM": "dumb"})
# Few parameters: SQLite commits each.
SMALLER = (
    re.sub(r"(n_random|population_size): \d", r"\1: 2", SEARCH)
    .replace("n_prior: 1", "n_prior: 0")
    .replace("max_horizon: 3", "max_horizon: 1")
)
MATRICES = (
    SEARCH
    + """\
seeds: [0, 1]
cross_validation:
  environments: [Pendulum-v1, MountainCarContinuous-v0]
  seeds: [2, 3]
  top: 3
baselines:
- {name: SAC}
- {name: CURL, aux_loss: curl}
"""
)
LOSSES = [AuxLoss.parse(text) for text in ("{s_t} -> {s_t+1}", "{s_t} -> {r_t}", "{s_t, a_t} -> {s_t+1}")]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the program runs."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments: object, code: int = 0) -> str:
    """What the program prints, which must end with an exit code; errors are one line."""
    result = runner.invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    if code == 2:
        assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    return result.output


def test_train_shows_the_curve_and_keeps_the_model(folder: Path) -> None:
    (folder / "own.yml").write_text(YAML + "  n_timesteps: 205\n")
    (folder / "winner.yml").write_text(yaml.safe_dump({"aux_loss": LOSSES[0]}))
    options = "--aux-loss winner.yml --hyperparams own.yml --evaluations 2 --episodes 1"
    arguments = ["train", "Pendulum-v1", *options.split(), "--seed", "4"]
    shown = run(*arguments)
    (path,) = Path("runs").iterdir()
    assert path.name.startswith("pendulum-v1-winner-yml-")
    curve = read_curve(path / "curve.csv")
    assert [point.environment_steps for point in curve] == [102, 204]
    for point in curve:
        assert re.search(rf"{point.environment_steps:,}\D+{abs(point.mean):.1f}\D+{point.std:.1f}", shown)
    assert f"(AULC) {(curve[0].mean + curve[1].mean) / 2:.1f}" in shown
    assert f"{path}/model.zip" in shown and f"{path}/curve.csv" in shown
    model = SACAux.load(path / "model.zip")
    assert model.aux_loss == LOSSES[0] and (model.seed, model.num_timesteps, model.batch_size) == (4, 204, 8)
    about = json.loads((path / "provenance.json").read_text())
    assert about["sessions"][0]["aux_loss"] == str(LOSSES[0]) and about["seconds"] > 0
    run(*arguments, "--folder", path)
    assert read_curve(path / "curve.csv") == curve  # it is not trained again
    assert f"{path} has another run: seed is 4 there, 5 here" in run(*arguments, "--seed", 5, "--folder", path, code=2)
    assert f"{path} has another run: aux_loss is" in run(*arguments, "--aux-loss", "none", "--folder", path, code=2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cartpole-blance"], "nearest: cartpole-balance"),
        (["Own-v0"], "Imports (--imports, or imports: in the file) register your own"),
        (["Pendulum-v1", "--aux-loss", "curll"], "nearest: curl"),
        (["Pendulum-v1", "--aux-loss", "{s_t} -> {q_t}"], "'q_t' is not a token"),
        (["Pendulum-v1"], "how many steps"),
        (["Pendulum-v1", "--steps", "3", "--evaluations", "5"], "too few"),
        (["Pendulum-v1", "--hyperparams", "sac_pixl"], "nearest: sac_pixel"),
        (["CartPole-v1", "--steps", "1000"], "CartPole-v1 cannot be trained"),
    ],
    ids=["environment", "module", "name", "notation", "no steps", "steps", "file", "actions"],
)
def test_errors_of_train_are_one_line(arguments: list[str], message: str, folder: Path) -> None:
    write_search(folder)
    if "--hyperparams" not in arguments:
        arguments = [*arguments, "--hyperparams", "hyperparameters.yml"]
    assert message in run("train", *arguments, code=2)
    assert not Path("runs").exists()


def test_losses_lists_the_whole_catalogue() -> None:
    rows = [[cell.strip() for cell in line.split("│")[1:3]] for line in run("losses").splitlines() if line.startswith("│")]
    table: dict[str, str] = {}
    for name, notation in rows:
        if name:
            table[name] = notation
        else:  # a long notation continues in the next line
            table[list(table)[-1]] += f" {notation}"
    assert list(table) == catalog.names()
    assert all(AuxLoss.parse(notation) == catalog.load(name) for name, notation in table.items())


def test_all_files_are_installed() -> None:
    assert (ZOO / "paper/aarl_state.yml").is_file()
    settings = ConfigParser()
    settings.read(ROOT / "setup.cfg")
    data = settings["options.package_data"]
    installed = {
        path
        for package in settings["options"]["packages"].split()
        for pattern in ("*.py", *data.get(package, "").split())
        for path in (ROOT / package.removeprefix("sb3_aarl.").replace(".", "/")).glob(pattern)
    }
    there = {path for name in ("sb3_aarl", "search", "zoo_configs") for path in (ROOT / name).rglob("*") if path.is_file()}
    assert installed == {path for path in there if "__pycache__" not in path.parts}


def test_the_help_needs_nothing_heavy() -> None:
    program = (
        "import sys; from typer.testing import CliRunner; from sb3_aarl.search.cli.main import app; "
        "[CliRunner().invoke(app, [*command, '--help']) for command in ([], ['search'], ['table'], ['report'])]; "
        "print([name for name in ('torch', 'optuna', 'pandas', 'matplotlib') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("environment", "options", "message"),
    [
        ("Pendulum-v1", "--cpus-per-run 8", "--cpus-per-run has no meaning with --executor local"),
        ("Pendulum-v1", "--executor ray --slurm mem_gb=4", "--slurm has no meaning with --executor ray"),
        ("CartPole-v1", "", "CartPole-v1 cannot be trained"),
        ("Pendulum-v1\noverrides: {train_freq: [1, episode], n_envs: 2}", "", "small.yml: Pendulum-v1 cannot be trained"),
        ("Pendulum-v1\noverrides: {stats_window_size: -1}", "--dry-run", "small.yml: Pendulum-v1 cannot be trained"),
    ],
    ids=str,
)
def test_what_cannot_be_searched_is_refused_before_anything_is_made(
    environment: str, options: str, message: str, folder: Path
) -> None:
    write_search(folder, SEARCH.replace("Pendulum-v1", environment))
    assert message in run("search", "small.yml", *options.split(), code=2)
    assert not Path("runs").exists()


def test_a_search_warns_of_horizons_that_no_episode_has(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_search(folder, SEARCH + "overrides: {env_kwargs: {action_repeat: 100}}\nspace: {gamma: [0.9, 0.99]}\n")
    Search.from_file("small.yml")
    assert caplog.text.count("max_horizon is 300 environment steps, episodes have 200") == 1


def test_a_folder_is_that_of_one_search(folder: Path, executor: Planted) -> None:
    write_search(folder, SMALLER + "cross_validation: {environments: [Pendulum-v1]}\n")
    output = run("search", "small.yml", "--generations", 1, "--folder", "mine")
    assert output.endswith(" small.yml --folder mine\n")
    shutil.copy("small.yml", "other.yml")
    assert "mine is the folder of the search small" in run("search", "other.yml", "--folder", "mine", code=2)
    assert "small" in run("cross-validate", "other.yml", "--folder", "mine", code=2)
    assert "Search mine" in run("status", "mine")


def test_errors_of_a_database_name_their_cause_and_no_password(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_search(folder)
    monkeypatch.setitem(sys.modules, "MySQLdb", None)
    for kind, cause in (("postgresql+psycopg", "127.0.0.1"), ("mysql", "MySQLdb")):
        error = run("search", "small.yml", "--storage", f"{kind}://me:s3cret@127.0.0.1:1/none", code=2)
        assert cause in error and "s3cret" not in error


def test_a_missing_extra_is_named(folder: Path, executor: Planted, monkeypatch: pytest.MonkeyPatch) -> None:
    write_search(folder)
    monkeypatch.delitem(sys.modules, "sb3_aarl.search.execution.ray", raising=False)
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'sb3-aarl[ray]'" in run("search", "small.yml", "--executor", "ray", code=2)


def test_a_ray_that_does_not_answer_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")
    write_search(folder)
    monkeypatch.setattr(ray, "init", Mock(side_effect=ConnectionError("No Ray instance. Please specify --address")))
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    for address, message in {
        f"127.0.0.1:{port}": f"no Ray cluster answers at 127.0.0.1:{port}: is it started with `ray start --head`?",
        "127.0.0.1": "--ray-address is auto or host:port, such as 192.0.2.2:6379, not 127.0.0.1",
        "auto": "--ray-address auto: No Ray instance\n",
    }.items():
        assert message in run("search", "small.yml", "--executor", "ray", "--ray-address", address, code=2)
    assert not Path("runs").exists()


@pytest.mark.slow
def test_search_reports_progress_and_resumes(folder: Path, executor: Planted) -> None:
    write_search(folder, SMALLER)
    output = run("search", "small.yml", "--generations", 1, "--threads", 2, "--workers", 3)
    assert executor.arguments == (3,) and {run.threads for run in executor.runs} == {2}
    assert "generation 1: 2/2 done, 0 running, 0 failed; best 1.00, finished" in output
    assert "To watch it: aarl dashboard runs/small\n" in output and "score 1.00" in output
    output = run("search", "small.yml", "--threads", 2)
    assert "generation 1: 2/2 done" in output and "generation 2: 2/2 done" in output and len(executor.runs) == 4
    study = optuna.load_study(study_name="small", storage=open_storage(Path("runs/small")))
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE] * 4
    run("report", "small.yml")
    notation = str(AuxLoss.parse(study.best_trial.user_attrs["loss"]))
    assert notation.replace(">", "&gt;") in Path("runs/small/report.html").read_text()


@pytest.mark.slow
def test_a_search_on_ray_fills_its_cluster(folder: Path, executor: Planted, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    write_search(folder, SMALLER + "cross_validation: {environments: [Pendulum-v1]}\n")
    monkeypatch.setattr("sb3_aarl.search.execution.ray.RayExecutor", executor)
    options = "--executor ray --ray-address host:1 --cpus-per-run 2 --gpus-per-run 0.25"
    output = run("search", "small.yml", *options.split(), "--generations", 1)
    assert executor.arguments == ("host:1", 2.0, 0.25) and len(executor.runs) == 2
    assert output.endswith(f"aarl cross-validate small.yml {options}\n")


def test_a_search_on_slurm_passes_parameters(folder: Path, executor: Planted, monkeypatch: pytest.MonkeyPatch) -> None:
    write_search(folder, SMALLER)
    parameters = ["--slurm", "slurm_partition=gpu", "--slurm", "timeout_min=30", "--gpus-per-run", 1]
    arguments = ["search", "small.yml", "--executor", "slurm", *parameters, "--generations", 1]
    made: dict[str, object] = {}
    monkeypatch.setattr(
        "sb3_aarl.search.execution.slurm.SlurmExecutor", lambda *args, **named: made.update(named, args=args) or executor
    )
    run(*arguments)
    assert made == {"args": (Path("runs/small/slurm"), 1, 1), "slurm_partition": "gpu", "timeout_min": 30}
    assert len(executor.runs) == 2


@pytest.mark.slow
def test_a_search_in_which_all_fails_is_exit_code_1(folder: Path, executor: Planted, monkeypatch: pytest.MonkeyPatch) -> None:
    write_search(folder, SMALLER)
    monkeypatch.setattr("sb3_aarl.search.execution.driver.MAX_FAILURES", 2)
    executor.fails = lambda run: True
    output = run("search", "small.yml", code=1)
    assert "Error: 2 candidates failed in a row, the last one: it burst (see runs/small/candidates/" in output


@pytest.fixture
def searched(folder: Path) -> optuna.Study:
    """A finished search of three losses, the last one the best."""
    write_search(folder, MATRICES)
    study = optuna.create_study(study_name="small", storage=open_storage(Path("runs/small")), direction="maximize")
    for value, loss in enumerate(LOSSES):
        study.add_trial(create_trial(value=value, params=loss_to_params(loss), distributions=distributions(loss.horizon)))
    return study


def test_cross_validation_ranks_what_is_complete(searched: optuna.Study, executor: Planted) -> None:
    worst, middle, best = map(str, LOSSES)
    executor.scores = {worst: 1.0, middle: 2.0, best: 3.0}
    executor.fails = lambda run: run.aux_loss == best and run.environment != "Pendulum-v1" and run.seed == 2
    output = run("cross-validate", "small.yml", "--workers", 2, code=1)
    assert executor.arguments == (2,)
    assert output.index(f"│ {middle}") < output.index(f"│ {worst}") and f"│ {best}" not in output
    assert f"Winner: {middle}" in output
    assert catalog.resolve("runs/small/winner.yml") == LOSSES[1]
    assert output.splitlines()[-1] == f"Failed: {best} on MountainCarContinuous-v0, seed 2: it burst"
    # The same command trains what is missing.
    n_runs, executor.fails = len(executor.runs), lambda run: False
    assert f"Winner: {best}" in run("cross-validate", "small.yml") and len(executor.runs) == n_runs + 1


def test_a_cross_validation_with_baselines(searched: optuna.Study, executor: Planted) -> None:
    executor.scores = {str(loss): float(score) for score, loss in enumerate(LOSSES)} | {None: 9.0}
    output = run("cross-validate", "small.yml", "--baselines")
    # The best row is a baseline, the winner the best candidate.
    rows = [line.split()[1] for line in output.splitlines() if line.startswith("│")]
    assert rows[:2] == ["SAC", "{s_t,"] and "CURL" in rows and f"Winner: {LOSSES[-1]}" in output
    assert {(r.environment, r.seed) for r in executor.runs if r.aux_loss is None} == {
        (environment, seed) for environment in ("Pendulum-v1", "MountainCarContinuous-v0") for seed in (2, 3)
    }
    run("report", "runs/small")
    assert "CURL" in Path("runs/small/report.html").read_text().partition("Cross-validation")[2]


def test_an_environment_on_which_all_fail_is_no_reason_not_to_rank(searched: optuna.Study, executor: Planted) -> None:
    executor.fails = lambda run: True
    output = run("cross-validate", "small.yml", code=1)
    assert "Winner" not in output and output.count("Failed: ") == 12 and not Path("runs/small/winner.yml").exists()
    executor.scores = {str(loss): float(score) for score, loss in enumerate(LOSSES)}
    executor.fails = lambda run: run.environment != "Pendulum-v1"
    output = run("cross-validate", "small.yml", code=1)
    assert f"Winner: {LOSSES[-1]}" in output and output.count("Failed: ") == 6


def test_cross_validation_needs_a_search(searched: optuna.Study) -> None:
    assert "elsewhere/study.db does not exist. aarl search" in run(
        "cross-validate", "small.yml", "--folder", "elsewhere", code=2
    )
    assert not Path("elsewhere").exists()


def test_baselines(folder: Path, executor: Planted) -> None:
    write_search(folder, MATRICES)
    executor.fails = lambda run: run.aux_loss is not None and "[" in run.aux_loss and run.seed == 1
    output = run("baselines", "small.yml", code=1)
    # Two seeds: scores 1 and 2.
    assert re.search(r"SAC\W+1\.500 .* 1\.000\W+2 ", output)
    assert output.splitlines()[-1] == "Failed: CURL on Pendulum-v1, seed 1: it burst"
    assert len(read_curve(Path("runs/small/baselines/SAC/Pendulum-v1/seed-1/curve.csv"))) == 2


def test_baselines_on_ray_fill_its_cluster(folder: Path, executor: Planted, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    write_search(folder, MATRICES)
    options = ["--executor", "ray", "--ray-address", "host:1", "--cpus-per-run", 2]
    assert "--slurm has no meaning" in run("baselines", "small.yml", *options, "--slurm", "mem_gb=4", code=2)
    monkeypatch.setattr("sb3_aarl.search.execution.ray.RayExecutor", executor)
    workers: list[int] = []
    monkeypatch.setattr("sb3_aarl.search.execution.matrix.Queue", lambda *args: workers.append(args[1]) or Queue(*args))
    run("baselines", "small.yml", *options)
    assert executor.arguments == ("host:1", 2, 0) and len(executor.runs) == 4 and workers == [4]


def test_baselines_and_other_environments_are_tried_out(folder: Path, executor: Planted, searched: optuna.Study) -> None:
    text = SEARCH + "baselines:\n- {name: a}\n- {name: b, overrides: {policy_kwargs: {n_critics: 0}}}\n"
    write_search(folder, text + "cross_validation: {environments: [Pendulum-v1, CartPole-v1], seeds: [1]}\n")
    assert "small.yml: Pendulum-v1 cannot be trained" in run("baselines", "small.yml", code=2)
    assert "small.yml: CartPole-v1 cannot be trained" in run("cross-validate", "small.yml", code=2)
    assert not executor.runs


def test_a_benchmark_grows_and_names_what_failed(folder: Path, executor: Planted) -> None:
    write_search(folder)
    for name in ("a", "b"):
        Path(f"{name}.yml").write_text(Path("hyperparameters.yml").read_text())
    executor.fails = lambda run: run.seed == 1
    options = "a.yml b.yml --envs Pendulum-v1 --checkpoints 200,400 --episodes 1 --folder bench"
    assert "Failed: " not in run("benchmark", *options.split(), "--seeds", "0")
    output = run("benchmark", *options.split(), "--seeds", "0,1", code=1)
    assert output.count("Failed: ") == 2 and len(executor.runs) == 4
    assert "Missing at 400" in run("table", "bench")
    assert "evaluations" in run("benchmark", *options.replace("200,400", "100,400").split(), "--seeds", "0", code=2)
    assert "--every" in run("benchmark", *options.split(), "--every", "20k,30k", code=2)
