"""Encoders: SB3 features extractors from observations to the latent states that the auxiliary loss works on."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn

from sb3_aarl.augmentation import image_spaces
from sb3_aarl.networks import SimbaBlock, orthogonal_init


def flatten(observations: th.Tensor | TensorDict) -> th.Tensor:
    """Observations (batch, ...), or the parts of a Dict in the order of their names, as vectors (batch, numbers)."""
    if isinstance(observations, dict):
        return th.cat([flatten(observations[key]) for key in sorted(observations)], dim=1)
    return observations.reshape(observations.shape[0], -1)


class Encoder(BaseFeaturesExtractor, ABC):
    """
    An encoder in two parts: a trunk, and a projection (linear, layer norm) from it to the latent state.

    The actor reads the trunk through a projection of its own, see ``policies.DetachedEncoder``.

    :param observation_space: The observation space, one key's if it is a Dict
    :param features_dim: Width of the latent state
    :param trunk_dim: Width of the trunk's output
    :param tanh: Whether to squash the latent state into (-1, 1)
    """

    projection: nn.Module

    def __init__(self, observation_space: spaces.Space, features_dim: int, trunk_dim: int, tanh: bool = False):
        super().__init__(observation_space, features_dim)
        self.trunk_dim = trunk_dim
        self.tanh = tanh

    def make_projection(self) -> nn.Module:
        """A new projection from the trunk to a latent state, with parameters of its own."""
        layers = [nn.Linear(self.trunk_dim, self.features_dim), nn.LayerNorm(self.features_dim)]
        return nn.Sequential(*layers, *([nn.Tanh()] if self.tanh else [])).apply(orthogonal_init)

    @abstractmethod
    def trunk(self, observations: th.Tensor) -> th.Tensor:
        """All but the projection: (batch, trunk_dim) of observations (batch, ...), floats as SB3 preprocesses them."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.projection(self.trunk(observations))


class PixelEncoder(Encoder):
    """
    CURL's encoder (paper, table 7): 3 x 3 convolutions with ReLU, the first with stride 2, then the projection.

    :param observation_space: Images (channels, height, width) of any size from 15 x 15 on; SB3 divides them by 255
    :param features_dim: Width of the latent state (table 7: 50)
    :param n_layers: Number of convolutions (table 7: 4)
    :param n_filters: Filters of each (table 7: 32)
    :param tanh: Whether to squash the latent state into (-1, 1) (CURL and the paper: no)
    """

    def __init__(
        self, observation_space: spaces.Box, features_dim: int = 50, n_layers: int = 4, n_filters: int = 32, tanh: bool = False
    ):
        channels, height, width = observation_space.shape
        # Size after the first convolution (stride 2), then two pixels less for each further one.
        height, width = ((length - 3) // 2 + 1 - 2 * (n_layers - 1) for length in (height, width))
        if min(height, width) < 1:
            raise ValueError(f"images of shape {observation_space.shape} are too small for {n_layers} convolutions")
        super().__init__(observation_space, features_dim, n_filters * height * width, tanh)
        layers: list[nn.Module] = []
        for i in range(n_layers):
            layers.append(nn.Conv2d(channels if i == 0 else n_filters, n_filters, 3, stride=2 if i == 0 else 1))
            layers.append(nn.ReLU(inplace=True))
        # Channels last: convolutions are faster that way, on CPUs too.
        self.convolutions = nn.Sequential(*layers).apply(orthogonal_init)
        self.convolutions.to(memory_format=th.channels_last)  # type: ignore[call-overload]
        self.projection = self.make_projection()

    def trunk(self, observations: th.Tensor) -> th.Tensor:
        # Flattened in the order of memory, channels last: nothing is copied.
        return self.convolutions(observations).permute(0, 2, 3, 1).flatten(start_dim=1)


class DenseMLP(Encoder):
    """
    Densely connected MLP (paper, figure 5): each layer maps x to [x, ReLU(Wx)].

    :param observation_space: Any space that SB3 can flatten
    :param features_dim: Width of the latent state (table 8: 40)
    :param n_layers: Number of dense layers (table 8: 1; 4 in table 6)
    :param width: Units that each layer adds (table 8: 40)
    """

    dense = True

    def __init__(self, observation_space: spaces.Space, features_dim: int = 40, n_layers: int = 1, width: int = 40):
        inputs = [get_flattened_obs_dim(observation_space)]
        for _ in range(n_layers):
            inputs.append(inputs[-1] + width if self.dense else width)
        super().__init__(observation_space, features_dim, inputs[-1])
        self.layers = nn.ModuleList(nn.Linear(size, width) for size in inputs[:-1]).apply(orthogonal_init)
        self.projection = self.make_projection()

    def trunk(self, observations: th.Tensor | TensorDict) -> th.Tensor:
        x = flatten(observations)
        for layer in self.layers:
            added = layer(x).relu()
            x = th.cat([x, added], dim=1) if self.dense else added
        return x


class MLP(DenseMLP):
    """Plain MLP for the ablation of the paper's table 6: each layer maps x to ReLU(Wx). Parameters as DenseMLP."""

    dense = False


class RunningNorm(nn.Module):
    """
    Observations with mean 0 and variance 1, by the running statistics of the batches that losses are computed on.

    Predictions and the actor, which read the encoder without gradients, leave the statistics as they are.
    """

    running_mean: th.Tensor
    running_var: th.Tensor
    running_batches: th.Tensor

    def __init__(self, size: int):
        super().__init__()
        # SACAux copies buffers of these names to the momentum encoder.
        self.register_buffer("running_mean", th.zeros(size))
        self.register_buffer("running_var", th.ones(size))
        self.register_buffer("running_batches", th.tensor(0.0))

    def forward(self, x: th.Tensor) -> th.Tensor:
        # A number that stands for "nothing there" may be so large that its square is infinite.
        x = x.clamp(-1e15, 1e15)
        if self.training and th.is_grad_enabled():
            with th.no_grad():
                self.running_batches += 1
                # The mean of the first batches, then an exponential average: batches are drawn from the whole buffer.
                weight = (1 / self.running_batches).clamp(min=0.001)
                difference = x.mean(dim=0) - self.running_mean
                variance = x.var(dim=0, unbiased=False)
                self.running_var.lerp_(variance + (1 - weight) * difference**2, weight)
                self.running_mean += weight * difference
        # Clipped as VecNormalize does: a number that was constant so far may be far off when it changes.
        return ((x - self.running_mean) / (self.running_var + 1e-5).sqrt()).clamp(-10, 10)


class SimbaEncoder(Encoder):
    """
    Encoder in the manner of SimBa (Lee et al., 2024): running normalisation, a linear layer, a residual block, layer norm.

    All of it is the trunk, and the latent state is the trunk's output. The actor reads it as it is if it contains the
    observation, else through a projection of its own.

    :param observation_space: Any space that SB3 can flatten
    :param features_dim: Width of the block, and of the latent state without the observation; 128 had lower
        returns (results/agent/encoder_width)
    :param normalize: Whether observations are normalised; VecNormalize would do the same before
    :param observation: Whether the latent state contains the (normalised) observation beside the output of the block
    """

    def __init__(
        self, observation_space: spaces.Space, features_dim: int = 64, normalize: bool = True, observation: bool = True
    ):
        inputs = get_flattened_obs_dim(observation_space)
        latent_dim = features_dim + inputs * observation
        super().__init__(observation_space, latent_dim, trunk_dim=latent_dim)
        self.observation = observation
        self.normalization: nn.Module = RunningNorm(inputs) if normalize else nn.Identity()
        layers = nn.Linear(inputs, features_dim), SimbaBlock(features_dim), nn.LayerNorm(features_dim)
        self.layers = nn.Sequential(*layers).apply(orthogonal_init)
        self.projection = nn.Identity()

    def make_projection(self) -> nn.Module:
        # The observation needs none, and one of all of it would grow with its square.
        return nn.Identity() if self.observation else super().make_projection()

    def trunk(self, observations: th.Tensor | TensorDict) -> th.Tensor:
        x = self.normalization(flatten(observations))
        return th.cat([self.layers(x), x], dim=1) if self.observation else self.layers(x)


VECTOR_ENCODERS: Mapping[str, type[DenseMLP] | type[SimbaEncoder]] = {
    "dense_mlp": DenseMLP,
    "mlp": MLP,
    "simba": SimbaEncoder,
}


class SideBySide(nn.Module):
    """Modules that each read a part of the input, of so many columns, and their outputs side by side."""

    def __init__(self, modules: Sequence[nn.Module], widths: Sequence[int]):
        super().__init__()
        self.parts = nn.ModuleList(modules)
        self.widths = list(widths)

    def forward(self, x: th.Tensor) -> th.Tensor:
        return th.cat([part(y) for part, y in zip(self.parts, x.split(self.widths, dim=1), strict=True)], dim=1)


class MultiInputEncoder(Encoder):
    """
    For Dict observations: a PixelEncoder for each image, one encoder for all other keys together.

    Each part projects its own trunk, for the critic and again for the actor.

    :param observation_space: Dict of images and of anything that SB3 can flatten
    :param cnn_output_dim: Width of each image's latent state (table 7: 50; the name is SB3's CombinedExtractor's)
    :param mlp_output_dim: ``features_dim`` of the other keys' encoder
    :param normalized_image: Whether images are floats already, as in SB3's CombinedExtractor
    :param vector_encoder: Encoder of the other keys: ``"simba"``, ``"dense_mlp"`` or ``"mlp"``
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        cnn_output_dim: int = 50,
        mlp_output_dim: int = 64,
        normalized_image: bool = False,
        vector_encoder: str = "simba",
    ):
        assert isinstance(observation_space, spaces.Dict), f"MultiInputPolicy is for Dict spaces, not for {observation_space}"
        images = image_spaces(observation_space, normalized_image)
        vectors = {key: space for key, space in observation_space.spaces.items() if key not in images}
        encoders: list[Encoder] = [PixelEncoder(space, cnn_output_dim) for space in images.values()]
        if vectors:
            encoders.append(VECTOR_ENCODERS[vector_encoder](spaces.Dict(vectors), mlp_output_dim))
        features_dim, trunk_dim = (sum(getattr(part, name) for part in encoders) for name in ("features_dim", "trunk_dim"))
        super().__init__(observation_space, features_dim, trunk_dim)
        self.image_keys, self.vector_keys = list(images), list(vectors)
        self.projection = SideBySide([part.projection for part in encoders], [part.trunk_dim for part in encoders])
        for encoder in encoders:
            encoder.projection = nn.Identity()  # it is in self.projection
        self.encoders = nn.ModuleList(encoders)

    def _inputs(self, observations: TensorDict) -> list[th.Tensor]:
        inputs = [observations[key] for key in self.image_keys]
        if self.vector_keys:
            inputs.append(flatten({key: observations[key] for key in self.vector_keys}))
        return inputs

    def trunk(self, observations: TensorDict) -> th.Tensor:  # type: ignore[override]
        parts = zip(self.encoders, self._inputs(observations), strict=True)
        return th.cat([encoder.trunk(x) for encoder, x in parts], dim=1)  # type: ignore[operator]

    def make_projection(self) -> SideBySide:
        encoders: list[Encoder] = list(self.encoders)  # type: ignore[arg-type]
        return SideBySide([part.make_projection() for part in encoders], [part.trunk_dim for part in encoders])


# The names that plain YAML uses for features_extractor_class.
ENCODERS: Mapping[str, type[BaseFeaturesExtractor]] = {
    "pixel": PixelEncoder,
    **VECTOR_ENCODERS,
    "multi_input": MultiInputEncoder,
    "identity": FlattenExtractor,
}


def encoder_class(name_or_class: str | type[BaseFeaturesExtractor]) -> type[BaseFeaturesExtractor]:
    """The features extractor of a name of ``ENCODERS``, or a class as it is."""
    if not isinstance(name_or_class, str):
        return name_or_class
    if name_or_class not in ENCODERS:
        raise ValueError(f"unknown encoder {name_or_class!r}, expected one of {', '.join(ENCODERS)} or a class")
    return ENCODERS[name_or_class]
