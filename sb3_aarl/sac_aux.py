"""SACAux: Soft Actor-Critic whose encoder is also trained with an auxiliary loss."""

import copy
import io
import logging
import math
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import FloatSchedule, polyak_update, update_learning_rate
from torch.nn import functional as F

from sb3_aarl import catalog
from sb3_aarl.aux_head import AuxHead, AuxOptions
from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.buffers import NoWindowError, WindowReplayBuffer, WindowSamples, detect_frame_stack
from sb3_aarl.health import NonFiniteError, QValueCheck, check_finite
from sb3_aarl.networks import computes_bf16
from sb3_aarl.policies import Actor, CnnPolicy, Critic, MultiInputPolicy, SACAuxPolicy, Trunk

logger = logging.getLogger(__name__)

COMPILED = ("_act", "_critic_loss", "_aux_loss")

SelfSACAux = TypeVar("SelfSACAux", bound="SACAux")


def default_learning_starts(total_timesteps: int) -> int:
    """Agent steps with random actions in a run of ``total_timesteps``, unless ``learning_starts`` says how many."""
    return min(5000, total_timesteps // 10)


class SACAux(SAC):
    """
    Soft Actor-Critic whose encoder is also trained with an auxiliary loss (paper, section 3), around SB3's SAC.

    The encoder is the critic's: the critic loss and the auxiliary loss train it, the actor reads it detached. The encoder
    of the target critic is the momentum encoder of the auxiliary loss; with batch norm the target Q networks read the
    encoder itself. Arguments that are not here are those of SB3's SAC.

    Defaults that are not SAC's are CrossQ's (learning rate, Adam's betas, updates of the actor, batch norm in the Q networks,
    here with target networks) and SimBa's (entropy, random steps). With all of SAC's and ``aux_loss=None`` it is SB3's SAC, to
    the bit: ``zoo_configs/sac.yml`` has them.

    :param policy: ``"MlpPolicy"`` (``simba`` encoder), ``"CnnPolicy"`` (CURL's encoder), ``"MultiInputPolicy"`` or a class
    :param env: The environment, or its registered name
    :param learning_rate: Learning rate or schedule of actor, critic, entropy coefficient and auxiliary loss, unless the last
        two have their own
    :param buffer_size: Size of the replay buffer in transitions (agent steps)
    :param learning_starts: Agent steps with random actions before learning starts; None (default, until ``learn``) for 5,000,
        or a tenth of ``learn`` if that is less. A model that goes on has none, or, if its replay buffer is empty, as many, but
        no more than the default
    :param batch_size: Transitions for each critic and actor update
    :param tau: Polyak coefficient of the target Q networks; 1 copies them at each update (no targets, as in CrossQ); 0 freezes
        the target critic's weights
    :param gamma: Discount factor
    :param replay_buffer_class: None for ``WindowReplayBuffer``; one that is not derived from it has no auxiliary loss
    :param replay_buffer_kwargs: Its arguments. ``frame_stack`` is detected from the wrappers unless given. If one that
        was detected does not hold, a warning is raised and whole observations are stored
    :param optimize_memory_usage: Accepted for SB3; the buffer stores each frame once anyway
    :param ent_coef: As in SB3; ``"auto_0.01"`` (default) learns it from 0.01 on
    :param target_entropy: As in SB3; ``"auto_0.5"`` (default) is half of what ``"auto"`` is
    :param target_update_interval: Gradient steps between updates of the target critic; SAC counts from 0 in each ``train``
    :param policy_kwargs: Arguments of ``policies.SACAuxPolicy``
    :param aux_loss: An AuxLoss, its notation, a name of the catalogue, a YAML file such as a search's ``winner.yml``, or
        None for SAC with the same encoder (the paper's baseline). ``"auto"`` is AARL-Pixel if any observation is an image
        and forward dynamics otherwise; where neither can be trained it is None, with a warning
    :param aux_kwargs: How the loss is trained: ``learning_rate``, ``batch_size``, ``tau`` of the momentum encoder,
        ``predictor_width``, ``joint`` and ``coef``, see ``AuxOptions``
    :param policy_delay: Gradient steps between updates of actor and entropy coefficient
    :param ent_coef_optimizer_kwargs: Arguments of the entropy coefficient's Adam, such as ``lr`` (else ``learning_rate``)
        and ``betas``
    :param precision: ``"fp32"``, or ``"bf16"``: in training the networks compute in bfloat16; parameters, optimizers, Q
        targets, entropy, losses and predictions stay float32. A device without instructions for it (of x86 processors those
        without AVX-512) would be ten times slower: it computes in float32, and logs a warning
    :param compile: Whether ``torch.compile`` compiles the losses, which takes two minutes and gains 7 % at most on a CPU
    :raises ValueError: for arguments that do not fit, with the culprit's name

    Training stops with :class:`NonFiniteError` where something is NaN or infinite, and with
    :class:`ExplodedError` where Q values are far beyond all that the rewards so far allow.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": SACAuxPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: SACAuxPolicy
    actor: Actor
    critic: Critic
    critic_target: Critic

    def __init__(
        self,
        policy: str | type[SACAuxPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int | None = None,
        batch_size: int = 256,
        tau: float = 0.02,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto_0.01",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto_0.5",
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        aux_loss: AuxLoss | str | Path | None = "auto",
        aux_kwargs: dict[str, Any] | None = None,
        policy_delay: int = 3,
        ent_coef_optimizer_kwargs: dict[str, Any] | None = None,
        precision: str = "fp32",
        compile: bool = False,
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,  # type: ignore[arg-type]
            env,
            learning_rate,
            buffer_size,
            learning_starts,  # type: ignore[arg-type]
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class,
            replay_buffer_kwargs,
            optimize_memory_usage,
            n_steps,
            ent_coef,
            target_update_interval,
            target_entropy,
            use_sde,
            sde_sample_freq,
            use_sde_at_warmup,
            stats_window_size,
            tensorboard_log,
            policy_kwargs,
            verbose,
            seed,
            device,
            _init_setup_model=False,
        )
        self.aux_loss = aux_loss
        self.aux_kwargs = aux_kwargs
        self.policy_delay = policy_delay
        self.ent_coef_optimizer_kwargs = ent_coef_optimizer_kwargs
        self.precision = precision
        self.compile = compile

        self.aux_head: AuxHead | None = None
        self.aux_optimizer: th.optim.Optimizer | None = None
        self._n_aux_skipped = 0
        self._reward_scale = 1.0  # by which rewards are divided
        self._q_value_check = QValueCheck()
        self._random_until = -1  # the last random agent step of a model that was loaded without its buffer
        self._stored_timesteps = 0  # steps whose transitions are in the buffer
        self._default_learning_starts: int | None = None  # which the last learn() has set
        self._frame_stack: int | dict[str, int] = 1  # as detected; saved, since load() may have no wrappers to look at

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        # Not in the constructor: load() replaces attributes after it.
        if self.aux_loss is not None and self.aux_loss != "auto":
            self.aux_loss = catalog.resolve(self.aux_loss)
        try:
            self._aux = AuxOptions(**(self.aux_kwargs or {}))
        except TypeError as error:
            known = ", ".join(AuxOptions.__dataclass_fields__)
            raise ValueError(f"aux_kwargs: {str(error).rpartition(' got ')[2]}; known: {known}") from None
        if self.replay_buffer_class is None:
            self.replay_buffer_class = WindowReplayBuffer
        self._check_arguments()
        if isinstance(self.target_entropy, str) and self.target_entropy.startswith("auto_"):
            share = float(self.target_entropy.removeprefix("auto_"))
            self.target_entropy = -share * get_action_dim(self.action_space)
        with warnings.catch_warnings():
            if issubclass(self.replay_buffer_class, WindowReplayBuffer):
                if self.replay_buffer is None:  # load() may be given one, or find it in the file
                    self._setup_replay_buffer(self.replay_buffer_class)
                # SB3 expects that no buffer class but its own knows n-step returns.
                warnings.filterwarnings("ignore", message="`n_steps=")
            super()._setup_model()

        if self.ent_coef_optimizer_kwargs and self.ent_coef_optimizer is None:
            logger.warning("ent_coef_optimizer_kwargs have no effect: ent_coef=%s is fixed", self.ent_coef)
        elif self.ent_coef_optimizer_kwargs:
            assert self.log_ent_coef is not None
            kwargs = {"lr": self.lr_schedule(1), **self.ent_coef_optimizer_kwargs}
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], **kwargs)
        self._setup_aux_loss()
        if self.precision == "bf16" and not computes_bf16(self.device):
            logger.warning("precision='bf16': this %s has no instructions for it, training in fp32", self.device.type.upper())
        if self.compile:
            self._compile_losses()

    def _setup_replay_buffer(self, buffer_class: type[WindowReplayBuffer]) -> None:
        if self.env is not None:
            self._frame_stack = detect_frame_stack(self.env)
        returns = {"n_steps": self.n_steps, "gamma": self.gamma} if self.n_steps > 1 else {}
        kwargs = {"frame_stack": self._frame_stack, **returns, **(self.replay_buffer_kwargs or {})}
        space, actions, n_envs = self.observation_space, self.action_space, self.n_envs
        self.replay_buffer = buffer_class(self.buffer_size, space, actions, device=self.device, n_envs=n_envs, **kwargs)
        self.replay_buffer.frame_stack_detected = "frame_stack" not in (self.replay_buffer_kwargs or {})

    def _check_arguments(self) -> None:
        if not issubclass(self.policy_class, SACAuxPolicy):
            raise ValueError(
                "policy must be MlpPolicy, CnnPolicy, MultiInputPolicy or derived from sb3_aarl.policies.SACAuxPolicy, "
                f"not {self.policy_class}: SB3's have no momentum encoder"
            )
        for name in ("buffer_size", "batch_size", "n_steps", "policy_delay", "target_update_interval"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in ("tau", "gamma"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, not {getattr(self, name)}")
        if self.policy_kwargs.get("n_critics", 2) < 1:
            raise ValueError(f"policy_kwargs: n_critics must be at least 1, not {self.policy_kwargs['n_critics']}")
        if self.precision not in ("fp32", "bf16"):
            raise ValueError(f"precision must be fp32 or bf16, not {self.precision!r}")
        fixed = np.flatnonzero(self.action_space.low == self.action_space.high)  # type: ignore[attr-defined]
        if len(fixed):
            raise ValueError(f"action_space has low == high at index {fixed[0]}: remove what cannot be chosen from the action")

    def _setup_aux_loss(self) -> None:
        encoder = [parameter for parameter in self.critic.features_extractor.parameters() if parameter.requires_grad]
        problem = None
        if not encoder:
            problem = f"{type(self.critic.features_extractor).__name__} has no parameters that the auxiliary loss could train"
        elif not isinstance(self.replay_buffer, WindowReplayBuffer):
            problem = f"{type(self.replay_buffer).__name__} has no windows, as buffers derived from WindowReplayBuffer have"
        if self.aux_loss == "auto" and problem:
            logger.warning("aux_loss='auto': training without an auxiliary loss, since %s", problem)
            self.aux_loss = None
        elif self.aux_loss == "auto":
            name = "aarl-pixel" if self.policy.image_keys else "forward-dynamics"
            self.aux_loss = catalog.load(name)
            if self.verbose >= 1:
                print(f"Auxiliary loss: {name}")
        if self.aux_loss is None:
            return
        assert isinstance(self.aux_loss, AuxLoss)
        if problem:
            raise ValueError(f"{problem}: pass aux_loss=None")
        latent_dim, action_dim = self.critic.features_extractor.features_dim, get_action_dim(self.action_space)
        self.aux_head = AuxHead(self.aux_loss, latent_dim, action_dim, self._aux.predictor_width).to(self.device)
        self.aux_optimizer = self.policy.make_optimizer([*encoder, *self.aux_head.parameters()], self._aux_schedule)
        if self._aux.joint:
            self.critic.optimizer = self.policy.make_optimizer(self.critic.q_parameters, self.lr_schedule)

    def _compile_losses(self) -> None:
        # The actor loss stays as it is: compiled, its backward pass computes gradients of the critics too.
        for name in COMPILED:
            # The random numbers are PyTorch's own.
            setattr(self, name, th.compile(getattr(self, name), options={"fallback_random": True}))

    @property
    def _aux_schedule(self) -> Schedule:
        return self.lr_schedule if self._aux.learning_rate is None else FloatSchedule(self._aux.learning_rate)

    def _update_learning_rates(self) -> None:
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        if self.ent_coef_optimizer is not None:
            rate = self.lr_schedule(self._current_progress_remaining)
            update_learning_rate(self.ent_coef_optimizer, (self.ent_coef_optimizer_kwargs or {}).get("lr", rate))
        if self.aux_optimizer is not None:
            update_learning_rate(self.aux_optimizer, self._aux_schedule(self._current_progress_remaining))

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if self.num_timesteps <= self._random_until:
            return
        # Batch norm and dropout of the networks that learn.
        self.policy.set_training_mode(True)
        self._update_learning_rates()
        # Networks compute in bfloat16 if asked to; their outputs, and all that is computed from them, are float32.
        bf16 = self.precision == "bf16" and computes_bf16(self.device)
        autocast = th.autocast(self.device.type, th.bfloat16, enabled=bf16)
        with self._logged() as log, self._actor_checked():
            for _ in range(gradient_steps):
                self._n_updates += 1
                update_actor = self._n_updates % self.policy_delay == 0
                batch, windows = self._sample(batch_size)
                if self._n_updates == 1 and self.critic.norm == "batch":
                    # The mean of a batch norm's outputs moves slowly: rewards of 10 and more would take thousands of steps.
                    n_steps = getattr(self.replay_buffer, "n_steps", 1)  # an SB3 buffer may have its own, or none
                    self._reward_scale = max(1.0, batch.rewards.abs().mean().item() / n_steps)
                batch = batch._replace(rewards=batch.rewards / self._reward_scale)
                log("largest_reward", batch.rewards.abs().max())
                if self.use_sde:
                    self.actor.reset_noise()

                # Actor and critic both read the trunk of the encoder: computed once.
                with autocast:
                    trunk = self.critic.trunk(batch.observations)
                    if update_actor:
                        detached = self.policy.share_features_extractor
                        actions_pi, log_prob = self._act(trunk if detached else batch.observations)

                # Entropy coefficient: before the critic as in SB3, and the whole step uses its value from before the update.
                if self.ent_coef_optimizer is None:
                    ent_coef = self.ent_coef_tensor / self._reward_scale
                else:
                    assert self.log_ent_coef is not None and isinstance(self.target_entropy, float)
                    ent_coef = self.log_ent_coef.detach().exp()
                    if update_actor:
                        ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
                        log("ent_coef_loss", ent_coef_loss)
                        self.ent_coef_optimizer.zero_grad()
                        ent_coef_loss.backward()
                        self.ent_coef_optimizer.step()
                log("ent_coef", ent_coef)

                # Critic and, through it, the encoder.
                with autocast:
                    critic_loss = self._critic_loss(trunk, batch, ent_coef)
                log("critic_loss", critic_loss)
                self.critic.optimizer.zero_grad()
                if self._aux.joint:
                    self._backward_aux_loss(windows, autocast, log)
                critic_loss.backward()  # with a joint optimizer it adds to the encoder's gradient
                self.critic.optimizer.step()
                if not self._aux.joint:
                    self._backward_aux_loss(windows, autocast, log)
                if self.aux_optimizer is not None and (self._aux.joint or windows is not None):
                    self.aux_optimizer.step()

                # Actor: neither the encoder nor the critic gets a gradient from it.
                if update_actor:
                    with autocast:
                        actor_loss = self._actor_loss(batch.observations, actions_pi, log_prob, ent_coef)
                    log("actor_loss", actor_loss)
                    self.actor.optimizer.zero_grad()
                    actor_loss.backward(inputs=[p for p in self.actor.optimizer.param_groups[0]["params"] if p.requires_grad])
                    self.actor.optimizer.step()

                if self._n_updates % self.target_update_interval == 0:
                    self._update_target()
                # Running statistics of the encoder are copied, see SB3's issue 996.
                polyak_update(self.critic.running_statistics, self.critic_target.running_statistics, 1.0)
        self.policy.set_training_mode(False)  # reading Q values between steps changes no running statistics

    def _act(self, observations: PyTorchObs | Trunk) -> tuple[th.Tensor, th.Tensor]:
        """Actions of the actor and their log probabilities, (batch, action_dim) and (batch, 1)."""
        actions, log_prob = self.actor.action_log_prob(observations)
        return actions, log_prob.reshape(-1, 1)

    def _critic_loss(self, trunk: Trunk, batch: ReplayBufferSamples, ent_coef: th.Tensor) -> th.Tensor:
        """Half the sum of the critics' mean squared errors, as in SB3."""
        latent = self.critic.encode(trunk)
        with th.no_grad():
            shared = self.policy.share_features_extractor
            next_trunk = self.critic.trunk(batch.next_observations) if shared else batch.next_observations
            next_actions, next_log_prob = self._act(next_trunk)
        if self.critic.norm == "batch":
            # Both states in one batch, so that batch norm sees what it is used on (CrossQ), in the target Q networks too.
            with th.no_grad():
                next_latent = self.critic.encode(next_trunk)
            latents, actions = th.cat([latent, next_latent]), th.cat([batch.actions, next_actions])
            with self.critic.batch_statistics(), self.critic_target.batch_statistics():
                q_values = [q.chunk(2)[0] for q in self.critic.q_values(latents, actions)]
                next_q_values = [q.chunk(2)[1] for q in self.critic_target.q_values(latents.detach(), actions)]
        else:
            q_values = list(self.critic.q_values(latent, batch.actions))
            next_q_values = list(self.critic_target.q_values(self.critic_target.encode(batch.next_observations), next_actions))
        with th.no_grad():
            next_q, _ = th.cat(next_q_values, dim=1).min(dim=1, keepdim=True)
            # n-step returns discount by gamma ** n_steps, by less where an episode ended.
            discounts = self.gamma if batch.discounts is None else batch.discounts
            target_q = batch.rewards + (1 - batch.dones) * discounts * (next_q - ent_coef * next_log_prob)
        return 0.5 * th.stack([F.mse_loss(q, target_q) for q in q_values]).sum()

    def _actor_loss(self, observations: PyTorchObs, actions: th.Tensor, log_prob: th.Tensor, ent_coef: th.Tensor) -> th.Tensor:
        with th.no_grad():
            latent = self.critic.encode(observations)
        min_q, _ = th.cat(self.critic.q_values(latent, actions), dim=1).min(dim=1, keepdim=True)
        return (ent_coef * log_prob - min_q).mean()

    def _aux_loss(self, windows: WindowSamples) -> th.Tensor:
        assert self.aux_head is not None
        return self.aux_head(windows, self.critic.encode, self.critic_target.encode)

    def _sample(self, batch_size: int) -> tuple[ReplayBufferSamples, WindowSamples | None]:
        """Transitions and windows of one gradient step, images augmented; no windows as long as no episode has one."""
        buffer, env, windows = self.replay_buffer, self._vec_normalize_env, None
        augment: Callable[[Any], Any] = self.policy.augment
        # Cropped while frames are gathered, which copies less: augment() finds nothing left to crop.
        size = self.policy.crop_size
        crop = {"crop_size": size} if size is not None and isinstance(buffer, WindowReplayBuffer) else {}
        batch = buffer.sample(batch_size, env, **crop)  # type: ignore[union-attr]
        batch = batch._replace(observations=augment(batch.observations), next_observations=augment(batch.next_observations))
        if self.aux_head is not None:
            assert isinstance(buffer, WindowReplayBuffer), "an auxiliary loss needs a WindowReplayBuffer"
            horizon, offsets = self.aux_head.loss.horizon, self.aux_head.offsets
            try:
                windows = buffer.sample_windows(self._aux.batch_size or batch_size, horizon, env, offsets, **crop)
                windows = windows._replace(observations=augment(windows.observations))
            except NoWindowError:
                self._n_aux_skipped += 1
        return batch, windows

    def _backward_aux_loss(
        self, windows: WindowSamples | None, autocast: th.autocast, log: Callable[[str, th.Tensor], None]
    ) -> None:
        """Replace the gradients of encoder and auxiliary head by those of the auxiliary loss."""
        if self.aux_head is None or self.aux_optimizer is None:
            return
        self.aux_optimizer.zero_grad()
        if windows is None:
            return
        with autocast:
            aux_loss = self._aux_loss(windows)
        log("aux_loss", aux_loss)
        (self._aux.coef * aux_loss).backward()

    def _update_target(self) -> None:
        # tau=0 freezes all weights of the target critic, as in SB3.
        if self.tau > 0:
            polyak_update(self.critic.q_parameters, self.critic_target.q_parameters, self.tau)
            polyak_update(self.critic.encoder_parameters, self.critic_target.encoder_parameters, self._aux.tau)

    @contextmanager
    def _logged(self) -> Iterator[Callable[[str, th.Tensor], None]]:
        """Yields ``log(name, value)``; then logs the means over gradient steps, and stops a run that has diverged."""
        logged: list[tuple[str, int, th.Tensor]] = []

        def log(name: str, value: th.Tensor) -> None:
            logged.append((name, self._n_updates, value.detach().reshape(())))

        try:
            yield log
        finally:  # the first loss that is not finite says more than an error that comes of it
            losses: dict[str, dict[int, float]] = defaultdict(dict)
            values = th.stack([tensor for *_, tensor in logged]).tolist() if logged else []
            for (name, step, _), value in zip(logged, values, strict=True):
                if not math.isfinite(value):
                    raise NonFiniteError(f"{name} is {value} at {self._describe(step)}")
                losses[name][step] = value
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/aux_skipped", self._n_aux_skipped)
        self.logger.record("train/reward_scale", self._reward_scale)
        for name, by_step in losses.items():
            if name != "largest_reward":
                self.logger.record(f"train/{name}", sum(by_step.values()) / len(by_step))
        if losses:
            self._q_value_check(losses, self.gamma, get_action_dim(self.action_space), self._describe)

    def _describe(self, gradient_step: int) -> str:
        return f"gradient step {gradient_step}, agent step {self.num_timesteps}; auxiliary loss: {self.aux_loss}"

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        place = f"agent step {self.num_timesteps}"
        check_finite("observation", new_obs, place)
        check_finite("reward", reward, place)
        for info in infos:
            if info.get("terminal_observation") is not None:
                check_finite("terminal observation", info["terminal_observation"], place)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)  # type: ignore[arg-type]
        self._stored_timesteps = self.num_timesteps

    def learn(
        self: SelfSACAux,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "SACAux",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSACAux:
        if not reset_num_timesteps and self._stored_timesteps != self.num_timesteps:
            # A callback ended learn() before the last transition was stored: SB3 resets the environments.
            self._last_obs = None
        goes_on = not reset_num_timesteps and self._n_updates > 0
        is_empty = not self.replay_buffer.size()  # type: ignore[union-attr]
        default = default_learning_starts(total_timesteps + (0 if reset_num_timesteps or goes_on else self.num_timesteps))
        is_default = self.learning_starts in (None, self._default_learning_starts)
        if self.learning_starts is None or (is_default and (is_empty or not goes_on)):
            self.learning_starts = self._default_learning_starts = default
        if reset_num_timesteps:
            self._random_until = -1
        elif goes_on and is_empty and self.critic.norm == "batch":
            # Batch norm forgets what it knows on a few transitions, or on those of one policy.
            n_random = min(self.learning_starts, default)
            self._random_until = self.num_timesteps + n_random
            logger.warning("the replay buffer is empty (load_replay_buffer): %d random steps come first", n_random)
        super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        if self._n_updates and self._n_aux_skipped == self._n_updates:
            warnings.warn(f"aux_loss was never trained: no episode is as long as its horizon ({self.aux_loss})", stacklevel=2)
        return self

    def _sample_action(self, learning_starts: int, *args: Any, **kwargs: Any) -> tuple[np.ndarray, np.ndarray]:
        with self._actor_checked():
            return super()._sample_action(max(learning_starts, self._random_until), *args, **kwargs)

    @contextmanager
    def _actor_checked(self) -> Iterator[None]:
        """PyTorch's distributions refuse NaN before any loss is computed, and know neither the step nor the cause."""
        try:
            yield
        except ValueError as error:
            if "to satisfy the constraint" not in str(error):
                raise
            raise NonFiniteError(f"an output of the actor is not finite at {self._describe(self._n_updates)}") from error

    def training_state(self) -> dict[str, Any]:
        """
        All that training changes in the model, as tensors and plain values: ``torch.load(weights_only=True)`` reads it.

        Neither the replay buffer, nor the environment, nor random generators are part of it.
        """
        tensors = {name: getattr(self, name).detach() for name in self._get_torch_save_params()[1]}
        names = ("num_timesteps", "learning_starts", "_n_updates", "_n_aux_skipped", "_episode_num", "_reward_scale")
        counters = {name: getattr(self, name) for name in names}
        state = {"parameters": self.get_parameters(), "tensors": tensors, "counters": counters}
        return copy.deepcopy({**state, "q_value_check": vars(self._q_value_check)})

    def load_training_state(self, state: Mapping[str, Any]) -> None:
        """Continue from the :meth:`training_state` of another model with the same settings."""
        # Copied, since PyTorch's optimizers keep the tensors that they load.
        self.set_parameters(copy.deepcopy(state["parameters"]), device=self.device)
        for name, value in state["tensors"].items():
            getattr(self, name).data.copy_(value)
        for name, value in state["counters"].items():
            setattr(self, name, value)
        self._q_value_check = QValueCheck(**state["q_value_check"])

    def load_replay_buffer(self, path: str | Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        replay_buffer = vars(self).get("replay_buffer")
        super().load_replay_buffer(path, truncate_last_traj)
        if self.aux_loss is not None and not isinstance(self.replay_buffer, WindowReplayBuffer):
            name, self.replay_buffer = type(self.replay_buffer).__name__, replay_buffer
            raise ValueError(f"{name} has no windows, which aux_loss={self.aux_loss} needs: only aux_loss=None can load it")

    def set_parameters(
        self, load_path_or_dict: str | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        As in SB3. Parameters of an auxiliary loss whose shapes are not those of this model's are left out, with a warning.
        The unit of rewards under batch norm (``train/reward_scale``) is no parameter: :meth:`load` keeps it.
        """
        given: Any = load_path_or_dict
        if not isinstance(given, dict):
            given = load_from_zip_file(given, device=device, load_data=False)[1]
        own, auxiliary = self.get_parameters(), {"aux_head", "aux_optimizer"}
        shapes = [{name: value.shape for name, value in some.get("aux_head", {}).items()} for some in (own, given)]
        if shapes[0] != shapes[1]:
            logger.warning("no parameters of this model's aux_loss (%s) are given: its own stay as they are", self.aux_loss)
            given = {name: value for name, value in given.items() if name not in auxiliary}
            given |= {name: own[name] for name in auxiliary & own.keys()}
        key = "critic.optimizer"
        groups = given.get(key, {}).get("param_groups", own[key]["param_groups"])
        if [group["params"] for group in groups] != [group["params"] for group in own[key]["param_groups"]]:
            # With aux_kwargs=dict(joint=True) the auxiliary optimizer has the encoder's part of the state.
            given = {**given, key: own[key]}
        super().set_parameters(given, exact_match, device)

    def __getstate__(self) -> dict[str, Any]:
        # Compiled losses compute with the networks of this model, not with those of a copy; nor can they be pickled.
        return {name: value for name, value in vars(self).items() if name not in COMPILED}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if self.compile:
            self._compile_losses()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *COMPILED, "batch_norm_stats", "batch_norm_stats_target"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        if self.aux_head is not None:
            state_dicts = [*state_dicts, "aux_head", "aux_optimizer"]
        return state_dicts, variables
