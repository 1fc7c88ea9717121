"""Training a candidate: reports, pruning, failures that stay its own, and going on after a kill."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from gymnasium.utils import EzPickle
from optuna.exceptions import StorageInternalError
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.samplers import RandomSampler
from optuna.storages import RetryHeartbeatStaleTrialCallback
from optuna.trial import FrozenTrial, TrialState
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_aarl import AuxLoss, SACAux
from sb3_aarl.callbacks import Evaluation, LearningCurveCallback, SingleEpisodes, aulc, read_curve
from sb3_aarl.envs import make_dmc_env
from search.evolution.sampler import AuxLossSampler
from search.evolution.space import loss_to_params
from search.execution import driver as evolve
from search.execution import workers
from search.execution.local import Unfit, WorkerError
from search.execution.storage import open_storage
from search.studies.objective import CandidateFailed, DiskError, Objective, disk_problem, make_pruner, mean_curve
from search.training import run as training
from search.studies.config import load_config
from search.training.config import ConfigError
from search.training.run import TrainingError, spread_checkpoints, train_candidate

LOSS = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
ENV = "dm_control/cartpole-balance-v0"
# 25 agent steps are an episode.
HYPER: dict[str, Any] = {
    "env_kwargs": {"action_repeat": 40},
    "buffer_size": 1000,
    "learning_starts": 10,
    "batch_size": 8,
    "predictor_width": 8,
    "policy_kwargs": {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8, "width": 8}},
    "device": "cpu",
}
CHECKPOINTS = (800, 1600, 2400)


class Broken(gym.Env):
    """Fails in a way of its own after some steps."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode: str | None = None, failure: str = "raise", after: int = 30):
        self.failure = failure
        self.after = after
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.steps += 1
        if self.steps > self.after:
            if self.failure == "raise":
                raise RuntimeError("the simulator\nexploded")
            if self.failure == "memory":
                raise MemoryError("no memory left")
            if self.failure == "interrupt":
                raise KeyboardInterrupt
            return np.full(2, np.nan, np.float32), 0.0, False, False, {}
        return np.zeros(2, np.float32), 0.0, False, self.steps % 10 == 0, {}


for failure in ("raise", "memory", "interrupt", "diverge"):
    gym.register(f"Broken-{failure}-v0", Broken, kwargs={"failure": failure}, disable_env_checker=True)


class Counting(gym.Env, EzPickle):
    """Episodes of 10 steps; counts the steps of all its environments, notes their seeds, and pickles without its state."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    steps = 0
    seeds: ClassVar[list[int]] = []

    def __init__(self, render_mode: str | None = None):
        EzPickle.__init__(self, render_mode)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        if seed is not None:
            Counting.seeds.append(seed)
        self.left = 10
        return np.zeros(2, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        Counting.steps += 1
        self.left -= 1
        return np.zeros(2, np.float32), 0.0, False, self.left == 0, {}


gym.register("Counting-v0", Counting, disable_env_checker=True)


@pytest.fixture(autouse=True, scope="module")
def key(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A key for these tests, instead of the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AARL_KEY_FILE", str(tmp_path_factory.mktemp("user") / "key"))
        yield


def make_objective(folder: Path, **settings: Any) -> Objective:
    (folder / "hyper.yml").write_text(yaml.safe_dump({"default": HYPER}))
    values = {
        "environment": ENV,
        "hyperparameters": "hyper.yml",
        "checkpoints": list(CHECKPOINTS[:2]),
        "evaluation_episodes": 1,
        "max_horizon": 2,
        **settings,
    }
    (folder / "search.yml").write_text(yaml.safe_dump(values))
    return Objective(load_config(folder / "search.yml"), folder / "runs")


def make_study(pruner: BasePruner | None = None, losses: int = 1) -> optuna.Study:
    study = optuna.create_study(direction="maximize", sampler=RandomSampler(seed=0), pruner=pruner or NopPruner())
    for i in range(losses):
        study.enqueue_trial(loss_to_params(AuxLoss.parse("{s_t} -> {r_t}" if i % 2 else str(LOSS))))
    return study


# Training.


def test_the_curve_is_that_of_a_plain_training(tmp_path: Path) -> None:
    told: list[Evaluation] = []
    run = train_candidate(ENV, LOSS, HYPER, 3, CHECKPOINTS, 2, tmp_path / "run", told.append)
    settings = {key: value for key, value in HYPER.items() if key != "env_kwargs"}
    model = SACAux("MlpPolicy", make_dmc_env(ENV, action_repeat=40, seed=3), aux_loss=LOSS, seed=3, **settings)
    env_kwargs = {"env_id": ENV, "action_repeat": 40}
    eval_env = make_vec_env(make_dmc_env, 2, seed=0, wrapper_class=SingleEpisodes, env_kwargs=env_kwargs)
    curve = LearningCurveCallback(eval_env, CHECKPOINTS, 2, seed=3_010_000)
    model.learn(60, curve)
    assert [point[:4] for point in run.curve] == [point[:4] for point in curve.curve]
    assert run.aulc == pytest.approx(np.mean([point.mean for point in curve.curve]))
    assert told == run.curve == read_curve(tmp_path / "run" / "curve.csv")
    # The replay buffer is gone.
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == ["curve.csv", "run.json"]


def test_other_gymnasium_environments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = train_candidate("Pendulum-v1", None, HYPER | {"env_kwargs": {"frame_stack": 2}}, 0, [30, 60], 1)
    assert [point.environment_steps for point in run.curve] == [30, 60]
    assert not list(tmp_path.iterdir())


def test_a_finished_training_is_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = (ENV, LOSS, HYPER, 0, [400], 1, tmp_path)
    first = train_candidate(*arguments)
    other = train_candidate(*arguments[:3], 1, *arguments[4:])  # another seed does not take it for its own
    assert other.curve[0][:2] != first.curve[0][:2]
    monkeypatch.setattr(training, "make_env", None)
    told: list[Evaluation] = []
    assert train_candidate(ENV, LOSS, HYPER, 1, [400], 1, tmp_path, told.append) == other
    assert told == other.curve


def test_the_model_is_kept_and_never_overwritten(tmp_path: Path) -> None:
    run = train_candidate(ENV, LOSS, HYPER, 0, [800], 1, tmp_path, keep_model=True)
    model = SACAux.load(tmp_path / "model.zip")
    assert model.num_timesteps == 20 and model.aux_loss == LOSS
    env = make_dmc_env(ENV, action_repeat=40)
    observation, _ = env.reset(seed=10_000)
    total, over = 0.0, False
    while not over:
        observation, reward, _, over, _ = env.step(model.predict(observation, deterministic=True)[0])
        total += reward
    # Evaluated one gradient step before the end.
    assert total == pytest.approx(run.curve[-1].mean, rel=0.1)
    with pytest.raises(FileExistsError, match="another training"):
        train_candidate(ENV, LOSS, HYPER, 1, [800], 1, tmp_path, keep_model=True)
    assert SACAux.load(tmp_path / "model.zip").seed == 0


@pytest.mark.parametrize(
    ("steps", "n", "repeat", "expected"),
    [(500_000, 5, 4, (100_000, 200_000, 300_000, 400_000, 500_000)), (1000, 3, 8, (328, 656, 984)), (7, 1, 4, (4,))],
)
def test_checkpoints_are_spread(steps: int, n: int, repeat: int, expected: tuple[int, ...]) -> None:
    assert spread_checkpoints(steps, n, repeat) == expected


def test_too_few_steps_are_refused() -> None:
    with pytest.raises(ValueError, match="too few"):
        spread_checkpoints(30, 4, 8)


# Several environments.


@pytest.fixture
def learned(monkeypatch: pytest.MonkeyPatch) -> list[SACAux]:
    """The models that have learned."""
    models: list[SACAux] = []
    learn = SACAux.learn

    def watched(self: SACAux, *args: Any, **kwargs: Any) -> SACAux:
        models.append(learn(self, *args, **kwargs))
        return self

    monkeypatch.setattr(SACAux, "learn", watched)
    return models


@pytest.mark.parametrize(
    ("n_envs", "evaluated_after", "updates"),
    # Environment steps of all environments; updates for all transitions after the random ones but the last step's, as
    # many as the last step has: 20 agent steps, of which 10 are random.
    [(1, [20, 40], 10), (2, [20, 40], 10), (4, [24, 40], 12)],
)
def test_the_steps_of_all_environments_count(
    n_envs: int, evaluated_after: list[int], updates: int, learned: list[SACAux]
) -> None:
    hyper = HYPER | {"env_kwargs": {"action_repeat": 2}, "n_envs": n_envs, "gradient_steps": -1, "train_freq": 1}
    after: list[int] = []
    began = Counting.steps

    def on_evaluation(evaluation: Evaluation) -> None:
        # 3 episodes of 10 steps in each evaluation, and not a step more.
        after.append(Counting.steps - began - 30 * (len(after) + 1))

    run = train_candidate("Counting-v0", LOSS, hyper, 0, [20, 40], 3, on_evaluation=on_evaluation)
    assert [point.environment_steps for point in run.curve] == [20, 40]
    assert after == evaluated_after
    (model,) = learned
    assert model.num_timesteps == 20 and model._n_updates == updates
    assert model.replay_buffer.size() * n_envs == 20


def test_environments_in_processes_of_their_own_are_the_same_run(learned: list[SACAux]) -> None:
    hyper = HYPER | {
        "env_kwargs": {"action_repeat": 40, "pixels": True, "image_size": 16, "frame_stack": 2},
        "policy_kwargs": {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8, "n_filters": 4}},
        "augmentation": "none",
        "gradient_steps": -1,
        "n_envs": 2,
    }
    dummy, subproc = (train_candidate(ENV, LOSS, hyper | {"vec_env": kind}, 1, [800], 1) for kind in ("dummy", "subproc"))
    assert dummy.curve[0][:4] == subproc.curve[0][:4]
    one, other = learned
    assert one._n_updates == other._n_updates == 10
    assert all(value.equal(other.policy.state_dict()[key]) for key, value in one.policy.state_dict().items())
    assert one._frame_stack == other._frame_stack == 2


def test_an_interruption_stays_one_where_the_processes_of_environments_are_gone() -> None:
    env = make_vec_env("Pendulum-v1", 1, vec_env_cls=SubprocVecEnv)
    with pytest.raises(KeyboardInterrupt), training._closed(env):
        env.processes[0].kill()
        env.processes[0].join()
        raise KeyboardInterrupt


def test_the_death_of_an_environments_process_costs_neither_checkpoint_nor_candidate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as by the kernel, when memory runs out: the same candidate goes on from where it was."""
    hyper = HYPER | {"n_envs": 2, "gradient_steps": -1, "vec_env": "subproc"}
    undisturbed = train_candidate(ENV, LOSS, hyper, 0, CHECKPOINTS, 1)
    made: list[VecEnv] = []

    def make(*arguments: Any, **keywords: Any) -> VecEnv:
        made.append(make_vec_env(*arguments, **keywords))
        return made[-1]

    def kill(evaluation: Evaluation) -> None:
        if evaluation.environment_steps == CHECKPOINTS[1]:
            assert isinstance(made[0], SubprocVecEnv)
            made[0].processes[0].kill()

    monkeypatch.setattr(training, "make_vec_env", make)
    with pytest.raises(training.EnvironmentLost, match="process of an environment was killed"):
        train_candidate(ENV, LOSS, hyper, 0, CHECKPOINTS, 1, tmp_path, kill)
    assert [path.name for path in (tmp_path / "checkpoint").iterdir()] == [str(CHECKPOINTS[0])]
    run = train_candidate(ENV, LOSS, hyper, 0, CHECKPOINTS, 1, tmp_path)
    assert [point[:4] for point in run.curve] == [point[:4] for point in undisturbed.curve]


def test_an_environment_that_raises_in_its_process_is_the_candidates_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hyper = HYPER | {"n_envs": 2, "vec_env": "subproc", "env_kwargs": {}}
    # The other process has not registered it.
    monkeypatch.setattr(training, "make_env", lambda env_id, env_kwargs: Broken())
    with pytest.raises(TrainingError) as error:
        train_candidate("Broken-raise-v0", LOSS, hyper, 0, [20, 100], 1, tmp_path)
    assert not isinstance(error.value, training.EnvironmentLost)
    assert not (tmp_path / "checkpoint").exists()


def test_a_candidate_whose_environment_died_is_given_out_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deaths = iter([True, True, False])

    def train(*arguments: Any, **keywords: Any) -> training.TrainingRun:
        if next(deaths):
            raise training.EnvironmentLost("the process of an environment was killed")
        return training.TrainingRun([Evaluation(800, 1.0, 0.0, 1, 0.0)], 1.0)

    monkeypatch.setattr("search.studies.objective.train_candidate", train)
    objective = make_objective(tmp_path)
    study = optuna.create_study(
        direction="maximize", sampler=AuxLossSampler(n_random=1, n_prior=0, n_stages=1, max_horizon=2, seed=0)
    )
    study.optimize(objective, n_trials=3, catch=CandidateFailed)
    assert [trial.state for trial in study.trials] == [TrialState.FAIL, TrialState.FAIL, TrialState.COMPLETE]
    assert len({trial.user_attrs["loss"] for trial in study.trials}) == 1
    assert study.trials[0].user_attrs["reason"] == "the process of an environment was killed"


def test_a_worker_whose_gpu_failed_ends_and_another_one_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All further calls of its process would fail, and innocent candidates with them."""
    objective = make_objective(tmp_path, n_random=2, n_prior=0, stages=1)
    config, where = objective.config, f"sqlite:///{tmp_path / 'study.db'}"
    sampler = AuxLossSampler(**config.sampler_settings())
    study = optuna.create_study(study_name="search", storage=open_storage(where), sampler=sampler, direction="maximize")
    evolve.keep_config(study, config)

    def fail(*arguments: Any, **keywords: Any) -> training.TrainingRun:
        raise training.DeviceError("the GPU failed: CUDA error: unspecified launch failure")

    with monkeypatch.context() as patch:
        patch.setattr("search.studies.objective.train_candidate", fail)
        with pytest.raises(Unfit, match=r"^the GPU failed: CUDA error: unspecified launch failure$"):
            evolve.run_worker("search", tmp_path, where, 60)
    (failed,) = study.trials
    assert failed.state == TrialState.FAIL and failed.user_attrs["reason"].startswith("the GPU failed: CUDA error")
    run = training.TrainingRun([Evaluation(800, 1.0, 0.0, 1, 0.0)], 1.0)
    monkeypatch.setattr("search.studies.objective.train_candidate", lambda *arguments, **keywords: run)
    evolve.run_worker("search", tmp_path, where, 60)
    assert [trial.state for trial in study.trials] == [TrialState.FAIL, TrialState.COMPLETE, TrialState.COMPLETE]
    assert study.trials[1].user_attrs["loss"] == failed.user_attrs["loss"]


@pytest.mark.parametrize("kind", ["journal", "sqlite"])
def test_a_study_that_somebody_deletes_is_named(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objective = make_objective(tmp_path, n_random=2, n_prior=0, stages=1)
    where = str(tmp_path) if kind == "journal" else f"sqlite:///{tmp_path / 'study.db'}"
    sampler = AuxLossSampler(**objective.config.sampler_settings())
    study = optuna.create_study(study_name="search", storage=open_storage(where), sampler=sampler, direction="maximize")
    evolve.keep_config(study, objective.config)

    def delete(*arguments: Any, on_evaluation: Callable[[Evaluation], bool], **keywords: Any) -> training.TrainingRun:
        optuna.delete_study(study_name="search", storage=open_storage(where))
        evaluation = Evaluation(800, 1.0, 0.0, 1, 0.0)
        on_evaluation(evaluation)
        return training.TrainingRun([evaluation], 1.0)

    monkeypatch.setattr("search.studies.objective.train_candidate", delete)
    message = r"^study 'search' was deleted from its storage$"
    with pytest.raises(ValueError, match=message):
        evolve.run_worker("search", tmp_path, where, 60)
    with pytest.raises(ValueError, match=message), evolve._explained(study, "search", tmp_path):
        evolve.look(study, sampler)


def test_what_a_worker_said_of_its_disk_is_not_explained_again(tmp_path: Path) -> None:
    problem = disk_problem(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/data/x"))
    assert problem is not None
    with pytest.raises(WorkerError) as raised, evolve._explained(optuna.create_study(), "some", tmp_path):
        raise WorkerError(problem)
    assert str(raised.value) == problem
    with pytest.raises(DiskError) as told, evolve._explained(optuna.create_study(), "some", tmp_path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/data/x")  # of this program's own
    assert str(told.value) == problem


def test_a_worker_that_was_taken_for_dead_trains_no_further_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objective = make_objective(tmp_path, seeds=[0, 1, 2])
    study = optuna.create_study(direction="maximize", sampler=RandomSampler(0))
    trained = []

    def train(*arguments: Any, on_evaluation: Callable[[Evaluation], bool], **keywords: Any) -> training.TrainingRun:
        trained.append(arguments[3])
        if len(trained) == 2:
            assert workers.fail(study, study.trials[0], "its worker died")
        evaluation = Evaluation(800, 1.0, 0.0, 1, 0.0)
        on_evaluation(evaluation)
        return training.TrainingRun([evaluation], 1.0)

    monkeypatch.setattr("search.studies.objective.train_candidate", train)
    study.enqueue_trial(loss_to_params(LOSS))
    with pytest.raises(Exception) as raised:
        study.optimize(objective, n_trials=1)
    assert workers.was_failed(raised.value)
    assert trained == [0, 1]


def test_several_environments_go_on_after_an_interruption(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hyper = HYPER | {"n_envs": 2, "gradient_steps": -1}

    def stop(evaluation: Evaluation) -> None:
        if evaluation.environment_steps == CHECKPOINTS[1]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_candidate(ENV, LOSS, hyper, 0, CHECKPOINTS, 1, tmp_path, stop)
    before = read_curve(tmp_path / "checkpoint" / "800" / "curve.csv")
    begins = trained_steps(monkeypatch)
    run = train_candidate(ENV, LOSS, hyper, 0, CHECKPOINTS, 1, tmp_path)
    assert begins == [(20, 10, 10)]
    assert run.curve[:1] == before
    assert [point.environment_steps for point in run.curve] == list(CHECKPOINTS)


# Checkpoints. That a training which goes on ends as if it had not been killed is shown in test_resume.py.

SCRIPT = """
import json, os, signal, sys
from search.training.run import train_candidate
arguments = json.loads(sys.argv[1])

def on_evaluation(evaluation):
    print(evaluation.environment_steps, flush=True)
    if evaluation.environment_steps == arguments["checkpoints"][1]:
        os.kill(os.getpid(), signal.SIGKILL)

train_candidate(**arguments, on_evaluation=on_evaluation)
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training in another process, which killed itself at its second evaluation."""
    folder, root = tmp_path_factory.mktemp("killed"), Path(__file__).parent.parent
    arguments = {
        "environment": ENV,
        "aux_loss": str(LOSS),
        "hyperparameters": HYPER,
        "seed": 0,
        "checkpoints": CHECKPOINTS,
        "evaluation_episodes": 1,
        "folder": str(folder),
    }
    command = [sys.executable, "-c", SCRIPT, json.dumps(arguments)]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    process = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
    assert process.returncode == -signal.SIGKILL, process.stderr
    assert process.stdout.split() == ["800", "1600"]
    return folder


def copy(folder: Path, to: Path) -> Path:
    return Path(shutil.copytree(folder, to / "copy"))


def trained_steps(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, int]]:
    """Agent steps, gradient steps and transitions in the buffer with which each learning begins."""
    begins: list[tuple[int, int, int]] = []
    learn = SACAux.learn

    def watched(self: SACAux, *args: Any, **kwargs: Any) -> SACAux:
        begins.append((self.num_timesteps, self._n_updates, self.replay_buffer.size()))
        return learn(self, *args, **kwargs)

    monkeypatch.setattr(SACAux, "learn", watched)
    return begins


def test_a_killed_training_goes_on_from_its_checkpoint(killed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = copy(killed, tmp_path)
    assert [path.name for path in (folder / "checkpoint").iterdir()] == ["800"]
    before = read_curve(folder / "checkpoint" / "800" / "curve.csv")
    begins = trained_steps(monkeypatch)
    told: list[Evaluation] = []
    run = train_candidate(ENV, str(LOSS), HYPER, 0, CHECKPOINTS, 1, folder, told.append)
    # 20 agent steps, of which 10 were random: all stored, all trained on.
    assert begins == [(20, 10, 20)]
    assert run.curve[:1] == before and told == run.curve
    assert [point.environment_steps for point in run.curve] == list(CHECKPOINTS)
    assert all(later.seconds > earlier.seconds for earlier, later in zip(run.curve, run.curve[1:], strict=False))
    assert not (folder / "checkpoint").exists()


def test_a_storage_that_fails_is_not_the_candidates_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objective = make_objective(tmp_path)
    study = make_study()
    report, failed = optuna.Trial.report, []

    def fails_once(trial: optuna.Trial, value: float, step: int) -> None:
        if step == 1600 and not failed:
            failed.append(step)
            raise StorageInternalError("locked")
        report(trial, value, step)

    monkeypatch.setattr(optuna.Trial, "report", fails_once)
    with pytest.raises(StorageInternalError, match="locked"):
        study.optimize(objective, n_trials=1, catch=(CandidateFailed,))
    assert study.trials[0].state == TrialState.FAIL and study.trials[0].user_attrs["interrupted"]
    assert "reason" not in study.trials[0].user_attrs
    (checkpoint,) = (tmp_path / "runs").rglob("checkpoint/*")
    assert checkpoint.name == "800"


def test_no_two_trainings_and_evaluations_begin_alike(tmp_path: Path) -> None:
    """Where the episode that ran is cut off, as a simulation that cannot be saved has it."""

    def seeds_of(loss: AuxLoss | None, seed: int) -> tuple[list[int], set[int]]:
        """Those of the training, before and after an interruption, and those of its evaluations."""

        def stop(evaluation: Evaluation) -> None:
            if evaluation.environment_steps == 40:
                raise KeyboardInterrupt

        Counting.seeds.clear()
        arguments = ("Counting-v0", loss, HYPER | {"env_kwargs": {}}, seed, [20, 40, 60], 3, tmp_path / f"{loss} {seed}")
        with pytest.raises(KeyboardInterrupt):
            train_candidate(*arguments, stop)
        n_before = len(Counting.seeds)
        train_candidate(*arguments)
        of_training = [Counting.seeds[0], Counting.seeds[n_before]]
        return of_training, {*Counting.seeds} - {*of_training}

    runs = [0, 1, 2, 9_990, 2**32 - 1]  # numpy's largest
    trained, evaluated = zip(*(seeds_of(LOSS, seed) for seed in runs), strict=True)
    assert all(len(seeds) == 9 for seeds in evaluated) and len(set.union(*evaluated)) == 9 * len(runs)
    assert [of_training[0] for of_training in trained] == runs
    assert all(2**31 <= of_training[1] < 2**32 for of_training in trained) and len({second for _, second in trained}) == len(
        runs
    )
    assert max(set.union(*evaluated)) < 2**31  # and never those of trainings that go on, however long
    assert seeds_of(None, 1)[1] == evaluated[1]  # equal for all losses


def truncate(name: str) -> Callable[[Path], None]:
    def tear(checkpoint: Path) -> None:
        content = (checkpoint / name).read_bytes()
        (checkpoint / name).write_bytes(content[: len(content) // 2])

    return tear


def rename(checkpoint: Path) -> None:
    checkpoint.rename(checkpoint.with_name("unfinished"))


@pytest.mark.parametrize(
    "tear",
    [
        *map(truncate, ("model.zip", "replay_buffer.pkl", "environments.pkl", "run.json", "manifest")),
        lambda path: (path / "curve.csv").unlink(),
        rename,
    ],
    ids=["model", "buffer", "simulation", "description", "manifest", "curve", "unfinished"],
)
def test_a_torn_checkpoint_is_refused(
    killed: Path,
    tmp_path: Path,
    tear: Callable[[Path], None],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    folder = copy(killed, tmp_path)
    tear(folder / "checkpoint" / "800")
    begins = trained_steps(monkeypatch)
    run = train_candidate(ENV, str(LOSS), HYPER, 0, CHECKPOINTS, 1, folder)
    assert begins == [(0, 0, 0)]
    assert [point.environment_steps for point in run.curve] == list(CHECKPOINTS)
    assert ("training begins anew" in caplog.text) is (tear is not rename)
    assert read_curve(folder / "curve.csv") == run.curve


@pytest.mark.parametrize("change", [{"seed": 1}, {"aux_loss": "{s_t} -> {r_t}"}, {"hyperparameters": {"gamma": 0.9}}], ids=str)
def test_a_foreign_checkpoint_is_refused(
    killed: Path, tmp_path: Path, change: dict[str, Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder = copy(killed, tmp_path)
    begins = trained_steps(monkeypatch)
    settings = {"aux_loss": str(LOSS), "seed": 0} | change
    settings["hyperparameters"] = HYPER | change.get("hyperparameters", {})
    train_candidate(ENV, **settings, checkpoints=CHECKPOINTS, evaluation_episodes=1, folder=folder)
    assert begins == [(0, 0, 0)]
    assert "other settings" in caplog.text


def test_a_checkpoint_appears_in_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the second one is written, the first one is whole."""
    seen: list[list[str]] = []
    save = SACAux.save_replay_buffer

    def watched(self: SACAux, path: Path) -> None:
        seen.append(sorted(folder.name.partition("-")[0] for folder in (tmp_path / "checkpoint").iterdir()))
        save(self, path)

    monkeypatch.setattr(SACAux, "save_replay_buffer", watched)
    train_candidate(ENV, LOSS, HYPER, 0, CHECKPOINTS, 1, tmp_path)
    assert seen == [["unfinished"], ["800", "unfinished"]]  # under a name of its own each time


# The objective.


def test_reports_and_attributes_are_those_of_the_curve(tmp_path: Path) -> None:
    study = make_study()
    study.optimize(make_objective(tmp_path), n_trials=1)
    trial = study.trials[0]
    (path,) = (tmp_path / "runs").rglob("curve.csv")
    curve = read_curve(path)
    assert [point.environment_steps for point in curve] == [800, 1600]
    assert trial.intermediate_values == {point.environment_steps: point.mean for point in curve}
    assert trial.value == pytest.approx(aulc(curve))
    attributes = trial.user_attrs
    assert attributes["curve"] == [[point.environment_steps, point.mean, point.std] for point in curve]
    assert attributes["loss"] == attributes["canonical"] == str(LOSS)
    assert attributes["environment"] == ENV
    assert attributes["seconds"] == round(curve[-1].seconds, 1)
    assert attributes["commit"] and "torch 2" in attributes["versions"]


def test_several_seeds(tmp_path: Path) -> None:
    study = make_study()
    study.optimize(make_objective(tmp_path, seeds=[5, 6]), n_trials=1)
    trial = study.trials[0]
    curves = [read_curve(path) for path in sorted((tmp_path / "runs").rglob("curve.csv"))]
    assert [path.parent.name for path in sorted((tmp_path / "runs").rglob("curve.csv"))] == ["seed-5", "seed-6"]
    assert trial.value == pytest.approx(np.mean([aulc(curve) for curve in curves]))
    assert trial.intermediate_values == {point.environment_steps: point.mean for point in curves[0]}
    assert [point[1] for point in trial.user_attrs["curve"]] == pytest.approx(
        [np.mean([curve[i].mean for curve in curves]) for i in range(2)]
    )


def test_the_mean_curve_is_over_all_episodes() -> None:
    returns = np.random.default_rng(0).normal(size=(3, 2, 10))  # seed, evaluation, episode
    curves = [
        [Evaluation(100 * (i + 1), float(row.mean()), float(row.std()), 10, 1.0) for i, row in enumerate(seed)]
        for seed in returns
    ]
    for i, (steps, mean, deviation) in enumerate(mean_curve(curves)):
        assert steps == 100 * (i + 1)
        assert (mean, deviation) == (pytest.approx(returns[:, i].mean()), pytest.approx(returns[:, i].std()))


class PruneAt(BasePruner):
    def __init__(self, step: int):
        self.step = step

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        return trial.last_step == self.step


@pytest.mark.parametrize(("step", "state"), [(800, TrialState.PRUNED), (1600, TrialState.COMPLETE)])
def test_the_pruner_decides_except_at_the_end(tmp_path: Path, step: int, state: TrialState) -> None:
    study = make_study(PruneAt(step))
    study.optimize(make_objective(tmp_path, seeds=[0, 1]), n_trials=1)
    trial = study.trials[0]
    assert trial.state == state
    pruned = state == TrialState.PRUNED
    assert len(trial.user_attrs["curve"]) == (1 if pruned else 2)
    # No other seed was trained, and nothing large is left.
    assert len(list((tmp_path / "runs").rglob("curve.csv"))) == (1 if pruned else 2)
    assert not list((tmp_path / "runs").rglob("checkpoint"))


def test_pruners_of_a_configuration(tmp_path: Path) -> None:
    types = {"none": NopPruner, "median": MedianPruner, "hyperband": HyperbandPruner}
    for name, expected in types.items():
        assert type(make_pruner(make_objective(tmp_path, pruner=name).config)) is expected
    # Hyperband needs steps to work on: its first rung is the first checkpoint.
    study = make_study(make_pruner(make_objective(tmp_path, pruner="hyperband").config), losses=2)
    study.optimize(make_objective(tmp_path, pruner="hyperband"), n_trials=2)
    assert {trial.state for trial in study.trials} <= {TrialState.COMPLETE, TrialState.PRUNED}


@pytest.mark.parametrize(
    ("failure", "reason"),
    [
        ("raise", "RuntimeError: the simulator exploded"),
        ("memory", "out of memory: MemoryError: no memory left"),
        ("diverge", "NonFiniteError: observation from the environment is not finite at agent step 31 (index [0, 0])"),
    ],
)
def test_a_candidate_fails_alone(tmp_path: Path, failure: str, reason: str) -> None:
    env_id, overrides = f"Broken-{failure}-v0", {"env_kwargs": {"action_repeat": 1}}
    objective = make_objective(tmp_path, environment=env_id, checkpoints=[16, 80], overrides=overrides)
    study = make_study(losses=2)
    study.optimize(objective, n_trials=2, catch=CandidateFailed)
    assert [trial.state for trial in study.trials] == [TrialState.FAIL] * 2
    assert all(trial.user_attrs["reason"].endswith(reason) for trial in study.trials)
    # What it learned until then stays, its replay buffer does not.
    assert study.trials[0].intermediate_values == {16: 0.0}
    assert len(list((tmp_path / "runs").rglob("curve.csv"))) == 2
    assert not list((tmp_path / "runs").rglob("checkpoint"))


def test_a_diverging_training_fails_alone(tmp_path: Path) -> None:
    study = make_study()
    study.optimize(make_objective(tmp_path, overrides={"learning_rate": 1e30}), n_trials=1, catch=CandidateFailed)
    assert study.trials[0].state == TrialState.FAIL
    assert "NonFiniteError" in study.trials[0].user_attrs["reason"] and str(LOSS) in study.trials[0].user_attrs["reason"]


def test_settings_that_no_candidate_can_work_with_stop_the_study(tmp_path: Path) -> None:
    study = make_study()
    with pytest.raises(ValueError, match="policy_delay"):
        study.optimize(make_objective(tmp_path, overrides={"policy_delay": 0}), n_trials=1, catch=CandidateFailed)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"policy_kwargs": {"net_arch": {"pi": [8]}}}, "AssertionError: .*qf"),
        ({"policy_kwargs": {"net_arch": [-5]}}, "RuntimeError: .*negative dimension"),
    ],
    ids=str,
)
def test_settings_that_pytorch_and_sb3_refuse_are_one_line(tmp_path: Path, overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=f"{ENV} cannot be trained with these settings: {message}") as error:
        make_study().optimize(make_objective(tmp_path, overrides=overrides), n_trials=1, catch=CandidateFailed)
    assert "\n" not in str(error.value)


def test_an_invalid_candidate_costs_nothing(tmp_path: Path) -> None:
    study = make_study(losses=0)
    study.enqueue_trial({**loss_to_params(LOSS), "source/s_t": False})
    study.optimize(make_objective(tmp_path), n_trials=1)
    assert study.trials[0].state == TrialState.PRUNED
    assert not (tmp_path / "runs").exists()


def test_ctrl_c_leaves_the_checkpoint_and_another_trial_of_the_place_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    objective = make_objective(tmp_path)
    sampler = AuxLossSampler(population_size=2, n_random=2, n_prior=0, max_horizon=2, seed=0)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    evaluate = training.LearningCurveCallback._evaluate

    def interrupted(self: Any) -> bool:
        if self.curve:
            raise KeyboardInterrupt
        return evaluate(self)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(training.LearningCurveCallback, "_evaluate", interrupted)
        study.optimize(objective, n_trials=1, catch=CandidateFailed)
    first = study.trials[0]
    assert first.state == TrialState.FAIL and first.user_attrs["interrupted"] is True
    assert "reason" not in first.user_attrs
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith(f"stage-{first.user_attrs['stage']}-place-{first.user_attrs['place']}-")

    begins = trained_steps(monkeypatch)
    study.optimize(objective, n_trials=2, catch=CandidateFailed)
    again = next(trial for trial in study.trials[1:] if trial.user_attrs["place"] == first.user_attrs["place"])
    assert again.user_attrs["loss"] == first.user_attrs["loss"]
    assert again.state == TrialState.COMPLETE
    assert begins[again.number - 1][0] == 20  # agent steps at the first checkpoint
    assert again.intermediate_values.keys() == {800, 1600}
    assert again.intermediate_values[800] == first.intermediate_values[800]


def interrupt(*arguments: Any, **keywords: Any) -> Any:
    raise KeyboardInterrupt


@pytest.mark.parametrize("moment", ["suggest_aux_loss", "train_candidate", "mean_curve"])
def test_ctrl_c_at_any_moment_is_not_the_candidates_fault(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    objective = make_objective(tmp_path)
    sampler = AuxLossSampler(population_size=2, n_random=2, n_prior=0, max_horizon=2, seed=0)
    study = optuna.create_study(direction="maximize", sampler=sampler)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("search.studies.objective.train_candidate", lambda *_, **__: training.TrainingRun([], 0.0))
        patch.setattr(f"search.studies.objective.{moment}", interrupt)
        study.optimize(objective, n_trials=1, catch=CandidateFailed)
    study.ask()
    first, again = (trial.system_attrs["AuxLossSampler:place"] for trial in study.trials)
    assert again == first


def test_procedures_that_do_not_search_train_given_losses(tmp_path: Path) -> None:
    objective = make_objective(tmp_path)
    study = optuna.create_study(direction="maximize")
    trial = study.ask()
    identity = {"policy_kwargs": {"features_extractor_class": "identity", "features_extractor_kwargs": None}}
    score = objective.train(trial, None, ENV, [2], identity)
    assert trial.user_attrs["loss"] == trial.user_attrs["canonical"] == "none"
    assert score == pytest.approx(np.mean([point[1] for point in trial.user_attrs["curve"]]))


def folders(path: Path) -> list[str]:
    return sorted(curve.parent.parent.name for curve in path.rglob("curve.csv"))


def test_trials_of_one_loss_have_folders_of_their_own(tmp_path: Path) -> None:
    study = make_study(losses=3)  # the first and the last are equal, as TPE may propose them to two workers
    study.optimize(make_objective(tmp_path), n_trials=3)
    first, second, third = folders(tmp_path / "runs")
    assert first.startswith("trial-0-") and second.startswith("trial-1-") and third.startswith("trial-2-")


def test_a_heartbeats_copy_of_a_killed_trial_goes_on_in_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study, objective = make_study(), make_objective(tmp_path)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("search.studies.objective.mean_curve", interrupt)
        study.optimize(objective, n_trials=1)
    with pytest.warns(optuna.exceptions.ExperimentalWarning):
        RetryHeartbeatStaleTrialCallback()(study, study.trials[0])
    begins = trained_steps(monkeypatch)
    study.optimize(objective, n_trials=1)
    assert study.trials[1].state == TrialState.COMPLETE
    assert len(folders(tmp_path / "runs")) == 1 and begins == []  # its training was over


def test_a_study_does_not_take_trainings_of_another_one_for_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The storage was deleted, the folder was not: the trainings may be of another version of this program."""
    begins = trained_steps(monkeypatch)
    for n_trained in (1, 2):
        study = make_study()
        study.optimize(make_objective(tmp_path), n_trials=1)
        assert len(begins) == len(folders(tmp_path / "runs")) == n_trained
    assert study.trials[0].state == TrialState.COMPLETE


def test_names_that_look_alike_in_a_file_system_have_folders_of_their_own(tmp_path: Path) -> None:
    objective, study = make_objective(tmp_path), make_study(losses=0)
    for name in ("SAC", "SAC+", "SAC"):
        objective.train(study.ask(), None, ENV, [0], {"gamma": 0.9} if name == "SAC+" else {}, name)
    assert [name[:4] for name in folders(tmp_path / "runs")] == ["sac-"] * 2
    assert study.trials[0].user_attrs["curve"] == study.trials[2].user_attrs["curve"] != study.trials[1].user_attrs["curve"]


def test_a_failure_has_a_cause(tmp_path: Path) -> None:
    with pytest.raises(TrainingError) as error:
        train_candidate("Broken-raise-v0", LOSS, HYPER | {"env_kwargs": {}}, 0, [80], 1, tmp_path)
    assert isinstance(error.value.__cause__, RuntimeError)
