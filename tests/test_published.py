"""Every candidate that the paper published trains: 35 + 35 + 29 + 25 in tables 9, 12, 13 and 14."""

import copy
import math

import gymnasium as gym
import pytest
import torch as th
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.logger import Logger

from sb3_aarl import SACAux, catalog

PUBLISHED = catalog.published()


def make_env(observation: str) -> gym.Env:
    if observation == "state":
        return gym.make("Pendulum-v1", max_episode_steps=30)
    return FakeImageEnv(action_dim=2, screen_height=16, screen_width=16, n_channels=3, discrete=False)


@pytest.fixture(scope="module")
def filled() -> dict[str, tuple[gym.Env, SACAux]]:
    """For both kinds of observations an environment, and a model without an auxiliary loss that has seen 90 steps of it."""
    made = {}
    for observation in ("state", "pixel"):
        env = make_env(observation)
        model = make_model(observation, env, None)
        model.learn(90)
        made[observation] = env, model
    return made


def make_model(observation: str, env: gym.Env, loss: object) -> SACAux:
    state = observation == "state"
    return SACAux(
        "MlpPolicy" if state else "CnnPolicy",
        env,
        buffer_size=100,
        learning_starts=1000,
        batch_size=8,
        policy_delay=1,
        target_update_interval=1,
        aux_kwargs={"predictor_width": 16},
        aux_loss=loss,
        policy_kwargs={
            "net_arch": [16],
            "features_extractor_kwargs": {"features_dim": 8, **({} if state else {"n_filters": 4})},
        },
        seed=0,
        device="cpu",
    )


@pytest.mark.slow
@pytest.mark.parametrize("table", [9, 12, 13, 14])
def test_trains(table: int, filled: dict[str, tuple[gym.Env, SACAux]]) -> None:
    for candidate in (candidate for candidate in PUBLISHED if candidate.table == table):
        env, source = filled[candidate.observation]
        model = make_model(candidate.observation, env, candidate.loss)
        model.replay_buffer = source.replay_buffer
        model.set_logger(Logger(None, []))
        before = copy.deepcopy(model.aux_head.state_dict())

        model.train(1, batch_size=8)

        logged = model.logger.name_to_value
        assert logged["train/aux_skipped"] == 0
        for name in ("aux_loss", "critic_loss", "actor_loss", "ent_coef_loss"):
            assert math.isfinite(logged[f"train/{name}"]), (candidate, name)
        # The gradient that the step leaves on encoder and head is the auxiliary loss's: the actor adds none.
        for name, parameter in [*model.critic.features_extractor.named_parameters(), *model.aux_head.named_parameters()]:
            finite = th.isfinite(parameter).all() and th.isfinite(parameter.grad).all()
            assert finite and parameter.grad.any(), (candidate, name)
        assert all(not th.equal(value, before[name]) for name, value in model.aux_head.state_dict().items())
