"""Policies of SACAux: actor, critic and momentum target around one encoder, which belongs to the critic."""

import copy
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim, is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor as SB3Actor
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from sb3_aarl.augmentation import center_crop, cropped_space, image_spaces, random_crop, random_shift, resolve_augmentation
from sb3_aarl.encoders import Encoder, MultiInputEncoder, PixelEncoder, SimbaEncoder, encoder_class
from sb3_aarl.networks import orthogonal_init, q_network


class _CropsImages:
    """Mixin for SB3 models: images that are larger than ``crop_size`` are cropped to their centre before the encoder."""

    features_extractor: Any
    observation_space: spaces.Space
    normalize_images: bool

    def __init__(self, *args: Any, crop_size: int | None = None, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.image_keys = frozenset(image_spaces(self.observation_space, not self.normalize_images))
        self.crop_size = crop_size

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        return features_extractor(self.preprocess(obs))

    def preprocess(self, obs: PyTorchObs) -> PyTorchObs:
        """Crop images to their centre unless the augmentation did so at random; then as SB3 does."""
        own = isinstance(self.features_extractor, (PixelEncoder, MultiInputEncoder))
        layout = th.channels_last if own else th.preserve_format

        def preprocess(images: th.Tensor) -> th.Tensor:
            if self.crop_size is not None:
                images = center_crop(images, self.crop_size)
            if not self.normalize_images:
                return images.contiguous()  # an encoder may call view() on its input
            if images.dtype.is_floating_point:
                return images.float() / 255
            # One copy, in the layout that the encoder's convolutions need: images are the largest tensors.
            return images.to(th.float32, memory_format=layout).div_(255)

        obs = map_images(obs, self.image_keys, preprocess)
        return preprocess_obs(obs, self.observation_space, normalize_images=False)


def map_images(obs: PyTorchObs, image_keys: Collection[str], function: Callable[[th.Tensor], th.Tensor]) -> PyTorchObs:
    """Apply a function to all images of an observation; their key is ``""`` where it is no Dict."""
    if isinstance(obs, dict):
        return {key: function(value) if key in image_keys else value for key, value in obs.items()}
    return function(obs) if image_keys else obs


def parts(encoder: BaseFeaturesExtractor) -> tuple[Callable[[Any], th.Tensor], Callable[[th.Tensor], th.Tensor]]:
    """An encoder's trunk, which actor and critic both read, and its projection; one without a projection is all trunk."""
    if isinstance(encoder, Encoder) and type(encoder).forward is Encoder.forward:
        return encoder.trunk, encoder.projection
    return encoder, nn.Identity()


def _image_advice(space: spaces.Space) -> str:
    shape = getattr(space, "shape", None) or ()
    if len(shape) == 2:
        return "An image has three dimensions: add a channel to it, such as GrayscaleObservation(env, keep_dim=True)"
    if len(shape) == 1:
        return "Vectors need MlpPolicy"
    if len(shape) > 3:
        return (
            "An image has three dimensions: stack RGB images with SB3's VecFrameStack, which stacks their channels, and grey "
            "ones without a channel with FrameStackObservation"
        )
    return (
        "Bytes have to be in a Box from 0 to 255. Images that are floats already, such as VecNormalize's, have to be channel "
        "first and need policy_kwargs=dict(normalize_images=False)"
    )


class Trunk(NamedTuple):
    """Stands for observations of which the output of the encoder's trunk is known, computed once for actor and critic."""

    values: th.Tensor


class DetachedEncoder(BaseFeaturesExtractor):
    """
    The actor's features extractor: the critic's encoder without gradient, then a projection of the actor's own.

    The projection (linear, layer norm) follows the encoder's trunk; an encoder that learns nothing, such as SB3's
    FlattenExtractor, is read as it is.
    """

    def __init__(self, encoder: BaseFeaturesExtractor):
        super().__init__(encoder._observation_space, encoder.features_dim)
        self.encoder = encoder
        self.projection: nn.Module = nn.Identity()
        if parts(encoder)[0] is not encoder:
            self.projection = encoder.make_projection()  # type: ignore[operator]
        elif any(parameter.requires_grad for parameter in encoder.parameters()):
            layers = nn.Linear(encoder.features_dim, encoder.features_dim), nn.LayerNorm(encoder.features_dim)
            self.projection = nn.Sequential(*layers).apply(orthogonal_init)

    def forward(self, observations: Any) -> th.Tensor:
        with th.no_grad():
            trunk = parts(self.encoder)[0](observations)
        return self.projection(trunk)


class Actor(_CropsImages, SB3Actor):
    """
    SB3's actor, which also takes the trunk of the critic's encoder for observations.

    :param squash_log_std: None for SB3's clipping of the log standard deviation to [-20, 2]; bounds such as (-10, 2)
        for tanh squashing into them
    :param kwargs: Those of SB3's actor, and ``crop_size``
    """

    def __init__(self, *args: Any, squash_log_std: tuple[float, float] | None = None, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.squash_log_std = squash_log_std

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"crop_size": self.crop_size, "squash_log_std": self.squash_log_std}
        return super()._get_constructor_parameters() | own

    def own_parameters(self) -> list[nn.Parameter]:
        """The parameters that the actor loss trains: all but those of the critic's encoder."""
        extractor = self.features_extractor
        critics = set(extractor.encoder.parameters()) if isinstance(extractor, DetachedEncoder) else set()
        return [parameter for parameter in self.parameters() if parameter not in critics]

    def extract_features(self, obs: PyTorchObs | Trunk, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        if isinstance(obs, Trunk):
            return features_extractor.projection(obs.values.detach())  # type: ignore[operator]
        return super().extract_features(obs, features_extractor)

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        if self.squash_log_std is None or self.use_sde:
            return super().get_action_dist_params(obs)
        latent = self.latent_pi(self.extract_features(obs, self.features_extractor))
        low, high = self.squash_log_std
        assert isinstance(self.log_std, nn.Linear)
        log_std = low + 0.5 * (high - low) * (th.tanh(self.log_std(latent)) + 1)
        return self.mu(latent), log_std, {}

    def action_log_prob(self, obs: PyTorchObs | Trunk) -> tuple[th.Tensor, th.Tensor]:
        mean_actions, log_std, kwargs = self.get_action_dist_params(obs)  # type: ignore[arg-type]
        kwargs = {name: value.float() for name, value in kwargs.items()}
        with th.autocast(mean_actions.device.type, enabled=False):
            return self.action_dist.log_prob_from_params(mean_actions.float(), log_std.float(), **kwargs)


class Critic(_CropsImages, ContinuousCritic):
    """
    SB3's critic around the encoder that the critic loss and the auxiliary loss train.

    :param norm: None, ``"layer"`` or ``"batch"``, see ``networks.q_network``
    :param kwargs: Those of SB3's critic, and ``crop_size``
    """

    def __init__(self, *args: Any, norm: str | None = None, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.norm = norm
        if norm is not None:
            inputs = kwargs["features_dim"] + get_action_dim(self.action_space)
            for i in range(len(self.q_networks)):
                self.q_networks[i] = q_network(norm, inputs, kwargs["net_arch"], kwargs["activation_fn"])
                setattr(self, f"qf{i}", self.q_networks[i])
        self.train()

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        # SB3's would compute gradients under no_grad() too, which a running normalisation takes for a training step.
        return self.q_values(self.encode(obs), actions)

    def trunk(self, obs: PyTorchObs) -> Trunk:
        """All of the encoder but its projection, of observations (batch, ...); all of it where it has none."""
        return Trunk(parts(self.features_extractor)[0](self.preprocess(obs)))

    def encode(self, obs: PyTorchObs | Trunk) -> th.Tensor:
        """Latent states (batch, features_dim) of observations (batch, ...), or of their trunk."""
        trunk = obs if isinstance(obs, Trunk) else self.trunk(obs)
        return parts(self.features_extractor)[1](trunk.values).float()

    def q_values(self, latent: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """One (batch, 1) for each critic; of latent states (batch, features_dim), actions (batch, action_dim) in [-1, 1]."""
        inputs = th.cat([latent, actions], dim=1)
        return tuple(q_network(inputs).float() for q_network in self.q_networks)

    def train(self, mode: bool = True) -> "Critic":
        super().train(mode)
        if self.norm == "batch":  # the statistics of a batch in the critic loss only
            for network in self.q_networks:
                network.eval()
        return self

    @contextmanager
    def batch_statistics(self) -> Iterator[None]:
        """Batch norms of the Q networks use the statistics of the batch, and learn from them; elsewhere the running ones."""
        for network in self.q_networks:
            network.train()
        yield
        for network in self.q_networks:
            network.eval()

    @cached_property
    def q_parameters(self) -> list[nn.Parameter]:
        """All parameters but those of the encoder, collected once."""
        return [parameter for network in self.q_networks for parameter in network.parameters()]

    @cached_property
    def encoder_parameters(self) -> list[nn.Parameter]:
        """The parameters of the encoder, collected once."""
        return list(self.features_extractor.parameters())

    @property
    def running_statistics(self) -> list[th.Tensor]:
        """The running statistics themselves: SB3's ``batch_norm_stats`` are copies of them in a model that was pickled."""
        return [buffer for name, buffer in self.named_buffers() if "running_" in name]


class SACAuxPolicy(SACPolicy):
    """
    Policy class (actor, critic and momentum target) of SACAux.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param net_arch: Hidden layers of actor and critic, as in SB3 (two of 256; the paper has two of 1024, tables 7 and 8)
    :param features_extractor_class: The encoder: a name of ``encoders.ENCODERS`` or a class
    :param features_extractor_kwargs: Its keyword arguments; of a network among them each encoder gets a copy
    :param share_features_extractor: True (default, CURL's pixel agent): the actor reads the critic's encoder
        detached, through a projection of its own if that has one. False: it has its own encoder, which the actor loss trains
    :param augmentation: What training does to images: ``"random_shift"`` by up to 4 pixels (DrQ), ``"random_crop"`` to
        ``crop_size`` with a centre crop elsewhere (CURL, paper), ``"none"``, or ``"auto"``: crop where ``crop_size`` is
        given, else shift. Vectors are never augmented
    :param crop_size: Height and width in pixels of cropped images, of ``"random_crop"`` alone; None for 84 (paper, table 7)
    :param squash_log_std: None (default, SB3): the log standard deviation is clipped to [-20, 2]. Bounds such as
        (-10, 2) (the public reference): tanh squashes it into them; gSDE ignores them
    :param ortho_init: Whether all linear layers of actor and critic, outputs too, start orthogonal with zero biases
        (CURL, the reference) or as PyTorch has it (default, SB3). This package's encoders always do
    :param critic_norm: ``"batch"`` (default): batch norm in the Q networks, and both states of a transition in one batch
        (CrossQ, Bhatt et al., 2024); rewards divided by their mean magnitude in the first batch if that is above 1;
        ``"layer"``: layer norm in them; None (SB3)
    :param kwargs: activation_fn, use_sde, log_std_init, use_expln, clip_mean, normalize_images, optimizer_class,
        optimizer_kwargs and n_critics of SB3's SACPolicy; ``betas`` of Adam and AdamW are (0.5, 0.999) unless given (CrossQ)
    """

    actor: Actor
    critic: Critic
    critic_target: Critic

    default_encoder: type[BaseFeaturesExtractor] = SimbaEncoder

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        features_extractor_class: str | type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = True,
        augmentation: str = "auto",
        crop_size: int | None = None,
        squash_log_std: tuple[float, float] | None = None,
        ortho_init: bool = False,
        critic_norm: str | None = "batch",
        **kwargs: Any,
    ):
        normalize_images = kwargs.get("normalize_images", True)
        if kwargs.get("optimizer_class", th.optim.Adam) in (th.optim.Adam, th.optim.AdamW):
            kwargs["optimizer_kwargs"] = {"betas": (0.5, 0.999), **(kwargs.get("optimizer_kwargs") or {})}
        resolved = resolve_augmentation(augmentation, observation_space, crop_size, not normalize_images)
        self.augmentation, self.crop_size = resolved
        self.image_keys = frozenset(image_spaces(observation_space, not normalize_images))
        self.squash_log_std = squash_log_std
        self.ortho_init = ortho_init
        self.critic_norm = critic_norm
        encoder = encoder_class(features_extractor_class or self.default_encoder)
        if encoder is FlattenExtractor and isinstance(observation_space, spaces.Dict):
            encoder = CombinedExtractor  # SB3's for Dicts: vectors as they are, beside each other
        if issubclass(encoder, MultiInputEncoder) and not normalize_images:
            features_extractor_kwargs = {"normalized_image": True, **(features_extractor_kwargs or {})}
        # As SB3's NatureCNN: floats that are not scaled are mostly a mistake.
        is_image = is_image_space(observation_space, normalized_image=not normalize_images)
        assert is_image or not issubclass(encoder, PixelEncoder), (
            f"{encoder.__name__} is for images, not for {observation_space}. {_image_advice(observation_space)}"
        )
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=net_arch,
            features_extractor_class=encoder,
            features_extractor_kwargs=features_extractor_kwargs,
            share_features_extractor=share_features_extractor,
            **kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        encoder = self.make_features_extractor() if self.share_features_extractor else None
        self.actor = self.make_actor(None if encoder is None else DetachedEncoder(encoder))
        self.critic = self.make_critic(encoder)
        if self.ortho_init:
            for network in (self.actor.latent_pi, self.actor.mu, self.actor.log_std, *self.critic.q_networks):
                if isinstance(network, nn.Module):
                    network.apply(orthogonal_init)
        self.critic_target = self.make_critic()
        if set(self.critic.parameters()) & set(self.critic_target.parameters()):
            name = self.features_extractor_class.__name__
            raise ValueError(f"{name} shares a network between critic and target critic: pass it in features_extractor_kwargs")
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.set_training_mode(False)
        self.critic_target.requires_grad_(False)
        self.actor.optimizer = self.make_optimizer(self.actor.own_parameters(), lr_schedule)
        self.critic.optimizer = self.make_optimizer(list(self.critic.parameters()), lr_schedule)
        self.set_training_mode(False)  # reading Q values before learn() changes no running statistics

    def make_optimizer(self, parameters: list[nn.Parameter], lr_schedule: Schedule) -> th.optim.Optimizer:
        """An optimizer of the policy's class and arguments."""
        kwargs = dict(self.optimizer_kwargs)
        learns = any(parameter.requires_grad for parameter in self.critic.features_extractor.parameters())
        if learns and self.optimizer_class in (th.optim.Adam, th.optim.AdamW) and not {"foreach", "fused"} & set(kwargs):
            # Several times faster, equal except for rounding. An encoder without parameters is SB3's SAC, to the bit.
            kwargs["fused"] = True
        return self.optimizer_class(parameters, lr=lr_schedule(1), **kwargs)  # type: ignore[call-arg]

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        space = self.observation_space
        if self.crop_size is not None:
            space = cropped_space(space, self.crop_size, not self.normalize_images)
        # Encoder and momentum encoder each get a copy of a network among the arguments.
        kwargs: dict[str, Any] = dict(self.features_extractor_kwargs)
        kwargs |= {name: copy.deepcopy(value) for name, value in kwargs.items() if isinstance(value, nn.Module)}
        return self.features_extractor_class(space, **kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return Actor(**kwargs, crop_size=self.crop_size, squash_log_std=self.squash_log_std).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Critic:
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        # To SB3 "shared" means that the critic does not train the encoder. Here it always does.
        kwargs["share_features_extractor"] = False
        return Critic(**kwargs, crop_size=self.crop_size, norm=self.critic_norm).to(self.device)

    def augment(self, obs: PyTorchObs) -> PyTorchObs:
        """Images of observations (batch, ...) or (batch, time, ...), each augmented at random unless cropped already."""

        def augment(images: th.Tensor) -> th.Tensor:
            if images.ndim == 5:
                # In the buffer's windows, memory is ordered by time first.
                times = images.transpose(0, 1)
                return augment(times.flatten(end_dim=1)).unflatten(0, times.shape[:2]).transpose(0, 1)
            return random_shift(images) if self.crop_size is None else random_crop(images, self.crop_size)

        return obs if self.augmentation == "none" else map_images(obs, self.image_keys, augment)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "share_features_extractor": self.share_features_extractor,
            "augmentation": self.augmentation,
            "crop_size": self.crop_size,
            "squash_log_std": self.squash_log_std,
            "ortho_init": self.ortho_init,
            "critic_norm": self.critic_norm,
        }


MlpPolicy = SACAuxPolicy


class CnnPolicy(SACAuxPolicy):
    """SACAuxPolicy with CURL's pixel encoder by default. Parameters as there."""

    default_encoder = PixelEncoder


class MultiInputPolicy(SACAuxPolicy):
    """SACAuxPolicy for Dict observations of vectors and images. Parameters as there."""

    default_encoder = MultiInputEncoder
