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
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import FloatSchedule, polyak_update, update_learning_rate
from stable_baselines3.her import HerReplayBuffer
from torch.nn import functional as F

from sb3_aarl import catalog
from sb3_aarl.aux_head import AuxHead
from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.buffers import NoWindowError, WindowReplayBuffer, WindowSamples, detect_frame_stack
from sb3_aarl.health import NonFiniteError, QValueCheck, check_finite
from sb3_aarl.policies import Actor, CnnPolicy, Critic, MultiInputPolicy, SACAuxPolicy, Trunk

logger = logging.getLogger(__name__)

COMPILED = ("_act", "_target_q", "_critic_loss", "_aux_loss")

SelfSACAux = TypeVar("SelfSACAux", bound="SACAux")


def _computes_bf16(device: th.device) -> bool:
    """Whether a device has instructions for bfloat16; of x86 processors those with AVX-512."""
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    return device.type != "cpu" or th.backends.cpu.get_cpu_capability() not in ("DEFAULT", "AVX2")


class SACAux(SAC):
    """
    Soft Actor-Critic with an auxiliary loss on its encoder (AARL), around SB3's SAC.

    The encoder is the critic's: the critic loss and the auxiliary loss train it, the actor reads it detached. The encoder
    of the target critic is the momentum encoder of the auxiliary loss. Arguments of SB3's SAC have its defaults, but for
    ``ent_coef``: from the paper's 0.1 Cheetah-Run (action repeat 4) has 199 at 20,000 environment steps, from SAC's 1 it
    has 34 (ten and two seeds), and both end level. On MuJoCo's tasks of Gymnasium SAC's is the safer one, with
    ``learning_starts=5000``: see ``zoo_configs/sac_aux.yml``. Arguments of SACAux alone have the paper's (tables 7 and 8)
    unless another source is named; all of the paper's values are in ``zoo_configs/``. From states encoder and loss are
    those that learnt fastest (``results/README.md``), not the paper's.

    :param policy: ``"MlpPolicy"`` (``simba`` encoder), ``"CnnPolicy"`` (CURL's encoder), ``"MultiInputPolicy"`` or a class
    :param env: The environment, or its registered name
    :param learning_rate: Of actor and critic, may be a schedule
    :param buffer_size: Size of the replay buffer in transitions (agent steps)
    :param learning_starts: Agent steps with random actions before learning starts
    :param batch_size: Transitions for each critic and actor update
    :param tau: Polyak coefficient of the target Q networks; 0 freezes the whole target critic, as in SB3
    :param gamma: Discount factor
    :param train_freq: As in SB3
    :param gradient_steps: As in SB3; -1 for one per transition
    :param action_noise: As in SB3
    :param replay_buffer_class: None for ``WindowReplayBuffer``; one that is not derived from it has no auxiliary loss
    :param replay_buffer_kwargs: Its arguments. ``frame_stack`` is detected from the wrappers unless given. One that is
        detected and does not hold is given up, with a warning: whole observations are stored
    :param optimize_memory_usage: Accepted for SB3; the buffer stores each frame once anyway
    :param n_steps: Steps of n-step returns
    :param ent_coef: As in SB3; ``"auto_0.1"`` (default, the paper) learns it from 0.1 on
    :param target_update_interval: Gradient steps between updates of the target critic; SAC counts from 0 in each ``train``
    :param target_entropy: As in SB3
    :param use_sde: Whether to use gSDE, as in SB3
    :param sde_sample_freq: As in SB3
    :param use_sde_at_warmup: As in SB3
    :param stats_window_size: As in SB3
    :param tensorboard_log: As in SB3
    :param policy_kwargs: Arguments of ``policies.SACAuxPolicy``; where it names ``augmentation`` or ``crop_size``, they win
    :param verbose: 0 no output, 1 info, 2 debug
    :param seed: Seed of the pseudo random generators
    :param device: Device of the networks
    :param aux_loss: An AuxLoss, its notation, a name of the catalogue, a YAML file such as a search's ``winner.yml``, or
        None for SAC with the same encoder (the paper's baseline). ``"auto"`` is AARL-Pixel if any observation is an image
        and forward dynamics otherwise, and None where neither can be trained: the encoder has no parameters that learn, or
        the replay buffer has no windows (HerReplayBuffer is refused unless it is None)
    :param aux_coef: Weight lambda of the auxiliary loss (equation 1). It matters with ``joint_optimizer=True``; by
        default the auxiliary loss has an Adam of its own, which divides a constant factor out again
    :param aux_batch_size: Windows for each auxiliary update, None for ``batch_size``
    :param encoder_tau: Polyak coefficient of the momentum encoder
    :param encoder_learning_rate: Of the auxiliary loss's optimizer, may be a schedule; None for ``learning_rate``
        (3e-3 for some pixel tasks). Without an auxiliary loss there is no such optimizer: the critic's trains the encoder
    :param joint_optimizer: False (default, CURL and the reference): the auxiliary loss has an optimizer of its own for
        encoder and predictor, beside the critic's, which trains the encoder too. True (equation 1): one optimizer trains
        the encoder on the sum of both losses, at ``encoder_learning_rate``
    :param predictor_width: Hidden units of the predictor (256), None for twice its input (the reference)
    :param predictor_batch_norm: Whether the predictor has batch norm (the paper names none, the reference has it)
    :param policy_delay: Gradient steps between updates of actor and entropy coefficient (2: CURL, the reference)
    :param ent_coef_learning_rate: Of the entropy coefficient, may be a schedule; None for ``learning_rate`` (paper: 1e-4)
    :param ent_coef_betas: Adam's betas for the entropy coefficient (SB3; paper: (0.5, 0.999))
    :param augmentation: ``"random_crop"`` to ``crop_size`` in training with a centre crop elsewhere,
        ``"random_shift"`` by up to 4 pixels, ``"none"``; ``"auto"`` crops if all images are larger than ``crop_size``
        and shifts if not. Vectors are never augmented
    :param crop_size: Height and width in pixels of cropped images, None for 84. Where it is given, images must not be smaller
    :param precision: ``"fp32"``, or ``"bf16"``: in training the networks compute in bfloat16; parameters, optimizers, Q
        targets, entropy, losses and predictions stay float32. A device without instructions for it (of x86 processors those
        without AVX-512) would be ten times slower: it computes in float32, and logs a warning
    :param compile: Whether ``torch.compile`` compiles the losses, for a minute of the first gradient steps. It pays for wide
        networks and long runs; without a C++ compiler logs a warning and goes on as it was
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
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto_0.1",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        aux_loss: AuxLoss | str | Path | Mapping[str, Any] | None = "auto",
        aux_coef: float = 1.0,
        aux_batch_size: int | None = None,
        encoder_tau: float = 0.05,
        encoder_learning_rate: float | Schedule | None = None,
        joint_optimizer: bool = False,
        predictor_width: int | None = 256,
        predictor_batch_norm: bool = False,
        policy_delay: int = 2,
        ent_coef_learning_rate: float | Schedule | None = None,
        ent_coef_betas: tuple[float, float] = (0.9, 0.999),
        augmentation: str = "auto",
        crop_size: int | None = None,
        precision: str = "fp32",
        compile: bool = False,
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,  # type: ignore[arg-type]
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class,
            dict(replay_buffer_kwargs or {}),
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
            None if policy_kwargs is None else dict(policy_kwargs),
            verbose,
            seed,
            device,
            _init_setup_model=False,
        )
        self.aux_loss = aux_loss
        self.aux_coef = aux_coef
        self.aux_batch_size = aux_batch_size
        self.encoder_tau = encoder_tau
        self.encoder_learning_rate = encoder_learning_rate
        self.joint_optimizer = joint_optimizer
        self.predictor_width = predictor_width
        self.predictor_batch_norm = predictor_batch_norm
        self.policy_delay = policy_delay
        self.ent_coef_learning_rate = ent_coef_learning_rate
        self.ent_coef_betas = ent_coef_betas
        self.augmentation = augmentation
        self.crop_size = crop_size
        self.precision = precision
        self.compile = compile

        self.aux_head: AuxHead | None = None
        self.aux_optimizer: th.optim.Optimizer | None = None
        self._n_aux_skipped = 0
        self._q_value_check = QValueCheck()
        self._stored_timesteps = 0  # steps whose transitions are in the buffer
        self._frame_stack: int | dict[str, int] = 1  # as detected; saved, since load() may have no wrappers to look at

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        # Not in the constructor: load() replaces attributes after it.
        if self.aux_loss is not None and self.aux_loss != "auto":
            self.aux_loss = catalog.resolve(self.aux_loss)
        self._check_arguments()
        if self.replay_buffer_class is None:
            self.replay_buffer_class = WindowReplayBuffer
        # load() compares policy_kwargs with those that were saved, and may change n_steps: they stay as the user gave them.
        policy_kwargs, replay_buffer_kwargs = self.policy_kwargs, self.replay_buffer_kwargs
        self.policy_kwargs = {"augmentation": self.augmentation, "crop_size": self.crop_size, **policy_kwargs}
        with warnings.catch_warnings():
            if issubclass(self.replay_buffer_class, WindowReplayBuffer):
                if self.env is not None:
                    self._frame_stack = detect_frame_stack(self.env)
                self.replay_buffer_kwargs = {"frame_stack": self._frame_stack, **replay_buffer_kwargs}
                if self.n_steps > 1:  # SB3 expects that no buffer class but its own knows n-step returns
                    warnings.filterwarnings("ignore", message="`n_steps=")
                    self.replay_buffer_kwargs |= {"n_steps": self.n_steps, "gamma": self.gamma}
            super()._setup_model()
        if isinstance(self.replay_buffer, WindowReplayBuffer):
            self.replay_buffer.frame_stack_detected = "frame_stack" not in replay_buffer_kwargs
        self.policy_kwargs, self.replay_buffer_kwargs = policy_kwargs, replay_buffer_kwargs

        if self.ent_coef_optimizer is not None:
            assert self.log_ent_coef is not None
            rate = self._schedule(self.ent_coef_learning_rate)(1)
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=rate, betas=self.ent_coef_betas)
        self._setup_aux_loss()
        if self.precision == "bf16" and not _computes_bf16(self.device):
            logger.warning("precision='bf16': this %s has no instructions for it, training in fp32", self.device.type.upper())
        if self.compile:
            self._compile_losses()

    def _check_arguments(self) -> None:
        if not issubclass(self.policy_class, SACAuxPolicy):
            raise ValueError(
                "policy must be MlpPolicy, CnnPolicy, MultiInputPolicy or derived from sb3_aarl.policies.SACAuxPolicy, "
                f"not {self.policy_class}: SB3's have no momentum encoder"
            )
        counts = ("buffer_size", "batch_size", "policy_delay", "target_update_interval", "crop_size")
        for name in (*counts, "aux_batch_size", "predictor_width"):
            if getattr(self, name) is not None and not getattr(self, name) >= 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not 0 <= self.aux_coef < float("inf"):
            raise ValueError(f"aux_coef must be a finite number of at least 0, not {self.aux_coef}")
        for name in ("tau", "encoder_tau", "gamma"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, not {getattr(self, name)}")
        if self.precision not in ("fp32", "bf16"):
            raise ValueError(f"precision must be fp32 or bf16, not {self.precision!r}")
        buffer_class = self.replay_buffer_class or WindowReplayBuffer
        if self.aux_loss is not None and issubclass(buffer_class, HerReplayBuffer):
            raise ValueError("HerReplayBuffer has no windows, which an auxiliary loss needs: pass aux_loss=None")
        if isinstance(self.aux_loss, AuxLoss) and not issubclass(buffer_class, WindowReplayBuffer):
            raise ValueError(
                f"{buffer_class.__name__} has no windows, which aux_loss={self.aux_loss} needs: WindowReplayBuffer has"
            )

    def _setup_aux_loss(self) -> None:
        encoder = [parameter for parameter in self.critic.features_extractor.parameters() if parameter.requires_grad]
        if self.aux_loss == "auto":
            trainable = bool(encoder) and isinstance(self.replay_buffer, WindowReplayBuffer)
            name = "aarl-pixel" if self.policy.image_keys else "forward-dynamics"
            self.aux_loss = catalog.load(name) if trainable else None
            if self.verbose >= 1:
                print(f"Auxiliary loss: {name if trainable else 'none'}")
        if self.aux_loss is None:
            return
        assert isinstance(self.aux_loss, AuxLoss)
        if not encoder:
            extractor = type(self.critic.features_extractor).__name__
            raise ValueError(f"{extractor} has no parameters that the auxiliary loss could train: pass aux_loss=None")
        self.aux_head = AuxHead(
            self.aux_loss,
            self.critic.features_extractor.features_dim,
            get_action_dim(self.action_space),
            self.predictor_width,
            self.predictor_batch_norm,
        ).to(self.device)
        schedule = self._schedule(self.encoder_learning_rate)
        self.aux_optimizer = self.policy.make_optimizer([*encoder, *self.aux_head.parameters()], schedule)
        if self.joint_optimizer:
            self.critic.optimizer = self.policy.make_optimizer(self.critic.q_parameters, self.lr_schedule)

    def _compile_losses(self) -> None:
        try:
            th.compile(th.square)(th.ones(1, device=self.device))
        except RuntimeError as error:
            problem = str(error).partition("\n")[0]
            logger.warning("compile=True: torch.compile does not work here, nothing is compiled: %s", problem)
            return
        # The actor loss stays as it is: compiled, its backward pass computes gradients of the critics too.
        for name in COMPILED:
            # The random numbers are PyTorch's own.
            setattr(self, name, th.compile(getattr(self, name), options={"fallback_random": True}))

    def _schedule(self, learning_rate: float | Schedule | None) -> Schedule:
        return self.lr_schedule if learning_rate is None else FloatSchedule(learning_rate)

    def _update_learning_rates(self) -> None:
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        progress_remaining = self._current_progress_remaining
        if self.ent_coef_optimizer is not None:
            update_learning_rate(self.ent_coef_optimizer, self._schedule(self.ent_coef_learning_rate)(progress_remaining))
        if self.aux_optimizer is not None:
            update_learning_rate(self.aux_optimizer, self._schedule(self.encoder_learning_rate)(progress_remaining))

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        # Batch norm and dropout of the networks that learn; the target critic stays in evaluation mode.
        self.policy.set_training_mode(True)
        self._update_learning_rates()
        # Networks compute in bfloat16 if asked to; their outputs, and all that is computed from them, are float32.
        bf16 = self.precision == "bf16" and _computes_bf16(self.device)
        autocast = th.autocast(self.device.type, th.bfloat16, enabled=bf16)
        with self._logged() as log:
            for _ in range(gradient_steps):
                self._n_updates += 1
                update_actor = self._n_updates % self.policy_delay == 0
                batch, windows = self._sample(batch_size)
                log("largest_reward", batch.rewards.abs().max())
                # n-step returns discount by gamma ** n_steps, by less where an episode ended.
                discounts = self.gamma if batch.discounts is None else batch.discounts
                if self.use_sde:
                    self.actor.reset_noise()

                # Actor and critic both read the trunk of the encoder: computed once.
                with autocast:
                    trunk = self.critic.trunk(batch.observations)
                    if update_actor:
                        share = self.actor.share_features_extractor
                        actions_pi, log_prob = self._act(trunk if share else batch.observations)

                # Entropy coefficient: before the critic as in SB3, and the whole step uses its value from before the update.
                if self.ent_coef_optimizer is None:
                    ent_coef = self.ent_coef_tensor
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
                    target_q = self._target_q(batch.next_observations, batch.rewards, batch.dones, discounts, ent_coef)
                    critic_loss = self._critic_loss(trunk, batch.actions, target_q)
                log("critic_loss", critic_loss)
                self.critic.optimizer.zero_grad()
                if self.joint_optimizer:
                    self._backward_aux_loss(windows, autocast, log)
                critic_loss.backward()  # with a joint optimizer it adds to the encoder's gradient
                self.critic.optimizer.step()
                if not self.joint_optimizer:
                    self._backward_aux_loss(windows, autocast, log)
                if self.aux_optimizer is not None and (self.joint_optimizer or windows is not None):
                    self.aux_optimizer.step()

                # Actor: neither the encoder nor the critic gets a gradient from it.
                if update_actor:
                    with autocast:
                        actor_loss = self._actor_loss(batch.observations, actions_pi, log_prob, ent_coef)
                    log("actor_loss", actor_loss)
                    trained = [p for p in self.actor.optimizer.param_groups[0]["params"] if p.requires_grad]
                    if trained:
                        self.actor.optimizer.zero_grad()
                        actor_loss.backward(inputs=trained)
                        self.actor.optimizer.step()

                if self._n_updates % self.target_update_interval == 0:
                    self._update_target()
                # Running statistics of the encoder are copied, see SB3's issue 996.
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

    def _act(self, observations: PyTorchObs | Trunk) -> tuple[th.Tensor, th.Tensor]:
        """Actions of the actor and their log probabilities, (batch, action_dim) and (batch, 1)."""
        actions, log_prob = self.actor.action_log_prob(observations)
        return actions, log_prob.reshape(-1, 1)

    @th.no_grad()
    def _target_q(
        self,
        next_observations: PyTorchObs,
        rewards: th.Tensor,
        dones: th.Tensor,
        discounts: th.Tensor | float,
        ent_coef: th.Tensor,
    ) -> th.Tensor:
        next_actions, next_log_prob = self._act(next_observations)
        next_latent = self.critic_target.encode(next_observations)
        next_q, _ = th.cat(self.critic_target.q_values(next_latent, next_actions), dim=1).min(dim=1, keepdim=True)
        return rewards + (1 - dones) * discounts * (next_q - ent_coef * next_log_prob)

    def _critic_loss(self, trunk: Trunk, actions: th.Tensor, target_q: th.Tensor) -> th.Tensor:
        q_values = self.critic.q_values(self.critic.encode(trunk), actions)
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
        assert buffer is not None
        if isinstance(buffer, WindowReplayBuffer):  # less to copy: augment() finds nothing left to crop
            buffer.crop_size = self.policy.crop_size if self.policy.crops else None
        batch = buffer.sample(batch_size, env)
        batch = batch._replace(observations=augment(batch.observations), next_observations=augment(batch.next_observations))
        if self.aux_head is not None:
            assert isinstance(buffer, WindowReplayBuffer), "an auxiliary loss needs a WindowReplayBuffer"
            horizon, offsets = self.aux_head.loss.horizon, self.aux_head.offsets
            try:
                windows = buffer.sample_windows(self.aux_batch_size or batch_size, horizon, env, offsets)
                windows = windows._replace(observations=augment(windows.observations))
            except NoWindowError:
                self._n_aux_skipped += 1
        if isinstance(buffer, WindowReplayBuffer):
            buffer.crop_size = None  # a user's own sample() has whole images
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
        (self.aux_coef * aux_loss).backward()

    def _update_target(self) -> None:
        # Without a copy of the Q networks a moving encoder would only detach them from it: tau=0 freezes both, as in SB3.
        if self.tau > 0:
            polyak_update(self.critic.q_parameters, self.critic_target.q_parameters, self.tau)
            polyak_update(self.critic.encoder_parameters, self.critic_target.encoder_parameters, self.encoder_tau)

    @contextmanager
    def _logged(self) -> Iterator[Callable[[str, th.Tensor], None]]:
        """Yields ``log(name, value)``; then logs the means over gradient steps, and stops a run that has diverged."""
        names: list[tuple[str, int]] = []
        tensors: list[th.Tensor] = []

        def log(name: str, value: th.Tensor) -> None:
            names.append((name, self._n_updates))
            tensors.append(value.detach().reshape(()))

        try:
            yield log
        finally:  # the first loss that is not finite says more than an error that comes of it
            losses: dict[str, dict[int, float]] = defaultdict(dict)
            for (name, step), value in zip(names, th.stack(tensors).tolist() if tensors else [], strict=True):
                if not math.isfinite(value):
                    raise NonFiniteError(f"{name} is {value} at {self._describe(step)}")
                losses[name][step] = value
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/aux_skipped", self._n_aux_skipped)
        for name, values in losses.items():
            if name != "largest_reward":
                self.logger.record(f"train/{name}", sum(values.values()) / len(values))
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
        tb_log_name: str = "SAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSACAux:
        if not reset_num_timesteps and self._stored_timesteps != self.num_timesteps:
            # A callback ended learn() before the last transition was stored: SB3 resets the environments.
            self._last_obs = None
        try:
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        except ValueError as error:
            # PyTorch's distributions refuse NaN before any loss is computed, and know neither the step nor the cause.
            if "to satisfy the constraint" not in str(error):
                raise
            raise NonFiniteError(f"an output of the actor is not finite at {self._describe(self._n_updates)}") from error
        if not self._n_updates:
            logger.warning("nothing was learnt: learning starts after %d agent steps", self.learning_starts)
        elif self._n_aux_skipped == self._n_updates:
            logger.warning("the auxiliary loss was never trained: no episode is as long as its horizon (%s)", self.aux_loss)
        return self

    def training_state(self) -> dict[str, Any]:
        """
        All that training changes in the model, as tensors and plain values: ``torch.load(weights_only=True)`` reads it.

        Neither the replay buffer, nor the environment, nor random generators are part of it.
        """
        tensors = {name: getattr(self, name).detach() for name in self._get_torch_save_params()[1]}
        counters = {name: getattr(self, name) for name in ("num_timesteps", "_n_updates", "_n_aux_skipped", "_episode_num")}
        state = {"parameters": self.get_parameters(), "tensors": tensors, "counters": counters}
        return copy.deepcopy({**state, "q_value_check": vars(self._q_value_check)})

    def load_training_state(self, state: Mapping[str, Any]) -> None:
        """
        Continue from the state of another model with the same settings.

        :param state: A return value of :meth:`training_state`
        """
        # Copied, since PyTorch's optimizers keep the tensors that they load.
        self.set_parameters(copy.deepcopy(state["parameters"]), device=self.device)
        for name, value in state["tensors"].items():
            getattr(self, name).data.copy_(value)
        for name, value in state["counters"].items():
            setattr(self, name, value)
        self._q_value_check = QValueCheck(**state["q_value_check"])

    def load_replay_buffer(self, path: str | Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        replay_buffer = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        if self.aux_loss is not None and not isinstance(self.replay_buffer, WindowReplayBuffer):
            name, self.replay_buffer = type(self.replay_buffer).__name__, replay_buffer
            raise ValueError(f"{name} has no windows, which aux_loss={self.aux_loss} needs: only aux_loss=None can load it")

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *COMPILED]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        if self.aux_head is not None:
            state_dicts = [*state_dicts, "aux_head", "aux_optimizer"]
        return state_dicts, variables
