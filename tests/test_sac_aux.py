"""SACAux: SB3's SAC without a loss, what a gradient step does, save and load, and what is refused."""

import contextlib
import copy
import io
import math
import pathlib
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation, TransformReward
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_aarl import SACAux, catalog
from sb3_aarl.buffers import WindowSamples
from sb3_aarl.health import ExplodedError, NonFiniteError
from sb3_aarl.sac_aux import default_learning_starts

LOSS = "{s_t, a_t, r_t} -> {r_t+1, s_t+1, s_t+2}"
KINDS = ("state", "pixels", "dict")
POLICIES = {"state": "MlpPolicy", "pixels": "CnnPolicy", "dict": "MultiInputPolicy"}
# From states the paper's, which the naive steps below compute; simba's running statistics have tests of their own.
ENCODERS: dict[str, dict[str, Any]] = {
    "state": {"features_extractor_class": "dense_mlp", "features_extractor_kwargs": {"features_dim": 8, "width": 8}},
    "pixels": {"features_extractor_kwargs": {"features_dim": 8, "n_filters": 4}},
    "dict": {"features_extractor_kwargs": {"cnn_output_dim": 8, "mlp_output_dim": 8, "vector_encoder": "dense_mlp"}},
}


class Point(gym.Env):
    """A point that actions move, observed as three numbers, as an image of 18 x 20 pixels, or as both."""

    def __init__(self, kind: str = "state", length: int = 15):
        self.kind = kind
        self.length = length
        vector = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        image = spaces.Box(0, 255, (3, 18, 20), np.uint8)
        both = spaces.Dict({"vector": vector, "image": image})
        self.observation_space = {"state": vector, "pixels": image, "dict": both}[kind]
        self.action_space = spaces.Box(-2, 2, (2,), np.float32)

    def observe(self) -> Any:
        vector = self.point.astype(np.float32)
        image = np.zeros((3, 18, 20), np.uint8)
        image[:] = (127 + 100 * np.tanh(self.point))[:, None, None]
        row, column = (np.tanh(self.point[:2]) * 8 + 8).astype(int)
        image[:, row : row + 3, column : column + 3] = 255
        return {"state": vector, "pixels": image, "dict": {"vector": vector, "image": image}}[self.kind]

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.steps = 0
        self.point = self.np_random.normal(size=3)
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.steps += 1
        self.point = 0.9 * self.point + 0.2 * np.append(action, 0.5) + 0.1 * self.np_random.normal(size=3)
        terminated = self.steps > 3 and bool(self.point[0] > 1.5)
        return self.observe(), -float(np.square(self.point).sum()), terminated, self.steps >= self.length, {}


def name(value: object) -> str:
    """A test's id, without addresses of functions."""
    return str(value).partition(" at 0x")[0]


def make_env(kind: str, n_envs: int = 1, length: int = 15) -> DummyVecEnv:
    return DummyVecEnv([lambda: Point(kind, length)] * n_envs)


def make_model(
    kind: str = "state",
    env: Any = None,
    policy_kwargs: dict[str, Any] | None = None,
    aux_kwargs: dict[str, Any] | None = None,
    **kwargs: Any,
) -> SACAux:
    policy_kwargs = {"net_arch": [16], "crop_size": 16, "critic_norm": None, **ENCODERS[kind], **(policy_kwargs or {})}
    # Unlike the critic's, or Adam's first two steps would cancel out where critic and auxiliary loss disagree.
    aux_kwargs = {"learning_rate": 7e-4, "predictor_width": 12, **(aux_kwargs or {})}
    settings: dict[str, Any] = {
        "buffer_size": 300,
        "learning_starts": 20,
        "batch_size": 16,
        "policy_delay": 2,
        "target_entropy": "auto",
        "aux_loss": LOSS,
        "seed": 3,
        "device": "cpu",
    }
    env = make_env(kind) if env is None else env
    return SACAux(POLICIES[kind], env, policy_kwargs=policy_kwargs, aux_kwargs=aux_kwargs, **{**settings, **kwargs})


def filled_model(kind: str = "state", steps: int = 60, **kwargs: Any) -> SACAux:
    """A model that has collected data and not yet trained."""
    return make_model(kind, **{"learning_starts": 1000, **kwargs}).learn(steps)


def everything(model: SAC) -> dict[str, Any]:
    """All that training changes, by name."""
    state: dict[str, Any] = {name: getattr(model, name).detach() for name in model._get_torch_save_params()[1]}
    for name, parameters in model.get_parameters().items():
        state |= {f"{name}.{key}": value for key, value in parameters.items()}
    return copy.deepcopy(state)


def assert_same(first: Any, second: Any, where: str = "") -> int:
    """Bit for bit equality of nested parameters and optimizer states; returns how many tensors and arrays were compared."""
    if isinstance(first, dict):
        assert first.keys() == second.keys(), where
        return sum(assert_same(first[key], second[key], f"{where}.{key}") for key in first)
    if isinstance(first, (list, tuple)):
        assert len(first) == len(second), where
        return sum(assert_same(*pair, f"{where}[{i}]") for i, pair in enumerate(zip(first, second, strict=True)))
    assert type(first) is type(second), where
    if isinstance(first, (th.Tensor, np.ndarray)):
        one, other = np.asarray(first), np.asarray(second)
        assert one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes(), where
        return 1
    assert first == second, where
    return 0


# --- SB3's SAC ---------------------------------------------------------------------------------------------------------


def sac_and_ours(policy: str, env: Callable[[], Any], steps: int, ours: dict[str, Any], **settings: Any) -> tuple[SAC, SACAux]:
    """SB3's SAC and SACAux without an auxiliary loss, trained alike."""
    both: dict[str, Any] = {"buffer_size": 500, "learning_starts": 10, "batch_size": 16, "learning_rate": 1e-3, "tau": 0.02}
    both |= {"seed": 5, "device": "cpu", "ent_coef": "auto", **settings}
    sac = SAC(policy, env(), **both).learn(steps)
    sacs = {"critic_norm": None, "optimizer_kwargs": {"betas": (0.9, 0.999)}}
    ours = {**both, **ours, "policy_kwargs": {**sacs, **both["policy_kwargs"], **ours["policy_kwargs"]}}
    ours = {"aux_loss": None, "policy_delay": 1, "target_entropy": "auto", **ours}
    return sac, SACAux(policy, env(), **ours).learn(steps)


@pytest.mark.parametrize(
    ("n_envs", "settings"),
    [
        (1, {}),
        (1, {"ent_coef": 0.2}),
        (2, {"n_steps": 3, "gradient_steps": -1}),
        (1, {"use_sde": True, "sde_sample_freq": 4}),
        (1, {"learning_rate": lambda remaining: 1e-2 * remaining}),
        (1, {"train_freq": 4, "gradient_steps": 3, "ent_coef": "auto_0.5", "target_entropy": -2.0}),
        (1, {"policy_kwargs": {"net_arch": {"pi": [12], "qf": [20, 8]}, "n_critics": 3, "activation_fn": th.nn.Tanh}}),
    ],
    ids=name,
)
def test_without_aux_loss_is_sac(n_envs: int, settings: dict[str, Any]) -> None:
    def pendulum() -> DummyVecEnv:
        return DummyVecEnv([lambda: gym.make("Pendulum-v1", max_episode_steps=20)] * n_envs)

    identity = {"policy_kwargs": {"features_extractor_class": "identity"}}
    settings = {"policy_kwargs": {"net_arch": [16]}, **settings}
    sac, ours = sac_and_ours("MlpPolicy", pendulum, 60 * n_envs + 10, identity, **settings)
    assert ours._n_updates == sac._n_updates >= 45
    assert_same(everything(ours), everything(sac))


def test_without_aux_loss_is_sac_on_dicts() -> None:
    def pendulum() -> gym.Env:
        space = spaces.Dict({"angle": spaces.Box(-1, 1, (2,)), "speed": spaces.Box(-8, 8, (1,))})
        return TransformObservation(gym.make("Pendulum-v1"), lambda x: {"angle": x[:2], "speed": x[2:]}, space)

    identity = {"policy_kwargs": {"features_extractor_class": "identity"}}
    sac, ours = sac_and_ours("MultiInputPolicy", pendulum, 60, identity, policy_kwargs={"net_arch": [16]})
    assert_same(everything(ours), everything(sac))


@pytest.mark.parametrize("kind", KINDS)
def test_with_encoders_of_their_own_is_sac(kind: str) -> None:
    """SB3's default: actor and critic each train an encoder, here of a class of the user's own."""
    extractor = {"state": FlattenExtractor, "pixels": SmallCNN, "dict": SmallCombined}[kind]
    # SB3's optimizer; the fused one of SACAux rounds in another way.
    policy_kwargs = {
        "net_arch": [16],
        "features_extractor_class": extractor,
        "optimizer_kwargs": {"fused": False, "betas": (0.9, 0.999)},
    }
    own = {"share_features_extractor": False, "augmentation": "none"}
    settings = {"aux_kwargs": {"tau": 0.02}, "policy_kwargs": own}
    sac, ours = sac_and_ours(POLICIES[kind], lambda: make_env(kind), 60, settings, policy_kwargs=policy_kwargs)
    assert ours._n_updates == sac._n_updates == 50
    assert_same(everything(ours), everything(sac))


class SmallCNN(BaseFeaturesExtractor):
    """An extractor of a user's own, with a batch norm."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 8):
        super().__init__(observation_space, features_dim)
        self.convolution = th.nn.Conv2d(observation_space.shape[0], 4, 5, stride=4)
        self.norm = th.nn.BatchNorm2d(4)
        with th.no_grad():
            size = self.convolution(th.zeros(1, *observation_space.shape)).numel()
        self.linear = th.nn.Linear(size, features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.linear(self.norm(self.convolution(observations)).relu().flatten(start_dim=1))


class SmallCombined(BaseFeaturesExtractor):
    """The same for Dict observations."""

    def __init__(self, observation_space: spaces.Dict):
        super().__init__(observation_space, 11)
        self.cnn = SmallCNN(observation_space["image"])

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return th.cat([self.cnn(observations["image"]), observations["vector"]], dim=1)


# --- One gradient step -------------------------------------------------------------------------------------------------


class NaiveAdam:
    def __init__(self, lr: float, betas: tuple[float, float], eps: float):
        self.lr, self.betas, self.eps = lr, betas, eps
        self.moments: dict[str, tuple[th.Tensor, th.Tensor, int]] = {}

    def step(self, weights: dict[str, th.Tensor], gradients: dict[str, th.Tensor]) -> None:
        for name, gradient in gradients.items():
            first, second, t = self.moments.get(name, (0 * gradient, 0 * gradient, 0))
            first = self.betas[0] * first + (1 - self.betas[0]) * gradient
            second = self.betas[1] * second + (1 - self.betas[1]) * gradient**2
            self.moments[name] = first, second, t + 1
            unbiased = [m / (1 - beta ** (t + 1)) for m, beta in zip((first, second), self.betas, strict=True)]
            weights[name] = (weights[name] - self.lr * unbiased[0] / (unbiased[1].sqrt() + self.eps)).detach()


class Naive:
    """The train step as the design has it, for states, DenseMLP, one hidden layer each; float64, weights by name."""

    GROUPS = {  # noqa: RUF012
        "encoder": ("critic.features_extractor.",),
        "q": ("critic.qf0.", "critic.qf1."),
        "actor": ("actor.features_extractor.projection.", "actor.latent_pi.", "actor.mu.", "actor.log_std."),
        "head": ("aux_head.",),
        "alpha": ("log_ent_coef",),
    }

    def __init__(self, model: SACAux, loss: str, negatives: bool, joint: bool, squash: tuple[float, float] | None):
        named = {**model.policy.state_dict(), "log_ent_coef": model.log_ent_coef}
        named |= {f"aux_head.{name}": value for name, value in model.aux_head.state_dict().items()}
        self.w = {name: value.detach().double() for name, value in named.items() if value.is_floating_point()}
        self.loss, self.negatives, self.joint, self.squash = loss, negatives, joint, squash
        self.coef = 0.7 if joint else 1.0
        self.optimizers = {name: NaiveAdam(2e-3, (0.9, 0.999), 1e-3) for name in ("critic", "actor")}
        self.optimizers["aux"] = NaiveAdam(3e-3, (0.9, 0.999), 1e-3)
        self.optimizers["alpha"] = NaiveAdam(1e-2, (0.5, 0.999), 1e-8)

    def names(self, *groups: str) -> list[str]:
        prefixes = tuple(prefix for group in groups for prefix in self.GROUPS[group])
        return [name for name in self.w if name.startswith(prefixes)]

    def linear(self, name: str, x: th.Tensor) -> th.Tensor:
        return x @ self.w[f"{name}.weight"].T + self.w[f"{name}.bias"]

    def project(self, name: str, x: th.Tensor) -> th.Tensor:
        x = self.linear(f"{name}.0", x)
        x = x - x.mean(1, keepdim=True)
        return x / (x.pow(2).mean(1, keepdim=True) + 1e-5).sqrt() * self.w[f"{name}.1.weight"] + self.w[f"{name}.1.bias"]

    def trunk(self, critic: str, x: th.Tensor) -> th.Tensor:
        return th.cat([x, self.linear(f"{critic}.features_extractor.layers.0", x).clamp(min=0)], 1)

    def encode(self, critic: str, x: th.Tensor) -> th.Tensor:
        return self.project(f"{critic}.features_extractor.projection", self.trunk(critic, x))

    def q(self, critic: str, latent: th.Tensor, action: th.Tensor) -> list[th.Tensor]:
        x = th.cat([latent, action], 1)
        return [self.linear(f"{critic}.qf{i}.2", self.linear(f"{critic}.qf{i}.0", x).clamp(min=0))[:, 0] for i in (0, 1)]

    def act(self, obs: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        hidden = self.project("actor.features_extractor.projection", self.trunk("critic", obs).detach())
        hidden = self.linear("actor.latent_pi.0", hidden).clamp(min=0)
        log_std = self.linear("actor.log_std", hidden)
        if self.squash:
            low, high = self.squash
            log_std = low + (high - low) * (log_std.tanh() + 1) / 2
        else:
            log_std = log_std.clamp(-20, 2)
        action = (self.linear("actor.mu", hidden) + log_std.exp() * noise).tanh()
        log_prob = -(noise**2) / 2 - log_std - math.log(2 * math.pi) / 2 - (1 - action**2 + 1e-6).log()
        return action, log_prob.sum(1)

    def aux(self, windows: WindowSamples) -> th.Tensor:
        s, a, r = windows.observations.double(), windows.actions.double(), windows.rewards.double()
        source = th.cat([self.encode("critic", s[:, 0]), self.encode("critic", s[:, 2]), a[:, 0], r[:, 0]], 1)
        target = th.cat([self.encode("critic_target", s[:, 1]), self.encode("critic_target", s[:, 2]), a[:, 1], r[:, 1]], 1)
        hidden = self.linear("aux_head.predictor.0", source)
        prediction = self.linear("aux_head.predictor.2", hidden.clamp(min=0))
        if self.loss == "mse":
            value = ((prediction - target.detach()) ** 2).sum() / target.numel()
        else:
            similarity = prediction @ self.w["aux_head.operator.weight"] @ target.detach().T
            value = -(similarity.diag() - similarity.logsumexp(1)).mean()
        return self.coef * value

    def gradients(self, loss: Callable[[], th.Tensor], *groups: str) -> dict[str, th.Tensor]:
        names = self.names(*groups)
        self.w |= {name: self.w[name].clone().requires_grad_() for name in names}
        found = th.autograd.grad(loss(), [self.w[name] for name in names])
        self.w |= {name: self.w[name].detach() for name in names}
        return dict(zip(names, found, strict=True))

    def step(self, number: int, batch: Any, windows: WindowSamples, noise: Iterator[th.Tensor]) -> None:
        obs, next_obs, actions = batch.observations.double(), batch.next_observations.double(), batch.actions.double()
        rewards, not_done = batch.rewards.double()[:, 0], 1 - batch.dones.double()[:, 0]
        alpha = self.w["log_ent_coef"].exp()
        actor_noise = next(noise) if number % 2 == 0 else None
        if actor_noise is not None:
            log_prob = self.act(obs, actor_noise)[1]
            gap = (log_prob + len(actions[0]) * -1.0).mean()
            alpha_gradient = {"log_ent_coef": -gap.reshape(1)}
        # The actor of this step: its trunk is read before the critic moves the encoder.
        old = dict(self.w)

        next_action, next_log_prob = self.act(next_obs, next(noise))
        next_q = th.stack(self.q("critic_target", self.encode("critic_target", next_obs), next_action)).amin(0)
        wanted = (rewards + not_done * 0.9 * (next_q - alpha * next_log_prob)).detach()

        def critic_loss() -> th.Tensor:
            return sum(((q - wanted) ** 2).mean() / 2 for q in self.q("critic", self.encode("critic", obs), actions))

        critic = self.gradients(critic_loss, "encoder", "q")
        if self.joint:
            aux = self.gradients(lambda: self.aux(windows), "encoder", "head")
            both = {name: aux[name] + critic[name] for name in self.names("encoder")}
            self.optimizers["critic"].step(self.w, {name: critic[name] for name in self.names("q")})
            self.optimizers["aux"].step(self.w, {**aux, **both})
        else:
            self.optimizers["critic"].step(self.w, critic)
            self.optimizers["aux"].step(self.w, self.gradients(lambda: self.aux(windows), "encoder", "head"))

        if actor_noise is None:
            return
        new_latent = self.encode("critic", obs)
        trunk = {name: old[name] for name in self.names("encoder")}

        def actor_loss() -> th.Tensor:
            now = {name: self.w[name] for name in trunk}
            self.w |= trunk
            action, log_prob = self.act(obs, actor_noise)
            self.w |= now
            return (alpha * log_prob - th.stack(self.q("critic", new_latent, action)).amin(0)).mean()

        self.optimizers["actor"].step(self.w, self.gradients(actor_loss, "actor"))
        self.optimizers["alpha"].step(self.w, alpha_gradient)
        for group, tau in (("q", 0.1), ("encoder", 0.3)):
            for name in self.names(group):
                target = name.replace("critic.", "critic_target.")
                self.w[target] = (1 - tau) * self.w[target] + tau * self.w[name]


@pytest.mark.parametrize(
    ("operator", "joint", "squash"),
    [("mse", False, None), ("mse", True, (-10, 2)), ("bilinear", True, None), ("bilinear", False, (-5, 1))],
)
def test_train_agrees_with_naive_steps(
    operator: str, joint: bool, squash: tuple[float, float] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    negatives = operator == "bilinear"
    brackets = " [bilinear, negatives]" if negatives else ""
    model = filled_model(
        aux_loss="{s_t, a_t, r_t, s_t+2} -> {s_t+1, a_t+1, r_t+1, s_t+2}" + brackets,
        learning_rate=2e-3,
        ent_coef_optimizer_kwargs={"lr": 1e-2, "betas": (0.5, 0.999)},
        aux_kwargs={"learning_rate": 3e-3, "batch_size": 24, "tau": 0.3, "joint": joint, **({"coef": 0.7} if joint else {})},
        gamma=0.9,
        tau=0.1,
        target_update_interval=2,
        policy_kwargs={"squash_log_std": squash, "optimizer_kwargs": {"betas": (0.9, 0.999), "eps": 1e-3}},
    )
    buffer = model.replay_buffer
    batches = [buffer.sample(16) for _ in range(6)]
    windows = [buffer.sample_windows(24, 2) for _ in range(6)]

    def drawn(batch_size: int, horizon: int, env: Any, offsets: list[int]) -> WindowSamples:
        assert (batch_size, horizon) == (24, 2)
        window = windows[model._n_updates - 1]
        return window._replace(observations=window.observations[:, offsets])

    monkeypatch.setattr(buffer, "sample", lambda batch_size, env: batches[model._n_updates - 1])
    monkeypatch.setattr(buffer, "sample_windows", drawn)
    naive = Naive(model, operator, negatives, joint, squash)
    for number in range(1, 7):
        th.manual_seed(number)
        model.train(1, batch_size=16)
        th.manual_seed(number)
        noise = (th.normal(th.zeros(16, 2), th.ones(16, 2)).double() for _ in range(2))
        naive.step(number, batches[number - 1], windows[number - 1], noise)

        state = {**model.policy.state_dict(), "log_ent_coef": model.log_ent_coef.detach()}
        state |= {f"aux_head.{name}": value for name, value in model.aux_head.state_dict().items()}
        for name, value in state.items():
            if not name.startswith("actor.features_extractor.encoder"):  # the critic's
                gap = (value.double() - naive.w[name]).abs().max()
                assert gap < 1e-6, f"{name} is {gap} off after step {number}"


def parts(model: SACAux) -> dict[str, list[th.Tensor]]:
    """What is trained, by what it is part of."""
    encoder = set(model.critic.features_extractor.parameters())
    target_encoder = set(model.critic_target.features_extractor.parameters())
    return {
        "encoder": list(encoder),
        "q": [p for p in model.critic.parameters() if p not in encoder],
        "actor": [p for p in model.actor.parameters() if p not in encoder],
        "head": list(model.aux_head.parameters()) if model.aux_head else [],
        "momentum_encoder": list(target_encoder),
        "target_q": [p for p in model.critic_target.parameters() if p not in target_encoder],
        "ent_coef": [model.log_ent_coef],
    }


def moved_by_train(model: SACAux, gradient_steps: int = 1) -> set[str]:
    """Which parts a call to ``train`` moves; each has to move as a whole or not at all."""
    before = {name: [p.detach().clone() for p in tensors] for name, tensors in parts(model).items()}
    model.train(gradient_steps, batch_size=16)
    moved = set()
    for name, tensors in parts(model).items():
        changed = [not th.equal(old, new) for old, new in zip(before[name], tensors, strict=True)]
        assert all(changed) or not any(changed), f"only some of {name} moved"
        if any(changed):
            moved.add(name)
    return moved


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("settings", [{}, {"aux_kwargs": {"joint": True}}, {"precision": "bf16"}], ids=name)
def test_what_a_step_moves(kind: str, settings: dict[str, Any]) -> None:
    model = filled_model(kind, policy_delay=3, target_update_interval=2, **settings)
    every = {"encoder", "q", "head"}
    targets = {"momentum_encoder", "target_q"}
    actor = {"actor", "ent_coef"}
    assert [moved_by_train(model) for _ in range(6)] == [
        every,
        every | targets,
        every | actor,
        every | targets,
        every,
        every | targets | actor,
    ]
    assert not any(p.requires_grad or p.grad is not None for p in model.critic_target.parameters())


def test_learning_rates_and_coef(caplog: pytest.LogCaptureFixture, tmp_path: pathlib.Path) -> None:
    settings = {"learning_rate": 1e-3, "aux_kwargs": {"learning_rate": lambda left: 2e-3 * left}}
    model = make_model(ent_coef_optimizer_kwargs={"lr": 1e-2, "betas": (0.3, 0.99)}, **settings).learn(50)
    assert model.aux_optimizer.param_groups[0]["lr"] == pytest.approx(2e-3 * model._current_progress_remaining)
    assert model.ent_coef_optimizer.param_groups[0]["lr"] == 1e-2
    assert model.ent_coef_optimizer.param_groups[0]["betas"] == (0.3, 0.99)
    assert model.critic.optimizer.param_groups[0]["lr"] == 1e-3
    model.save(tmp_path / "model")
    loaded = SACAux.load(tmp_path / "model", make_env("state"), ent_coef_optimizer_kwargs={"lr": 1e-5}).learn(50)
    assert loaded.ent_coef_optimizer.param_groups[0]["lr"] == 1e-5
    make_model(ent_coef=0.1, ent_coef_optimizer_kwargs={"lr": 1e-2})
    assert "ent_coef_optimizer_kwargs have no effect: ent_coef=0.1 is fixed" in caplog.text
    model = make_model(learning_rate=lambda left: 1e-3 + left).learn(10)
    assert model.ent_coef_optimizer.param_groups[0]["lr"] == model.actor.optimizer.param_groups[0]["lr"] > 1e-3

    norms = []
    for coefficient in (0.0, 1.0, 3.0):
        model = filled_model(aux_kwargs={"joint": True, "coef": coefficient})
        th.manual_seed(0)
        np.random.seed(0)
        model.train(1, batch_size=16)
        norms.append(math.hypot(*(parameter.grad.norm() for parameter in model.aux_head.parameters())))
    assert norms == [0, norms[1], pytest.approx(3 * norms[1])] and norms[1] > 0


# --- Logs --------------------------------------------------------------------------------------------------------------


def test_logs() -> None:
    model = filled_model()
    model.train(4, batch_size=16)
    logged = model.logger.name_to_value
    names = "aux_loss aux_skipped reward_scale n_updates ent_coef ent_coef_loss critic_loss actor_loss learning_rate"
    assert {f"train/{name}" for name in names.split()} == set(logged) - {name for name in logged if "train/" not in name}
    model.train(1, batch_size=16)
    assert logged["train/aux_loss"] > 0 and logged["train/aux_skipped"] == 0


@pytest.mark.parametrize("joint", [False, True])
def test_a_horizon_longer_than_any_episode_is_skipped_and_counted(joint: bool) -> None:
    model = make_model(env=make_env("state", length=4), aux_loss="{s_t} -> {s_t+5}", aux_kwargs={"joint": joint})
    before = copy.deepcopy(model.aux_head.state_dict())
    encoder = copy.deepcopy(model.critic.features_extractor.state_dict())
    with pytest.warns(UserWarning, match=r"never trained: no episode is as long as its horizon \(\{s_t\} -> \{s_t\+5\}\)"):
        model.learn(50, log_interval=1000)
    assert model.logger.name_to_value["train/aux_skipped"] == model._n_updates == 30
    assert "train/aux_loss" not in model.logger.name_to_value
    assert_same(dict(model.aux_head.state_dict()), before)
    assert all(not th.equal(value, encoder[name]) for name, value in model.critic.features_extractor.state_dict().items())

    # As soon as an episode is long enough, the loss is trained.
    model.env.envs[0].length = 6
    model.learn(30, reset_num_timesteps=False, log_interval=1000)
    assert 30 < model.logger.name_to_value["train/aux_skipped"] < 60
    assert math.isfinite(model.logger.name_to_value["train/aux_loss"])
    assert not th.equal(model.aux_head.state_dict()["predictor.0.weight"], before["predictor.0.weight"])


def test_defaults_that_depend_on_run_and_actions() -> None:
    model = SACAux("MlpPolicy", make_env("state"), batch_size=8, device="cpu").learn(60)
    assert (model.learning_starts, model._n_updates) == (6, 54)  # a tenth of a short run
    assert model.learn(20)._n_updates == 54 + 18  # of each one
    assert model.learn(20, reset_num_timesteps=False)._n_updates == 54 + 18 + 20
    model.learn(960, lambda *_: model.num_timesteps < 50, reset_num_timesteps=False)
    assert model._n_updates == 54 + 18 + 20 + 9  # the more steps are to come, not the more random ones
    model.learning_starts = 30
    assert model.learn(20)._n_updates == 54 + 18 + 20 + 9
    assert default_learning_starts(10**6) == 5000
    offline = SACAux("MlpPolicy", make_env("state"), batch_size=8, device="cpu")
    offline.replay_buffer = model.replay_buffer
    offline.set_logger(model.logger)
    offline.train(5, 8)
    assert offline.learn(20, reset_num_timesteps=False)._n_updates == 5 + 18
    assert model.target_entropy == -1.0  # half of SAC's, which is -2 for two actions


@pytest.mark.parametrize("fixed", [None, 2.0**-4])
def test_rewards_of_any_magnitude_are_learnt_alike(tmp_path: pathlib.Path, fixed: float | None) -> None:
    models = []
    for factor in (2.0**5, 2.0**15):  # powers of two, which change no other bit
        env = TransformReward(Point(), lambda reward, factor=factor: factor * reward)
        settings = {"policy_kwargs": {"critic_norm": "batch"}, "aux_loss": "forward-dynamics"}
        coefficient = {} if fixed is None else {"ent_coef": factor * fixed}
        models.append(make_model(env=env, n_steps=3, **settings, **coefficient).learn(60))
    assert_same(models[0].policy.state_dict(), models[1].policy.state_dict())
    models[1].save(tmp_path / "model")
    loaded = SACAux.load(tmp_path / "model")
    assert loaded._reward_scale == models[1]._reward_scale == 2**10 * models[0]._reward_scale > 2**10


def test_the_unit_of_rewards_is_that_of_one_step_of_the_buffer() -> None:
    scales = []
    for settings in ({}, {"n_steps": 3}, {"replay_buffer_kwargs": {"n_steps": 3, "gamma": 0.99}}):
        env = TransformReward(Point(), lambda reward: 32.0)
        scales.append(make_model(env=env, policy_kwargs={"critic_norm": "batch"}, **settings).learn(40)._reward_scale)
    assert scales[0] == 32 > scales[1] == scales[2] > 16  # some of three steps are the last ones


# --- Save and load -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("state", {}),
        ("state", {"aux_kwargs": {"joint": True}, "policy_delay": 3}),
        ("state", {"use_sde": True, "ent_coef": 0.1}),
        ("state", {"aux_loss": None, "n_steps": 3}),
        ("pixels", {"aux_loss": LOSS + " [bilinear, negatives]", "precision": "bf16"}),
        ("dict", {}),
    ],
    ids=name,
)
def test_training_state(kind: str, settings: dict[str, Any]) -> None:
    """A new model with the state of another, and the same data and random numbers, trains as the other does, to the bit."""
    straight = make_model(kind, **settings).learn(50)
    file = io.BytesIO()
    th.save(straight.training_state(), file)
    file.seek(0)
    resumed = make_model(kind, **{**settings, "seed": 9})
    state = th.load(file, weights_only=True)
    resumed.load_training_state(state)
    counters = ("num_timesteps", "_n_updates", "_n_aux_skipped", "_episode_num", "_q_value_check")
    assert [getattr(resumed, name) for name in counters] == [getattr(straight, name) for name in counters]
    resumed.replay_buffer = copy.deepcopy(straight.replay_buffer)
    resumed.set_logger(straight.logger)
    assert_same(everything(resumed), everything(straight))
    for model in (straight, resumed):
        np.random.seed(7)
        th.manual_seed(7)
        model.train(5, batch_size=16)
    assert_same(everything(resumed), everything(straight))
    # The state is a copy: neither model has changed it.
    other = make_model(kind, **settings)
    other.load_training_state(state)
    assert_same(other.training_state(), state)
    assert other._n_updates == 30


@pytest.mark.parametrize("ortho_init", [False, True])
def test_ortho_init_reaches_every_linear_layer(ortho_init: bool) -> None:
    policy = make_model(policy_kwargs={"ortho_init": ortho_init}).policy
    for part in (policy.actor, policy.critic):
        for name, module in part.named_modules():
            if isinstance(module, th.nn.Linear):
                short = module.weight if module.weight.shape[0] <= module.weight.shape[1] else module.weight.T
                orthogonal = th.allclose(short @ short.T, th.eye(len(short)), atol=1e-4)
                encoder = "features_extractor" in name
                # A single output is orthogonal as soon as its weights have length one.
                assert (orthogonal and not module.bias.any()) == (ortho_init or encoder), name
    assert_same(policy.critic_target.state_dict(), policy.critic.state_dict())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [True, False])
def test_a_loaded_model_predicts_equally_without_an_env(kind: str, share: bool, tmp_path: pathlib.Path) -> None:
    model = make_model(kind, policy_kwargs={"share_features_extractor": share, "squash_log_std": (-10, 2)}).learn(40)
    observations = [Point(kind).reset(seed=seed)[0] for seed in range(100, 109)]
    model.save(tmp_path / "model")
    loaded = SACAux.load(tmp_path / "model", device="cpu")
    assert (loaded.aux_loss, loaded.env) == (model.aux_loss, None)
    assert_same(everything(loaded), everything(model))
    model.policy.save(tmp_path / "policy")
    policy = type(model.policy).load(tmp_path / "policy", device="cpu")
    actions = []
    for observation in observations:
        actions.append(model.predict(observation, deterministic=True)[0])
        assert_same(actions[-1], loaded.predict(observation, deterministic=True)[0])
        assert_same(actions[-1], policy.predict(observation, deterministic=True)[0])
        assert model.action_space.contains(actions[-1])
    assert len(np.unique(actions, axis=0)) > 1
    # A loaded model trains in a new environment as well.
    loaded.set_env(make_env(kind))
    loaded.learn(30)
    assert loaded._n_updates > model._n_updates


def test_reading_q_values_changes_no_running_statistics(tmp_path: pathlib.Path) -> None:
    model = SACAux("MlpPolicy", make_env("state"), batch_size=8, device="cpu")
    model.policy.save(tmp_path / "policy")
    for policy in (model.policy, type(model.policy).load(tmp_path / "policy"), model.learn(40).policy):
        before = copy.deepcopy(policy.state_dict())
        policy.critic(th.rand(8, 3), th.rand(8, 2))[0].sum().backward()
        assert_same(policy.state_dict(), before)


@pytest.mark.parametrize("joint", [False, True])
def test_loading_without_the_loss_or_with_one(joint: bool, tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture) -> None:
    """Back to plain SAC after pre-training, the other way round, another loss: all but it is loaded, with a warning."""
    other = "{s_t} -> {r_t} [bilinear, negatives]"
    for before, after in ((LOSS, None), (None, LOSS), (LOSS, other)):
        trained = make_model(aux_loss=before, aux_kwargs={"joint": joint}).learn(40)
        trained.save(tmp_path / "model")
        # Whether one optimizer trains both may change, too.
        loaded = SACAux.load(tmp_path / "model", make_env("state"), aux_loss=after, aux_kwargs={"joint": after == other})
        given = make_model(aux_loss=after, aux_kwargs={"joint": joint}, seed=9)
        given.set_parameters(trained.get_parameters(), exact_match=before is None)
        for model in (loaded, given):
            assert_same(dict(model.policy.state_dict()), dict(trained.policy.state_dict()))
            model.learn(30)
        messages = [record.getMessage() for record in caplog.records]
        kept = f"this model's aux_loss ({given.aux_loss}) are given: its own stay as they are"
        assert len(messages) == 2 and all(kept in message for message in messages)
        caplog.clear()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda model: cloudpickle.loads(cloudpickle.dumps(model))])
def test_a_copy_of_a_compiled_model_trains_its_own_networks(copied: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = th.compile
    monkeypatch.setattr(th, "compile", lambda function, **kwargs: compiler(function, backend="eager"))
    # With running statistics, which the momentum encoder gets from the encoder.
    simba = {"features_extractor_class": "simba", "features_extractor_kwargs": {"features_dim": 8}}
    model = make_model(compile=True, policy_kwargs=simba).learn(30)
    before = everything(model)
    twin = copied(model)
    set_random_seed(4)
    twin.train(2, batch_size=16)
    assert_same(everything(model), before)
    set_random_seed(4)
    model.train(2, batch_size=16)
    assert_same(everything(twin), everything(model))


def test_loading_with_other_n_step_returns(tmp_path: pathlib.Path) -> None:
    model = make_model(n_steps=3)
    assert model.replay_buffer.n_steps == 3
    model.save(tmp_path / "model")
    loaded = SACAux.load(tmp_path / "model", make_env("state"), n_steps=2, gamma=0.5)
    assert (loaded.replay_buffer.n_steps, loaded.replay_buffer.gamma) == (2, 0.5)
    assert SACAux.load(tmp_path / "model", make_env("state"), n_steps=1).replay_buffer.n_steps == 1


class Stop(BaseCallback):
    """Ends training at the 27th step, before SB3 stores its transition."""

    def __init__(self, by: str):
        super().__init__()
        self.by = by

    def _on_step(self) -> bool:
        if self.n_calls == 27 and self.by == "KeyboardInterrupt":
            raise KeyboardInterrupt
        return self.n_calls < 27


@pytest.mark.parametrize("by", ["callback", "KeyboardInterrupt"])
@pytest.mark.parametrize("kind", ["state", "pixels"])
def test_learning_continues_after_it_was_stopped(kind: str, by: str) -> None:
    env: Any = make_env(kind, length=50)
    model = make_model(kind, VecFrameStack(env, 3, channels_order="first") if kind == "pixels" else env)
    with pytest.raises(KeyboardInterrupt) if by == "KeyboardInterrupt" else contextlib.nullcontext():
        model.learn(40, Stop(by))
    before = model._n_updates
    model.learn(20, reset_num_timesteps=False)
    assert model._n_updates == before + 20 and model.replay_buffer.size() == 46


@pytest.mark.parametrize("norm", ["batch", None])
def test_a_model_without_its_buffer_goes_on_with_random_steps(norm: str | None, tmp_path: pathlib.Path, caplog: Any) -> None:
    model = make_model(learning_starts=20, policy_kwargs={"critic_norm": norm}).learn(40)
    model.save(tmp_path / "model", include=["replay_buffer"])
    loaded = SACAux.load(tmp_path / "model", make_env("state"), replay_buffer=None)
    loaded.predict = mock.Mock(wraps=loaded.predict)
    loaded.learn(50, reset_num_timesteps=False)
    assert loaded._n_updates - 20 == loaded.predict.call_count == 50 - 5 * (norm == "batch")  # a tenth, as at the start
    assert ("5 random steps come first" in caplog.text) == (norm == "batch")
    assert loaded.learn(15, reset_num_timesteps=False)._n_updates == (80 if norm == "batch" else 85)
    kept = SACAux.load(tmp_path / "model", make_env("state"))
    assert kept.replay_buffer.size() == 40 and kept.learn(5, reset_num_timesteps=False)._n_updates == 25


# --- Seeds and prediction ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_seeds(kind: str) -> None:
    first, again, other = (make_model(kind, make_env(kind, 2), seed=seed).learn(60) for seed in (1, 1, 2))
    assert_same(everything(first), everything(again))
    assert not th.equal(first.critic.q_networks[0][0].weight, other.critic.q_networks[0][0].weight)


class Places(Point):
    """The red channel of each pixel says where it is: a crop's corner names the crop."""

    def observe(self) -> Any:
        observation = super().observe()
        image = observation if self.kind == "pixels" else observation["image"]
        image[0] = 10 * np.arange(18)[:, None] + np.arange(20)
        return observation


@pytest.mark.parametrize("kind", ["pixels", "dict"])
def test_prediction_sees_the_centre_and_training_sees_any_crop(kind: str) -> None:
    env = Places(kind)
    model = filled_model(kind, env=DummyVecEnv([lambda: env]))
    seen: list[th.Tensor] = []
    for critic in (model.critic, model.critic_target):
        encoder = critic.features_extractor
        layer = encoder.convolutions if kind == "pixels" else encoder.encoders[0].convolutions
        layer.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    observation, _ = env.reset(seed=4)
    image = observation if kind == "pixels" else observation["image"]
    model.predict(observation, deterministic=True)
    assert th.equal(seen[0], th.as_tensor(image)[None, :, 1:17, 2:18] / 255)
    seen.clear()
    model.train(3, batch_size=64)
    assert all(images.shape[2:] == (16, 16) for images in seen)
    corners = [set((images[:, 0, 0, 0] * 255).round().tolist()) for images in seen]
    assert set().union(*corners) == {10 * row + column for row in range(3) for column in range(5)}
    assert min(map(len, corners)) > 5  # each pass of an encoder sees crops of its own
    images = model.replay_buffer.sample(2).observations
    assert (images if kind == "pixels" else images["image"]).shape[2:] == (18, 20)  # a user's own sample has all


@pytest.mark.parametrize("argument", [{"crop_size": 17}, {"augmentation": "random_shift"}, {"augmentation": "none"}])
def test_augmentation_is_saved(argument: dict[str, Any], tmp_path: pathlib.Path) -> None:
    model = make_model("pixels", policy_kwargs=argument)
    model.save(tmp_path / "model")
    size = (17, 17) if "crop_size" in argument else (18, 20)
    for each in (model, SACAux.load(tmp_path / "model")):
        images = each.policy.augment(th.zeros(2, 3, 18, 20, dtype=th.uint8))
        assert images.shape[2:] == each.critic.features_extractor._observation_space.shape[1:] == size


# --- Bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        ("state", {"aux_loss": "forward-dynamic"}, r"forward-dynamic'.*nearest: forward-dynamics"),
        ("state", {"aux_loss": "{s_t, b_t} -> {s_t+1}"}, "'b_t' is not a token"),
        ("state", {"aux_loss": 3}, r"an auxiliary loss is .*not 3"),
        ("state", {"policy_delay": 0}, r"policy_delay must be at least 1, not 0"),
        ("state", {"n_steps": 0}, r"n_steps must be at least 1, not 0"),
        ("state", {"gamma": 5}, r"gamma must be between 0 and 1, not 5"),
        ("state", {"policy_kwargs": {"n_critics": 0}}, r"policy_kwargs: n_critics must be at least 1, not 0"),
        ("state", {"aux_kwargs": {"tau": 2}}, r"aux_kwargs: tau must be between 0 and 1, not 2"),
        ("state", {"aux_kwargs": {"predictor_width": 0}}, r"aux_kwargs: predictor_width must be at least 1, not 0"),
        ("state", {"aux_kwargs": {"tua": 0.1}}, r"aux_kwargs: an unexpected .*'tua'"),
        ("state", {"aux_kwargs": {"tau": "0.1"}}, r"aux_kwargs: .* not supported .*'str'"),
        ("state", {"aux_kwargs": {"coef": math.nan}}, r"aux_kwargs: coef must be a finite number of at least 0, not nan"),
        ("state", {"aux_kwargs": {"coef": 2}}, r"aux_kwargs: coef needs joint=True"),
        ("state", {"precision": "fp16"}, r"precision must be fp32 or bf16, not 'fp16'"),
        (
            "state",
            {"policy_kwargs": {"critic_norm": "group"}},
            "unknown critic_norm 'group', expected one of None, layer, batch",
        ),
        ("state", {"policy_kwargs": {"augmentation": "flip"}}, "unknown augmentation 'flip', expected one of auto"),
        ("pixels", {"policy_kwargs": {"crop_size": 19}}, r"18 x 20 pixels are smaller than the crop of 19 x 19"),
        ("dict", {"policy_kwargs": {"crop_size": 19}}, r"under 'image' of 18 x 20 pixels are smaller"),
        ("pixels", {"replay_buffer_kwargs": {"frame_stack": 2}}, r"frame_stack=2 does not divide the first axis"),
        ("state", {"policy_kwargs": {"features_extractor_class": "pixle"}}, r"unknown encoder 'pixle', expected one of"),
        (
            "state",
            {"policy_kwargs": {"features_extractor_class": "identity", "features_extractor_kwargs": {}}},
            r"FlattenExtractor has no parameters .*pass aux_loss=None",
        ),
    ],
    ids=name,
)
def test_bad_arguments(kind: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(kind, **settings)


@pytest.mark.parametrize(
    ("shape", "advice"),
    [((84, 84), "add a channel"), ((4, 40, 40, 3), "SB3's VecFrameStack"), ((4, 40, 40, 1), "without a channel")],
    ids=str,
)
def test_images_of_a_wrong_layout(shape: tuple[int, ...], advice: str) -> None:
    env = Point("pixels")
    env.observation_space = spaces.Box(0, 255, shape, np.uint8)
    with pytest.raises(AssertionError, match=f"An image has three dimensions: .*{advice}"):
        SACAux("CnnPolicy", env)


def test_an_action_that_cannot_be_chosen() -> None:
    env = Point()
    env.action_space = spaces.Box(np.array([-1, 0.5], np.float32), np.array([1, 0.5], np.float32))
    with pytest.raises(ValueError, match="action_space has low == high at index 1"):
        SACAux("MlpPolicy", env)


def test_an_error_of_the_environments_own_is_raised_as_it_is() -> None:
    class Broken(Point):
        def step(self, action: np.ndarray) -> Any:
            th.distributions.Normal(th.tensor(math.nan), 1.0, validate_args=True)

    with pytest.raises(ValueError, match="to satisfy the constraint") as error:
        make_model(env=DummyVecEnv([Broken])).learn(5)
    assert not isinstance(error.value, NonFiniteError)


class NaNAt(gym.Wrapper):
    """Returns NaN at one step."""

    def __init__(self, env: gym.Env, part: str, at: int):
        super().__init__(env)
        self.part, self.at, self.n = part, at, 0

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict]:
        self.n += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self.n == self.at and self.part == "reward":
            reward = math.nan
        elif self.n == self.at:
            (observation["vector"] if isinstance(observation, dict) else observation)[1] = math.nan
            terminated = self.part == "terminal observation"
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize(
    ("kind", "part", "at", "name"),
    [
        ("state", "observation", 5, "observation"),
        ("dict", "observation", 3, "observation 'vector'"),
        ("state", "terminal observation", 7, "terminal observation"),
        ("state", "reward", 30, "reward"),
    ],
)
def test_nan_from_the_environment(kind: str, part: str, at: int, name: str) -> None:
    model = make_model(kind, DummyVecEnv([lambda: NaNAt(Point(kind, 100), part, at)]))
    with pytest.raises(NonFiniteError, match=f"^{name} from the environment is not finite at agent step {at} "):
        model.learn(60)
    assert model.replay_buffer.size() == at - 1
    assert np.isfinite(model.replay_buffer.rewards).all()


class PoisonAt(BaseCallback):
    """Sets a weight at one step."""

    def __init__(self, weight: th.Tensor, at: int, value: float = math.inf):
        super().__init__()
        self.weight, self.at, self.value = weight, at, value

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            self.weight.data.flatten()[0] = self.value
        return True


@pytest.mark.parametrize(
    ("part", "culprit"),
    [
        (lambda model: model.aux_head.predictor[0].bias, "aux_loss"),
        (lambda model: model.critic.q_networks[1][-1].bias, "critic_loss"),
        (lambda model: model.actor.mu.bias, "critic_loss"),
        # Actions are NaN before any loss is: PyTorch's distributions refuse them.
        (lambda model: model.actor.features_extractor.projection[0].bias, "an output of the actor"),
    ],
)
def test_a_loss_that_is_not_finite(part: Callable[[SACAux], th.Tensor], culprit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # torch.compile, in a test before this one, ends the checks of all distributions.
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", True)
    model = make_model(policy_delay=100)
    with pytest.raises(NonFiniteError) as error:
        model.learn(60, callback=PoisonAt(part(model), 35))
    # The first of 15 gradient steps is at agent step 21.
    text = str(error.value)
    assert text.startswith(f"{culprit} is ") and text.endswith(
        f"at gradient step 15, agent step 35; auxiliary loss: {model.aux_loss}"
    )


def test_the_first_of_many_gradient_steps_is_named() -> None:
    """Losses are looked at when all gradient steps of a call are done; what fails because of them says less."""
    messages = []
    for at_once in (1, 40):
        model = filled_model()
        assert model.replay_buffer is not None
        model.replay_buffer.rewards[3] = math.inf
        np.random.seed(0)
        th.manual_seed(0)
        with pytest.raises(NonFiniteError, match=r"is (inf|nan) at gradient step \d+,") as error:
            for _ in range(40 // at_once):
                model.train(at_once, batch_size=2)
        messages.append(str(error.value))
    assert messages[0] == messages[1]


def test_q_values_that_explode() -> None:
    model = make_model(gamma=0.9, learning_rate=0.0).learn(40)
    # Rewards of about -10, entropies of at most 2 x 34 times 0.1: 17 / (1 - 0.9) is far below.
    bias = model.critic.q_networks[0][-1].bias
    model.learn(10, PoisonAt(bias, 45, 1e4), reset_num_timesteps=False)
    with pytest.raises(
        ExplodedError, match=r"^the error of the Q values is \S+ at gradient step 35, agent step 55; .*rewards of"
    ):
        model.learn(10, PoisonAt(bias, 55, 1e7), reset_num_timesteps=False)


@pytest.mark.parametrize(("kind", "name"), [("state", "forward-dynamics"), ("pixels", "aarl-pixel"), ("dict", "aarl-pixel")])
def test_auto_loss(kind: str, name: str, capsys: pytest.CaptureFixture, caplog: pytest.LogCaptureFixture) -> None:
    model = make_model(kind, aux_loss="auto", verbose=1)
    assert model.aux_loss == catalog.load(name)
    assert f"Auxiliary loss: {name}\n" in capsys.readouterr().out
    identity = {"features_extractor_class": "identity", "features_extractor_kwargs": {}}
    assert make_model("state", aux_loss="auto", policy_kwargs=identity).aux_loss is None
    assert "training without an auxiliary loss, since FlattenExtractor has no parameters" in caplog.text
