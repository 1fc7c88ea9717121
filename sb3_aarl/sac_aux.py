"""SACAux: Soft Actor-Critic whose encoder is also trained with an auxiliary loss."""

import copy
import io
import logging
import pathlib
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from itertools import islice
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, RolloutReturn, Schedule
from stable_baselines3.common.utils import FloatSchedule, polyak_update
from stable_baselines3.her import HerReplayBuffer
from torch.nn import functional as F

from sb3_aarl import catalog
from sb3_aarl.aux_head import AuxHead
from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.buffers import NoWindowError, WindowReplayBuffer, WindowSamples, detect_frame_stack
from sb3_aarl.cuda_graph import GraphedStep, unchecked_distributions
from sb3_aarl.policies import Actor, CnnPolicy, Critic, MultiInputPolicy, SACAuxPolicy

logger = logging.getLogger(__name__)

SelfSACAux = TypeVar("SelfSACAux", bound="SACAux")


# A training whose Q values are this many times larger than rewards and entropy allow has diverged: healthy ones may overshoot
# while they are learnt, those that explode go through a factor of a thousand on their way to infinity.
EXPLODED = 1000.0
# The largest log density of a squashed Gaussian for each dimension of an action: SB3 clips the log standard deviation at -20,
# and takes the slope of tanh for 1e-6 at least.
LARGEST_LOG_DENSITY = 34.0
# Plain attributes that training changes.
TRAINING_VALUES = ("num_timesteps", "_n_updates", "_n_aux_skipped", "_episode_num", "_largest_reward", "_first_error")


class NonFiniteError(FloatingPointError, ValueError):
    """An observation, reward, loss or parameter is NaN or infinite; the message says which and when."""


class ParametersError(RuntimeError, ValueError):
    """
    Parameters are of a model with other settings. SB3's ``set_parameters`` raises ValueError there, which its ``load`` takes
    for a DQN of an old version unless it is a RuntimeError too.
    """


class ExplodedError(FloatingPointError, ValueError):
    """Q values are far larger than rewards allow; the message says how large they are, may be, and when."""


def _computes_bf16(device: th.device) -> bool:
    """Whether a device has instructions for bfloat16."""
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        return th.backends.mkldnn.is_available() and th.ops.mkldnn._is_mkldnn_bf16_supported()
    return True


class SACAux(SAC):
    """
    Soft Actor-Critic with an auxiliary loss on its encoder (AARL), around SB3's SAC.

    The encoder is the critic's: the critic loss and the auxiliary loss train it, the actor reads it detached. The
    encoder of the target critic is the momentum encoder of the auxiliary loss. Defaults are the paper's tables 7 and 8
    unless another source is named; what differs there between tasks has the value of most tasks.

    :param policy: ``"MlpPolicy"`` (DenseMLP encoder), ``"CnnPolicy"`` (CURL's encoder), ``"MultiInputPolicy"`` or a class
    :param env: The environment, or its registered name (those of DeepMind Control once ``sb3_aarl.envs`` is imported: they
        are for ``"MultiInputPolicy"``, while ``envs.make_dmc_env`` makes vectors or images of their observations)
    :param learning_rate: Of actor and critic, may be a schedule (1e-3; 2e-4 for Cheetah-Run)
    :param buffer_size: Size of the replay buffer in transitions (agent steps)
    :param learning_starts: Agent steps with random actions before learning starts
    :param batch_size: Transitions for each critic and actor update (512; 128 during the evolution from pixels)
    :param tau: Polyak coefficient of the target Q networks; 0 freezes the whole target critic, as in SB3
    :param gamma: Discount factor
    :param train_freq: As in SB3
    :param gradient_steps: As in SB3; -1 for one per transition
    :param action_noise: As in SB3
    :param replay_buffer_class: None for ``WindowReplayBuffer``; one that is not derived from it has no auxiliary loss
    :param replay_buffer_kwargs: Its arguments. ``frame_stack`` is found out from the wrappers unless given, but
        has to be given for a class of your own
    :param optimize_memory_usage: Accepted for SB3; the buffer stores each frame once anyway
    :param n_steps: Steps of n-step returns, not for Dict observations (as in SB3)
    :param ent_coef: Entropy coefficient; ``"auto_0.1"`` learns it from 0.1 on
    :param target_update_interval: Gradient steps between updates of the target critic
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
    :param aux_loss: An AuxLoss, its notation, a name of the catalogue, or None for SAC with the same encoder (the
        paper's baseline). ``"auto"`` is AARL-Pixel if any observation is an image and AARL-State otherwise, and None
        where neither can be trained: the encoder has no parameters that learn, or the replay buffer gives no windows
        (HerReplayBuffer is refused unless it is None)
    :param aux_coef: Weight lambda of the auxiliary loss (equation 1). It matters with ``joint_optimizer=True``; by
        default the auxiliary loss has an Adam of its own, which divides a constant factor out again
    :param aux_batch_size: Windows for each auxiliary update, None for ``batch_size``
    :param encoder_tau: Polyak coefficient of the momentum encoder
    :param encoder_learning_rate: Of the auxiliary loss's optimizer, may be a schedule; None for ``learning_rate``
        (3e-3 for some pixel tasks). Without an auxiliary loss there is no such optimizer: the critic's trains the encoder
    :param joint_optimizer: False (default, CURL and the reference): the auxiliary loss has an optimizer of its own for
        encoder and predictor, beside the critic's, which trains the encoder too (weight decay, if ``optimizer_kwargs`` has
        one, then reaches the encoder from both). True (equation 1): one optimizer trains the encoder on the sum of both
        losses, at ``encoder_learning_rate``
    :param predictor_width: Hidden units of the predictor (256), None for twice its input (the reference)
    :param predictor_batch_norm: Whether the predictor has batch norm (the paper names none, the reference has it)
    :param policy_delay: Gradient steps between updates of actor and entropy coefficient (2: CURL, the reference)
    :param ent_coef_learning_rate: Of the entropy coefficient, may be a schedule; None for ``learning_rate`` (SB3)
    :param ent_coef_betas: Adam's betas for the entropy coefficient (SB3: (0.9, 0.999))
    :param augmentation: ``"random_crop"`` to ``crop_size`` in training with a centre crop elsewhere,
        ``"random_shift"`` by up to 4 pixels, ``"none"``; ``"auto"`` crops if all images are larger than ``crop_size``
        and shifts if not. Vectors are never augmented
    :param crop_size: Height and width in pixels of cropped images, None for 84. Where it is given, images must not be smaller
    :param precision: ``"fp32"``, or ``"bf16"``: in training the networks compute in bfloat16, while parameters, optimizers,
        Q targets, entropy and losses stay float32. Predictions are made in float32. It is faster where the device has
        instructions for bfloat16, and many times slower where it has not, which one line of log says: of x86 processors
        those without AVX-512
    :param compile: ``"cudagraphs"``: on a GPU, the gradient step is one captured CUDA graph. Elsewhere, or where it cannot be
        captured, one line of log says so and the step runs as it does with None. What is no tensor (``gamma``, ``tau``,
        ``aux_coef``) keeps the value of the capture; learning rates may change. It cannot be used with gSDE
    :param allow_tf32: Whether float32 products and convolutions of the gradient step may use TF32 on a GPU; None for
        PyTorch's own settings (convolutions only)
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
        buffer_size: int = 100_000,
        learning_starts: int = 1000,
        batch_size: int = 512,
        tau: float = 0.01,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto_0.1",
        target_update_interval: int = 2,
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
        aux_loss: AuxLoss | str | Mapping[str, Any] | None = "auto",
        aux_coef: float = 1.0,
        aux_batch_size: int | None = None,
        encoder_tau: float = 0.05,
        encoder_learning_rate: float | Schedule | None = None,
        joint_optimizer: bool = False,
        predictor_width: int | None = 256,
        predictor_batch_norm: bool = False,
        policy_delay: int = 2,
        ent_coef_learning_rate: float | Schedule | None = 1e-4,
        ent_coef_betas: tuple[float, float] = (0.5, 0.999),
        augmentation: str = "auto",
        crop_size: int | None = None,
        precision: str = "fp32",
        compile: str | None = None,
        allow_tf32: bool | None = None,
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
        self.allow_tf32 = allow_tf32

        self._graphed_step: GraphedStep | None = None
        self._frame_stack: int | dict[str, int] | None = None  # of the env that the buffer was made for
        self.aux_head: AuxHead | None = None
        self.aux_optimizer: th.optim.Optimizer | None = None
        self._n_aux_skipped = 0
        self._largest_reward = 0.0
        self._first_error = 0.0
        self._random_state: dict[str, Any] | None = None

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        # Here rather than in the constructor: load() takes these arguments too, and replaces attributes by them.
        if self.aux_loss is not None and self.aux_loss != "auto":
            self.aux_loss = catalog.resolve(self.aux_loss)
        if not issubclass(self.policy_class, SACAuxPolicy):
            raise ValueError(
                "policy must be MlpPolicy, CnnPolicy, MultiInputPolicy or derived from sb3_aarl.policies.SACAuxPolicy, "
                f"not {self.policy_class}: SB3's have no momentum encoder"
            )
        # What each argument is called, in case that one of them does not fit.
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
        if self.compile not in (None, "cudagraphs"):
            raise ValueError(f"compile must be None or cudagraphs, not {self.compile!r}")

        own_buffer = self.replay_buffer_class in (None, WindowReplayBuffer)
        self._check_replay_buffer_class(own_buffer)
        if own_buffer:
            # SB3 warns that a buffer class of the user's own goes without n_steps; this one does not.
            self.replay_buffer_class = None
            self.replay_buffer = self.replay_buffer or self._make_replay_buffer()
        policy_kwargs, buffer_kwargs, random_state = self.policy_kwargs, self.replay_buffer_kwargs, self._random_state
        self.policy_kwargs = {"augmentation": self.augmentation, "crop_size": self.crop_size, **policy_kwargs}
        self.replay_buffer_kwargs = dict(buffer_kwargs)  # SB3 adds n_steps and gamma, which load() may be given anew
        super()._setup_model()
        self.policy_kwargs, self.replay_buffer_kwargs, self._random_state = policy_kwargs, buffer_kwargs, random_state
        if own_buffer:
            self.replay_buffer_class = WindowReplayBuffer

        if self.ent_coef_optimizer is not None:
            assert self.log_ent_coef is not None
            self.ent_coef_schedule = self._schedule(self.ent_coef_learning_rate)
            rate = self.ent_coef_schedule(1)
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=rate, betas=self.ent_coef_betas)
        self._setup_aux_loss(own_buffer)
        if self.precision == "bf16" and not _computes_bf16(self.device):
            logger.warning("precision='bf16': this %s has no instructions for it, fp32 is faster", self.device.type.upper())
        self._graphed_step = None
        if self.compile is not None:
            if self.device.type != "cuda":
                problem = f"needs a CUDA device, not {self.device}"
            elif not all("capturable" in optimizer.param_groups[0] for optimizer in self._optimizers()):
                problem = "needs optimizers that can be captured, as Adam can"
            elif self.use_sde:
                problem = "cannot be used with gSDE, whose noise lives on between gradient steps"
            else:
                problem = None
                self._graphed_step = GraphedStep(self._gradient_step, self.device)
            if problem is not None:
                logger.warning("compile=%r %s: the gradient step runs as without", self.compile, problem)

    def _optimizers(self) -> dict[th.optim.Optimizer, Schedule]:
        """All optimizers, with the schedules of their learning rates."""
        optimizers = {self.actor.optimizer: self.lr_schedule, self.critic.optimizer: self.lr_schedule}
        if self.ent_coef_optimizer is not None:
            optimizers[self.ent_coef_optimizer] = self.ent_coef_schedule
        if self.aux_optimizer is not None:
            optimizers[self.aux_optimizer] = self.encoder_schedule
        return optimizers

    def _check_replay_buffer_class(self, own_buffer: bool) -> None:
        if own_buffer or self.aux_loss is None:
            return
        assert self.replay_buffer_class is not None
        if issubclass(self.replay_buffer_class, HerReplayBuffer):
            raise ValueError(
                "HerReplayBuffer cannot be used with an auxiliary loss: relabelled transitions have no window of "
                "consecutive steps. Pass aux_loss=None to train with HER"
            )
        if self.aux_loss != "auto" and not issubclass(self.replay_buffer_class, WindowReplayBuffer):
            raise ValueError(
                f"replay_buffer_class={self.replay_buffer_class.__name__} gives no windows, which aux_loss={self.aux_loss} "
                "needs: leave it out, or derive it from sb3_aarl.buffers.WindowReplayBuffer"
            )

    def _make_replay_buffer(self) -> WindowReplayBuffer:
        # SB3's own check, which it makes before its buffer is there.
        assert self.n_steps == 1 or not isinstance(self.observation_space, spaces.Dict), (
            f"n_steps={self.n_steps}: n-step returns are not supported for Dict observation spaces"
        )
        if self.env is not None and "frame_stack" not in self.replay_buffer_kwargs:
            self._frame_stack = detect_frame_stack(self.env)
        found = {} if self._frame_stack is None else {"frame_stack": self._frame_stack}
        n_steps = {"n_steps": self.n_steps, "gamma": self.gamma}
        try:
            return WindowReplayBuffer(
                self.buffer_size,
                self.observation_space,
                self.action_space,
                self.device,
                self.n_envs,
                **{**found, **self.replay_buffer_kwargs, **(n_steps if self.n_steps > 1 else {})},
            )
        except (MemoryError, th.cuda.OutOfMemoryError) as error:
            raise MemoryError(
                f"no replay buffer of buffer_size={self.buffer_size} with observations {self.observation_space}: {error}"
            ) from error

    def _setup_aux_loss(self, own_buffer: bool) -> None:
        encoder = [parameter for parameter in self.critic.features_extractor.parameters() if parameter.requires_grad]
        if self.aux_loss == "auto":
            trainable = bool(encoder) and isinstance(self.replay_buffer, WindowReplayBuffer)
            name = "aarl-pixel" if self.policy.image_keys else "aarl-state"
            self.aux_loss = catalog.load(name) if trainable else None
            if self.verbose >= 1:
                print(f"Auxiliary loss: {name if trainable else 'none'}")
        if self.aux_loss is None:
            return
        assert isinstance(self.aux_loss, AuxLoss) and isinstance(self.action_space, spaces.Box)
        if not encoder:
            extractor = type(self.critic.features_extractor).__name__
            raise ValueError(f"{extractor} has no parameters that the auxiliary loss could train: pass aux_loss=None")
        self.encoder_schedule = self._schedule(self.encoder_learning_rate)
        self.aux_head = AuxHead(
            self.aux_loss,
            self.critic.features_extractor.features_dim,
            int(np.prod(self.action_space.shape)),
            self.predictor_width,
            self.predictor_batch_norm,
        ).to(self.device)
        self.aux_optimizer = self.policy.make_optimizer([*encoder, *self.aux_head.parameters()], self.encoder_schedule)
        if self.joint_optimizer:
            self.critic.optimizer = self.policy.make_optimizer(self._q_parameters(self.critic), self.lr_schedule)

    def _schedule(self, learning_rate: float | Schedule | None) -> Schedule:
        return self._learning_rate if learning_rate is None else FloatSchedule(learning_rate)

    def _learning_rate(self, progress_remaining: float) -> float:
        # A method, so that copies of the model follow their own schedule.
        return self.lr_schedule(progress_remaining)

    @staticmethod
    def _q_parameters(critic: Critic) -> list[th.nn.Parameter]:
        """The critic's parameters without those of the encoder."""
        return [parameter for network in critic.q_networks for parameter in network.parameters()]

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        # Batch norm and dropout of the networks that learn; the target critic stays in evaluation mode.
        self.policy.set_training_mode(True)
        self._update_learning_rates()
        step = self._graphed_step or self._gradient_step
        logs: list[dict[str, th.Tensor]] = []
        rewards: list[th.Tensor] = []
        with self._gpu_settings():
            for _ in range(gradient_steps):
                self._n_updates += 1
                batch, windows = self._draw(batch_size)
                update_actor = self._n_updates % self.policy_delay == 0
                update_target = self._n_updates % self.target_update_interval == 0
                logs.append(step(batch, windows, update_actor, update_target))
                rewards.append(batch.rewards.abs().max())

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/aux_skipped", self._n_aux_skipped)
        first = self._n_updates - gradient_steps + 1
        # In one piece: a GPU is waited for once.
        shown = [*rewards, *(value for log in logs for value in log.values())]
        numbers = iter(th.stack(shown).cpu().numpy() if shown else ())
        self._largest_reward = float(max([self._largest_reward, *islice(numbers, len(rewards))]))
        found = [{name: next(numbers) for name in log} for log in logs]
        ent_coef = 0.0
        for name in dict.fromkeys(name for log in found for name in log):
            steps = [first + i for i, log in enumerate(found) if name in log]
            values = np.array([log[name] for log in found if name in log])
            if not np.isfinite(values).all():
                wrong = int(np.flatnonzero(~np.isfinite(values))[0])
                raise NonFiniteError(f"{name} is {values[wrong]} at {self._step_and_loss(steps[wrong])}")
            self.logger.record(f"train/{name}", np.mean(values, dtype=np.float64))
            # In the order of the gradient step, so that the entropy coefficient is known when the losses come.
            if name == "ent_coef":
                ent_coef = float(values.max())
            elif name == "critic_loss":
                self._check_q_values("the error of the Q values", np.sqrt(values), steps, ent_coef)
            elif name == "actor_loss":  # minus the soft value of states, on average
                self._check_q_values("the value of states", np.abs(values), steps, ent_coef)

    def _check_q_values(self, name: str, values: np.ndarray, steps: list[int], ent_coef: float) -> None:
        """
        Stop a training that has diverged, long before it is infinite.

        :param name: What is looked at
        :param values: In units of returns, one for each gradient step
        :param steps: Numbers of the gradient steps
        :param ent_coef: Entropy coefficient
        :raises ExplodedError: when one of them is ``EXPLODED`` times what the sum of discounted rewards and entropies can be
        """
        if self.gamma >= 1:
            return
        if steps[0] == 1:
            self._first_error = max(self._first_error, float(values[0]))
        # Where rewards are tiny, or none came yet, the networks begin with values of about 1 nevertheless, and with large ones
        # where an encoder passes on large observations.
        assert isinstance(self.action_space, spaces.Box)
        entropy = ent_coef * LARGEST_LOG_DENSITY * float(np.prod(self.action_space.shape))
        bound = max((max(1.0, self._largest_reward) + entropy) / (1 - self.gamma), self._first_error)
        worst = int(np.argmax(values))
        if values[worst] > EXPLODED * bound:
            raise ExplodedError(
                f"{name} is {values[worst]:.3g} at {self._step_and_loss(steps[worst])}; rewards of at most "
                f"{self._largest_reward:.3g} and gamma={self.gamma} allow {bound:.3g}: the Q values have exploded"
            )

    def _draw(self, batch_size: int) -> tuple[ReplayBufferSamples, WindowSamples | None]:
        """
        What one gradient step learns from, images augmented.

        :param batch_size: Transitions to draw, and windows unless ``aux_batch_size`` is given
        :return: Transitions, and the windows that the auxiliary loss names; None without one, and as long as no episode
            is as long as its horizon
        """
        assert self.replay_buffer is not None
        crop: dict[str, Any] = {}
        if self.policy.crops and type(self.replay_buffer) is WindowReplayBuffer:
            crop["crop_size"] = self.policy.crop_size  # while frames are gathered: augment() finds nothing left to crop
        env = self._vec_normalize_env
        batch = self.replay_buffer.sample(batch_size, env=env, **crop)
        augment: Callable[[Any], Any] = self.policy.augment
        batch = batch._replace(observations=augment(batch.observations), next_observations=augment(batch.next_observations))
        if self.aux_head is None:
            return batch, None
        assert isinstance(self.replay_buffer, WindowReplayBuffer)
        horizon, offsets = self.aux_head.loss.horizon, self.aux_head.offsets
        try:
            windows = self.replay_buffer.sample_windows(
                self.aux_batch_size or batch_size, horizon, env=env, offsets=offsets, **crop
            )
        except NoWindowError:
            self._n_aux_skipped += 1
            return batch, None
        return batch, windows._replace(observations=augment(windows.observations))

    def _gradient_step(
        self, batch: ReplayBufferSamples, windows: WindowSamples | None, update_actor: bool, update_target: bool
    ) -> dict[str, th.Tensor]:
        """
        One update of everything.

        :param batch: Transitions
        :param windows: Windows for the auxiliary loss, None to leave it out
        :param update_actor: Whether actor and entropy coefficient are updated too
        :param update_target: Whether the target critic follows
        :return: What the log shows, scalars by name
        """
        logs: dict[str, th.Tensor] = {}
        # Networks compute in bfloat16 if asked to; what they give, and all that is computed of it, is float32.
        autocast = th.autocast(self.device.type, th.bfloat16, enabled=self.precision == "bf16")

        def log(name: str, value: th.Tensor) -> None:
            # On a GPU this would wait for the result in every step: there all are looked at in the end.
            if value.device.type == "cpu" and not th.isfinite(value).all():
                raise NonFiniteError(f"{name} is {value.item()} at {self._step_and_loss(self._n_updates)}")
            logs[name] = value.detach().reshape(())

        obs, next_obs = batch.observations, batch.next_observations
        # n-step returns discount by gamma ** n_steps, by less where an episode ended.
        discounts = self.gamma if batch.discounts is None else batch.discounts
        if self.use_sde:
            self.actor.reset_noise()

        # What actor and critic both read of these observations is computed once.
        with autocast:
            trunk = self.critic.trunk(obs)

        # Entropy coefficient: as in SB3 before the critic, so that all of this step sees one value of it.
        if update_actor:
            with autocast:
                actions_pi, log_prob = self.actor.action_log_prob(trunk if self.actor.share_features_extractor else obs)
            log_prob = log_prob.reshape(-1, 1)
        if self.ent_coef_optimizer is not None:
            assert self.log_ent_coef is not None and isinstance(self.target_entropy, float)
            ent_coef = self.log_ent_coef.detach().exp()
            if update_actor:
                ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
                log("ent_coef_loss", ent_coef_loss)
                self.ent_coef_optimizer.zero_grad()
                ent_coef_loss.backward()
                self.ent_coef_optimizer.step()
        else:
            ent_coef = self.ent_coef_tensor
        log("ent_coef", ent_coef)

        # Critic and, through it, the encoder.
        with th.no_grad(), autocast:
            next_actions, next_log_prob = self.actor.action_log_prob(next_obs)
            next_latent = self.critic_target.encode(next_obs)
            next_q, _ = th.cat(self.critic_target.q_values(next_latent, next_actions), dim=1).min(dim=1, keepdim=True)
            next_q = next_q - ent_coef * next_log_prob.reshape(-1, 1)
            target_q = batch.rewards + (1 - batch.dones) * discounts * next_q
        with autocast:
            q_values = self.critic.q_values(self.critic.encode(trunk), batch.actions)
        critic_loss = 0.5 * sum(F.mse_loss(q, target_q) for q in q_values)
        assert isinstance(critic_loss, th.Tensor)
        log("critic_loss", critic_loss)
        self.critic.optimizer.zero_grad()
        if self.joint_optimizer and self.aux_optimizer is not None:
            self.aux_optimizer.zero_grad()
            if windows is not None:
                self._backward_aux_loss(windows, autocast, log)
            critic_loss.backward()  # adds to the encoder's gradient
            self.critic.optimizer.step()
            self.aux_optimizer.step()
        else:
            critic_loss.backward()
            self.critic.optimizer.step()
            if windows is not None:
                assert self.aux_optimizer is not None
                self.aux_optimizer.zero_grad()
                self._backward_aux_loss(windows, autocast, log)
                self.aux_optimizer.step()

        # Actor: neither the encoder nor the critic gets a gradient from it.
        if update_actor:
            with autocast:
                with th.no_grad():
                    latent = self.critic.encode(obs)
                # Without an auxiliary loss this may be SB3's SAC to the bit.
                min_q = self.critic.min_q_values(latent, actions_pi, skip_rows=self.aux_head is not None)
            actor_loss = (ent_coef * log_prob - min_q).mean()
            log("actor_loss", actor_loss)
            trained = [parameter for parameter in self.actor.own_parameters() if parameter.requires_grad]
            if trained:
                self.actor.optimizer.zero_grad()
                actor_loss.backward(inputs=trained)
                self.actor.optimizer.step()

        # Target critic, its encoder being the momentum encoder.
        if update_target:
            self._update_target()
        return logs

    def _backward_aux_loss(self, windows: WindowSamples, autocast: th.autocast, log: Callable[[str, th.Tensor], None]) -> None:
        """Add the gradient of the auxiliary loss to encoder and head, which have none yet."""
        assert self.aux_head is not None and self.aux_optimizer is not None
        with autocast:
            aux_loss = self.aux_head(windows, self.critic.encode, self.critic_target.encode)
        log("aux_loss", aux_loss)
        (self.aux_coef * aux_loss).backward()
        trained = self.aux_optimizer.param_groups[0]["params"]
        gradients = [parameter.grad for parameter in trained if parameter.grad is not None]
        log("aux_grad_norm", th.nn.utils.get_total_norm(gradients))

    def _update_target(self) -> None:
        # Without a copy of the Q networks a moving encoder would only detach them from it: tau=0 freezes both, as in SB3.
        if self.tau > 0:
            _moving_average(self._q_parameters(self.critic_target), self._q_parameters(self.critic), self.tau)
            encoder, momentum_encoder = self.critic.features_extractor, self.critic_target.features_extractor
            _moving_average(momentum_encoder.parameters(), encoder.parameters(), self.encoder_tau)
        # Running means of batch norm are copied, see SB3's issue 996.
        polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

    def _update_learning_rates(self) -> None:
        progress = self._current_progress_remaining
        self.logger.record("train/learning_rate", self.lr_schedule(progress))
        # A CUDA graph repeats every number that it was captured with, unless it is a tensor.
        graphed = self._graphed_step is not None
        for optimizer, schedule in self._optimizers().items():
            for group in optimizer.param_groups:
                if group.get("capturable", graphed) != graphed:  # of a model that was saved in the other mode
                    group["capturable"] = graphed
                    # Adam keeps it on the CPU unless it is capturable or fused.
                    device = self.device if graphed or group.get("fused") else "cpu"
                    for state in optimizer.state.values():
                        state["step"] = state["step"].to(device)
                if not graphed:
                    group["lr"] = schedule(progress)
                elif isinstance(group["lr"], th.Tensor):
                    group["lr"].fill_(schedule(progress))
                else:
                    group["lr"] = th.tensor(schedule(progress), device=self.device)

    @contextmanager
    def _gpu_settings(self) -> Iterator[None]:
        """PyTorch's settings of TF32 as ``allow_tf32`` says; on a GPU no distribution waits for a check of its parameters."""
        backends: tuple[Any, ...] = () if self.allow_tf32 is None else (th.backends.cuda.matmul, th.backends.cudnn)
        before = [backend.allow_tf32 for backend in backends]
        for backend in backends:
            backend.allow_tf32 = self.allow_tf32
        try:
            with nullcontext() if self.device.type == "cpu" else unchecked_distributions():
                yield
        finally:
            for backend, allowed in zip(backends, before, strict=True):
                backend.allow_tf32 = allowed

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        self._check_finite("observation", new_obs)
        self._check_finite("reward", reward)
        for info in infos:
            if info.get("terminal_observation") is not None:
                self._check_finite("terminal observation", info["terminal_observation"])
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)  # type: ignore[arg-type]

    def _step_and_loss(self, gradient_step: int) -> str:
        return f"gradient step {gradient_step}, agent step {self.num_timesteps}; auxiliary loss: {self.aux_loss}"

    def _check_finite(self, name: str, values: np.ndarray | dict[str, np.ndarray]) -> None:
        for key, array in values.items() if isinstance(values, dict) else [("", values)]:
            if np.issubdtype(np.asarray(array).dtype, np.floating) and not np.isfinite(array).all():
                where = np.argwhere(~np.isfinite(array))[0].tolist()
                raise NonFiniteError(
                    f"{name}{f' {key!r}' if key else ''} from the environment is not finite at agent step "
                    f"{self.num_timesteps} (index {where})"
                )

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        As in SB3.

        :param path: Path of the pickled replay buffer
        :param truncate_last_traj: As in SB3, of HerReplayBuffer
        :raises ValueError: when the auxiliary loss needs windows, and the buffer gives none; the model keeps its own then
        """
        before = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        if self.aux_head is not None and not isinstance(self.replay_buffer, WindowReplayBuffer):
            loaded, self.replay_buffer = self.replay_buffer, before
            raise ValueError(
                f"a {type(loaded).__name__} gives no windows, which aux_loss={self.aux_loss} needs: {path} was not saved by a "
                "model with sb3_aarl.buffers.WindowReplayBuffer"
            )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        buffer = self.replay_buffer
        if isinstance(buffer, WindowReplayBuffer) and self._last_obs is not None and not reset_num_timesteps:  # type: ignore[has-type]
            obs = self._last_obs if self._vec_normalize_env is None else self._last_original_obs  # type: ignore[has-type]
            if obs is not None and not buffer.can_go_on(obs):
                logger.warning("the replay buffer has no frames of the running episodes: the environments are reset")
                self._last_obs = None
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        self._check_finite("observation", self._last_obs)  # type: ignore[arg-type]
        return result

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        rollout = None
        try:
            rollout = super().collect_rollouts(*args, **kwargs)
            return rollout
        finally:
            ended = rollout is not None and rollout.continue_training
            if not ended and isinstance(self.replay_buffer, WindowReplayBuffer) and self.replay_buffer.stacks:
                # Stopped before the last step was stored: that frame is missing in the stacks that would follow.
                self._last_obs = None

    def learn(
        self: SelfSACAux,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "SACAux",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSACAux:
        # A loaded model goes on with the random numbers that it was saved with, unless it was given another seed.
        state = self._random_state
        if state is not None and not reset_num_timesteps and state.get("seed", self.seed) == self.seed:
            self._set_random_state(state)
        self._random_state = None
        try:
            return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        except ValueError as error:
            # PyTorch refuses actions that are NaN before any loss is; it knows neither the step nor the cause.
            culprit = None if isinstance(error, FloatingPointError) else self._non_finite_parameter()
            if culprit is None:
                raise
            raise NonFiniteError(f"{culprit} is not finite at {self._step_and_loss(self._n_updates)}") from error

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        As in SB3; a loaded model does not go on with the random numbers that it was saved with then.

        :param seed: The seed, None to leave everything as it is
        """
        super().set_random_seed(seed)
        if seed is not None:
            self._random_state = None

    def _get_random_state(self) -> dict[str, Any]:
        return {
            "seed": self.seed,
            "python": random.getstate(),
            "numpy": np.random.get_state(),
            "torch": th.get_rng_state(),
            "cuda": th.cuda.get_rng_state_all() if self.device.type == "cuda" else [],
            "action_space": self.action_space.np_random.bit_generator.state,
        }

    def _set_random_state(self, state: dict[str, Any]) -> None:
        random.setstate(state["python"])
        np.random.set_state(state["numpy"])
        th.set_rng_state(state["torch"])
        if self.device.type == "cuda" and len(state["cuda"]) == th.cuda.device_count():
            th.cuda.set_rng_state_all(state["cuda"])
        self.action_space.np_random.bit_generator.state = state["action_space"]

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        As in SB3, together with the state of all random generators, so that a loaded model can go on as if it had not
        stopped: ``load(path, env, force_reset=False)``, ``load_replay_buffer`` and
        ``learn(..., reset_num_timesteps=False)``.

        :param path: Where to save
        :param exclude: Attributes that are left out
        :param include: Attributes that are put in although they are usually left out
        :raises NonFiniteError: when a parameter is NaN or infinite; what is at ``path`` stays as it is
        """
        culprit = self._non_finite_parameter()
        if culprit is not None:
            raise NonFiniteError(f"{culprit} is not finite: the model is not saved to {path}")
        # That of a loaded model which has not gone on yet: generators have been seeded anew meanwhile.
        pending = self._random_state
        self._random_state = pending or self._get_random_state()
        try:
            super().save(path, exclude, include)
        finally:
            self._random_state = pending

    def _non_finite_parameter(self) -> str | None:
        """The name of a parameter or buffer that is NaN, or infinite where that is wrong, if there is one."""
        found = [(f"model.{name}", getattr(self, name)) for name in self._get_torch_save_params()[1]]
        for name, module in (("policy", self.policy), ("aux_head", self.aux_head)):
            if module is not None:
                found += [(f"{name}.{key}", parameter) for key, parameter in module.named_parameters()]
                for key, buffer in module.named_buffers():
                    # A mask of an encoder may well be infinite, a mean of batch norm may not.
                    is_mean = key.endswith(("running_mean", "running_var"))
                    found.append((f"{name}.{key}", buffer if is_mean else buffer.masked_fill(buffer.isinf(), 0)))
        return next((name for name, value in found if value is not None and not th.isfinite(value).all()), None)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "ent_coef_schedule", "encoder_schedule", "_graphed_step"]

    def set_parameters(
        self, load_path_or_dict: str | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        As in SB3.

        :param load_path_or_dict: Path of a saved model, or what ``get_parameters`` gave
        :param exact_match: Whether all parameters must be there, and no others
        :param device: Device of the parameters
        :raises ParametersError: when they are of a model with other settings
        """
        if isinstance(load_path_or_dict, dict):
            # PyTorch's optimizers take the tensors themselves, and would go on with those of another model.
            load_path_or_dict = {
                name: copy.deepcopy(state) if "optimizer" in name else state for name, state in load_path_or_dict.items()
            }
        else:
            load_path_or_dict = load_from_zip_file(load_path_or_dict, device=device, load_data=False)[1]
        if ("aux_head" in load_path_or_dict) > (self.aux_head is not None):
            raise ParametersError(
                "these parameters are of a model with an auxiliary loss, this one has none: load it with its own, and make a "
                "new model with aux_loss=None to train without"
            )
        try:
            super().set_parameters(load_path_or_dict, exact_match, device)  # type: ignore[arg-type]
        except (ValueError, RuntimeError) as error:
            names = ("aux_loss", "joint_optimizer", "predictor_width", "predictor_batch_norm")
            settings = ", ".join(f"{name}={getattr(self, name)}" for name in names)
            raise ParametersError(f"{error}. Are they of a model with other settings than {settings}?") from error
        if self._graphed_step is not None:
            # What was recorded reads and writes the tensors that the optimizers had before.
            self._graphed_step = GraphedStep(self._gradient_step, self.device)

    def training_state(self) -> dict[str, Any]:
        """
        All that training changes in the model, as tensors and plain values: ``torch.load(weights_only=True)`` reads it.

        Neither the replay buffer, nor the environment, nor random generators are part of it.
        """
        tensors = {name: getattr(self, name).detach() for name in self._get_torch_save_params()[1]}
        values = {name: getattr(self, name) for name in TRAINING_VALUES}
        return copy.deepcopy({"parameters": self.get_parameters(), "tensors": tensors, "values": values})

    def load_training_state(self, state: Mapping[str, Any]) -> None:
        """
        Continue from the state of another model with the same settings.

        :param state: A return value of :meth:`training_state`
        """
        # Copied, since PyTorch's optimizers keep the tensors that they load.
        self.set_parameters(copy.deepcopy(state["parameters"]), device=self.device)
        for name, value in state["tensors"].items():
            getattr(self, name).data.copy_(value)
        for name in TRAINING_VALUES:
            setattr(self, name, state["values"][name])

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        if self.aux_head is not None:
            state_dicts = [*state_dicts, "aux_head", "aux_optimizer"]
        return state_dicts, variables


@th.no_grad()
def _moving_average(averages: Iterable[th.Tensor], parameters: Iterable[th.Tensor], tau: float) -> None:
    """SB3's ``polyak_update``, to the bit, with two kernels for all parameters together where there is a GPU."""
    # A frozen network may be one and the same in both.
    pairs = [(average, parameter) for average, parameter in zip(averages, parameters, strict=True) if average is not parameter]
    if pairs:
        moved, towards = map(list, zip(*pairs, strict=True))
        th._foreach_mul_(moved, 1 - tau)
        th._foreach_add_(moved, towards, alpha=tau)
