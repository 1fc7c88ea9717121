"""Learning curve at fixed environment steps, and the area under it (AULC)."""

import csv
import io
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, sync_envs_normalization

from sb3_aarl.files import replace_text


class Evaluation(NamedTuple):
    """
    One point of a learning curve.

    :param environment_steps: Environment steps that were trained (agent steps x action repeat)
    :param mean: Mean return of the episodes
    :param std: Standard deviation of their returns
    :param episodes: Number of episodes
    :param seconds: Wall time since training began, evaluations included
    """

    environment_steps: int
    mean: float
    std: float
    episodes: int
    seconds: float


def aulc(curve: Sequence[Evaluation]) -> float:
    """Area under a learning curve as the paper approximates it (figure 4): the mean of equally spaced evaluations."""
    return float(np.mean([evaluation.mean for evaluation in curve]))


class LearningCurveCallback(BaseCallback):
    """
    Evaluate with deterministic actions at fixed environment steps (paper, A.2: 10 episodes).

    Episode i of evaluation k is that of ``reset(seed=seed + 1000 * k + i)``, so that runs can be compared and a resumed run
    has the same initial states. As many episodes run at once as there are evaluation environments, with one prediction for
    all. Their number changes the last bits of actions, as matrix products of other sizes round differently, and contacts
    amplify them: compare runs that are evaluated with equally many. The last checkpoint may be the end of training.

    :param eval_env: Environment to evaluate on, not the one that is trained on. A VecEnv, such as
        ``make_vec_env(make_dmc_env, 10, env_kwargs=...)``, has at most ``n_eval_episodes``
    :param checkpoints: Environment steps (agent steps x action repeat) at which to evaluate, ascending
    :param n_eval_episodes: Episodes of each evaluation
    :param action_repeat: Environment steps of one agent step, None for that of the environment's wrappers
    :param seed: Seed of the initial states
    :param path: CSV file that the curve is written to after every evaluation, None for no file
    :param on_evaluation: Called after each evaluation; training stops if it returns False
    :param curve: Evaluations before this run was resumed
    :param verbose: 1 prints each evaluation
    :raises ValueError: when the checkpoints are not ascending, lie between two agent steps or before those of a model that
        goes on, or a VecEnv is too large
    """

    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        checkpoints: Sequence[int],
        n_eval_episodes: int = 10,
        action_repeat: int | None = None,
        seed: int = 0,
        path: str | Path | None = None,
        on_evaluation: Callable[[Evaluation], bool | None] | None = None,
        curve: Sequence[Evaluation] = (),
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if not isinstance(eval_env, VecEnv):
            env = eval_env if is_wrapped(eval_env, Monitor) else Monitor(eval_env)
            eval_env = DummyVecEnv([lambda: env])
        self.eval_env = eval_env
        if action_repeat is None:
            action_repeat = int(eval_env.get_attr("num_repeats")[0]) if eval_env.has_attr("num_repeats") else 1
        self.action_repeat = action_repeat
        self.checkpoints = list(checkpoints)
        if not self.checkpoints or sorted({*self.checkpoints}) != self.checkpoints or self.checkpoints[0] < 1:
            raise ValueError(f"checkpoints must be positive environment steps in ascending order, not {self.checkpoints}")
        for checkpoint in self.checkpoints:
            if checkpoint % action_repeat:
                raise ValueError(f"checkpoint {checkpoint} is no multiple of the action repeat {action_repeat}")
        if eval_env.num_envs > n_eval_episodes:
            raise ValueError(f"eval_env has {eval_env.num_envs} environments, more than n_eval_episodes={n_eval_episodes}")
        self.n_eval_episodes = n_eval_episodes
        self.seed = seed
        self.path = None if path is None else Path(path)
        self.on_evaluation = on_evaluation
        self.curve = list(curve)
        self._started = 0.0

    def _on_training_start(self) -> None:
        environment_steps = self.num_timesteps * self.action_repeat
        if self._started and not environment_steps:
            self.curve = []  # that was another run's
        if not self.curve and self.checkpoints[0] < environment_steps:
            raise ValueError(f"checkpoint {self.checkpoints[0]} is over: the model has {environment_steps} environment steps")
        self._seconds_before = self.curve[-1].seconds if self.curve else 0.0
        self._started = time.monotonic()

    def _on_step(self) -> bool:
        # With several environments, or a resumed run, one step may pass more than one checkpoint.
        environment_steps = self.num_timesteps * self.action_repeat
        while len(self.curve) < len(self.checkpoints) and environment_steps >= self.checkpoints[len(self.curve)]:
            if not self._evaluate():
                return False
        return True

    def _evaluate(self) -> bool:
        """One evaluation; whether training continues."""
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        returns = self._episode_returns(self.seed + 1000 * len(self.curve))
        evaluation = Evaluation(
            environment_steps=self.checkpoints[len(self.curve)],
            mean=float(np.mean(returns)),
            std=float(np.std(returns)),
            episodes=len(returns),
            seconds=round(self._seconds_before + time.monotonic() - self._started, 3),
        )
        self.curve.append(evaluation)
        if self.path is not None:
            write_curve(self.path, self.curve)
        self.logger.record("eval/mean_reward", evaluation.mean)
        self.logger.record("eval/environment_steps", evaluation.environment_steps)
        self.model.dump_logs()  # SB3 does so every fourth episode: here the log has losses and episodes at each evaluation
        if self.verbose:
            print(f"{evaluation.environment_steps:>9,} environment steps: {evaluation.mean:7.1f} +- {evaluation.std:.1f}")
        return self.on_evaluation is None or self.on_evaluation(evaluation) is not False

    def _episode_returns(self, seed: int) -> list[float]:
        """Returns of the episodes with this seed and the following ones; those that ran at once as they ended."""
        returns: list[float] = []
        while len(returns) < self.n_eval_episodes:
            n = min(self.eval_env.num_envs, self.n_eval_episodes - len(returns))
            # Environment i takes seed + i; of more environments than episodes, evaluate_policy plays with the last ones.
            self.eval_env.seed(seed + len(returns) - (self.eval_env.num_envs - n))
            some, _ = evaluate_policy(self.model, self.eval_env, n, return_episode_rewards=True)
            assert isinstance(some, list)
            returns += some
        return returns

    @property
    def aulc(self) -> float:
        """Area under the learning curve so far."""
        return aulc(self.curve)


def write_curve(path: Path, curve: Sequence[Evaluation]) -> None:
    """Write a learning curve as CSV, one evaluation a line; an old file is replaced in one step."""
    file = io.StringIO(newline="")
    writer = csv.writer(file)
    writer.writerow(Evaluation._fields)
    writer.writerows(curve)
    replace_text(path, file.getvalue())


def read_curve(path: str | Path) -> list[Evaluation]:
    """Read what :func:`write_curve` wrote."""
    kinds = Evaluation.__annotations__.items()
    with Path(path).open(newline="", encoding="utf-8") as file:
        return [Evaluation(*(kind(row[name]) for name, kind in kinds)) for row in csv.DictReader(file)]
