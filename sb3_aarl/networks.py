"""Layers that encoders, actor and critics share, and where they can compute in bfloat16."""

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

CRITIC_NORMS = (None, "layer", "batch")


def computes_bf16(device: th.device) -> bool:
    """Whether PyTorch is fast in bfloat16 on a device: of x86 processors on those with AVX-512."""
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    return device.type != "cpu" or th.backends.cpu.get_cpu_capability() not in ("DEFAULT", "AVX2")


def orthogonal_init(module: nn.Module) -> None:
    """
    Orthogonal linear layers and delta-orthogonal convolutions, biases zero, as in CURL; for ``Module.apply``.

    Delta-orthogonal: all taps of a kernel are zero but the middle one, which is orthogonal across channels.
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
    """Residual block of SimBa (Lee et al., 2024): layer norm, a ReLU layer four times as wide, a projection back."""

    def __init__(self, width: int):
        super().__init__()
        self.layers = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return x + self.layers(x)


def q_network(norm: str | None, inputs: int, net_arch: list[int], activation_fn: type[nn.Module]) -> nn.Sequential:
    """
    A Q network.

    :param norm: None as in SB3; ``"layer"``: layer norm before each activation; ``"batch"``: batch norm before each linear
        layer, the last one too (CrossQ, Bhatt et al., 2024), with PyTorch's momentum: the actor reads running statistics,
        which must not lag behind the weights (results/agent/identity)
    :param inputs: Width of latent state and action together
    :param net_arch: Widths of the hidden layers
    :param activation_fn: Class of the activations
    """
    if norm not in CRITIC_NORMS:
        raise ValueError(f"unknown critic_norm {norm!r}, expected one of {', '.join(map(str, CRITIC_NORMS))}")
    layers = create_mlp(inputs, 1, net_arch, activation_fn, post_linear_modules=[nn.LayerNorm] if norm == "layer" else [])
    if norm == "batch":
        for position, layer in reversed(list(enumerate(layers))):
            if isinstance(layer, nn.Linear):
                normalization = nn.BatchNorm1d(layer.in_features, eps=1e-3)
                normalization.num_batches_tracked = th.tensor(0.0)  # a float, as all that SB3's tools expect among parameters
                layers.insert(position, normalization)
    return nn.Sequential(*layers)
