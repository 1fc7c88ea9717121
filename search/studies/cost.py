"""The cost of runs on this machine, measured on one of each kind."""

import time
from contextlib import closing

import torch as th
from sb3_aarl.search.training.folder import Run
from sb3_aarl.search.training.setup import Setup
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_aarl.buffers import ARRAYS, WindowReplayBuffer

MEASURED_SECONDS = 2.0
MEASURED_STEPS = 50  # at least, so that there are windows
# Of environments that name none.
EPISODE_STEPS = 1000


def measure(run: Run) -> dict[str, float]:
    """Train a run for some seconds, and return what the whole run would take here, evaluations included."""
    th.set_num_threads(run.threads)
    setup = Setup(run, run.environment)
    with closing(setup.training_env()) as env:
        model = setup.model(env)
        learning_starts, gradient_steps = model.learning_starts, model.gradient_steps
        model.learning_starts = MEASURED_STEPS - 2
        model.learn(MEASURED_STEPS)  # the first of everything is slow
        model.learning_starts = model.gradient_steps = 0  # actions of the policy, and no training
        started = time.monotonic()
        model.learn(10**9, lambda *_: time.monotonic() - started < MEASURED_SECONDS)  # type: ignore[arg-type]
        agent_step = (time.monotonic() - started) / model.num_timesteps
        n, started = 0, time.monotonic()
        while time.monotonic() - started < MEASURED_SECONDS:
            model.train(1, model.batch_size)
            n += 1
        gradient_step = (time.monotonic() - started) / n
        episode = (setup.episode_steps or EPISODE_STEPS) / setup.action_repeat
        assert isinstance(model.train_freq, TrainFreq)
        frequency, unit = model.train_freq
        rollout = frequency * env.num_envs * (episode if unit == TrainFrequencyUnit.EPISODE else 1)
        n_updates = max(0, setup.agent_steps - learning_starts) * (1 if gradient_steps < 0 else gradient_steps / rollout)
        evaluated = len(run.checkpoints) * run.evaluation_episodes * episode
        buffer = model.replay_buffer
        assert isinstance(buffer, WindowReplayBuffer)
        arrays = [*(store.frames for store in buffer.stores.values()), *(getattr(buffer, name) for name in ARRAYS)]
        share = min(1.0, setup.agent_steps / buffer.buffer_size / env.num_envs)  # it takes memory as it fills
    return {
        "ms a gradient step": 1000 * gradient_step,
        "hours": ((setup.agent_steps + evaluated) * agent_step + n_updates * gradient_step) / 3600,
        "MB of buffer": share * sum(array.nbytes for array in arrays) / 1e6,
    }
