"""Benchmarks: the runs that are planned, what is refused, and the files of every run."""

import json
import re
import shutil
import subprocess
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import paper_figures
import paper_tables
import pytest
from sb3_aarl.search.execution.executors import LocalExecutor
from sb3_aarl.search.execution.matrix import Cell, cell_folder, check_matrix, run_matrix, scores
from sb3_aarl.search.results import table
from sb3_aarl.search.studies.benchmark import load_benchmark, parse_seeds, parse_steps, read_abouts
from sb3_aarl.search.training import provenance
from sb3_aarl.search.training.config import load_hyperparameters
from sb3_aarl.search.training.folder import read_outcome
from sb3_aarl.search.training.provenance import ABOUT, read_about, write_about
from sb3_aarl.search.training.run import prepare_run, train
from sb3_aarl.search.training.setup import Setup
from sb3_aarl.search.training.shipped import DEFAULTS
from stable_baselines3.common.envs import FakeImageEnv
from tiny import YAML

from sb3_aarl.callbacks import Evaluation, aulc, read_curve, write_curve
from sb3_aarl.policies import CnnPolicy

ZOO = Path(__file__).parent.parent / "zoo_configs"
OWN = YAML.replace("default:", "Pendulum-v1:\n  aux_loss: curl\n  n_timesteps: 400")
ENV = "Pendulum-v1"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with two variants."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yml").write_text(OWN)
    (tmp_path / "plain.yml").write_text(OWN.replace("curl", "none"))
    return tmp_path


def load(names: str = "mine.yml", **options: Any) -> Any:
    options = {"seeds": [0], "checkpoints": [400], "folder": Path("out"), **options}
    return load_benchmark([Path(name) for name in names.split()], **options)


@pytest.mark.parametrize(
    ("text", "steps"),
    [("100k,500k,1000k", (100_000, 500_000, 1_000_000)), ("1M", (1_000_000,)), ("20000, 3K", (20_000, 3_000))],
)
def test_environment_steps_are_read(text: str, steps: tuple[int, ...]) -> None:
    assert parse_steps(text) == steps


@pytest.mark.parametrize(("text", "seeds"), [("0-3", (0, 1, 2, 3)), ("7", (7,)), ("0, 5-6,2", (0, 5, 6, 2))])
def test_seeds_are_read(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(("parse", "text"), [(parse_steps, "3x"), (parse_steps, ""), (parse_seeds, "3-1"), (parse_seeds, "a")])
def test_other_text_is_refused(parse: Any, text: str) -> None:
    with pytest.raises(ValueError, match=f"written like .*, not '{text}'"):
        parse(text)


@pytest.mark.parametrize(
    ("number", "variants", "n_tasks"),
    [
        (4, ["aarl_state", "sac_identity", "sac_dense_mlp", "curl_state"], 18),
        (3, ["aarl_pixel", "curl_pixel", "sac_pixel_no_aug"], 6),
        (6, ["aarl_state", "aarl_mlp_1", "aarl_mlp_4", "aarl_dense_mlp_4"], 12),
    ],
)
def test_without_options_the_zoo_makes_the_papers_tables(number: int, variants: list[str], n_tasks: int) -> None:
    matrix = load_benchmark([ZOO / "paper" / f"{variant}.yml" for variant in variants])
    assert list(dict.fromkeys(cell.variant for cell in matrix.runs)) == variants
    assert {cell.seed for cell in matrix.runs} == {*range(10)} and len(matrix.runs) == n_tasks * 10 * len(variants)
    scores = paper_tables.paper_scores(number)
    assert set(variants) == set(scores["variant"].dropna()) and paper_tables.closest_table(variants) == number
    if number != 6:  # its environments are not named
        assert {cell.environment for cell in matrix.runs} == set(scores["environment"])
        for cell, about in matrix.abouts.items():
            of_paper = set(scores[scores["environment"] == cell.environment]["checkpoint"])
            assert of_paper <= set(about["checkpoints"]) and max(of_paper) == about["checkpoints"][-1]


def test_evaluations_in_between_are_no_checkpoints() -> None:
    matrix = load(checkpoints=[120, 400], every=100, seeds=[0, 3])
    for cell, run in matrix.runs.items():
        assert run.checkpoints == (100, 120, 200, 300, 400) and run.seed == cell.seed
        about = matrix.abouts[cell]
        assert (about["checkpoints"], about["evaluations"]) == ([120, 400], [100, 120, 200, 300, 400])
        assert about["hyperparameters"] == load_hyperparameters("mine.yml", ENV)


def test_the_defaults_take_the_policy_that_fits_the_observations() -> None:
    gym.register("Picture-v0", lambda: FakeImageEnv(2, 32, 32, discrete=False))
    Path("base.yml").write_text("base: sac_aux\nvariants: {based: {}}\n")
    runs = load("base.yml", environments=["Picture-v0"]).runs | load(str(DEFAULTS), environments=["Picture-v0"]).runs
    assert len(runs) == 2
    for run in runs.values():
        setup = Setup(run, "")
        assert setup.model(setup.training_env()).policy_class is CnnPolicy


BETWEEN = r"multiples of 4 \(.*action repeat\), "


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        ("mine.yml other/mine.yml", {}, "two variants are called mine"),
        ("mine.yml missing.yml", {}, "missing.yml: cannot be read: No such file"),
        ("mine.yml default.yml", {}, "no entry of one environment in common: name environments"),
        ("empty.yml", {}, "empty.yml: variants: .*at least 1 item"),
        ("mine.yml", {"environments": ["Pendulm-v1"]}, "unknown environment 'Pendulm-v1'.*nearest: Pendulum-v1"),
        ("mine.yml", {"environments": ["Hopper-v5"]}, "mine.yml: neither 'Hopper-v5' nor 'default' is there"),
        ("default.yml", {"environments": ["CartPole-v1"]}, "CartPole-v1 cannot be trained .*Discrete"),
        ("mine.yml", {"checkpoints": []}, f"n_timesteps ends the runs on {ENV} at 400 environment steps: name checkpoints"),
        ("default.yml", {"environments": ["reacher-easy"], "checkpoints": [302]}, BETWEEN + r"\[302\] are not"),
        ("default.yml", {"environments": ["reacher-easy"], "every": 6}, BETWEEN + r"\[6, .* are not"),
    ],
)
def test_what_cannot_be_trained_is_refused(names: str, options: dict[str, Any], message: str, folder: Path) -> None:
    (folder / "other").mkdir()
    (folder / "other" / "mine.yml").write_text(OWN)
    (folder / "default.yml").write_text("default: {env_kwargs: {action_repeat: 4}}\n")
    (folder / "empty.yml").write_text("base: default.yml\nvariants: {}\n")
    with pytest.raises(ValueError, match=message):
        check_matrix(load(names, **options))
    assert not Path("out").exists()


def plant(matrix: Any) -> None:
    for cell, about in matrix.abouts.items():
        path = cell_folder(matrix.folder, cell)
        path.mkdir(parents=True, exist_ok=True)
        write_about(path, {**about, "sessions": [{"commit": "c0ffee", "threads": 1}], "seconds": 3.0})
        write_curve(path / "curve.csv", [Evaluation(steps, 1.0, 0.5, 1, 3.0) for steps in about["evaluations"]])


@pytest.mark.parametrize(
    ("old", "new", "options", "message"),
    [
        ("gamma: 0.9", "gamma: 0.8", {}, "gamma=0.9, not 0.8"),
        ("", "aux_loss: none", {}, "aux_loss='auto', not None"),
        ("aux_loss: none", "", {}, "aux_loss=None, not 'auto'"),
        ("", "aux_loss: aarl-state", {}, "aux_loss='auto', not 'aarl-state'"),
        ("", "", {"checkpoints": [500]}, r"evaluations=\[400\], not \[500\]"),
        ("", "", {"evaluation_episodes": 3}, "evaluation_episodes=10, not 3"),
    ],
)
def test_other_seeds_of_a_variant_are_trained_alike(
    old: str, new: str, options: dict[str, Any], message: str, folder: Path
) -> None:
    (folder / "mine.yml").write_text(f"{ENV}: {{{old}}}\n")
    plant(load())
    (folder / "mine.yml").write_text(f"{ENV}: {{{new}}}\n")
    with pytest.raises(ValueError, match=f"out has runs of mine on {ENV} with {message}: name another folder"):
        load(seeds=[1], **options)
    load(seeds=[1], folder=Path("another"), **options)
    (folder / "mine.yml").write_text(f"{ENV}: {{{old + ', ' if old else ''}n_timesteps: 9, device: cpu}}\n")
    load(seeds=[1])


def test_a_run_that_is_there_twice_is_refused(folder: Path) -> None:
    plant(load("mine.yml plain.yml", seeds=[0, 1], checkpoints=[200, 400]))
    assert len(read_abouts(Path("out"))) == 4
    curves = paper_figures.read_curves(Path("out"))
    assert len(curves) == 8 and set(curves["env"]) == {ENV} and set(curves["environment_steps"]) == {200, 400}
    path = cell_folder(Path("out"), Cell("mine", ENV, 1))
    assert ".." not in cell_folder(Path("out"), Cell("..", ENV, 1)).parts
    shutil.copytree("out", "out/another")  # another benchmark, in a folder below
    assert len(read_abouts(Path("out"))) == 4
    about = read_about(path)
    write_about(path, {**about, "seed": 0})
    with pytest.raises(ValueError, match=f"have the same run: mine on {ENV}, seed 0"):
        read_abouts(Path("out"))
    (path / ABOUT).write_text("{}")
    assert len(read_abouts(Path("out"))) == 3
    with pytest.raises(ValueError, match="no learning curves"):
        paper_figures.read_curves(folder / "nowhere")


def test_the_time_to_go_is_that_of_the_runs_that_are_left(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_aarl.search.execution.matrix.POLL_SECONDS", 0)
    matrix = load("mine.yml", seeds=[0, 1, 2], checkpoints=[80])
    curve = [Evaluation(80, 0.0, 0.0, 1, 40.0)]
    future: Future[Any] = Future()
    progress = run_matrix(matrix, SimpleNamespace(submit=lambda *_: future), workers=1)
    assert next(progress).seconds_to_go is None
    write_curve(cell_folder(Path("out"), next(iter(matrix.runs))) / "curve.csv", curve)
    future.set_result({"curve": [list(point) for point in curve], "failure": None, "retry": False})
    assert next(progress) == (3, 1, 0, pytest.approx(80))


@pytest.mark.slow
def test_runs_are_those_without_a_benchmark_and_what_fails_does_not_hide_the_others(folder: Path) -> None:
    (folder / "bursts.yml").write_text(OWN.replace("learning_starts: 40", "learning_starts: 5\n  learning_rate: 1.0e+30"))
    matrix = load("mine.yml bursts.yml", seeds=[3], checkpoints=[80], every=40, evaluation_episodes=1)
    with LocalExecutor(2) as executor:
        (*_, last) = run_matrix(matrix, executor, workers=2)
    assert (last.finished, last.failed) == (1, 1)
    mine, bursts = matrix.runs
    outcomes = [read_outcome(cell_folder(Path("out"), cell)) for cell in (mine, bursts)]
    assert outcomes[0] is not None and outcomes[0].failure is None and outcomes[1] is not None
    reason = outcomes[1].failure
    assert reason
    runs = table.read_runs(Path("out")).set_index("variant")
    assert runs["mean"].notna().to_dict() == {"mine": True, "bursts": False} and runs.loc["bursts", "reason"] == reason

    prepare_run(folder / "alone", matrix.runs[mine])
    curve = train(folder / "alone")
    path = cell_folder(Path("out"), mine)
    assert [point[:4] for point in read_curve(path / "curve.csv")] == [point[:4] for point in curve]
    (row,) = scores(matrix).dropna().to_dict("records")
    assert row["variant"] == "mine" and row["score"] == pytest.approx(aulc(curve))
    about = json.loads((path / ABOUT).read_text())
    assert {key: about[key] for key in matrix.abouts[mine]} == matrix.abouts[mine]
    assert about["seconds"] > 0 and about["hyperparameters"] == load_hyperparameters(about["file"], ENV)
    (session,) = about["sessions"]
    assert {"commit", "command", "date", "cpu", "gpu", "python", "versions"} <= set(session) and session["threads"] == 1
    load("mine.yml", seeds=[3, 4], checkpoints=[40, 80], evaluation_episodes=1)  # more seeds, other steps to compare at


def test_the_commit_says_whether_files_differ_from_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "search" / "training").mkdir(parents=True)
    monkeypatch.setattr(provenance, "__file__", str(folder / "search" / "training" / "provenance.py"))
    for command in ("init", "add mine.yml", "-c user.name=me -c user.email=me@here commit -m first"):
        subprocess.run(["git", *command.split()], check=True, capture_output=True)
    commit = provenance.commit.__wrapped__
    clean = commit()
    (folder / "mine.yml").write_text("changed")
    assert re.fullmatch("[0-9a-f]{12}", clean) and commit() == f"{clean}-dirty"
