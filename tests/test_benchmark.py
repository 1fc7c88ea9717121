"""Benchmarks: what is asked for, what every run leaves, killed and gone on with, somebody's own environments."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from test_grid import SameProcess
from typer.testing import CliRunner

from sb3_aarl import AuxLoss
from sb3_aarl.callbacks import read_curve
from search.cli.main import app
from search.execution import matrix as grid
from search.execution.matrix import Cell
from search.results import table
from search.studies.benchmark import Benchmark, load_benchmark, parse_seeds, parse_steps, run_folder
from search.training.config import load_hyperparameters
from search.training.provenance import ABOUT
from search.training.run import provenance, train_candidate

ROOT = Path(__file__).parent.parent
ZOO = ROOT / "zoo_configs"
# Ten lines are enough for an environment of one's own.
MINE = """
Pendulum-v1: &mine
  aux_loss: "{s_t, a_t} -> {s_t+1}"
  n_timesteps: 300
  learning_starts: 250
  batch_size: 8
  predictor_width: 8
  policy_kwargs:
    net_arch: [16]
    features_extractor_kwargs: {features_dim: 8, width: 8}
"""
runner = CliRunner(env={"COLUMNS": "200", "TERM": "dumb"})


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the program runs, with two variants."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yml").write_text(MINE)
    (tmp_path / "plain.yml").write_text(MINE.replace('"{s_t, a_t} -> {s_t+1}"', "none"))
    return tmp_path


@pytest.mark.parametrize(
    ("text", "steps"),
    [("100k,500k,1000k", (100_000, 500_000, 1_000_000)), ("1M", (1_000_000,)), ("20000, 3K", (20_000, 3_000))],
)
def test_environment_steps_are_read(text: str, steps: tuple[int, ...]) -> None:
    assert parse_steps(text) == steps


@pytest.mark.parametrize(("text", "seeds"), [("0-3", (0, 1, 2, 3)), ("7", (7,)), ("0, 5-6,2", (0, 5, 6, 2))])
def test_seeds_are_read(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    ("number", "variants", "n_tasks"),
    [
        (4, ["aarl_state", "sac_identity", "sac_dense_mlp", "curl_state"], 18),
        (3, ["aarl_pixel", "curl_pixel", "sac_pixel_no_aug"], 6),
        (6, ["aarl_state", "aarl_mlp_1", "aarl_mlp_4", "aarl_dense_mlp_4"], 12),
    ],
)
def test_without_options_the_zoo_makes_the_papers_tables(number: int, variants: list[str], n_tasks: int) -> None:
    benchmark = load_benchmark([ZOO / f"{variant}.yml" for variant in variants])
    assert list(benchmark.files) == variants and list(benchmark.seeds) == list(range(10))
    assert len(benchmark.checkpoints) == n_tasks and len(benchmark.cells) == len(set(benchmark.cells)) == n_tasks * 10 * len(
        variants
    )
    scores = table.paper_scores(number)
    assert set(variants) == set(scores["variant"].dropna())
    if number != 6:  # its environments are not named
        assert set(benchmark.checkpoints) == set(scores["environment"])
        for environment, checkpoints in benchmark.checkpoints.items():
            of_paper = set(scores[scores["environment"] == environment]["checkpoint"])
            assert of_paper <= set(checkpoints) and max(of_paper) == checkpoints[-1]
    assert table.closest_table(variants) == number


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("mine.yml other/mine.yml", "two files are called mine"),
        ("mine.yml missing.yml", "missing.yml: cannot be read: No such file"),
        ("mine.yml default.yml", "no entry of one environment in common: name environments"),
        ("mine.yml --envs Pendulm-v1", "unknown environment 'Pendulm-v1', nearest: Pendulum-v1"),
        ("mine.yml --envs Hopper-v5", "mine.yml: neither 'Hopper-v5' nor 'default' is there"),
        ("default.yml --envs CartPole-v1", "CartPole-v1 has no continuous actions, which SACAux needs, but Discrete(2)"),
        ("mine.yml", "n_timesteps ends the training on Pendulum-v1 at 300 environment steps: name checkpoints"),
        (
            "mine.yml --checkpoints 300,200",
            "checkpoints must be positive environment steps in ascending order, not [300, 200]",
        ),
        ("mine.yml --checkpoints 3x", "environment steps are written like 100k, 1M or 20000, not '3x'"),
        ("mine.yml --checkpoints 300 --every 0", "every must be at least 1, not 0"),
        ("mine.yml --checkpoints 300 --seeds 3-1", "seeds are written like 0-9 or 0,3,5, not '3-1'"),
        ("mine.yml --checkpoints 300 --seeds 1,1", "seeds must be different numbers from 0 to 2**32 - 1, not [1, 1]"),
        ("mine.yml --checkpoints 300 --seeds 5000000000", "seeds must be different numbers from 0 to 2**32 - 1"),
        ("default.yml --envs reacher-easy --checkpoints 302", "at multiples of its action repeat 4, not 302"),
        ("default.yml --envs reacher-easy --checkpoints 304 --every 6", "at multiples of its action repeat 4, not 6"),
    ],
)
def test_what_cannot_be_benchmarked_is_refused_before_anything_is_made(options: str, message: str, folder: Path) -> None:
    (folder / "other").mkdir()
    (folder / "other" / "mine.yml").write_text(MINE)
    (folder / "default.yml").write_text("default: {env_kwargs: {action_repeat: 4}}\n")
    result = runner.invoke(app, ["benchmark", *options.split()])
    assert result.exit_code == 2
    assert message in result.stderr and len(result.stderr.strip().splitlines()) == 1
    assert not Path("runs").exists()


def test_other_checkpoints_of_the_same_evaluations_are_those_of_all_runs(folder: Path) -> None:
    files = [folder / "mine.yml", folder / "plain.yml"]
    load_benchmark(files, checkpoints=[100, 300], every=100, seeds=[0, 1]).prepare(folder)
    begun = run_folder(folder, Cell("mine", "Pendulum-v1", 0)) / ABOUT
    begun.write_text(json.dumps({**json.loads(begun.read_text()), "sessions": [{"commit": "c0ffee"}], "seconds": 3.0}))
    load_benchmark(files[:1], checkpoints=[200, 300], every=100, seeds=[0]).prepare(folder)
    runs = table.read_runs(folder)
    assert len(runs) == 8 and set(runs["checkpoint"]) == {200, 300}
    about = json.loads(begun.read_text())
    assert about["evaluations"] == [100, 200, 300] and about["seconds"] == 3.0 and about["sessions"] == [{"commit": "c0ffee"}]


def test_evaluations_in_between_are_no_checkpoints(folder: Path) -> None:
    benchmark = load_benchmark([folder / "mine.yml"], checkpoints=[120, 300], every=100)
    assert benchmark.evaluations("Pendulum-v1") == [100, 120, 200, 300]
    assert benchmark.about(benchmark.cells[0])["checkpoints"] == [120, 300]


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ("none", None, "aux_loss=None, not 'auto'"),
        (None, "none", "aux_loss='auto', not None"),
        (None, "aarl-state", "aux_loss='auto', not 'aarl-state'"),
    ],
    ids=str,
)
def test_a_file_that_says_nothing_of_a_loss_is_not_one_that_says_none(
    first: str | None, second: str | None, message: str, folder: Path
) -> None:
    line = '  aux_loss: "{s_t, a_t} -> {s_t+1}"\n'
    for loss in (first, second):
        (folder / "mine.yml").write_text(MINE.replace(line, "" if loss is None else f"  aux_loss: {loss}\n"))
        benchmark = load_benchmark([folder / "mine.yml"], seeds=[0], checkpoints=[300])
        if loss is first:
            benchmark.prepare(folder)
    with pytest.raises(ValueError, match=re.escape(f"{message} (mine on Pendulum-v1)")):
        benchmark.prepare(folder)


def test_two_sets_of_changes_are_two_commits(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    of_this_process = provenance.commit()
    (folder / "search").mkdir()
    monkeypatch.setattr(provenance, "__file__", str(folder / "search" / "provenance.py"))
    for command in ("init", "add mine.yml", "-c user.name=me -c user.email=me@here commit -m first"):
        subprocess.run(["git", *command.split()], check=True, capture_output=True)
    look = provenance.commit.__wrapped__
    commits = [look()]
    for text in ("one", "two\xe9", "one"):
        (folder / "mine.yml").write_text(text, encoding="latin-1")
        commits.append(look())
    clean, one, two, again = commits
    assert re.fullmatch("[0-9a-f]{12}", clean) and one == again != two
    assert all(re.fullmatch(rf"{clean}\+changes\.[0-9a-f]{{8}}", commit) for commit in (one, two))
    # An installation in a checkout of somebody else's, as that of a virtual environment.
    (folder / "venv" / "search").mkdir(parents=True)
    monkeypatch.setattr(provenance, "__file__", str(folder / "venv" / "search" / "provenance.py"))
    assert look() == metadata.version("sb3-aarl")
    # A process keeps the code that it has begun with, whatever is checked out later.
    assert provenance.provenance()["commit"] == of_this_process != again


CHECKPOINT = 300


def reference(cell: Cell) -> list[float]:
    """Mean returns of the same training without a benchmark."""
    settings = load_hyperparameters(f"{cell.variant}.yml", cell.environment)
    loss = settings.pop("aux_loss")
    assert loss in (None, "{s_t, a_t} -> {s_t+1}")
    aux_loss = None if loss is None else AuxLoss.parse(loss)
    return [point.mean for point in train_candidate(cell.environment, aux_loss, settings, cell.seed, [CHECKPOINT], 1).curve]


def test_killed_and_gone_on_with_it_is_what_it_would_have_been(folder: Path) -> None:
    options = ["mine.yml", "plain.yml", "--checkpoints", "300", "--seeds", "0-1", "--episodes", "1", "--threads", "1"]
    command = ["benchmark", *options, "--out", "out"]
    program = [sys.executable, "-c", "from search.cli.main import main; main()", *command]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    finished: set[Path] = set()
    with subprocess.Popen(program, env=environment, stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 120
        while not finished and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
            finished = {path for path in Path("out").rglob(ABOUT) if "seconds" in json.loads(path.read_text())}
        process.send_signal(signal.SIGKILL)
    assert 1 <= len(finished) < 4
    first = finished.pop()
    written = first.with_name("curve.csv").stat().st_mtime_ns
    result = runner.invoke(app, command)
    assert result.exit_code == 0, result.stderr

    losses = {"mine": "{s_t, a_t} -> {s_t+1}", "plain": "None"}
    cells = [Cell(variant, "Pendulum-v1", seed) for seed in (0, 1) for variant in losses]
    assert first.with_name("curve.csv").stat().st_mtime_ns == written  # not trained again
    means = {cell: reference(cell) for cell in cells}
    for cell in cells:
        path = run_folder(Path("out"), cell)
        assert [point.mean for point in read_curve(path / "curve.csv")] == means[cell]
        with (path / "curve.csv").open(newline="") as file:
            (row,) = csv.DictReader(file)
        assert list(row) == ["environment_steps", "mean", "std", "episodes", "seconds"]
        about = json.loads((path / ABOUT).read_text())
        assert (about["variant"], about["environment"], about["seed"]) == cell
        assert about["checkpoints"] == about["evaluations"] == [300] and about["evaluation_episodes"] == 1
        assert about["hyperparameters"] == {**load_hyperparameters(about["file"], cell.environment)}
        assert about["seconds"] == float(row["seconds"]) > 0
        assert {"commit", "command", "date", "cpu", "gpu", "python", "versions"} <= set(about["sessions"][-1])
        assert re.fullmatch(r"[0-9a-f]{12}(\+changes\.[0-9a-f]{8})?", about["sessions"][-1]["commit"])
        assert about["sessions"][-1]["aux_loss"] == losses[about["variant"]]
    assert " ".join(command).removeprefix("benchmark") in json.loads(first.read_text())["sessions"][0]["command"]

    for variant in ("mine", "plain"):
        of_variant = [mean for cell in cells for mean in means[cell] if cell.variant == variant]
        assert re.search(rf"{np.mean(of_variant):.1f} ± {np.std(of_variant, ddof=1):.1f}", result.stdout)
    assert "The interquartile mean of fewer than four runs is their mean" in " ".join(result.stdout.split())
    assert runner.invoke(app, ["table", "out"]).stdout == result.stdout.partition("4/4\n")[2]

    # Another seed is added; trained otherwise is refused, and leaves nothing behind.
    refused = runner.invoke(app, [*command[:3], "--checkpoints", "400", "--seeds", "0-9", "--out", "out"])
    assert refused.exit_code == 2 and "evaluations=[300], not [400] (mine on Pendulum-v1)" in refused.stderr
    assert not run_folder(Path("out"), Cell("mine", "Pendulum-v1", 9)).exists()


def test_a_variant_that_fails_is_named_and_does_not_hide_the_others(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grid, "WorkerPool", SameProcess)
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.0)
    (folder / "bursts.yml").write_text(MINE.replace("learning_starts: 250", "learning_rate: 1.0e+30\n  learning_starts: 5"))
    command = ["benchmark", "mine.yml", "bursts.yml", "--checkpoints", "100,260", "--seeds", "3", "--episodes", "1"]
    result = runner.invoke(app, command)
    assert result.exit_code == 1
    about = json.loads((run_folder(Path("runs/benchmark"), Cell("bursts", "Pendulum-v1", 3)) / ABOUT).read_text())
    assert "seconds" not in about and len(about["sessions"]) == grid.MAX_TRIES
    for checkpoint in (100, 260):
        assert f"Missing at {checkpoint}: bursts on Pendulum-v1, seed 3: {about['failed']}" in result.stdout
    assert result.stderr.splitlines() == [f"Failed: bursts on Pendulum-v1, seed 3: {about['failed']}"]
    runs = table.read_runs(Path("runs/benchmark")).set_index(["variant", "checkpoint"])
    assert runs["mean"].notna().to_dict() == {
        ("bursts", 100): False,
        ("bursts", 260): False,
        ("mine", 100): True,
        ("mine", 260): True,
    }
    again = runner.invoke(app, command)  # it does not try for ever
    assert again.exit_code == 1 and again.stdout.endswith(result.stdout[result.stdout.index("100 steps") :])


def test_tasks_of_mujoco_and_of_namespaces_have_folders_of_their_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grid, "WorkerPool", SameProcess)
    monkeypatch.setattr(grid, "POLL_SECONDS", 0.0)
    (folder / "mine.yml").write_text(MINE.replace("Pendulum-v1", "default"))
    benchmark: Benchmark = load_benchmark(
        [folder / "mine.yml"], ["Swimmer-v5", "reacher-easy"], [0], [260], evaluation_episodes=1
    )
    benchmark.prepare(folder)
    assert list(grid.run(benchmark, folder, str(folder)))[-1] == (2, 0)
    assert [len(read_curve(folder / "mine" / task / "seed-0" / "curve.csv")) for task in ("Swimmer-v5", "reacher-easy")] == [
        1,
        1,
    ]
