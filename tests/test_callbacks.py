"""Learning curves: evaluated exactly where they should be, repeatable, and without an influence on training."""

import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_aarl import SACAux
from sb3_aarl.callbacks import Evaluation, LearningCurveCallback, aulc, read_curve, write_curve
from sb3_aarl.envs import RepeatAction


class Walk(gym.Env):
    """A random walk of 5 to 9 steps; the reward is where it is. Remembers where its episodes began, and counts steps."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self) -> None:
        self.starts: list[np.ndarray] = []
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.point = self.np_random.normal(size=2).astype(np.float32)
        self.left = int(self.np_random.integers(5, 10))
        self.starts.append(self.point)
        return self.point, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.left -= 1
        self.steps += 1
        self.point = (self.point + 0.1 * action + 0.1 * self.np_random.normal(size=2)).astype(np.float32)
        return self.point, float(self.point[0]), False, self.left == 0, {}


def make_model(env: Any, **kwargs: Any) -> SACAux:
    policy_kwargs = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8}}
    arguments = {"buffer_size": 200, "learning_starts": 5, "batch_size": 8, "seed": 0, "device": "cpu"}
    return SACAux("MlpPolicy", env, aux_loss="forward-dynamics", policy_kwargs=policy_kwargs, **{**arguments, **kwargs})


@pytest.mark.parametrize(
    ("n_envs", "action_repeat", "checkpoints", "at"),
    [
        (1, 1, [5, 6, 20], [5, 6, 20]),
        (1, 3, [9, 30], [3, 10]),
        # With two environments an odd checkpoint is passed, by one step, and two checkpoints may be passed at once.
        (2, 1, [5, 6, 20], [6, 6, 20]),
        (2, 3, [12, 30], [4, 10]),
    ],
)
def test_evaluates_at_the_checkpoints(n_envs: int, action_repeat: int, checkpoints: list[int], at: list[int]) -> None:
    def make_env() -> gym.Env:
        return RepeatAction(Walk(), action_repeat) if action_repeat > 1 else Walk()

    agent_steps: list[int] = []
    reported: list[Evaluation] = []
    model = make_model(DummyVecEnv([make_env] * n_envs))

    def on_evaluation(evaluation: Evaluation) -> None:
        agent_steps.append(model.num_timesteps)
        reported.append(evaluation)

    callback = LearningCurveCallback(make_env(), checkpoints, 2, on_evaluation=on_evaluation)
    model.learn(checkpoints[-1] // action_repeat, callback)
    assert agent_steps == at
    assert [evaluation.environment_steps for evaluation in callback.curve] == checkpoints
    assert reported == callback.curve
    assert callback.aulc == aulc(reported) == pytest.approx(sum(evaluation.mean for evaluation in reported) / len(reported))
    assert all(evaluation.episodes == 2 for evaluation in reported)


def test_seconds_continue_with_training(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(0, 10**6, 10))
    monkeypatch.setattr("sb3_aarl.callbacks.time.monotonic", lambda: float(next(clock)))
    model, callback = make_model(Walk()), LearningCurveCallback(Walk(), [10, 20], 1)
    model.learn(10, callback)
    next(clock)  # between calls of learn() it does not count
    model.learn(10, callback, reset_num_timesteps=False)
    assert [point.seconds for point in callback.curve] == [10.0, 20.0]


def test_another_run_is_evaluated_anew_and_no_checkpoint_that_is_over() -> None:
    model, callback = make_model(Walk()), LearningCurveCallback(Walk(), [10, 20], 1)
    model.learn(20, callback)
    first = callback.curve
    model.learn(20, callback)
    assert [point.environment_steps for point in callback.curve] == [10, 20] and callback.curve != first
    late = LearningCurveCallback(Walk(), [10, 30], 1)
    with pytest.raises(ValueError, match="checkpoint 10 is over: the model has 20 environment steps"):
        model.learn(10, late, reset_num_timesteps=False)


def play(model: SACAux, env: gym.Env, seed: int) -> tuple[float, int]:
    """Return and length of the deterministic episode with a seed."""
    observation, _ = env.reset(seed=seed)
    total, steps, over = 0.0, 0, False
    while not over:
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, steps, over = total + float(reward), steps + 1, terminated or truncated
    return total, steps


@pytest.mark.parametrize("at_once", [1, 3, 5])
def test_the_returns_are_those_of_seeded_episodes_however_many_run_at_once(at_once: int) -> None:
    model = make_model(Walk())
    expected: list[list[tuple[float, int]]] = []

    def play_again(_: Evaluation) -> None:
        expected.append([play(model, Walk(), 40 + 1000 * len(expected) + episode) for episode in range(5)])

    callback = LearningCurveCallback(make_vec_env(Walk, at_once), [10, 30], 5, seed=40, on_evaluation=play_again)
    model.learn(30, callback)
    returns = [[total for total, _ in evaluation] for evaluation in expected]
    # Matrix products of more rows round differently.
    np.testing.assert_allclose([point.mean for point in callback.curve], np.mean(returns, 1), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose([point.std for point in callback.curve], np.std(returns, 1), rtol=1e-4, atol=1e-4)


def parameters_after(checkpoints: list[int] | None, episodes: int = 3) -> list[th.Tensor]:
    model = make_model(Walk())
    model.learn(40, None if checkpoints is None else LearningCurveCallback(Walk(), checkpoints, episodes))
    return [*model.policy.parameters(), *model.aux_head.parameters()]


def test_an_evaluation_does_not_disturb_training() -> None:
    plain = parameters_after(None)
    watched = parameters_after([10, 11, 25, 40])
    assert all(th.equal(*pair) for pair in zip(plain, watched, strict=True))


def test_training_ends_when_the_function_returns_false() -> None:
    model = make_model(Walk())
    callback = LearningCurveCallback(Walk(), [10, 20, 30], 1, on_evaluation=lambda point: point.environment_steps < 20)
    model.learn(30, callback)
    assert model.num_timesteps == 20
    assert len(callback.curve) == 2


@pytest.mark.parametrize(
    ("checkpoints", "kwargs", "culprit"),
    [
        ([], {}, "checkpoints"),
        ([5, 5], {}, "checkpoints"),
        ([5, 4], {}, "checkpoints"),
        ([0, 4], {}, "checkpoints"),
        ([5], {"action_repeat": 2}, "checkpoint 5"),
        ([5], {"n_eval_episodes": 0}, "n_eval_episodes"),
    ],
)
def test_wrong_arguments_are_refused(checkpoints: list[int], kwargs: dict[str, int], culprit: str) -> None:
    with pytest.raises(ValueError, match=culprit):
        LearningCurveCallback(Walk(), checkpoints, **kwargs)


def test_more_environments_than_episodes_are_refused() -> None:
    with pytest.raises(ValueError, match="eval_env has 3 environments"):
        LearningCurveCallback(make_vec_env(Walk, 3), [5], n_eval_episodes=2)


finite = st.floats(allow_nan=False, allow_infinity=False)
evaluations = st.builds(Evaluation, st.integers(1, 10**9), finite, finite, st.integers(1, 100), finite)


curves = st.lists(evaluations, max_size=5, unique_by=lambda evaluation: evaluation.environment_steps).map(sorted)


@given(curves, curves)
@settings(max_examples=50, deadline=None)
def test_a_curve_is_read_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, before: list[Evaluation], curve: list[Evaluation]
) -> None:
    path = tmp_path_factory.mktemp("curve") / "new" / "curve.csv"
    write_curve(path, before)
    write_curve(path, curve)
    assert read_curve(path) == curve
    assert [file.name for file in path.parent.iterdir()] == ["curve.csv"]


def test_the_file_has_every_evaluation_at_once(tmp_path: Path) -> None:
    path = tmp_path / "curve.csv"
    rows: list[list[dict[str, str]]] = []

    def read(_: Evaluation) -> None:
        with path.open() as file:
            rows.append(list(csv.DictReader(file)))

    make_model(Walk()).learn(20, LearningCurveCallback(Walk(), [10, 20], 1, path=path, on_evaluation=read))
    assert [[row["environment_steps"] for row in table] for table in rows] == [["10"], ["10", "20"]]
