"""What SB3 promises for SAC holds for SACAux: spaces, images, vectorized environments, wrappers, callbacks, options."""

import inspect
import warnings
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, EveryNTimesteps, StopTrainingOnMaxEpisodes
from stable_baselines3.common.envs import BitFlippingEnv, IdentityEnvBox
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.sac.policies import CnnPolicy, SACPolicy
from test_sac_aux import assert_same
from torch import nn

from sb3_aarl import SACAux, catalog
from sb3_aarl.encoders import DenseMLP

FORWARD_DYNAMICS = "{s_t, a_t} -> {s_t+1}"
EPISODE = 7
VECTOR = spaces.Box(-1, 1, (3,))
SMALL_CNN = {"features_dim": 8, "n_filters": 4, "n_layers": 2}


class RandomEnv(gym.Env):
    """Observations drawn from the space, reward 1, episodes of 7 steps that are terminated and truncated in turn."""

    def __init__(self, observation_space: spaces.Space = VECTOR, action_space: spaces.Space | None = None, seed: int = 0):
        self.observation_space = deepcopy(observation_space)  # with a random generator of its own
        self.action_space = spaces.Box(-1, 1, (2,)) if action_space is None else action_space
        self.observation_space.seed(seed)
        self.episodes = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.episodes += 1
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray):
        assert self.action_space.contains(action)
        self.t += 1
        over, terminates = self.t == EPISODE, self.episodes % 2 == 0
        return self.observation_space.sample(), 1.0, over and terminates, over and not terminates, {}


class ChannelLast(gym.ObservationWrapper):
    """The same images, channels last."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        channels, *size = env.observation_space.shape
        self.observation_space = spaces.Box(0, 255, (*size, channels), np.uint8)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return np.moveaxis(observation, 0, -1)


def image_space(*shape: int) -> spaces.Box:
    return spaces.Box(0, 255, shape, np.uint8)


def make_model(
    env: Any = None, policy: str = "MlpPolicy", policy_kwargs: dict[str, Any] | None = None, **kwargs: Any
) -> SACAux:
    settings: dict[str, Any] = {"buffer_size": 100, "learning_starts": EPISODE, "batch_size": 4, "seed": 0, "device": "cpu"}
    settings |= {"aux_loss": FORWARD_DYNAMICS, "aux_kwargs": {"predictor_width": 16}} | kwargs
    return SACAux(policy, env or RandomEnv(), policy_kwargs={"net_arch": [16]} | (policy_kwargs or {}), **settings)


def networks(model: SACAux) -> dict[str, list[nn.Parameter]]:
    """The parameters by what has to train them."""
    return {
        "encoder": list(model.critic.features_extractor.parameters()),
        "q": model.critic.q_parameters,
        "actor": model.actor.own_parameters(),
        "head": [] if model.aux_head is None else list(model.aux_head.parameters()),
        "momentum encoder": list(model.critic_target.features_extractor.parameters()),
    }


def moved_by_training(model: SACAux, total_timesteps: int = 20) -> dict[str, list[bool]]:
    """Which parameter tensors training changes; all of them have to stay finite."""
    before = {name: [parameter.detach().clone() for parameter in group] for name, group in networks(model).items()}
    model.learn(total_timesteps)
    after = networks(model)
    assert all(parameter.isfinite().all() for group in after.values() for parameter in group)
    return {
        name: [not th.equal(old, new) for old, new in zip(group, after[name], strict=True)] for name, group in before.items()
    }


def assert_all_train(model: SACAux, total_timesteps: int = 20) -> None:
    for name, moved in moved_by_training(model, total_timesteps).items():
        assert moved and all(moved), name


def assert_predicts(model: SACAux, observations: list[Any]) -> np.ndarray:
    """One at a time and as a batch: the same actions, of the right shape, inside the action space, not all the same."""
    space = model.action_space
    single = np.stack([model.predict(observation, deterministic=True)[0] for observation in observations])
    if isinstance(observations[0], dict):
        batch: Any = {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    else:
        batch = np.stack(observations)
    together = model.predict(batch, deterministic=True)[0]
    assert together.shape == (len(observations), *space.shape)
    np.testing.assert_allclose(together, single, rtol=1e-4, atol=1e-5)
    assert all(space.contains(action.astype(space.dtype)) for action in model.predict(batch)[0])
    assert np.ptp(together, axis=0).max() > 0
    return together


@pytest.mark.parametrize("method", ["__init__", "learn"])
def test_defaults_are_those_of_sac(method: str) -> None:
    ours, sacs = (inspect.signature(getattr(cls, method)).parameters for cls in (SACAux, SAC))
    # Why: see the docstring of SACAux.
    constructor = ["learning_rate", "learning_starts", "tau", "ent_coef", "target_entropy"]
    changed = {"__init__": constructor, "learn": ["tb_log_name"]}[method]
    assert [name for name in sacs if ours[name].default != sacs[name].default] == changed


@pytest.mark.parametrize(
    "space",
    [
        VECTOR,
        spaces.Box(-1, 1, (3,), np.float64),
        spaces.Box(-np.inf, np.inf, (2, 3)),
        spaces.Discrete(5),
        spaces.MultiDiscrete([3, 4]),
        spaces.MultiBinary((2, 3)),
        spaces.Box(-1, 1, ()),
    ],
    ids=str,
)
def test_observation_spaces(space: spaces.Space) -> None:
    model = make_model(RandomEnv(space))
    assert_all_train(model, 60)  # every category of a one-hot has to be drawn for every weight to move
    # The environment's own sequence, out of a space with the same seed; the first observation is the one at reset.
    again = RandomEnv(space)
    stored = model.replay_buffer.observations[:EPISODE].reshape(EPISODE, -1)
    drawn = [again.reset()[0], *(again.step(again.action_space.sample())[0] for _ in range(EPISODE - 1))]
    np.testing.assert_array_equal(stored, np.array(drawn).reshape(EPISODE, -1))
    assert_predicts(model, [space.sample() for _ in range(8)])


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (1,)),
        spaces.Box(np.array([-2, 0], np.float32), np.array([1, 100], np.float32)),
        spaces.Box(-3, 3, (2,), np.float64),
        spaces.Box(0, 1, (2, 3)),
    ],
    ids=str,
)
def test_action_spaces(space: spaces.Box) -> None:
    model = make_model(RandomEnv(action_space=space))
    assert_all_train(model)
    stored = model.replay_buffer.actions[:20]
    assert stored.shape == (20, 1, np.prod(space.shape)) and np.abs(stored).max() <= 1
    observations = [VECTOR.sample() for _ in range(5)]
    actions = assert_predicts(model, observations)
    with th.no_grad():
        squashed = model.actor(th.as_tensor(np.stack(observations)), deterministic=True).numpy().reshape(5, *space.shape)
    np.testing.assert_allclose(actions, space.low + (squashed + 1) / 2 * (space.high - space.low), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.MultiBinary(2), spaces.MultiDiscrete([2, 2])], ids=str)
def test_discrete_actions_are_refused(space: spaces.Space) -> None:
    with pytest.raises(AssertionError, match=type(space).__name__):
        make_model(RandomEnv(action_space=space))


@pytest.mark.parametrize(
    ("shape", "encoded"),
    [((1, 36, 36), (1, 36, 36)), ((3, 40, 60), (3, 40, 60)), ((2, 40, 50), (2, 36, 36))],
    ids=str,
)
def test_images_of_any_size(shape: tuple[int, int, int], encoded: tuple[int, int, int]) -> None:
    crop = {} if shape == encoded else {"crop_size": 36}
    kwargs: dict[str, Any] = {"policy": "CnnPolicy", "policy_kwargs": {"features_extractor_kwargs": SMALL_CNN, **crop}}
    first = make_model(RandomEnv(image_space(*shape)), **kwargs)
    assert first.critic.features_extractor._observation_space.shape == encoded
    assert first.policy.augmentation == ("random_shift" if shape == encoded else "random_crop")
    assert_all_train(first)
    last = make_model(ChannelLast(RandomEnv(image_space(*shape))), **kwargs).learn(20)
    assert_same(first.policy.state_dict(), last.policy.state_dict())

    images = [image_space(*shape).sample() for _ in range(3)]
    actions = assert_predicts(first, images)
    np.testing.assert_allclose(assert_predicts(last, [np.moveaxis(image, 0, -1) for image in images]), actions, rtol=1e-5)


MIXED = spaces.Dict(
    {
        "image": image_space(36, 36, 1),
        "wide": image_space(40, 60, 3),
        "vector": spaces.Box(-1, 1, (3,), np.float64),
        "discrete": spaces.Discrete(3),
        "bits": spaces.MultiBinary(2),
    }
)


@pytest.mark.slow
@pytest.mark.parametrize("extractor", ["multi_input", CombinedExtractor], ids=["multi_input", "SB3's"])
def test_dict_observations(extractor: Any) -> None:
    arguments = {"cnn_output_dim": 8}
    kwargs: dict[str, Any] = {"policy_kwargs": {"features_extractor_class": extractor, "features_extractor_kwargs": arguments}}
    model = make_model(RandomEnv(MIXED), policy="MultiInputPolicy", **kwargs)
    moved = moved_by_training(model, 40)
    # NatureCNN on noise: units of a ReLU that are dead for all of it are no fault of the training.
    assert np.mean(moved["encoder"] + moved["momentum encoder"]) > 0.95
    assert all(all(moved[name]) for name in ("q", "actor", "head"))
    observation, other = MIXED.sample(), MIXED.sample()
    other["discrete"], other["bits"] = (observation["discrete"] + 1) % 3, 1 - observation["bits"]
    assert_predicts(model, [observation, other])
    action = model.predict(observation, deterministic=True)[0]
    for key in MIXED.spaces:
        changed = model.predict({**observation, key: other[key]}, deterministic=True)[0]
        assert not np.array_equal(action, changed), f"{key} is not read"


@pytest.mark.parametrize("train_freq", [(2, "step"), (1, "episode")], ids=str)
@pytest.mark.parametrize("gradient_steps", [-1, 2])
def test_vectorized_environments(train_freq: tuple[int, str], gradient_steps: int) -> None:
    n_envs = 3 if train_freq[1] == "step" else 1
    env = DummyVecEnv([lambda i=i: RandomEnv(seed=i) for i in range(n_envs)])
    settings: dict[str, Any] = {"train_freq": train_freq, "gradient_steps": gradient_steps, "learning_starts": 12}
    model = make_model(env, **settings)
    assert_all_train(model, 60)
    reference = SAC("MlpPolicy", env, batch_size=4, device="cpu", policy_kwargs={"net_arch": [16]}, **settings).learn(60)
    assert model._n_updates == reference._n_updates > 0
    assert model.num_timesteps == reference.num_timesteps
    assert model.replay_buffer.size() * n_envs == model.num_timesteps
    # Each env has a sequence of its own, which shows up at its index in the buffer.
    firsts = [RandomEnv(seed=i).reset()[0] for i in range(n_envs)]
    np.testing.assert_array_equal(model.replay_buffer.observations[0], firsts)
    batch = np.stack([VECTOR.sample() for _ in range(n_envs)])
    assert model.predict(batch)[0].shape == (n_envs, 2)


def test_vec_normalize_reaches_the_auxiliary_loss() -> None:
    space = spaces.Box(np.array([0, 50, -5], np.float32), np.array([1, 100, -4], np.float32))
    env = VecNormalize(DummyVecEnv([lambda: RandomEnv(space)]), clip_obs=1.5, gamma=0.9)
    model = make_model(env)
    assert_all_train(model, 30)
    buffer = model.replay_buffer
    raw = buffer.observations[:30, 0]
    assert all(space.contains(observation) for observation in raw)  # stored as the environment returned them

    seen = []
    model.aux_head.register_forward_pre_hook(lambda head, inputs: seen.append(inputs[0]))
    model.train(1, 4)
    normalized = np.clip((raw - env.obs_rms.mean) / np.sqrt(env.obs_rms.var + env.epsilon), -1.5, 1.5)
    rewards = np.clip(1 / np.sqrt(env.ret_rms.var + env.epsilon), -env.clip_reward, env.clip_reward)
    for window in seen[0].observations.numpy():
        assert np.isclose(normalized, window[0], atol=1e-4).all(axis=1).any()
    np.testing.assert_allclose(seen[0].rewards, rewards, rtol=1e-4)


@pytest.mark.parametrize("use_expln", [False, True])
def test_gsde(use_expln: bool) -> None:
    policy_kwargs = {"use_expln": use_expln, "log_std_init": -2.0, "clip_mean": 1.5}
    model = make_model(use_sde=True, sde_sample_freq=4, use_sde_at_warmup=True, train_freq=8, policy_kwargs=policy_kwargs)
    assert (model.actor.log_std == -2).all()
    resampled = []
    reset_noise = model.actor.reset_noise
    model.actor.reset_noise = lambda *args: (resampled.append(model.num_timesteps), reset_noise(*args))[1]
    assert_all_train(model, 24)
    # At the begin of each rollout of 8 steps, every 4 steps in it, and for the gradient step after it.
    assert set(resampled) == {0, 4, 8, 12, 16, 20, 24}

    observation = np.zeros(3, np.float32)
    first = model.predict(observation)[0]
    np.testing.assert_array_equal(first, model.predict(observation)[0])  # the noise is a function of the state
    model.actor.reset_noise()
    assert not np.array_equal(first, model.predict(observation)[0])
    model.policy.zero_grad()
    model.actor.action_log_prob(th.ones(4, 3))[1].sum().backward()
    assert all(parameter.grad is None for parameter in model.critic.features_extractor.parameters())
    assert all(parameter.grad is not None for parameter in model.actor.own_parameters())


@pytest.mark.parametrize("n_envs", [1, 2])
def test_action_noise(n_envs: int) -> None:
    noise: Any = NormalActionNoise(np.full(2, 5.0), np.zeros(2))
    noise = noise if n_envs == 1 else VectorizedActionNoise(noise, n_envs)
    model = make_model(DummyVecEnv([RandomEnv] * n_envs), action_noise=noise)
    assert_all_train(model)
    assert (model.replay_buffer.actions[: model.replay_buffer.size()] == 1).all()


class AroundNetwork(BaseFeaturesExtractor):
    """An encoder around a network that comes as an argument."""

    def __init__(self, observation_space: spaces.Space, network: nn.Module):
        super().__init__(observation_space, 6)
        self.network = network
        self.last = nn.Linear(5, 6)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.last(self.network(observations))


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("frozen", [True, False])
def test_a_network_among_the_arguments_is_copied_for_each_encoder(frozen: bool, share: bool) -> None:
    network = nn.Sequential(nn.Linear(3, 5), nn.Tanh()).requires_grad_(not frozen)
    before = network[0].weight.detach().clone()
    policy_kwargs = {
        "features_extractor_class": AroundNetwork,
        "features_extractor_kwargs": {"network": network},
        "share_features_extractor": share,
    }
    model = make_model(policy_kwargs=policy_kwargs)
    owners = (model.critic, model.critic_target, *([] if share else [model.actor]))
    copies = [owner.features_extractor.network[0] for owner in owners]
    assert len({id(copied) for copied in [network[0], *copies]}) == (3 if share else 4)
    assert all(th.equal(copied.weight, before) for copied in copies)
    assert moved_by_training(model)["encoder"] == [not frozen, not frozen, True, True]
    assert th.equal(network[0].weight, before)


def test_an_encoder_that_critic_and_target_would_share_is_refused() -> None:
    network = nn.Linear(3, 5)

    class AroundTheOne(AroundNetwork):
        def __init__(self, observation_space: spaces.Space):
            super().__init__(observation_space, network)

    with pytest.raises(ValueError, match="AroundTheOne shares a network between critic and target critic"):
        make_model(policy_kwargs={"features_extractor_class": AroundTheOne})


def test_an_actor_is_traced_for_batches_of_any_size() -> None:
    model = make_model()

    class Deterministic(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.actor = model.actor

        def forward(self, obs: th.Tensor) -> th.Tensor:
            return self.actor(obs, deterministic=True)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tracing is deprecated, and warns of Python values
        traced = th.jit.trace(Deterministic(), (th.rand(1, 3),))
    several = th.rand(5, 3)
    with th.no_grad():
        th.testing.assert_close(traced(several), model.actor(several, deterministic=True))


class Doubled(DenseMLP):
    """One of the package's encoders, with a forward pass of its own."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return 2 * super().forward(observations)


def test_an_encoder_derived_from_the_packages_own() -> None:
    extractor = {"features_extractor_class": Doubled, "features_extractor_kwargs": {"features_dim": 4, "width": 3}}
    model = make_model(policy_kwargs=extractor)
    assert_all_train(model)
    observations = th.rand(5, 3)
    encoder = model.critic.features_extractor
    with th.no_grad():
        expected = 2 * encoder.projection(encoder.trunk(observations))
        th.testing.assert_close(model.critic.encode(observations), expected)
        read = model.actor.extract_features(observations, model.actor.features_extractor)
        th.testing.assert_close(read, model.actor.features_extractor.projection(expected))


@pytest.mark.parametrize("policy", [SACPolicy, CnnPolicy])
def test_policies_of_sb3_are_refused(policy: type, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"policy must be MlpPolicy, .*, not <class '.*{policy.__name__}'>"):
        make_model(policy=policy)
    SAC("MlpPolicy", RandomEnv(), device="cpu").save(tmp_path / "model")
    with pytest.raises(ValueError, match="policy must be MlpPolicy"):
        SACAux.load(tmp_path / "model")


@pytest.mark.parametrize(
    ("space", "normalize", "largest"),
    [
        (image_space(1, 36, 36), True, 1),
        (image_space(1, 36, 36), False, 255),
        (spaces.Box(0, 1, (1, 36, 36)), False, 1),
        (image_space(1, 100, 100), False, 255),
    ],
    ids=str,
)
def test_normalize_images(space: spaces.Box, normalize: bool, largest: float) -> None:
    kwargs = {"normalize_images": normalize, "features_extractor_kwargs": SMALL_CNN}
    model = make_model(RandomEnv(space), "CnnPolicy", kwargs)
    seen: list[float] = []
    model.critic.features_extractor.convolutions.register_forward_pre_hook(lambda module, x: seen.append(x[0].max().item()))
    assert_all_train(model)
    assert 0.9 * largest < max(seen) <= largest
    model.predict(space.high)
    assert seen[-1] == largest


@pytest.mark.parametrize(
    ("space", "advice"), [(spaces.Box(0, 1, (1, 36, 36)), "normalize_images=False"), (VECTOR, "MlpPolicy")], ids=str
)
def test_what_is_no_image_is_refused(space: spaces.Space, advice: str) -> None:
    with pytest.raises(AssertionError, match=advice):
        make_model(RandomEnv(space), "CnnPolicy")


@pytest.mark.parametrize(("augmentation", "size"), [("auto", 100), ("random_crop", 84), ("none", 100)])
def test_float_images_are_augmented_too(augmentation: str, size: int) -> None:
    kwargs = {"normalize_images": False, "features_extractor_kwargs": SMALL_CNN}
    env = RandomEnv(spaces.Box(0, 1, (1, 100, 100)))
    model = make_model(env, "CnnPolicy", {**kwargs, "augmentation": augmentation}, aux_loss="auto")
    assert model.aux_loss == catalog.load("aarl-pixel")
    read = model.critic.features_extractor._observation_space
    assert isinstance(read, spaces.Box) and read == spaces.Box(0, 1, (1, size, size))
    images = th.rand(4, 1, 100, 100)
    augmented = model.policy.augment(images)
    assert augmented.shape[2:] == (size, size) and th.equal(augmented, images) == (augmentation == "none")
    small = RandomEnv(spaces.Box(0, 1, (1, 40, 40)))
    with pytest.raises(ValueError, match="40 x 40 pixels are smaller than the crop"):
        make_model(small, "CnnPolicy", {**kwargs, "augmentation": "random_crop"})


def test_float_images_of_a_dict() -> None:
    space = spaces.Dict(image=spaces.Box(0, 1, (1, 36, 36)), vector=VECTOR)
    kwargs = {"normalize_images": False, "features_extractor_kwargs": {"cnn_output_dim": 5, "mlp_output_dim": 4}}
    model = make_model(RandomEnv(space), "MultiInputPolicy", kwargs)
    assert model.critic.features_extractor.image_keys == ["image"]
    assert model.critic.features_extractor.features_dim == 5 + 4 + VECTOR.shape[0]
    assert_all_train(model)


def test_callbacks(tmp_path: Any) -> None:
    env = DummyVecEnv([lambda: Monitor(RandomEnv())])
    evaluation = EvalCallback(env, best_model_save_path=tmp_path, eval_freq=10, n_eval_episodes=2, verbose=0)
    checkpoints = CheckpointCallback(10, tmp_path, "model", save_replay_buffer=True)
    every = EveryNTimesteps(5, CheckpointCallback(1, tmp_path / "often", "model"))
    model = make_model()
    model.learn(1000, callback=[evaluation, checkpoints, every, StopTrainingOnMaxEpisodes(4)])
    assert model.num_timesteps == 4 * EPISODE
    assert evaluation.last_mean_reward == EPISODE
    assert sorted(path.name for path in tmp_path.glob("model_*steps.zip")) == ["model_10_steps.zip", "model_20_steps.zip"]
    assert len(list((tmp_path / "often").glob("*.zip"))) == 5

    loaded = SACAux.load(tmp_path / "model_20_steps", env=RandomEnv())
    loaded.load_replay_buffer(tmp_path / "model_replay_buffer_20_steps.pkl")
    # SB3 calls back before it stores the transition.
    assert loaded.num_timesteps == 20 and loaded.replay_buffer.size() == 19
    np.testing.assert_array_equal(loaded.replay_buffer.observations[:19], model.replay_buffer.observations[:19])
    best = SACAux.load(tmp_path / "best_model")
    checkpoint = SACAux.load(tmp_path / "model_10_steps")  # the first evaluation was the best, as all returns are equal
    assert_same(best.policy.state_dict(), checkpoint.policy.state_dict())


@pytest.mark.filterwarnings("error:`n_steps")
def test_her(caplog: pytest.LogCaptureFixture) -> None:
    kwargs: dict[str, Any] = {"replay_buffer_class": HerReplayBuffer, "buffer_size": 200, "learning_starts": 20}
    with pytest.raises(ValueError, match=r"HerReplayBuffer has no windows, .*pass aux_loss=None"):
        make_model(BitFlippingEnv(n_bits=4, continuous=True), "MultiInputPolicy", **kwargs)
    model = make_model(BitFlippingEnv(n_bits=4, continuous=True), "MultiInputPolicy", aux_loss="auto", **kwargs)
    assert model.aux_loss is None and "HerReplayBuffer has no windows" in caplog.text
    moved = moved_by_training(model, 40)
    assert isinstance(model.replay_buffer, HerReplayBuffer) and model.replay_buffer.size() == 40
    assert moved.pop("head") == [] and all(map(all, moved.values()))


def test_sb3s_identity_task_is_learnt() -> None:
    """SB3 trains SAC on it; reward 1 where the action is within 0.5 of the observation, 100 steps an episode."""
    env = DummyVecEnv([lambda: IdentityEnvBox(eps=0.5)])
    model = SACAux("MlpPolicy", env, policy_kwargs={"net_arch": [64, 64]}, gamma=0.95, learning_starts=100, seed=1)
    model.learn(1_050)
    assert evaluate_policy(model, env, 20, warn=False)[0] > 90
