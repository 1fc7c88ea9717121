"""Commands around a search and a run: shipped files by name, costs, status; evaluation and video of a model."""

import logging
import re
from pathlib import Path

import gymnasium as gym
import imageio.v3 as imageio
import optuna
import pytest
import sb3_aarl.search.cli.console
from executors import Planted
from rich.console import Console
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import suggest_aux_loss
from sb3_aarl.search.execution.storage import open_storage
from sb3_aarl.search.studies.config import load_config
from sb3_aarl.search.training.run import prepare_run, train
from sb3_aarl.search.training.setup import measure
from sb3_aarl.search.training.shipped import ZOO, find_file
from test_cli import run
from tiny import HYPERPARAMETERS, SEARCH, tiny_run, write_search

from sb3_aarl import SACAux
from sb3_aarl.callbacks import read_curve

BASELINES = SEARCH + "baselines:\n- {name: SAC}\n- {name: CURL, aux_loss: curl}\n"
# An environment of a user's own, whose reward is the action, and which renders.
OWN_ENV = """\
import gymnasium as gym
import numpy as np


class Own(gym.Env):
    metadata = {"render_modes": ["rgb_array"]}
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), {}

    def step(self, action):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), float(action[0]), False, False, {}

    def render(self):
        return self.np_random.integers(0, 256, (32, 32, 3), np.uint8)


class Unseen(Own):
    def __init__(self):
        pass


class Image(Own):
    observation_space = gym.spaces.Box(0, 255, (16, 16, 3), np.uint8)

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), super().reset(seed=seed)[1]

    def step(self, action):
        return self.observation_space.sample(), *super().step(action)[1:]


class Parts(Image):
    observation_space = gym.spaces.Dict(image=Image.observation_space, speed=gym.spaces.Box(-1, 1, (2,), np.float64))


gym.register("Shown-v0", Own, max_episode_steps=20)
gym.register("Unseen-v0", Unseen, max_episode_steps=20)
gym.register("Blind-v0", type("Blind", (Own,), {"metadata": {}}), max_episode_steps=20)
gym.register("Image-v0", Image, max_episode_steps=20)
gym.register("Parts-v0", Parts, max_episode_steps=20)
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the program runs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("sb3_aarl.search.training.setup.MEASURED_SECONDS", 0.2)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "searches", "file"),
    [
        ("demo", True, "search/demo.yml"),
        ("aarl_state.yml", False, "paper/aarl_state.yml"),
        ("paper/aarl_state", False, "paper/aarl_state.yml"),
    ],
)
def test_shipped_files_have_names(name: str, searches: bool, file: str) -> None:
    assert find_file(Path(name), searches) == ZOO / file


def test_a_file_that_is_there_wins(folder: Path) -> None:
    (folder / "sac").mkdir()  # a folder is none
    assert find_file(Path("sac")) == ZOO / "sac.yml"
    (folder / "aarl_state").write_text("default: {}")
    assert find_file(Path("aarl_state")).samefile(folder / "aarl_state")
    (folder / "elsewhere").mkdir()
    assert find_file(Path("aarl_state"), folder=folder / "elsewhere") == ZOO / "paper/aarl_state.yml"


@pytest.mark.parametrize(
    ("arguments", "nearest"),
    [
        ("search dmo", "demo"),
        ("benchmark arl_state --envs cheetah-run", "aarl_state"),
    ],
)
def test_an_unknown_name_has_the_nearest(arguments: str, nearest: str) -> None:
    assert run(*arguments.split(), code=2).endswith(f"nearest: {nearest}\n")
    assert not Path("runs").exists()


def test_a_search_may_name_a_shipped_file_or_none(folder: Path) -> None:
    config = load_config(write_search(folder, SEARCH.replace("hyperparameters.yml", "sac_identity")))
    assert config.hyperparameters == ZOO / "paper/sac_identity.yml"
    text = SEARCH.replace("hyperparameters: hyperparameters.yml\n", "overrides: {batch_size: 8}\n")
    assert load_config(write_search(folder, text)).hyperparameters_for("Pendulum-v1")["batch_size"] == 8


@pytest.mark.slow
def test_init_writes_a_search_that_runs_and_overwrites_nothing(folder: Path) -> None:
    assert "own.yml" in run("init", "own.yml")
    # One of a candidate's runs, shortened.
    text = Path("own.yml").read_text().replace("[1000, 2000]", "[600, 1200]").replace("evaluation_episodes: 5", "")
    Path("own.yml").write_text(text)
    config = load_config("own.yml")
    assert config.cross_validation and len(config.baselines) == 2
    assert "own.yml" in run("init", "own.yml", code=2) and Path("own.yml").read_text() == text
    # Candidates, baselines, and what is cross-validated.
    assert f"All: {4 + 2 + 2 * (3 + 2)} runs" in run("search", "own.yml", "--generations", 1, "--dry-run")


@pytest.mark.slow
def test_the_cost_of_a_search_is_known_before_it_starts(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_search(folder, SEARCH + "seeds: [0, 1]\n")
    measured: dict[str, float] = {}
    monkeypatch.setattr("sb3_aarl.search.training.setup.measure", lambda run: measured.setdefault("small", measure(run)))
    output = run("search", "small.yml", "--workers", 4, "--dry-run")
    row = next(line for line in output.splitlines() if line.startswith("│ small"))
    # 2 random ones and a prior, then 3; two seeds.
    assert [float(cell) for cell in row.split("│")[2:5]] == [12, *(float(f"{n * measured['small']:.2g}") for n in (1, 12))]
    assert f"All: 12 runs, {12 / 4 * measured['small']:.2g} hours with 4 at once" in output
    assert not Path("runs").exists()


def test_a_benchmark_costs_what_is_not_finished(folder: Path, executor: Planted) -> None:
    write_search(folder)
    options = ["hyperparameters.yml", "--envs", "Pendulum-v1", "--checkpoints", "100,200", "--folder", "bench"]
    assert "All: 3 runs" in run("benchmark", *options, "--seeds", "0-2", "--dry-run")
    assert not Path("bench").exists()
    run("benchmark", *options, "--seeds", "0")
    assert "All: 2 runs" in run("benchmark", *options, "--seeds", "0-2", "--dry-run")
    assert "All: 0 runs" in run("benchmark", *options, "--seeds", "0", "--dry-run")
    Path("bad.yml").write_text("default: {policy_kwargs: {nett_arch: [8]}}\n")
    assert "nett_arch" in run("benchmark", "bad.yml", *options[1:-1], "bad", "--dry-run", code=2)


def test_status_of_a_search_and_its_baselines(folder: Path, executor: Planted) -> None:
    write_search(folder, BASELINES)
    executor.scores = {None: 3.0}
    run("search", "small.yml", "--generations", 1, "--workers", 2)
    shown = run("status", "small.yml")
    assert shown == run("status", "runs/small")
    assert "generation 1: 3/3 done, 0 running, 0 failed" in shown and "finished" in shown
    write_search(folder, BASELINES + "overrides: {gamma: 0.5}\n")
    for storage in ((), ("--storage", "sqlite:///runs/small/study.db", "--folder", "another")):
        assert "it was started with gamma=None, not 0.5" in run("baselines", "small.yml", *storage, code=2)
    write_search(folder, BASELINES)
    run("baselines", "small.yml")
    assert re.search(r"SAC +│ +1 │ +1 │ +0 │", run("status", "small.yml"))


def test_a_search_refuses_baselines_of_other_settings(folder: Path, executor: Planted) -> None:
    write_search(folder, BASELINES)
    executor.scores = {None: 3.0}
    run("baselines", "small.yml")
    write_search(folder, BASELINES + "overrides: {gamma: 0.5}\n")
    assert "has another run: hyperparameters.gamma is not set there, 0.5 here" in run("search", "small.yml", code=2)
    assert "has another run" not in run("search", "small.yml", "--folder", "another")
    write_search(folder, BASELINES + "screening: 2\n")  # the study that was refused has no settings
    assert "Best" in run("search", "small.yml")


def test_status_of_a_study_made_in_python() -> None:
    sampler = AuxLossSampler(seed=0, population_size=2, n_random=2, n_prior=0)

    def objective(trial: optuna.Trial) -> float:
        loss = suggest_aux_loss(trial)
        if trial.number == 0:
            raise ValueError
        return float(loss.horizon)

    study = optuna.create_study(
        storage=open_storage(Path("runs/own")), sampler=sampler, direction="maximize", study_name="own"
    )
    assert "no trial of an AuxLossSampler" in run("status", "own", code=2)
    study.optimize(objective, 40, catch=ValueError, callbacks=[lambda study, trial: trial.value is None or study.stop()])
    assert "No driver" not in run("status", "own")
    study.set_user_attr("settings", {"rate": 0.1})  # of one's own
    shown = run("status", "own")
    progress = re.search(r"generation 1: (\d+)/\d+ done, 0 running, (\d+) failed", shown)
    assert progress is not None and sum(map(int, progress.groups())) == len(study.trials)
    assert f"best {study.best_value:.2f}" in shown
    optuna.create_study(storage=open_storage(Path("runs/two")), directions=["maximize", "minimize"], study_name="two")
    for command in ("status", "report"):
        assert "study 'two' has 2 objectives" in run(command, "runs/two", code=2)


def test_status_of_a_benchmark(folder: Path) -> None:
    for seed in range(3):
        path = Path(f"bench/some/Pendulum-v1/seed-{seed}")
        prepare_run(path, tiny_run(seed=seed, checkpoints=(200,)))
        (path / "provenance.json").write_text('{"variant": "some"}')
    train(Path("bench/some/Pendulum-v1/seed-0"))
    Path("bench/some/Pendulum-v1/seed-1/failed.json").write_text('{"reason": "it burst", "retry": false}')
    assert re.search(r"some +│ +3 │ +1 │ +1 │", run("status", "bench"))
    assert "neither" in run("status", "nowhere", code=2)


def test_a_log_has_a_line_for_each_change(capsys: pytest.CaptureFixture[str]) -> None:
    with sb3_aarl.search.cli.console.live() as show:
        for done in (1, 1, 2):
            show(f"{done} done, 0:01:00 to go", done)
    lines = [line.partition(" ")[2] for line in capsys.readouterr().err.splitlines()]
    assert lines == ["1 done, 0:01:00 to go", "2 done, 0:01:00 to go"]


def test_messages_are_above_the_progress(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sb3_aarl.search.cli.console, "errors", Console(stderr=True, force_terminal=True))
    with sb3_aarl.search.cli.console.live() as show:
        show("1 done", 1)
        for _ in range(2):  # the second one takes the place of the progress
            sb3_aarl.search.cli.console.Messages().handle(logging.makeLogRecord({"msg": "runs/[a] is resubmitted"}))
    assert "\x1b[2Kruns/[a] is resubmitted\n" in capsys.readouterr().err


def test_the_version() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", run("--version"))


@pytest.fixture
def trained(folder: Path) -> Path:
    """A run of 400 steps whose model was kept, with running statistics."""
    (folder / "own_env.py").write_text(OWN_ENV)
    settings = {**HYPERPARAMETERS, "normalize": True}
    own = tiny_run(environment="Shown-v0", imports=("own_env",), keep_model=True, checkpoints=(100,), hyperparameters=settings)
    prepare_run(Path("trained"), own)
    train(Path("trained"))
    return Path("trained")


def test_a_model_is_evaluated_as_in_its_run(trained: Path) -> None:
    shown = run("evaluate", trained, "--episodes", 3, "--seed", 5)
    # The sum of the actions, not of normalized rewards.
    (point,) = read_curve(trained / "curve.csv")
    assert float(shown.partition(" ± ")[0]) == pytest.approx(point.mean, abs=4)


def test_a_video_of_a_model(trained: Path) -> None:
    assert "19 pictures" in run("video", trained)
    assert imageio.imread(trained / "video.gif", index=None).shape == (19, 32, 32, 3)
    run("video", trained, "--out", "film.mp4")
    assert imageio.improps("film.mp4", plugin="FFMPEG").shape[1:] == (32, 32, 3)


def test_what_cannot_be_played_is_one_line(trained: Path) -> None:
    text = (trained / "run.json").read_text()
    for env, message in (("Unseen", "Unseen-v0 cannot be made"), ("Blind", "Blind-v0 has no pictures")):
        (trained / "run.json").write_text(text.replace("Shown", env))
        assert message in run("video", trained, code=2)
    (trained / "model.zip").unlink()
    assert "model.zip does not exist" in run("evaluate", trained, code=2)


@pytest.mark.parametrize(
    ("env", "policy"), [("Shown-v0", "MlpPolicy"), ("Image-v0", "CnnPolicy"), ("Parts-v0", "MultiInputPolicy")]
)
def test_observations_are_trained_on_as_they_are(env: str, policy: str, folder: Path) -> None:
    (folder / "own_env.py").write_text(OWN_ENV)
    run("train", env, "--imports", "own_env", "--steps", 20, "--evaluations", 1, "--folder", "run")
    assert "mean and deviation" in run("evaluate", "run")
    trained = SACAux.load("run/model.zip", gym.make(env))
    assert trained.policy_class is SACAux.policy_aliases[policy]
