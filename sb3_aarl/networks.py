"""Layers that encoders, actor and critics share."""

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

HEADS = ("mlp", "layer_norm", "simba")


def orthogonal_init(module: nn.Module) -> None:
    """
    Orthogonal linear layers and delta-orthogonal convolutions, biases zero, as in CURL; for ``Module.apply``.

    Delta-orthogonal: all taps of a kernel are zero but the middle one, which is orthogonal across channels.

    :param module: A layer; what is neither linear nor convolutional stays as it is
    """
    if isinstance(module, nn.Linear):
        nn.init.orthogonal_(module.weight)
    elif isinstance(module, nn.Conv2d):
        nn.init.zeros_(module.weight)
        middle = module.weight[:, :, module.kernel_size[0] // 2, module.kernel_size[1] // 2]
        with th.no_grad():
            middle.copy_(nn.init.orthogonal_(th.empty_like(middle), nn.init.calculate_gain("relu")))
    if isinstance(module, (nn.Linear, nn.Conv2d)) and module.bias is not None:
        nn.init.zeros_(module.bias)


class SimbaBlock(nn.Module):
    """
    Residual block of SimBa (Lee et al., 2024): layer norm, a ReLU layer four times as wide, a projection back.

    :param width: Width of input and output
    """

    def __init__(self, width: int):
        super().__init__()
        self.layers = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return x + self.layers(x)


def hidden_layers(network: str, inputs: int, net_arch: list[int], activation_fn: type[nn.Module]) -> nn.Sequential:
    """
    The hidden layers of an actor or critic.

    :param network: ``"mlp"`` as in SB3, ``"layer_norm"`` with layer norm before each activation, or ``"simba"``: a linear
        layer, a residual block (with ReLU) for each width of ``net_arch``, and layer norm
    :param inputs: Width of the input
    :param net_arch: Widths of the hidden layers
    :param activation_fn: Class of the activations
    :raises ValueError: for an unknown network
    """
    if network not in HEADS:
        raise ValueError(f"unknown network {network!r}, expected one of {', '.join(HEADS)}")
    if network != "simba":
        norms: list[type[nn.Module]] = [nn.LayerNorm] if network == "layer_norm" else []
        return nn.Sequential(*create_mlp(inputs, -1, net_arch, activation_fn, post_linear_modules=norms))
    layers: list[nn.Module] = []
    for width in net_arch:
        if not layers or width != inputs:
            layers.append(nn.Linear(inputs, width))
        layers.append(SimbaBlock(width))
        inputs = width
    return nn.Sequential(*layers, nn.LayerNorm(inputs))
