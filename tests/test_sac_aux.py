"""SACAux: what a gradient step does, that a saved model goes on as if it had not stopped, and what is refused."""

import copy
import math
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_aarl import SACAux, catalog
from sb3_aarl.augmentation import center_crop
from sb3_aarl.buffers import WindowSamples
from sb3_aarl.sac_aux import NonFiniteError, ParametersError

LOSS = "{s_t, a_t, r_t} -> {r_t+1, s_t+1, s_t+2}"
KINDS = ("state", "pixels", "dict")
POLICIES = {"state": "MlpPolicy", "pixels": "CnnPolicy", "dict": "MultiInputPolicy"}
ENCODERS: dict[str, dict[str, Any]] = {
    "state": {"features_dim": 8, "width": 8},
    "pixels": {"features_dim": 8, "n_filters": 4},
    "dict": {"cnn_output_dim": 8, "mlp_output_dim": 8},
}


class Point(gym.Env):
    """A point that actions push about, seen as three numbers, as a picture of 18 x 20 pixels, or as both."""

    def __init__(self, kind: str = "state", length: int = 15):
        self.kind = kind
        self.length = length
        vector = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        image = spaces.Box(0, 255, (3, 18, 20), np.uint8)
        self.observation_space = {
            "state": vector,
            "pixels": image,
            "dict": spaces.Dict({"vector": vector, "image": image}),
        }[kind]
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
    """A test's id: without addresses of functions, which differ among pytest's processes."""
    return str(value).partition(" at 0x")[0]


def make_env(kind: str, n_envs: int = 1, length: int = 15) -> DummyVecEnv:
    return DummyVecEnv([lambda: Point(kind, length)] * n_envs)


def make_model(kind: str = "state", env: Any = None, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any) -> SACAux:
    policy_kwargs = {"net_arch": [16], "features_extractor_kwargs": ENCODERS[kind], **(policy_kwargs or {})}
    settings: dict[str, Any] = {
        "buffer_size": 300,
        "learning_starts": 20,
        "batch_size": 16,
        "aux_loss": LOSS,
        # Unlike the critic's, or Adam's first two steps would cancel out where critic and auxiliary loss disagree.
        "encoder_learning_rate": 7e-4,
        "predictor_width": 12,
        "crop_size": 16,
        "seed": 3,
        "device": "cpu",
    }
    env = make_env(kind) if env is None else env
    return SACAux(POLICIES[kind], env, policy_kwargs=policy_kwargs, **{**settings, **kwargs})


def filled_model(kind: str = "state", steps: int = 60, **kwargs: Any) -> SACAux:
    """A model that has seen the environment and not yet trained."""
    return make_model(kind, **{"learning_starts": 1000, **kwargs}).learn(steps)


def everything(model: SAC) -> dict[str, Any]:
    """All that training changes, by name."""
    state: dict[str, Any] = {name: getattr(model, name).detach() for name in model._get_torch_save_params()[1]}
    for name, parameters in model.get_parameters().items():
        state |= {f"{name}.{key}": value for key, value in parameters.items()}
    return copy.deepcopy(state)


def assert_same(first: Any, second: Any, where: str = "") -> None:
    """Bit for bit equality of nested parameters and optimizer states."""
    if isinstance(first, dict):
        assert first.keys() == second.keys(), where
        for key in first:
            assert_same(first[key], second[key], f"{where}.{key}")
    elif isinstance(first, (list, tuple)):
        assert len(first) == len(second), where
        for i, pair in enumerate(zip(first, second, strict=True)):
            assert_same(*pair, f"{where}[{i}]")
    elif isinstance(first, (th.Tensor, np.ndarray)):
        assert np.array_equal(np.asarray(first), np.asarray(second)), where
    else:
        assert first == second, where


# --- SB3's SAC ---------------------------------------------------------------------------------------------------------


def pendulum(n_envs: int) -> DummyVecEnv:
    return DummyVecEnv([lambda: gym.make("Pendulum-v1", max_episode_steps=20)] * n_envs)


@pytest.mark.parametrize(
    ("n_envs", "settings"),
    [
        (1, {}),
        (2, {}),
        (1, {"ent_coef": 0.2}),
        (1, {"n_steps": 3}),
        (2, {"n_steps": 3, "gradient_steps": -1}),
        (1, {"use_sde": True, "sde_sample_freq": 4}),
        (1, {"learning_rate": lambda remaining: 1e-2 * remaining}),
        (1, {"train_freq": 4, "gradient_steps": 3, "ent_coef": "auto_0.5", "target_entropy": -2.0}),
        (1, {"policy_kwargs": {"net_arch": {"pi": [12], "qf": [20, 8]}, "n_critics": 3, "activation_fn": th.nn.Tanh}}),
    ],
    ids=name,
)
def test_without_aux_loss_is_sac(n_envs: int, settings: dict[str, Any]) -> None:
    both: dict[str, Any] = {
        "learning_rate": 1e-3,
        "buffer_size": 1000,
        "learning_starts": 24,
        "batch_size": 16,
        "tau": 0.02,
        "target_update_interval": 1,
        "ent_coef": "auto",
        "seed": 5,
        "device": "cpu",
        **settings,
    }
    steps = 80 * n_envs + 24
    policy_kwargs = {"net_arch": [16], **both.pop("policy_kwargs", {})}
    sac = SAC("MlpPolicy", pendulum(n_envs), policy_kwargs=policy_kwargs, **both).learn(steps)
    ours = SACAux(
        "MlpPolicy",
        pendulum(n_envs),
        policy_kwargs={"features_extractor_class": "identity", **policy_kwargs},
        aux_loss=None,
        policy_delay=1,
        ent_coef_learning_rate=None,
        ent_coef_betas=(0.9, 0.999),
        **both,
    ).learn(steps)

    assert ours._n_updates == sac._n_updates >= 50
    assert_same(everything(ours), everything(sac))


@pytest.mark.parametrize("kind", KINDS)
def test_with_encoders_of_their_own_is_sac(kind: str) -> None:
    """SB3's default: actor and critic each train an encoder. Its extractors stand for any class of a user's own."""
    both: dict[str, Any] = {
        "learning_starts": 10,
        "batch_size": 8,
        "buffer_size": 200,
        "learning_rate": 1e-3,
        "tau": 0.01,
        "target_update_interval": 1,
        "seed": 5,
        "device": "cpu",
    }
    extractor = {"state": FlattenExtractor, "pixels": SmallCNN, "dict": SmallCombined}[kind]
    # SB3's optimizer; the fused one of SACAux rounds in another way.
    policy_kwargs: dict[str, Any] = {
        "net_arch": [16],
        "features_extractor_class": extractor,
        "optimizer_kwargs": {"fused": False},
    }
    sac = SAC(POLICIES[kind], make_env(kind), policy_kwargs=policy_kwargs, **both).learn(70)
    ours = SACAux(
        POLICIES[kind],
        make_env(kind),
        policy_kwargs={**policy_kwargs, "share_features_extractor": False},
        aux_loss=None,
        policy_delay=1,
        encoder_tau=0.01,
        ent_coef="auto",
        ent_coef_learning_rate=None,
        ent_coef_betas=(0.9, 0.999),
        augmentation="none",
        **both,
    ).learn(70)

    assert ours._n_updates == 60
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
        "actor": ("actor.projection.", "actor.latent_pi.", "actor.mu.", "actor.log_std."),
        "head": ("aux_head.",),
        "alpha": ("log_ent_coef",),
    }

    def __init__(self, model: SACAux, loss: str, negatives: bool, joint: bool, squash: tuple[float, float] | None):
        named = {**model.policy.state_dict(), "log_ent_coef": model.log_ent_coef}
        named |= {f"aux_head.{name}": value for name, value in model.aux_head.state_dict().items()}
        self.w = {name: value.detach().double() for name, value in named.items() if value.is_floating_point()}
        self.loss, self.negatives, self.joint, self.squash = loss, negatives, joint, squash
        self.optimizers = {name: NaiveAdam(2e-3, (0.9, 0.999), 1e-3) for name in ("critic", "actor")}
        self.optimizers["aux"] = NaiveAdam(3e-3, (0.9, 0.999), 1e-3)
        self.optimizers["alpha"] = NaiveAdam(1e-2, (0.5, 0.999), 1e-8)

    def names(self, *groups: str) -> list[str]:
        prefixes = tuple(prefix for group in groups for prefix in self.GROUPS[group])
        return [name for name in self.w if name.startswith(prefixes) and "running_" not in name]

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
        hidden = self.project("actor.projection", self.trunk("critic", obs).detach())
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
        last = "aux_head.predictor.2"
        if "aux_head.predictor.1.weight" in self.w:
            hidden = (hidden - hidden.mean(0)) / (hidden.var(0, unbiased=False) + 1e-5).sqrt()
            hidden = hidden * self.w["aux_head.predictor.1.weight"] + self.w["aux_head.predictor.1.bias"]
            last = "aux_head.predictor.3"
        prediction = self.linear(last, hidden.clamp(min=0))
        if self.loss == "mse":
            value = ((prediction - target.detach()) ** 2).sum() / target.numel()
        else:
            similarity = prediction @ self.w["aux_head.operator.weight"] @ target.detach().T
            value = -(similarity.diag() - similarity.logsumexp(1)).mean()
        return 0.7 * value

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
    ("operator", "joint", "batch_norm", "squash"),
    [
        ("mse", False, False, None),
        ("mse", True, False, (-10, 2)),
        ("mse", False, True, None),
        ("bilinear", True, False, None),
        ("bilinear", False, False, (-5, 1)),
    ],
)
def test_train_agrees_with_naive_steps(
    operator: str, joint: bool, batch_norm: bool, squash: tuple[float, float] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    negatives = operator == "bilinear"
    brackets = " [bilinear, negatives]" if negatives else ""
    model = filled_model(
        aux_loss="{s_t, a_t, r_t, s_t+2} -> {s_t+1, a_t+1, r_t+1, s_t+2}" + brackets,
        learning_rate=2e-3,
        encoder_learning_rate=3e-3,
        ent_coef_learning_rate=1e-2,
        aux_coef=0.7,
        aux_batch_size=24,
        gamma=0.9,
        tau=0.1,
        encoder_tau=0.3,
        joint_optimizer=joint,
        predictor_batch_norm=batch_norm,
        # An epsilon that leaves gradients of rounding errors (a bias before batch norm) without effect.
        policy_kwargs={"squash_log_std": squash, "optimizer_kwargs": {"eps": 1e-3}},
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
            if "running_" not in name and "num_batches" not in name and not name.startswith("actor.features_extractor"):
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
@pytest.mark.parametrize(
    "settings", [{}, {"joint_optimizer": True}, {"predictor_batch_norm": True}, {"precision": "bf16"}], ids=name
)
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


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("joint", [False, True])
def test_which_loss_moves_the_encoder(kind: str, joint: bool) -> None:
    """With a learning rate of zero elsewhere only the auxiliary loss is left, and the other way round."""
    frozen: dict[str, Any] = {"ent_coef_learning_rate": 0.0, "policy_delay": 1, "target_update_interval": 100}
    only_aux = filled_model(kind, learning_rate=0.0, encoder_learning_rate=1e-3, joint_optimizer=joint, **frozen)
    assert moved_by_train(only_aux) == {"encoder", "head"}
    no_aux = filled_model(kind, learning_rate=1e-3, encoder_learning_rate=0.0, joint_optimizer=joint, **frozen)
    assert moved_by_train(no_aux) == ({"q", "actor"} if joint else {"encoder", "q", "actor"})
    none = filled_model(kind, aux_loss=None, learning_rate=1e-3, joint_optimizer=joint, **frozen)
    assert moved_by_train(none) == {"encoder", "q", "actor"}


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize(
    ("kind", "extractor"),
    [("state", None), ("pixels", None), ("dict", None), ("pixels", SmallCNN), ("dict", SmallCombined)],
)
def test_how_often_gradients_arrive(kind: str, extractor: type[BaseFeaturesExtractor] | None, share: bool) -> None:
    """The critic's encoder hears critic and auxiliary loss, never the actor; the actor's own one only the actor."""
    kwargs = {"features_extractor_class": extractor, "features_extractor_kwargs": {}} if extractor else {}
    model = filled_model(kind, policy_delay=1, policy_kwargs={"share_features_extractor": share, **kwargs})
    assert (model.actor.features_extractor is model.critic.features_extractor) == share
    arrived = dict.fromkeys(parts(model), 0)
    for name in ("encoder", "q", "actor", "head", "ent_coef"):
        for parameter in parts(model)[name]:

            def count(gradient: th.Tensor, name: str = name) -> None:
                arrived[name] += 1

            parameter.register_hook(count)
    model.train(3, batch_size=16)
    backwards = {name: arrived[name] / len(tensors) / 3 for name, tensors in parts(model).items()}
    assert backwards == {
        "encoder": 2,  # critic and auxiliary loss
        "q": 1,  # critic loss; the actor loss passes through on its way to the actor and leaves nothing
        "actor": 1,
        "head": 1,
        "momentum_encoder": 0,
        "target_q": 0,
        "ent_coef": 1,
    }


@pytest.mark.parametrize("kind", KINDS)
def test_actor_and_critic_with_an_encoder_each(kind: str) -> None:
    model = filled_model(kind, policy_delay=2, policy_kwargs={"share_features_extractor": False})
    critic, actor = model.critic.features_extractor, model.actor.features_extractor
    critics, actors = copy.deepcopy((critic.state_dict(), actor.state_dict()))
    model.train(1, batch_size=16)
    assert all(not th.equal(value, critics[name]) for name, value in critic.state_dict().items())
    assert all(th.equal(value, actors[name]) for name, value in actor.state_dict().items())
    model.train(1, batch_size=16)
    assert all(not th.equal(value, actors[name]) for name, value in actor.state_dict().items())


@pytest.mark.parametrize("kind", KINDS)
def test_targets_are_moving_averages(kind: str) -> None:
    model = filled_model(kind, tau=0.1, encoder_tau=0.4, target_update_interval=2)
    expected = {name: value.clone() for name, value in model.critic.state_dict().items()}
    assert_same(expected, dict(model.critic_target.state_dict()))
    for number in range(1, 7):
        model.train(1, batch_size=16)
        for name, value in model.critic.state_dict().items():
            tau = 0.4 if name.startswith("features_extractor.") else 0.1
            if number % 2 == 0:
                expected[name] = (1 - tau) * expected[name] + tau * value
            th.testing.assert_close(model.critic_target.state_dict()[name], expected[name], rtol=0, atol=1e-6)


def test_running_statistics_of_the_encoder_are_copied() -> None:
    kwargs = {"features_extractor_class": SmallCNN, "features_extractor_kwargs": {}}
    model = filled_model("pixels", target_update_interval=1, policy_kwargs=kwargs)
    before = model.critic.features_extractor.norm.running_mean.clone()
    model.train(2, batch_size=16)
    norms = [critic.features_extractor.norm for critic in (model.critic, model.critic_target)]
    assert not th.equal(before, norms[0].running_mean)
    for name in ("running_mean", "running_var"):
        assert th.equal(getattr(norms[0], name), getattr(norms[1], name))
    assert norms[0].training and not norms[1].training


def test_schedules_and_aux_coef() -> None:
    settings = {"learning_rate": 1e-3, "encoder_learning_rate": lambda left: 2e-3 * left, "ent_coef_betas": (0.3, 0.99)}
    model = make_model(ent_coef_learning_rate=lambda left: 1e-2 * left**2, **settings).learn(50)
    assert model.aux_optimizer.param_groups[0]["lr"] == pytest.approx(2e-3 * model._current_progress_remaining)
    assert model.ent_coef_optimizer.param_groups[0]["lr"] == pytest.approx(1e-2 * model._current_progress_remaining**2)
    assert model.ent_coef_optimizer.param_groups[0]["betas"] == (0.3, 0.99)
    assert model.critic.optimizer.param_groups[0]["lr"] == 1e-3

    norms = []
    for coefficient in (0.0, 1.0, 3.0):
        model = filled_model(aux_coef=coefficient, policy_kwargs={"optimizer_class": th.optim.SGD})
        th.manual_seed(0)
        np.random.seed(0)
        model.train(1, batch_size=16)
        norms.append(model.logger.name_to_value["train/aux_grad_norm"])
    assert norms == [0, norms[1], pytest.approx(3 * norms[1])] and norms[1] > 0


# --- Logs --------------------------------------------------------------------------------------------------------------


def test_logs() -> None:
    model = filled_model()
    model.train(4, batch_size=16)
    logged = model.logger.name_to_value
    assert {
        "train/aux_loss",
        "train/aux_grad_norm",
        "train/aux_skipped",
        "train/n_updates",
        "train/ent_coef",
        "train/ent_coef_loss",
        "train/critic_loss",
        "train/actor_loss",
        "train/learning_rate",
    } <= logged.keys()
    model.train(1, batch_size=16)
    assert logged["train/aux_loss"] > 0 and logged["train/aux_skipped"] == 0
    gradients = [p.grad for name in ("encoder", "head") for p in parts(model)[name]]
    expected = math.sqrt(sum(gradient.square().sum().item() for gradient in gradients))
    assert logged["train/aux_grad_norm"] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("joint", [False, True])
def test_a_horizon_longer_than_any_episode_is_skipped_and_counted(joint: bool) -> None:
    model = make_model(env=make_env("state", length=4), aux_loss="{s_t} -> {s_t+5}", joint_optimizer=joint)
    before = copy.deepcopy(model.aux_head.state_dict())
    encoder = copy.deepcopy(model.critic.features_extractor.state_dict())
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


# --- Save and load -----------------------------------------------------------------------------------------------------


def resumable_env(variant: str) -> Any:
    kind = variant.partition("-")[0]
    if variant == "pixels-stack":
        return VecFrameStack(make_env(kind, 2), 3, channels_order="first")
    if variant == "state-normalized":
        return VecNormalize(make_env(kind, 2))
    return make_env(kind)


@pytest.mark.parametrize(
    ("variant", "steps", "settings"),
    [
        ("state", 200, {}),
        ("state-joint", 80, {"joint_optimizer": True, "policy_delay": 3, "target_update_interval": 7}),
        ("state-batchnorm", 80, {"predictor_batch_norm": True, "aux_loss": LOSS + " [bilinear, negatives]"}),
        ("state-normalized", 80, {}),
        ("state-sde", 80, {"use_sde": True, "ent_coef": 0.1, "n_steps": 3}),
        ("state-small", 80, {"buffer_size": 70}),
        ("state-bf16", 80, {"precision": "bf16"}),
        ("pixels-bf16", 40, {"precision": "bf16", "augmentation": "random_crop"}),
        ("dict", 40, {}),
        ("pixels", 60, {"augmentation": "random_crop"}),
        ("pixels-stack", 60, {"augmentation": "random_shift"}),
    ],
)
def test_a_saved_model_goes_on_as_if_it_had_not_stopped(
    variant: str, steps: int, settings: dict[str, Any], tmp_path: pathlib.Path
) -> None:
    kind = variant.partition("-")[0]
    straight = make_model(kind, resumable_env(variant), **settings).learn(2 * steps)

    first = make_model(kind, resumable_env(variant), **settings).learn(steps)
    first.save(tmp_path / "model")
    first.save_replay_buffer(tmp_path / "buffer")
    # Anything may happen in between.
    th.manual_seed(77)
    np.random.seed(77)
    resumed = SACAux.load(tmp_path / "model", env=first.get_env(), force_reset=False, device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    assert_same(everything(resumed), everything(first))
    resumed.learn(steps, reset_num_timesteps=False)

    assert resumed.num_timesteps == straight.num_timesteps == 2 * steps
    assert resumed._n_updates == straight._n_updates > steps / 4
    assert_same(everything(resumed), everything(straight))
    for name in ("actions", "rewards", "dones"):
        assert_same(getattr(resumed.replay_buffer, name), getattr(straight.replay_buffer, name))


@pytest.mark.parametrize("ortho_init", [False, True])
def test_ortho_init_reaches_every_linear_layer(ortho_init: bool) -> None:
    policy = make_model(policy_kwargs={"ortho_init": ortho_init}).policy
    for part in (policy.actor, policy.critic):
        for name, module in part.named_modules():
            if isinstance(module, th.nn.Linear):
                short = module.weight if module.weight.shape[0] <= module.weight.shape[1] else module.weight.T
                orthogonal = th.allclose(short @ short.T, th.eye(len(short)), atol=1e-4)
                encoder = "features_extractor" in name or name == "projection" or name.startswith("projection.")
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


@pytest.mark.parametrize("joint", [False, True])
def test_parameters_include_the_auxiliary_ones(joint: bool) -> None:
    trained = make_model(joint_optimizer=joint).learn(60)
    fresh = make_model(joint_optimizer=joint, seed=9)
    parameters = trained.get_parameters()
    assert {"policy", "actor.optimizer", "critic.optimizer", "ent_coef_optimizer", "aux_head", "aux_optimizer"} == set(
        parameters
    )
    assert fresh.aux_optimizer.state_dict()["state"] == {}
    fresh.set_parameters(parameters)
    assert_same(fresh.get_parameters(), parameters)
    del parameters["aux_head"]
    with pytest.raises(ValueError, match="aux_head"):
        fresh.set_parameters(parameters)


def test_without_aux_loss_nothing_auxiliary_is_saved(tmp_path: pathlib.Path) -> None:
    model = make_model(aux_loss=None).learn(40)
    assert not any(name.startswith("aux") for name in model.get_parameters())
    model.save(tmp_path / "model")
    assert SACAux.load(tmp_path / "model").aux_loss is None


def test_load_takes_a_loss_in_all_its_forms(tmp_path: pathlib.Path) -> None:
    make_model(aux_loss="forward-dynamics").save(tmp_path / "model")
    loss = catalog.load("forward-dynamics")
    for form in (loss, str(loss), "forward-dynamics", loss.to_dict()):
        assert SACAux.load(tmp_path / "model", aux_loss=form).aux_loss == loss


def test_a_model_with_nan_is_not_saved_over_a_good_one(tmp_path: pathlib.Path) -> None:
    model = make_model().learn(30)
    model.save(tmp_path / "model.zip")
    good = (tmp_path / "model.zip").read_bytes()
    tensors = {
        "policy.critic.qf0.0.bias": model.critic.q_networks[0][0].bias,
        "aux_head.predictor.0.weight": model.aux_head.predictor[0].weight,
        "log_ent_coef": model.log_ent_coef,
    }
    for name, tensor in tensors.items():
        value = tensor.data.flatten()[0].item()
        tensor.data.flatten()[0] = float("nan")
        with pytest.raises(NonFiniteError, match=name):
            model.save(tmp_path / "model.zip")
        tensor.data.flatten()[0] = value
    assert (tmp_path / "model.zip").read_bytes() == good
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]
    model.save(tmp_path / "model.zip")
    assert_same(everything(SACAux.load(tmp_path / "model.zip", device="cpu")), everything(model))


class Masked(FlattenExtractor):
    """An encoder with a buffer that is infinite on purpose, and the layer that the auxiliary loss trains."""

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space)
        self.layer = th.nn.Linear(3, 3)
        self.norm = th.nn.BatchNorm1d(3)
        self.register_buffer("mask", th.full((3,), -math.inf))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.norm(self.layer(observations)).maximum(self.mask)


def test_an_infinite_buffer_is_not_a_divergence(tmp_path: pathlib.Path) -> None:
    policy_kwargs = {"features_extractor_class": Masked, "features_extractor_kwargs": {}}
    model = make_model(policy_kwargs=policy_kwargs).learn(30)
    model.save(tmp_path / "model")
    assert_same(everything(SACAux.load(tmp_path / "model", device="cpu")), everything(model))

    class Broken(BaseCallback):
        def _on_step(self) -> bool:
            raise ValueError("my callback is wrong")

    with pytest.raises(ValueError, match=r"^my callback is wrong$"):
        model.learn(5, Broken())
    # What is averaged while it learns is watched all the same.
    norm = model.critic.features_extractor.norm
    for buffer, value in ((norm.running_var, math.inf), (model.critic.features_extractor.mask, math.nan)):
        kept = buffer[1].item()
        buffer[1] = value
        with pytest.raises(NonFiniteError, match=r"(running_var|mask) is not finite"):
            model.save(tmp_path / "other")
        buffer[1] = kept
    model.save(tmp_path / "other")


def test_saving_a_loaded_model_changes_nothing(tmp_path: pathlib.Path) -> None:
    model = make_model().learn(40)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    env = model.get_env()

    def resumed(path: str, backup: str | None = None) -> dict[str, Any]:
        loaded = SACAux.load(tmp_path / path, env=copy.deepcopy(env), force_reset=False, device="cpu")
        loaded.load_replay_buffer(tmp_path / "buffer")
        if backup is not None:
            loaded.save(tmp_path / backup)
        return everything(loaded.learn(40, reset_num_timesteps=False))

    straight = resumed("model")
    assert_same(resumed("model", backup="backup"), straight)
    assert_same(resumed("backup"), straight)


def test_loading_with_other_settings_says_what_is_wrong(tmp_path: pathlib.Path) -> None:
    make_model(aux_loss=None).save(tmp_path / "plain")
    make_model().save(tmp_path / "model")
    other: list[dict[str, Any]] = [{"joint_optimizer": True}, {"aux_loss": "{s_t, a_t} -> {s_t+1}"}, {"predictor_width": 20}]
    for path, settings in (("plain", {"aux_loss": LOSS}), *(("model", settings) for settings in other)):
        with pytest.raises(ParametersError, match=r"Are they of a model with other settings than aux_loss=.*joint_optimizer="):
            SACAux.load(tmp_path / path, **settings)


def test_loading_with_other_n_step_returns(tmp_path: pathlib.Path) -> None:
    model = make_model(n_steps=3)
    assert model.replay_buffer_kwargs == {} and model.replay_buffer.n_steps == 3
    model.save(tmp_path / "model")
    loaded = SACAux.load(tmp_path / "model", make_env("state"), n_steps=2, gamma=0.5)
    assert (loaded.replay_buffer.n_steps, loaded.replay_buffer.gamma) == (2, 0.5)
    assert SACAux.load(tmp_path / "model", make_env("state"), n_steps=1).replay_buffer.n_steps == 1


def test_a_replay_buffer_without_windows_is_not_loaded(tmp_path: pathlib.Path) -> None:
    theirs = SAC("MlpPolicy", make_env("state"), learning_starts=100, buffer_size=50).learn(20)
    theirs.save_replay_buffer(tmp_path / "buffer")
    model = make_model().learn(30)
    buffer = model.replay_buffer
    with pytest.raises(ValueError, match=r"a ReplayBuffer gives no windows, which aux_loss=\{s_t.*buffer was not saved by"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is buffer
    plain = make_model(aux_loss=None)
    plain.load_replay_buffer(tmp_path / "buffer")
    assert plain.learn(30)._n_updates > 0


@pytest.mark.parametrize(("n_envs", "normalized"), [(1, False), (2, False), (2, True)])
def test_a_buffer_that_was_emptied_inside_an_episode(n_envs: int, normalized: bool, caplog: pytest.LogCaptureFixture) -> None:
    env: Any = VecFrameStack(make_env("pixels", n_envs, length=50), 3, channels_order="first")
    model = make_model("pixels", VecNormalize(env, norm_obs=False) if normalized else env)
    model.learn(20)
    model.learn(4, reset_num_timesteps=False)
    assert not caplog.records  # it goes on inside the episode
    model.replay_buffer.reset()
    model.learn(20, reset_num_timesteps=False)
    assert ["the environments are reset" in record.message for record in caplog.records] == [True]
    assert model.replay_buffer.size() == 20 // n_envs


class Viewed(BaseFeaturesExtractor):
    """Looks at images as rows, which only memory without gaps allows."""

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, features_dim=4)
        self.layer = th.nn.Linear(3 * 16 * 16, 4)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layer(observations.view(len(observations), -1))


def test_cropped_floats_reach_an_encoder_without_gaps() -> None:
    env = gym.wrappers.TransformObservation(
        Point("pixels"), lambda image: (image / 255).astype(np.float32), spaces.Box(0, 1, (3, 18, 20), np.float32)
    )
    policy_kwargs = {"features_extractor_class": Viewed, "features_extractor_kwargs": {}, "normalize_images": False}
    model = make_model("pixels", env, policy_kwargs, augmentation="random_crop").learn(30)
    image = env.reset(seed=1)[0]
    action, _ = model.predict(image, deterministic=True)
    # The centre is what counts.
    framed = np.zeros_like(image)
    framed[:, 1:-1, 2:-2] = image[:, 1:-1, 2:-2]
    assert not np.array_equal(framed, image) and np.array_equal(model.predict(framed, deterministic=True)[0], action)


def test_a_training_that_a_callback_stopped_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return self.n_calls < 7

    for kind, stacked in (("state", False), ("pixels", True)):
        env: Any = make_env(kind, length=50)
        model = make_model(kind, VecFrameStack(env, 3, channels_order="first") if stacked else env)
        model.learn(20, Stop())
        assert model.num_timesteps == 7 and (model._last_obs is None) is stacked
        model.learn(20, reset_num_timesteps=False)
        assert model.replay_buffer.size() == 26  # the step that stopped it is not stored, as in SB3


@pytest.mark.parametrize("kind", ["state", "pixels"])
def test_a_training_that_was_interrupted_goes_on(kind: str) -> None:
    class Interrupt(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 27:
                raise KeyboardInterrupt
            return True

    env: Any = make_env(kind, length=50)
    model = make_model(kind, VecFrameStack(env, 3, channels_order="first") if kind == "pixels" else env)
    with pytest.raises(KeyboardInterrupt):
        model.learn(40, Interrupt())
    before = model._n_updates
    model.learn(20, reset_num_timesteps=False)
    assert model._n_updates == before + 20 and model.replay_buffer.size() == 46


@pytest.mark.parametrize("normalized", [False, True])
def test_environments_that_somebody_else_stepped(normalized: bool) -> None:
    env: Any = VecFrameStack(make_env("pixels", length=50), 3, channels_order="first")
    model = make_model("pixels", VecNormalize(env, norm_obs=False) if normalized else env).learn(25)
    env = model.get_env()
    obs = env.reset()
    for _ in range(5):
        obs, *_ = env.step(model.predict(obs)[0])
    with pytest.raises(ValueError, match=r"if somebody else stepped them since, .* call learn\(\) again"):
        model.learn(20, reset_num_timesteps=False)
    before = model.replay_buffer.size()
    model.learn(20, reset_num_timesteps=False)
    assert model.replay_buffer.size() == before + 20


def test_other_envs_than_those_of_the_saved_model(tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture) -> None:
    make_model(env=VecNormalize(make_env("state"))).learn(30).save(tmp_path / "model")
    loaded = SACAux.load(tmp_path / "model", env=VecNormalize(make_env("state", 2)), device="cpu")
    assert loaded.learn(40)._n_updates > 0 and loaded.replay_buffer.n_envs == 2
    stacked = make_model("pixels", VecNormalize(VecFrameStack(make_env("pixels"), 3, channels_order="first"), norm_obs=False))
    stacked.learn(20)
    stacked.replay_buffer.reset()
    stacked.learn(20)  # from the beginning: nothing to say
    assert not caplog.records


def test_an_actor_that_is_frozen_stays_as_it_is() -> None:
    model = make_model(ent_coef=0.1)
    for parameter in model.actor.own_parameters():
        parameter.requires_grad = False
    own = {id(parameter) for parameter in model.actor.own_parameters()}
    frozen = {name for name, parameter in model.policy.named_parameters() if id(parameter) in own}
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(40)
    moved = {name for name, value in model.policy.state_dict().items() if not th.equal(before[name], value)}
    assert frozen and not moved & frozen
    assert moved >= {name for name in before if name.startswith("critic.") and name.endswith("weight")}


# --- Seeds and prediction ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_seeds(kind: str) -> None:
    first, again, other = (make_model(kind, make_env(kind, 2), seed=seed).learn(60) for seed in (1, 1, 2))
    assert_same(everything(first), everything(again))
    assert not th.equal(first.critic.q_networks[0][0].weight, other.critic.q_networks[0][0].weight)


def test_a_loaded_model_takes_another_seed(tmp_path: pathlib.Path) -> None:
    model = make_model().learn(30)
    model.save(tmp_path / "model")

    def go_on(seed_at_load: int | None, seed_after: int | None) -> np.ndarray:
        kwargs = {} if seed_at_load is None else {"seed": seed_at_load}
        loaded = SACAux.load(tmp_path / "model", make_env("state"), device="cpu", **kwargs)
        if seed_after is not None:
            loaded.set_random_seed(seed_after)
        loaded.learn(10, reset_num_timesteps=False)
        return loaded.replay_buffer.actions[:10].copy()

    plain, again, same = go_on(None, None), go_on(None, None), go_on(model.seed, None)
    assert np.array_equal(plain, again) and np.array_equal(plain, same)
    others = [go_on(1, None), go_on(2, None), go_on(None, 1), go_on(None, 5)]
    assert len({actions.tobytes() for actions in [plain, *others[:2]]}) == 3
    assert len({actions.tobytes() for actions in [plain, *others[2:]]}) == 3


@pytest.mark.parametrize("kind", ["pixels", "dict"])
def test_prediction_sees_the_centre_and_training_sees_any_crop(kind: str) -> None:
    model = filled_model(kind, crop_size=16, augmentation="random_crop")
    seen: list[th.Tensor] = []
    for critic in (model.critic, model.critic_target):
        encoder = critic.features_extractor
        layer = encoder.convolutions if kind == "pixels" else encoder.encoders[0].convolutions
        layer.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))

    env = Point(kind)
    observation, _ = env.reset(seed=4)
    image = observation if kind == "pixels" else observation["image"]
    model.predict(observation, deterministic=True)
    assert th.equal(seen[0], center_crop(th.as_tensor(image)[None], 16) / 255)
    assert th.equal(seen[0], th.as_tensor(image)[None, :, 1:17, 2:18] / 255)

    # Pixels that say where they are: their corner tells the crop.
    place = np.arange(18 * 20, dtype=np.uint8).reshape(18, 20) // 20 * 10 + np.arange(20, dtype=np.uint8)
    for store in model.replay_buffer.stores.values():
        if store.frames.dtype == np.uint8:
            store.frames[:] = place
            store.final_frames[:] = place
    seen.clear()
    model.train(3, batch_size=64)
    corners = [set((images[:, 0, 0, 0] * 255).round().tolist()) for images in seen]
    assert all(images.shape[2:] == (16, 16) for images in seen)
    assert set().union(*corners) == {10 * row + column for row in range(3) for column in range(5)}
    # Each pass, of whichever encoder, sees crops of its own.
    assert min(map(len, corners)) > 5
    seen.clear()
    model.predict(observation, deterministic=True)
    assert th.equal(seen[0], th.as_tensor(image)[None, :, 1:17, 2:18] / 255)


@pytest.mark.parametrize("argument", [{"crop_size": 17}, {"augmentation": "random_shift"}, {"augmentation": "none"}])
def test_policy_kwargs_name_the_augmentation_too(argument: dict[str, Any], tmp_path: pathlib.Path) -> None:
    model = make_model("pixels", policy_kwargs=argument)
    model.save(tmp_path / "model")
    size = (17, 17) if "crop_size" in argument else (18, 20)
    for each in (model, SACAux.load(tmp_path / "model"), make_model("pixels", **argument)):
        images = each.policy.augment(th.zeros(2, 3, 18, 20, dtype=th.uint8))
        assert images.shape[2:] == each.critic.features_extractor._observation_space.shape[1:] == size


# --- Bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        ("state", {"aux_loss": "forward-dynamic"}, r"forward-dynamic'.*nearest: forward-dynamics"),
        ("state", {"aux_loss": "{s_t, b_t} -> {s_t+1}"}, r"position 6"),
        ("state", {"aux_loss": "{a_t} -> {s_t+1}"}, r"source needs at least one state"),
        ("state", {"aux_loss": "{s_t} -> {}"}, r"target is empty"),
        ("state", {"aux_loss": 3}, r"an auxiliary loss is .*not 3"),
        ("state", {"policy_delay": 0}, r"policy_delay must be at least 1, not 0"),
        ("state", {"batch_size": 0}, r"batch_size must be at least 1, not 0"),
        ("state", {"buffer_size": 0}, r"buffer_size must be at least 1, not 0"),
        ("state", {"gamma": 5}, r"gamma must be between 0 and 1, not 5"),
        ("state", {"target_update_interval": 0}, r"target_update_interval must be at least 1"),
        ("state", {"encoder_tau": 2}, r"encoder_tau must be between 0 and 1, not 2"),
        ("state", {"encoder_tau": float("nan")}, r"encoder_tau must be between 0 and 1, not nan"),
        ("state", {"tau": -0.1}, r"tau must be between 0 and 1, not -0.1"),
        ("state", {"aux_batch_size": 0}, r"aux_batch_size must be at least 1, not 0"),
        ("state", {"predictor_width": 0}, r"predictor_width must be at least 1, not 0"),
        ("state", {"aux_coef": float("nan")}, r"aux_coef must be a finite number of at least 0, not nan"),
        ("state", {"aux_coef": -1.0}, r"aux_coef must be a finite number of at least 0, not -1"),
        ("state", {"aux_coef": float("inf")}, r"aux_coef must be a finite number"),
        ("state", {"precision": "fp16"}, r"precision must be fp32 or bf16, not 'fp16'"),
        ("state", {"compile": "inductor"}, r"compile must be None or cudagraphs, not 'inductor'"),
        ("state", {"augmentation": "flip"}, r"unknown augmentation 'flip', expected one of auto, random_crop"),
        ("pixels", {"augmentation": "random_crop", "crop_size": 19}, r"18 x 20 pixels are smaller than the crop of 19 x 19"),
        ("pixels", {"crop_size": 19}, r"18 x 20 pixels are smaller than the crop of 19 x 19"),
        ("dict", {"augmentation": "random_crop", "crop_size": 19}, r"under 'image' of 18 x 20 pixels are smaller"),
        ("pixels", {"replay_buffer_kwargs": {"frame_stack": 2}}, r"frame_stack=2 does not divide the first axis"),
        ("state", {"policy_kwargs": {"features_extractor_class": "pixle"}}, r"unknown encoder 'pixle', expected one of"),
        (
            "state",
            {"policy_kwargs": {"features_extractor_class": "identity", "features_extractor_kwargs": {}}},
            r"FlattenExtractor has no parameters .*pass aux_loss=None",
        ),
        ("dict", {"replay_buffer_class": HerReplayBuffer}, r"HerReplayBuffer cannot be used with an auxiliary loss"),
    ],
    ids=name,
)
def test_bad_arguments(kind: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(kind, **settings)


def test_loading_without_the_auxiliary_loss_says_what_is_wrong(tmp_path: pathlib.Path) -> None:
    make_model("state").save(tmp_path / "model")
    with pytest.raises(RuntimeError, match="of a model with an auxiliary loss"):
        SACAux.load(tmp_path / "model", aux_loss=None)
    plain = make_model("state", aux_loss=None)
    before = everything(plain)
    with pytest.raises(RuntimeError, match="of a model with an auxiliary loss"):
        plain.set_parameters(str(tmp_path / "model"))
    assert_same(everything(plain), before)
    other = make_model("state", seed=9)
    other.set_parameters(str(tmp_path / "model"))
    assert_same(other.get_parameters(), SACAux.load(tmp_path / "model").get_parameters())


def test_a_part_of_the_actor_may_be_frozen() -> None:
    model = make_model("state", policy_kwargs={"share_features_extractor": False})
    model.actor.features_extractor.requires_grad_(False)
    before = everything(model)
    model.learn(40)
    after = everything(model)
    frozen = [name for name in after if name.startswith("policy.actor.features_extractor")]
    assert frozen and all(th.equal(before[name], after[name]) for name in frozen)
    assert not th.equal(before["policy.actor.mu.weight"], after["policy.actor.mu.weight"])


def test_what_is_found_out_of_the_wrappers_is_found_out_again(tmp_path: pathlib.Path) -> None:
    stacked = make_model(env=VecFrameStack(make_env("state"), 2)).learn(30)
    assert stacked.replay_buffer.stores[""].stack == 2 and "frame_stack" not in stacked.replay_buffer_kwargs
    stacked.save(tmp_path / "model")
    assert SACAux.load(tmp_path / "model").replay_buffer.stores[""].stack == 2  # there are no wrappers to look at

    class Wide(gym.ObservationWrapper):
        """As many numbers, which are no stack."""

        observation_space = stacked.observation_space

        def observation(self, observation: np.ndarray) -> np.ndarray:
            return np.concatenate([observation, observation**2])

    env = DummyVecEnv([lambda: Wide(Point())])
    model = SACAux.load(tmp_path / "model", env)
    assert model.replay_buffer.stores[""].stack == 1
    model.learn(30)


def test_a_copy_follows_its_own_learning_rate() -> None:
    model = make_model(encoder_learning_rate=None)
    other = copy.deepcopy(model)
    other.lr_schedule = lambda _: 0.25
    other.learn(30)
    assert other.aux_optimizer is not None and other.aux_optimizer.param_groups[0]["lr"] == 0.25


def test_a_frame_stack_that_observations_are_not() -> None:
    model = make_model("pixels", replay_buffer_kwargs={"frame_stack": 3})
    with pytest.raises(ValueError, match=r"frame_stack=3 does not fit observations of shape \(3, 18, 20\)"):
        model.learn(20)


class Spoilt(gym.Wrapper):
    """Gives NaN or infinity in one place, at one step."""

    def __init__(self, env: gym.Env, what: str, at: int):
        super().__init__(env)
        self.what, self.at, self.n = what, at, 0

    def spoil(self, observation: Any) -> Any:
        if isinstance(observation, dict):
            return {**observation, "vector": self.spoil(observation["vector"])}
        return np.where(np.arange(len(observation)) == 1, np.nan, observation).astype(np.float32)

    def reset(self, **kwargs: Any) -> tuple[Any, dict]:
        observation, info = self.env.reset(**kwargs)
        return (self.spoil(observation) if self.at == 0 else observation), info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.n += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self.n == self.at:
            if self.what == "reward":
                reward = math.inf
            else:
                observation = self.spoil(observation)
                terminated = self.what == "terminal observation"
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize(
    ("kind", "what", "at", "message"),
    [
        ("state", "observation", 0, r"^observation from the environment is not finite at agent step 0 \(index \[0, 1\]\)"),
        ("state", "observation", 5, r"^observation from the environment is not finite at agent step 5 \(index \[0, 1\]\)"),
        ("dict", "observation", 3, r"^observation 'vector' from the environment is not finite at agent step 3"),
        ("state", "terminal observation", 7, r"^terminal observation from the environment is not finite at agent step 7"),
        ("state", "reward", 30, r"^reward from the environment is not finite at agent step 30"),
    ],
)
def test_nan_from_the_environment(kind: str, what: str, at: int, message: str) -> None:
    model = make_model(kind, DummyVecEnv([lambda: Spoilt(Point(kind, 100), what, at)]))
    with pytest.raises(NonFiniteError, match=message):
        model.learn(60)
    assert model.replay_buffer.size() == max(0, at - 1)
    assert np.isfinite(model.replay_buffer.rewards).all()


class PoisonAt(BaseCallback):
    """Makes a weight infinite."""

    def __init__(self, weight: th.Tensor, at: int):
        super().__init__()
        self.weight, self.at = weight, at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            self.weight.data.flatten()[0] = math.inf
        return True


@pytest.mark.parametrize(
    ("part", "loss"),
    [
        (lambda model: model.aux_head.predictor[0].bias, "aux_loss"),
        (lambda model: model.critic.q_networks[1][-1].bias, "critic_loss"),
        (lambda model: model.actor.mu.bias, "critic_loss"),
        # Turns actions into NaN before any loss: PyTorch's distributions complain first.
        (lambda model: model.actor.projection[0].bias, "policy.actor.projection.0.bias"),
    ],
)
def test_a_loss_that_is_not_finite(part: Callable[[SACAux], th.Tensor], loss: str, tmp_path: pathlib.Path) -> None:
    model = make_model(policy_delay=100)
    model.save(tmp_path / "model.zip")
    good = (tmp_path / "model.zip").read_bytes()
    with pytest.raises(NonFiniteError) as error:
        model.learn(60, callback=PoisonAt(part(model), 35))
    text = str(error.value)
    # The first of 15 gradient steps is at agent step 21.
    assert text.partition(" ")[0].endswith(loss) and "gradient step 15, agent step 35" in text and str(model.aux_loss) in text
    with pytest.raises(NonFiniteError):
        model.save(tmp_path / "model.zip")
    assert (tmp_path / "model.zip").read_bytes() == good


@pytest.mark.parametrize(("kind", "name"), [("state", "aarl-state"), ("pixels", "aarl-pixel"), ("dict", "aarl-pixel")])
def test_auto_is_the_papers_loss(kind: str, name: str, capsys: pytest.CaptureFixture) -> None:
    model = make_model(kind, aux_loss="auto", verbose=1)
    assert model.aux_loss == catalog.load(name)
    assert f"Auxiliary loss: {name}\n" in capsys.readouterr().out
    identity = {"features_extractor_class": "identity", "features_extractor_kwargs": {}}
    assert make_model("state", aux_loss="auto", policy_kwargs=identity).aux_loss is None


class Frozen(FlattenExtractor):
    """Has parameters, of which none learns."""

    def __init__(self, space: spaces.Space):
        super().__init__(space)
        self.scale = th.nn.Parameter(th.ones(()), requires_grad=False)


def test_auto_is_nothing_where_nothing_learns() -> None:
    frozen = {"features_extractor_class": Frozen, "features_extractor_kwargs": {}}
    assert make_model("state", aux_loss="auto", policy_kwargs=frozen).aux_loss is None
    with pytest.raises(ValueError, match="Frozen has no parameters that the auxiliary loss could train"):
        make_model("state", policy_kwargs=frozen)
