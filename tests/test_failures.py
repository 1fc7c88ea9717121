"""Candidates that fail alone with their reason: exploding values, memory; and what is not their fault: a full disk."""

import contextlib
import errno
import gc
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import optuna
import pytest
import torch as th
import yaml
from optuna.samplers import RandomSampler
from optuna.trial import TrialState
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_aarl import AuxLoss, SACAux, sac_aux
from sb3_aarl.envs import make_dmc_env
from sb3_aarl.sac_aux import ExplodedError, NonFiniteError
from search.evolution.sampler import AuxLossSampler
from search.evolution.space import loss_to_params
from search.execution.storage import open_storage
from search.studies.objective import CandidateFailed, DiskError, Objective, check_study, disk_problem, memory_problem
from search.studies.config import load_config
from search.training.run import TrainingError

LOSS = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
NETS: dict[str, Any] = {
    "learning_starts": 20,
    "batch_size": 16,
    "predictor_width": 8,
    "policy_kwargs": {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8, "width": 8}},
    "device": "cpu",
}


class Rewarding(gym.Env):
    """Episodes of ten steps with a reward that is given."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, reward: float = 0.0, render_mode: str | None = None):
        self.reward = reward

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.left = 10
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.left -= 1
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), self.reward, False, self.left == 0, {}


gym.register("Rewarding-v0", Rewarding, disable_env_checker=True)


def make_objective(folder: Path, **settings: Any) -> Objective:
    folder.mkdir(exist_ok=True)
    (folder / "hyper.yml").write_text(yaml.safe_dump({"default": NETS}))
    values = {
        "environment": "Rewarding-v0",
        "hyperparameters": "hyper.yml",
        "checkpoints": [30, 60],
        "evaluation_episodes": 1,
        "max_horizon": 2,
        **settings,
    }
    (folder / "search.yml").write_text(yaml.safe_dump(values))
    return Objective(load_config(folder / "search.yml"), folder / "candidates")


def make_study(*losses: str, **arguments: Any) -> optuna.Study:
    study = optuna.create_study(direction="maximize", sampler=RandomSampler(seed=0), **arguments)
    for loss in losses:
        study.enqueue_trial(loss_to_params(AuxLoss.parse(loss)))
    return study


# Exploding Q values.


@pytest.mark.parametrize("aux_loss", [None, LOSS], ids=str)
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_exploding_q_values_stop_a_training(precision: str, aux_loss: AuxLoss | None) -> None:
    model = SACAux(
        "MlpPolicy", "Pendulum-v1", learning_rate=100.0, tau=1.0, aux_loss=aux_loss, precision=precision, seed=0, **NETS
    )
    with pytest.raises(ExplodedError) as error:
        model.learn(200)
    message = str(error.value)
    assert isinstance(error.value, ValueError)  # RL-Zoo prunes trials that end with one
    assert "gradient step 2, agent step 22; auxiliary loss: " + str(aux_loss) in message
    assert "the error of the Q values is" in message and "gamma=0.99" in message
    # Everything is finite still: it is the size that is refused.
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


def test_an_exploding_candidate_fails_alone(tmp_path: Path) -> None:
    objective = make_objective(
        tmp_path, environment="Pendulum-v1", overrides={"learning_rate": 100.0, "tau": 1.0, "target_update_interval": 1}
    )
    study = make_study(str(LOSS))
    study.optimize(objective, n_trials=1, catch=CandidateFailed)
    (trial,) = study.trials
    assert trial.state == TrialState.FAIL
    assert trial.user_attrs["reason"].startswith("ExplodedError: ") and str(LOSS) in trial.user_attrs["reason"]


@pytest.mark.parametrize(
    "make",
    [
        lambda: "Pendulum-v1",
        lambda: make_dmc_env("cartpole-swingup_sparse", action_repeat=8),
        lambda: DummyVecEnv([lambda: Rewarding(0.0)]),
        lambda: DummyVecEnv([lambda: Rewarding(-1e8)]),
        lambda: VecNormalize(DummyVecEnv([lambda: Rewarding(1e8)])),
    ],
    ids=["pendulum", "sparse", "none", "huge", "normalized"],
)
def test_healthy_trainings_stay_far_below_the_limit(make: Callable[[], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sac_aux, "EXPLODED", 1.0)  # a thousandth of it
    model = SACAux("MlpPolicy", make(), aux_loss=LOSS, seed=0, **NETS)
    model.learn(100)
    assert model._n_updates == 80


@pytest.mark.parametrize("gamma", [0.0, 0.9, 0.99])
def test_large_observations_are_no_divergence(gamma: float) -> None:
    """Raw observations of another unit give large Q values from the beginning on; SB3's SAC trains with them."""
    space = gym.spaces.Box(-1e7, 1e7, (2,), np.float32)
    env = gym.wrappers.TransformObservation(Rewarding(0.5), lambda obs: 1e7 * obs, space)
    settings = {**NETS, "policy_kwargs": {"net_arch": [16], "features_extractor_class": "identity"}}
    model = SACAux("MlpPolicy", env, aux_loss=None, gamma=gamma, seed=0, **settings)
    model.learn(60)
    assert model._n_updates == 40
    # What is far beyond these is one.
    with pytest.raises(ExplodedError, match=r"^c is "):
        model._check_q_values("c", np.array([1e12]), [41], 0.0)


@pytest.mark.parametrize("gamma", [0.9, 0.99])
@pytest.mark.parametrize(("reward", "ent_coef"), [(0.0, 0.0), (-50.0, 0.0), (3.0, 2.0)])
def test_the_limit(gamma: float, reward: float, ent_coef: float) -> None:
    model = SACAux("MlpPolicy", DummyVecEnv([lambda: Rewarding(reward)]), aux_loss=None, gamma=gamma, seed=0, **NETS)
    model.learn(30)
    # Discounted rewards of the same size for ever, and the largest log density at each of these steps.
    allowed = sum(gamma**i * (max(1.0, abs(reward)) + 34 * ent_coef) for i in range(5000))
    for name, values in (("a", [allowed * 999]), ("b", [0.0, allowed * 999])):
        model._check_q_values(name, np.array(values), [7, 8], ent_coef)
    with pytest.raises(ExplodedError, match=r"^b is .* at gradient step 8, "):
        model._check_q_values("b", np.array([0.0, allowed * 1001]), [7, 8], ent_coef)
    model.gamma = 1.0  # returns have no limit
    model._check_q_values("c", np.array([1e30]), [7], ent_coef)


def test_the_largest_reward_is_saved(tmp_path: Path) -> None:
    model = SACAux("MlpPolicy", DummyVecEnv([lambda: Rewarding(-7.0)]), seed=0, **NETS)
    model.learn(30)
    model.save(tmp_path / "model")
    assert SACAux.load(tmp_path / "model")._largest_reward == 7.0


# What is not finite.


class SpoilGradients(BaseCallback):
    """From an agent step on, the gradient of a parameter is NaN; losses are finite still."""

    def __init__(self, parameter: Callable[[SACAux], th.nn.Parameter], at: int):
        super().__init__()
        self.parameter, self.at = parameter, at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            assert isinstance(self.model, SACAux)
            self.parameter(self.model).register_hook(lambda gradient: gradient * float("nan"))
        return True


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize(
    "parameter",
    [
        lambda model: model.critic.q_networks[0][0].weight,
        lambda model: model.critic.features_extractor.state_dict(keep_vars=True).popitem()[1],
        lambda model: model.actor.mu.weight,
        lambda model: model.aux_head.predictor[0].weight,
        lambda model: model.log_ent_coef,
    ],
    ids=["critic", "encoder", "actor", "head", "entropy"],
)
def test_gradients_that_are_nan_stop_within_two_updates(
    parameter: Callable[[SACAux], th.nn.Parameter], precision: str, tmp_path: Path
) -> None:
    model = SACAux("MlpPolicy", "Pendulum-v1", aux_loss=LOSS, precision=precision, seed=0, **NETS)
    with pytest.raises(NonFiniteError, match=r"(gradient step \d+, agent step \d+; auxiliary loss: \{s_t, a_t\})"):
        model.learn(100, callback=SpoilGradients(parameter, 41))
    assert model.num_timesteps <= 45


# Out of memory.


def test_a_network_that_is_too_large_fails_with_its_size(tmp_path: Path) -> None:
    objective = make_objective(tmp_path, overrides={"policy_kwargs": {"net_arch": [1_000_000, 1_000_000]}})
    study = make_study(str(LOSS))
    study.optimize(objective, n_trials=1, catch=CandidateFailed)
    (trial,) = study.trials
    assert trial.state == TrialState.FAIL
    assert trial.user_attrs["reason"].startswith(f"out of memory ({4e12 / 2**30:,.2f} GiB were asked for): RuntimeError: ")


def test_a_replay_buffer_that_is_too_large_is_named(tmp_path: Path) -> None:
    objective = make_objective(tmp_path, checkpoints=[10**13], overrides={"buffer_size": 10**13})
    study = make_study(str(LOSS))
    study.optimize(objective, n_trials=1, catch=CandidateFailed)
    (trial,) = study.trials
    assert trial.state == TrialState.FAIL
    reason = trial.user_attrs["reason"]
    asked = re.match(r"out of memory \(([0-9,.]+) GiB were asked for\): MemoryError: ", reason)
    assert asked is not None and float(asked[1].replace(",", "")) == pytest.approx(10**13 * 2 * 4 / 2**30, rel=0.01)
    assert "no replay buffer of buffer_size=10000000000000 with observations Box(-1.0, 1.0, (2,), float32)" in reason


SCRIPT = """
import json, pathlib, resource, sys
import psutil
import torch as th
from test_failures import CandidateFailed, make_objective, make_study

th.set_num_threads(1)
policy_kwargs = {"features_extractor_kwargs": {"features_dim": 1000}}
overrides = {"predictor_width": None, "policy_kwargs": policy_kwargs}  # twice the input: quadratic in the number of states
objective = make_objective(pathlib.Path(sys.argv[1]), checkpoints=[24], overrides=overrides)
study = make_study("{s_t} -> {s_t+1}", "{s_t, s_t+1, s_t+2, a_t} -> {s_t, s_t+1, s_t+2}", "{s_t} -> {r_t}")
limit = psutil.Process().memory_info().vms + int(sys.argv[2]) * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
study.optimize(objective, n_trials=3, catch=CandidateFailed)
print(json.dumps([[trial.state.name, trial.user_attrs.get("reason")] for trial in study.trials]))
"""


def test_only_the_candidate_that_needs_too_much_memory_fails(tmp_path: Path) -> None:
    tests = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": f"{tests}{os.pathsep}{tests.parent}"}
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), "250"]
    process = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert process.returncode == 0, process.stderr
    (first, _), (second, reason), (third, _) = json.loads(process.stdout)
    assert (first, second, third) == ("COMPLETE", "FAIL", "COMPLETE"), process.stdout
    assert reason.startswith("out of memory (") and "GiB were asked for" in reason


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (MemoryError(), "out of memory: MemoryError: "),
        (
            np._core._exceptions._ArrayMemoryError((20_000, 20_000), np.dtype(np.float64)),  # type: ignore[attr-defined]
            "out of memory (2.98 GiB were asked for): MemoryError: Unable to allocate 2.98 GiB",
        ),
        (
            th.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 1536.00 MiB. GPU 0 has 139.80 GiB"),
            "out of memory (1.50 GiB were asked for): OutOfMemoryError: CUDA out of memory",
        ),
        (TrainingError("MemoryError: no"), None),  # without its cause it is a text only
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "out of memory: OSError: [Errno 12] Cannot allocate memory"),
        (RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling"), "out of memory: RuntimeError: CUDA error"),
        (RuntimeError("the simulator exploded"), None),
        (OSError(errno.ENOSPC, "No space left on device"), None),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_what_is_said_of_memory(error: BaseException, reason: str | None) -> None:
    said = memory_problem(error)
    assert said is None if reason is None else said is not None and said.startswith(reason)
    wrapped = TrainingError("wrapped")
    wrapped.__cause__ = error
    assert memory_problem(wrapped) == said


def n_models() -> int:
    return sum(isinstance(thing, SACAux) for thing in gc.get_objects())


def test_a_failed_candidate_leaves_no_model_behind(tmp_path: Path) -> None:
    """Else the next one has what is left of the memory."""
    gc.collect()
    before = n_models()
    objective = make_objective(tmp_path, overrides={"learning_rate": 1e30})
    study = make_study(str(LOSS))
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # as in the search: pytest keeps what is logged, traceback and all
    gc.disable()
    try:
        study.optimize(objective, n_trials=1, catch=CandidateFailed, gc_after_trial=True)
        assert n_models() == before
    finally:
        gc.enable()
        optuna.logging.set_verbosity(verbosity)


# A full disk.


@contextlib.contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Callable[[str], None]]:
    """A file system of that size in the folder; gives a function that changes the size."""
    folder.mkdir()

    def mount(*options: str) -> None:
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(folder)], check=True, capture_output=True
        )

    try:
        mount(f"size={size}")
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs the right to mount a file system")
    try:
        yield lambda size: mount("remount", f"size={size}")
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(folder: Path) -> Path:
    """Leave no free byte on a disk."""
    with (folder / "ballast").open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))
    return folder / "ballast"


def make_search(storage: Any, objective: Objective, create: bool = True) -> optuna.Study:
    settings = objective.config.sampler_settings()
    arguments = {"study_name": "search", "storage": storage, "sampler": AuxLossSampler(**settings)}
    return optuna.create_study(direction="maximize", **arguments) if create else optuna.load_study(**arguments)


@pytest.mark.parametrize("kind", ["journal", "sqlite"])
def test_a_full_disk_is_no_candidates_fault(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Candidates and storage are on one disk. It is full at the second candidate's first evaluation."""
    disk = tmp_path / "disk"
    stages = {"stages": 1, "n_random": 3, "n_prior": 0}
    with small_disk(disk, "4m") as resize:
        where = str(disk) if kind == "journal" else f"sqlite:///{disk}/study.db"
        objective = make_objective(tmp_path, **stages, checkpoints=[30, 60])
        objective.folder = disk / "candidates"
        study = make_search(open_storage(where), objective)
        study.optimize(objective, n_trials=1, catch=CandidateFailed)
        (done,) = study.trials

        with monkeypatch.context() as patch:
            report = optuna.Trial.report

            def fill_and_report(trial: optuna.Trial, *arguments: Any) -> None:
                fill(disk)
                report(trial, *arguments)

            patch.setattr(optuna.Trial, "report", fill_and_report)
            with pytest.raises(Exception) as error:  # Optuna's own where the trial cannot be failed either
                study.optimize(objective, n_trials=1, catch=CandidateFailed)
        problem = disk_problem(error.value, objective.folder)
        assert problem is not None and "\n" not in problem
        assert str(disk) in problem and "the same command goes on" in problem

        # Another process finds all that was finished, while the disk is full still.
        resize("8m")
        (disk / "ballast").unlink()
        storage = open_storage(where)
        study = make_search(storage, objective, create=False)
        assert study.trials[0] == done
        second = study.trials[1]
        assert second.state in (TrialState.RUNNING, TrialState.FAIL)
        if second.state == TrialState.RUNNING:  # nothing could be written: that of a worker that has ended
            storage.set_trial_state_values(second._trial_id, TrialState.FAIL)
        assert "reason" not in second.user_attrs
        study.optimize(objective, n_trials=2, catch=CandidateFailed)
        assert [trial.state for trial in study.trials].count(TrialState.COMPLETE) == 3
        again = next(trial for trial in study.trials[2:] if trial.user_attrs["place"] == second.user_attrs["place"])
        assert again.user_attrs["loss"] == second.user_attrs["loss"]


def test_a_full_disk_of_the_candidates_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = tmp_path / "disk"
    with small_disk(disk, "1m") as resize:
        objective = make_objective(tmp_path, stages=1, n_random=1, n_prior=0, checkpoints=[30, 60])
        objective.folder = disk / "candidates"
        study = make_search(None, objective)
        fill(disk)
        with pytest.raises(DiskError, match=f"{disk}.*No space left on device.*the same command goes on"):
            study.optimize(objective, n_trials=1, catch=CandidateFailed)
        first = study.trials[0]
        assert first.state == TrialState.FAIL and first.user_attrs["interrupted"] is True
        assert "reason" not in first.user_attrs
        resize("8m")
        study.optimize(objective, n_trials=1, catch=CandidateFailed)
        assert study.trials[1].state == TrialState.COMPLETE
        assert study.trials[1].user_attrs["loss"] == first.user_attrs["loss"]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/data/x"), "/data/x: No space left on device. "),
        (OSError(errno.EROFS, "Read-only file system"), "/runs, or the storage: Read-only file system. "),
        (RuntimeError("(sqlite3.OperationalError) database or disk is full"), "/runs, or the storage: (sqlite3.Op"),
        (FileNotFoundError(errno.ENOENT, "No such file or directory"), None),
        (ValueError("batch_size"), None),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_what_is_said_of_a_disk(error: Exception, said: str | None) -> None:
    problem = disk_problem(error, Path("/runs"))
    assert problem is None if said is None else problem is not None and problem.startswith(said)

    def wrap() -> None:
        try:
            raise error
        except Exception:
            raise AssertionError("Should not reach.")  # noqa: B904 - as Optuna does

    with pytest.raises(AssertionError) as wrapped:
        wrap()
    assert disk_problem(wrapped.value, Path("/runs")) == problem


# Studies that are something else.


def foreign(suggest: Callable[[optuna.Trial], float], direction: str = "maximize") -> optuna.Study:
    study = optuna.create_study(direction=direction, sampler=RandomSampler(seed=0), study_name="search")
    study.optimize(suggest, n_trials=1)
    return study


def of_space(trial: optuna.Trial, max_horizon: int, operators: list[str] | None = None) -> float:
    from search.evolution.space import suggest_aux_loss

    suggest_aux_loss(trial, max_horizon, operators)
    return 0.0


@pytest.mark.parametrize(
    ("study", "problem"),
    [
        (lambda: foreign(lambda trial: trial.suggest_float("lr", 0, 1)), "trial 0 has the parameter 'lr', FloatDistribution"),
        (lambda: foreign(lambda trial: 1.0), "trial 0 has no parameter 'horizon'"),
        (lambda: optuna.create_study(study_name="search"), r"its directions are \['minimize'\]"),
        (lambda: foreign(lambda trial: of_space(trial, 5)), r"'horizon', .*high=5.*here it is .*high=2"),
        (lambda: foreign(lambda trial: of_space(trial, 2, ["mse", "inner"])), "'operator', .*none of this name here"),
    ],
    ids=["learning-rate", "nothing", "direction", "horizon", "operators"],
)
def test_another_study_of_the_same_name_is_refused(study: Callable[[], optuna.Study], problem: str, tmp_path: Path) -> None:
    objective, study_ = make_objective(tmp_path), study()
    before = study_.user_attrs, study_._storage.get_study_system_attrs(study_._study_id), study_.trials
    with pytest.raises(ValueError, match=f"^study 'search' is not this search: .*{problem}.*Another search needs") as error:
        check_study(study_, objective.config)
    assert "\n" not in str(error.value)
    assert before == (study_.user_attrs, study_._storage.get_study_system_attrs(study_._study_id), study_.trials)
    # And by the objective itself, before anything is trained.
    with pytest.raises(ValueError, match="is not this search"):
        study_.optimize(objective, n_trials=1, catch=CandidateFailed)
    assert not objective.folder.exists()


def test_a_search_is_not_refused(tmp_path: Path) -> None:
    objective = make_objective(tmp_path, operators=["mse"])
    study = optuna.create_study(study_name="search", direction="maximize", sampler=RandomSampler(seed=0))
    check_study(study, objective.config)
    study.enqueue_trial({"horizon": 9})  # the user's mistake, pruned
    study.optimize(lambda trial: of_space(trial, 2, ["mse"]), n_trials=4)
    study.enqueue_trial({})
    check_study(study, objective.config)
