"""A run and its folder: what is refused, how it ends, what it leaves."""

import contextlib
import json
import logging
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from filelock import FileLock, Timeout
from hypothesis import given
from hypothesis import strategies as st
from sb3_aarl.search.training import run as module
from sb3_aarl.search.training.config import ConfigError, load_hyperparameters, spread_checkpoints
from sb3_aarl.search.training.folder import Outcome, is_finished, read_outcome
from sb3_aarl.search.training.provenance import read_about, write_about
from sb3_aarl.search.training.run import Run, check_run, prepare_run, train
from sb3_aarl.search.training.setup import Setup, make_env
from sb3_aarl.search.training.shipped import find_file
from stable_baselines3.common.vec_env import VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import DENSE

from sb3_aarl import SACAux
from sb3_aarl.callbacks import Evaluation, read_curve
from sb3_aarl.health import NonFiniteError


class Walk(gym.Env):
    """Sixteen steps from a random position, rewarded for it; after some steps, whatever ``fault`` says."""

    observation_space = gym.spaces.Box(-100, 100, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    fault: Any = None
    n_steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x = float(self.np_random.normal())
        self.n = 0
        return np.array([self.x, self.n], np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        Walk.n_steps += 1
        self.x += float(action[0])
        self.n += 1
        reward = self.x
        if Walk.fault is not None and Walk.n_steps > 75:
            reward = Walk.fault()
        return np.array([self.x, self.n], np.float32), reward, False, self.n == 16, {}


class Wide(Walk):
    observation_space = gym.spaces.Box(-100, 100, (3,), np.float32)


class Parts(Walk):
    observation_space = gym.spaces.Dict(x=gym.spaces.Box(-100, 100, (2,)))

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        return {"x": super().reset(**kwargs)[0]}, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, *rest = super().step(action)
        return {"x": observation}, *rest


gym.register("Walk-v0", Walk, max_episode_steps=16)
gym.register("Wide-v0", Wide, max_episode_steps=16)
gym.register("WalkInParts-v0", Parts, max_episode_steps=16)


@pytest.fixture(autouse=True)
def no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Walk, "fault", None)
    monkeypatch.setattr(Walk, "n_steps", 0)


def make_run(**changes: Any) -> Run:
    values = {
        "environment": "Walk-v0",
        "aux_loss": "{s_t, a_t} -> {s_t+1}",
        "hyperparameters": DENSE,
        "seed": 3,
        "checkpoints": (32, 64),
        "evaluation_episodes": 2,
    }
    return Run(**{**values, **changes})


def run_program(folder: Path, monkeypatch: pytest.MonkeyPatch, *options: str) -> None:
    """``python -m sb3_aarl.search.training.run`` in this process."""
    monkeypatch.setattr(sys, "argv", ["run.py", str(folder), *options])
    module.main()


# The folder.


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"seed": 4}, "seed is 3 there, 4 here"),
        ({"checkpoints": (32, 96)}, r"checkpoints is \[32, 64\] there, \[32, 96\] here"),
        ({"hyperparameters": DENSE | {"batch_size": 8}}, "hyperparameters.batch_size is 16 there, 8 here"),
        ({"hyperparameters": DENSE | {"gamma": 0.9}}, "hyperparameters.gamma is not set there, 0.9 here"),
        ({"hyperparameters": DENSE | {"policy_kwargs": {"net_arch": [9]}}}, "hyperparameters.policy_kwargs.net_arch"),
    ],
    ids=["seed", "checkpoints", "batch_size", "gamma", "nested"],
)
def test_a_folder_of_another_run_is_refused(changes: dict[str, Any], key: str, tmp_path: Path) -> None:
    prepare_run(tmp_path / "run", make_run())
    before = (tmp_path / "run" / "run.json").read_bytes()
    with pytest.raises(ValueError, match=f"{tmp_path}/run has another run: {key}"):
        prepare_run(tmp_path / "run", make_run(**changes))
    assert (tmp_path / "run" / "run.json").read_bytes() == before
    prepare_run(tmp_path / "run", make_run(imports=("json",)))
    falling = DENSE | {"learning_rate": "lin_1e-3"}  # of a longer run it is another schedule
    prepare_run(tmp_path / "falling", make_run(hyperparameters=falling))
    with pytest.raises(ValueError, match="checkpoints is"):
        prepare_run(tmp_path / "falling", make_run(hyperparameters=falling, checkpoints=(32, 64, 96)))


def test_the_device_may_change(tmp_path: Path) -> None:
    prepare_run(tmp_path, make_run())
    prepare_run(tmp_path, make_run(hyperparameters=DENSE | {"device": "auto", "n_timesteps": 5000}))
    assert json.loads((tmp_path / "run.json").read_text())["hyperparameters"]["device"] == "auto"


# How it ends.


def test_a_finished_run_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare_run(tmp_path, make_run())
    assert read_outcome(tmp_path) is None and not is_finished(tmp_path)
    seen: list[list[int]] = []

    def on_evaluation(curve: list[Evaluation]) -> None:
        seen.append([point.environment_steps for point in curve])
        with pytest.raises(Timeout):
            FileLock(tmp_path / "lock", timeout=0).acquire()

    curve = train(tmp_path, on_evaluation=on_evaluation)
    assert seen == [[32], [32, 64]]
    assert read_outcome(tmp_path) == Outcome(curve, None, False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["curve.csv", "lock", "provenance.json", "run.json"]

    monkeypatch.setattr(SACAux, "learn", None)
    prepare_run(tmp_path, make_run())
    assert train(tmp_path) == curve == read_curve(tmp_path / "curve.csv")


def test_the_model_is_kept_and_evaluated_as_documented(tmp_path: Path) -> None:
    """The last point of the curve, with one environment after the other."""
    prepare_run(tmp_path, make_run(keep_model=True, hyperparameters=DENSE | {"gradient_steps": 0}))
    curve = train(tmp_path)
    model = SACAux.load(tmp_path / "model.zip")
    env = make_env("Walk-v0", {})
    returns = []
    for i in range(2):
        obs, _ = env.reset(seed=10_000 + 3 * 1_000_000 + 1000 * 1 + i)
        returns.append(0.0)
        over = False
        while not over:
            obs, reward, _, over, _ = env.step(model.predict(obs, deterministic=True)[0])
            returns[-1] += float(reward)
    assert curve[-1].mean == pytest.approx(np.mean(returns)) and curve[-1].episodes == 2

    (tmp_path / "model.zip").unlink()
    assert not is_finished(tmp_path) and read_outcome(tmp_path) is None


def test_a_run_that_is_stopped_ends_at_once_and_is_promoted_later(tmp_path: Path) -> None:
    checkpoints = (32, 64, 96)
    prepare_run(tmp_path / "undisturbed", make_run(checkpoints=checkpoints))
    expected = train(tmp_path / "undisturbed")
    prepare_run(tmp_path, make_run())
    curve = train(tmp_path, on_evaluation=lambda curve: (tmp_path / "stop").touch())
    n_steps = Walk.n_steps
    assert [point.environment_steps for point in curve] == [32] and read_outcome(tmp_path) is None
    assert train(tmp_path) == curve and Walk.n_steps <= n_steps + 1  # it is still told to stop
    prepare_run(tmp_path, make_run(checkpoints=checkpoints))
    whole = train(tmp_path)
    assert [point[:4] for point in whole] == [point[:4] for point in expected]
    assert not (tmp_path / "checkpoint.pt").exists()


def test_a_promoted_run_does_not_begin_again_with_random_actions(tmp_path: Path) -> None:
    settings = {key: value for key, value in DENSE.items() if key != "learning_starts"}
    prepare_run(tmp_path, make_run(hyperparameters=settings, keep_model=True))
    train(tmp_path, on_evaluation=lambda curve: (tmp_path / "stop").touch())
    prepare_run(tmp_path, make_run(hyperparameters=settings, keep_model=True, checkpoints=(32, 64, 128)))
    train(tmp_path)
    model = SACAux.load(tmp_path / "model.zip")
    assert model.learning_starts == 6 and model._n_updates == 128 - 6


def test_a_candidate_that_fails_is_not_to_be_retried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Walk, "fault", lambda: float("nan"))
    prepare_run(tmp_path, make_run(checkpoints=(16, 64), evaluation_episodes=1))
    with pytest.raises(NonFiniteError):
        run_program(tmp_path, monkeypatch)
    outcome = read_outcome(tmp_path)
    assert outcome is not None and outcome.failure is not None and not outcome.retry
    assert outcome.failure.startswith("NonFiniteError: reward") and "\n" not in outcome.failure
    assert [point.environment_steps for point in outcome.curve] == [16]
    assert not (tmp_path / "checkpoint.pt").exists()


@pytest.mark.parametrize(("environment", "settings"), [("Walk-v0", {}), ("WalkInParts-v0", {"normalize": True})])
def test_an_environment_that_fails_is_retried_from_the_checkpoint(
    environment: str, settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def explode() -> float:
        raise RuntimeError("the simulator\nexploded")

    hyperparameters = {key: value for key, value in DENSE.items() if key != "policy_kwargs"} | settings
    run = make_run(environment=environment, hyperparameters=hyperparameters, checkpoints=(16, 64), evaluation_episodes=1)
    prepare_run(tmp_path / "undisturbed", run)
    expected = train(tmp_path / "undisturbed")

    prepare_run(tmp_path / "run", run)
    monkeypatch.setattr(Walk, "n_steps", 0)
    monkeypatch.setattr(Walk, "fault", explode)
    with pytest.raises(RuntimeError, match="exploded"):
        run_program(tmp_path / "run", monkeypatch)
    outcome = read_outcome(tmp_path / "run")
    assert outcome is not None and outcome[1:] == ("RuntimeError: the simulator exploded", True)
    assert len(outcome.curve) == 1 and (tmp_path / "run" / "checkpoint.pt").exists()

    monkeypatch.setattr(Walk, "fault", None)
    prepare_run(tmp_path / "run", run)
    assert read_outcome(tmp_path / "run") is None
    run_program(tmp_path / "run", monkeypatch)
    outcome = read_outcome(tmp_path / "run")
    assert outcome is not None and [point[:4] for point in outcome.curve] == [point[:4] for point in expected]


def test_a_second_process_waits_and_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare_run(tmp_path, make_run())
    monkeypatch.setattr(module, "LOCK_SECONDS", 0.1)
    with FileLock(tmp_path / "lock"):
        with pytest.raises(Timeout):
            train(tmp_path)
        with pytest.raises(SystemExit, match=str(module.LOCKED)):
            run_program(tmp_path, monkeypatch)
    assert read_outcome(tmp_path) is None  # that of the first one will be there
    assert len(train(tmp_path)) == 2


EXITS = """
import os
import gymnasium as gym
from gymnasium.envs.classic_control import PendulumEnv

class Exits(PendulumEnv):
    n_steps = 0

    def step(self, action):
        Exits.n_steps += 1
        if Exits.n_steps == 20:
            os._exit(3)
        return super().step(action)

gym.register("Exits-v0", Exits, max_episode_steps=10)
"""


def test_a_full_disk_is_the_reason_of_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit on the size of files stands for it: a part of a checkpoint would take the room of the reason."""
    prepare_run(tmp_path, make_run())
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    with pytest.raises(OSError, match="File too large"), contextlib.ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_FSIZE, limits)
        run_program(tmp_path, monkeypatch)
    assert "File too large" in str(read_outcome(tmp_path))
    assert not [path for path in tmp_path.iterdir() if path.stat().st_size > 10_000]


@pytest.mark.slow
def test_an_environment_that_ends_its_process_leaves_no_outcome(tmp_path: Path) -> None:
    """And the modules that register environments are found in the working directory."""
    log = "import logging; logging.info('of another library')"
    (tmp_path / "exits.py").write_text(EXITS.replace("os._exit(3)", f"{log}; os._exit(3)"))
    prepare_run(tmp_path / "run", make_run(environment="Exits-v0", imports=("exits",), checkpoints=(10, 30)))
    program = [sys.executable, "-m", "sb3_aarl.search.training.run", str(tmp_path / "run")]
    ended = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 3 and "of another library" not in ended.stderr  # its last line is the reason of a failure
    assert read_outcome(tmp_path / "run") is None


# What it leaves, and what it is trained with.


def test_provenance_keeps_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare_run(tmp_path, make_run(aux_loss="auto"))
    write_about(tmp_path, {"variant": "ours", "environment": "Walk"})

    def interrupt(curve: list[Evaluation]) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, on_evaluation=interrupt)
    assert "seconds" not in read_about(tmp_path)
    curve = train(tmp_path)
    about = read_about(tmp_path)
    assert about["variant"] == "ours" and about["environment"] == "Walk"
    assert about["seconds"] == curve[-1].seconds
    for session in about["sessions"]:
        assert session["device"] == "cpu" and session["threads"] == 1 and "->" in session["aux_loss"] and session["commit"]
    assert len(about["sessions"]) == 2


def test_evaluations_are_normalized_like_training_without_changing_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[VecNormalize] = []

    class Watched(VecNormalize):
        def __init__(self, *args: Any, **kwargs: Any):
            super().__init__(*args, **kwargs)
            made.append(self)

    monkeypatch.setattr("sb3_aarl.search.training.setup.VecNormalize", Watched)
    prepare_run(tmp_path, make_run(hyperparameters=DENSE | {"normalize": {"clip_obs": 5.0}, "gamma": 0.9}))
    train(tmp_path)
    training, evaluation = made
    assert training.training and training.norm_reward and training.clip_obs == evaluation.clip_obs == 5.0
    assert training.gamma == 0.9 and not evaluation.training and not evaluation.norm_reward
    # Every observation up to the last evaluation was counted once: 64 steps, the first reset and that after the checkpoint.
    assert evaluation.obs_rms.count == training.obs_rms.count == pytest.approx(66, abs=0.01)


def test_the_replay_buffer_is_no_larger_than_the_run() -> None:
    for n_envs in (1, 2):  # which share it
        assert Setup(make_run(hyperparameters=DENSE | {"n_envs": n_envs}), "test").settings["buffer_size"] == 64
    unset = {name: value for name, value in DENSE.items() if name != "buffer_size"}
    long = make_run(hyperparameters=unset, checkpoints=(2_000_000,))
    assert Setup(long, "test").settings["buffer_size"] == 1_000_000  # SB3's default


def test_tensorboard_has_every_evaluation_of_a_short_run(tmp_path: Path) -> None:
    """SB3 alone writes after every fourth episode."""
    hyperparameters = DENSE | {"tensorboard_log": str(tmp_path / "tensorboard")}
    prepare_run(tmp_path / "run", make_run(checkpoints=(16, 32, 48), hyperparameters=hyperparameters))
    curve = train(tmp_path / "run")
    (folder,) = (tmp_path / "tensorboard").iterdir()
    events = EventAccumulator(str(folder)).Reload()
    assert [(event.step, event.value) for event in events.Scalars("eval/mean_reward")] == [
        (point.environment_steps, pytest.approx(point.mean)) for point in curve
    ]
    for name in (
        "rollout/ep_rew_mean",
        "rollout/ep_len_mean",
        "eval/environment_steps",
        "train/critic_loss",
        "train/aux_loss",
    ):
        assert events.Scalars(name)[-1].step == 48


def test_learning_rates_that_fall(tmp_path: Path) -> None:
    rates = {"learning_rate": "lin_1e-2", "aux_kwargs": {"learning_rate": "lin_2e-3"}}
    prepare_run(tmp_path, make_run(hyperparameters=DENSE | rates, keep_model=True))
    train(tmp_path)
    model = SACAux.load(tmp_path / "model.zip")
    assert [model.lr_schedule(share) for share in (1, 0.25)] == pytest.approx([1e-2, 2.5e-3])
    assert model.aux_optimizer is not None and model.ent_coef_optimizer is not None
    # At the last step, nothing is left of them.
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.aux_optimizer, model.ent_coef_optimizer):
        assert optimizer.param_groups[0]["lr"] == 0


def test_wrappers_are_in_training_and_evaluation(tmp_path: Path) -> None:
    wrappers = ["gymnasium.wrappers.ClipAction", {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 8}}]
    setup = Setup(make_run(hyperparameters=DENSE | {"env_wrapper": wrappers}), "here")
    assert setup.episode_steps == 8
    for env in (setup.training_env(), setup.evaluation_env()):
        env.reset()
        assert [bool(env.step(np.array([[0.0]] * env.num_envs))[2][0]) for _ in range(8)] == [False] * 7 + [True]
        assert env.env_is_wrapped(gym.wrappers.ClipAction)[0]


def test_wrappers_of_rl_zoo_can_be_trained_with(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3", reason="pip install 'sb3-aarl[zoo]'")
    wrappers = ["sb3_contrib.common.wrappers.TimeFeatureWrapper", {"rl_zoo3.wrappers.HistoryWrapper": {"horizon": 3}}]
    prepare_run(tmp_path, make_run(hyperparameters=DENSE | {"env_wrapper": wrappers}, keep_model=True))
    train(tmp_path)
    # Two numbers and the time, three times, and three actions.
    assert SACAux.load(tmp_path / "model.zip").observation_space.shape == (3 * 3 + 3,)


@pytest.mark.slow
def test_environments_in_processes_are_the_same(tmp_path: Path) -> None:
    curves = []
    for vec_env in ("dummy", "subproc"):
        run = make_run(environment="Pendulum-v1", hyperparameters=DENSE | {"vec_env": vec_env}, checkpoints=(30, 60))
        prepare_run(tmp_path / vec_env, run)
        curves.append([point[:4] for point in train(tmp_path / vec_env)])
    assert curves[0] == curves[1]


# What is refused before it is trained.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environment": "CartPole-v1"}, r"CartPole-v1 cannot be trained with these settings: .*Box"),
        ({"environment": "Walk-v7"}, "Walk-v7 cannot be trained with these settings: .*Walk"),
        ({"environment": "Wide-v0"}, r"Wide-v0 cannot be trained with these settings: .*shape \(2,\)"),
        ({"aux_loss": "{s_t} -> {s_t+17}"}, "episodes have 16 environment steps, the horizon of .* 17"),
        ({"batch_size": 0}, "batch_size must be at least 1"),
        ({"train_freq": 3, "n_envs": 2}, r"checkpoints .* multiples of 6 .*\[32, 64\] are not"),
        ({"train_freq": [2, "episode"]}, "train_freq"),
        ({"train_freq": [1, "episode"], "n_envs": 2}, "only one env"),
        ({"policy_kwargs": {"n_critics": 0}}, "Walk-v0 cannot be trained with these settings"),
        ({"policy_kwargs": {"net_arc": [3]}}, "Walk-v0 cannot be trained .*net_arc"),
        ({"policy_kwargs": {"optimizer_kwargs": {"epss": 1}}}, "Walk-v0 cannot be trained .*epss"),
        ({"policy_kwargs": {"features_extractor_class": "dens"}}, "Walk-v0 cannot be .*dense_mlp"),
        ({"replay_buffer_kwargs": {"frame": 2}}, "Walk-v0 cannot be trained .*frame"),
        ({"normalize": {"norm_obz": True}}, "Walk-v0 cannot be trained .*norm_obz"),
        ({"env_wrapper": "gymnasium.wrappers.TimeLimit"}, "missing 1 required .*'max_episode_steps'"),
        ({"policy": "MultiInputPolicy", "policy_kwargs": {}}, "MultiInputPolicy is for Dict spaces, not for Box"),
    ],
    ids=str,
)
def test_settings_that_do_not_fit(changes: dict[str, Any], message: str) -> None:
    changes = changes if {"environment", "aux_loss"} & {*changes} else {"hyperparameters": DENSE | changes}
    with pytest.raises(ConfigError, match=message) as error:
        check_run(make_run(**changes), "own.yml")
    assert str(error.value).startswith("own.yml: ") and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["sac", "sac_aux"])
def test_shipped_files_train_on_dicts_too(name: str) -> None:
    settings = load_hyperparameters(find_file(Path(name)), "WalkInParts-v0")
    check_run(make_run(environment="WalkInParts-v0", aux_loss=settings.pop("aux_loss", "auto"), hyperparameters=settings))


def test_an_error_of_an_environment_names_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("oops.py").write_text(EXITS.replace("Exits", "Oops").replace("os._exit(3)", "raise KeyError('speed')"))
    with pytest.raises(ConfigError, match=r"^Oops-v0 raised KeyError: 'speed' \(.*oops.py, line 12\)$"):
        check_run(make_run(environment="Oops-v0", imports=("oops",)), "own.yml")


def test_a_run_is_tried_out_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for train_freq in (1, (1, "episode"), 32):
        check_run(make_run(hyperparameters=DENSE | {"tensorboard_log": "logs", "train_freq": train_freq}), "own.yml")
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr("stable_baselines3.common.utils.SummaryWriter", None)  # without tensorboard
    with pytest.raises(ConfigError, match=r"own.yml: Walk-v0 cannot be trained .*tensorboard"):
        check_run(make_run(hyperparameters=DENSE | {"tensorboard_log": "logs"}), "own.yml")


@pytest.mark.parametrize(
    ("checkpoints", "n_envs", "n_warnings"), [((16, 32), 1, 0), ((16, 30), 1, 1), ((16, 32), 2, 1), ((10, 32), 1, 1)]
)
def test_evaluations_closer_than_an_episode(
    checkpoints: tuple[int, ...], n_envs: int, n_warnings: int, caplog: pytest.LogCaptureFixture
) -> None:
    check_run(make_run(checkpoints=checkpoints, hyperparameters=DENSE | {"n_envs": n_envs}), "own.yml")
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warnings) == n_warnings and all("truncate" in warning for warning in warnings)


def test_a_run_too_short_to_learn_is_said_before_it_starts(caplog: pytest.LogCaptureFixture) -> None:
    check_run(make_run(hyperparameters=DENSE | {"learning_starts": 64}), "own.yml")
    check_run(make_run(hyperparameters=DENSE | {"learning_starts": 63}), "own.yml")
    assert [record.getMessage() for record in caplog.records] == [
        "Walk-v0: all 64 agent steps are random actions, and nothing is learnt: learning_starts is 64"
    ]


@given(st.integers(1, 10**6), st.integers(1, 30), st.integers(1, 16))
def test_checkpoints_are_spread_equally(environment_steps: int, n: int, interval: int) -> None:
    if environment_steps < n * interval:
        with pytest.raises(ValueError, match=f"{environment_steps} environment steps"):
            spread_checkpoints(environment_steps, n, interval)
        return
    checkpoints = spread_checkpoints(environment_steps, n, interval)
    assert len(checkpoints) == n and {checkpoint % interval for checkpoint in checkpoints} == {0}
    assert len({after - before for before, after in zip((0, *checkpoints), checkpoints, strict=False)}) == 1
    assert environment_steps - n * interval < checkpoints[-1] <= environment_steps
