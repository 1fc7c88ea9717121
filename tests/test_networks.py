"""Hidden layers of actor and critics against their formulas, and in a policy that is saved."""

from pathlib import Path
from typing import Any

import pytest
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_aarl import SACAux
from sb3_aarl.networks import hidden_layers


def naive(network: str, layers: nn.Sequential, x: th.Tensor) -> th.Tensor:
    """Two hidden layers of one width, from their parameters alone."""
    parameters = list(layers.parameters())

    def take(function: Any, x: th.Tensor) -> th.Tensor:
        weight, bias = parameters.pop(0), parameters.pop(0)
        return function(x, weight.shape, weight, bias) if function is F.layer_norm else function(x, weight, bias)

    if network == "simba":
        x = take(F.linear, x)
        for _ in range(2):
            x = x + take(F.linear, take(F.linear, take(F.layer_norm, x)).relu())
        return take(F.layer_norm, x)
    for _ in range(2):
        x = take(F.linear, x)
        x = (take(F.layer_norm, x) if network == "layer_norm" else x).relu()
    assert not parameters
    return x


@pytest.mark.parametrize("network", ["mlp", "layer_norm", "simba"])
def test_hidden_layers_are_their_formula(network: str) -> None:
    layers = hidden_layers(network, 3, [4, 4], nn.ReLU)
    for parameter in layers.parameters():
        nn.init.normal_(parameter)
    x = th.randn(5, 3)
    th.testing.assert_close(layers(x), naive(network, layers, x))


def test_widths_of_blocks_may_differ() -> None:
    assert hidden_layers("simba", 3, [8, 8, 4], nn.ReLU)(th.zeros(2, 3)).shape == (2, 4)


@pytest.mark.parametrize("network", ["simba", {"pi": "mlp", "qf": "layer_norm"}], ids=str)
@pytest.mark.parametrize("use_sde", [False, True])
def test_networks_of_a_policy(network: Any, use_sde: bool, tmp_path: Path) -> None:
    policy_kwargs = {"net_arch": [8, 8], "network": network}
    model = SACAux("MlpPolicy", "Pendulum-v1", 1e-2, learning_starts=10, use_sde=use_sde, policy_kwargs=policy_kwargs)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(20)
    actor, critic = (network, network) if isinstance(network, str) else (network["pi"], network["qf"])
    wanted = {"mlp": 0, "layer_norm": 2, "simba": 3}
    for layers, kind in ((model.actor.latent_pi, actor), (model.critic.qf0, critic), (model.critic_target.qf1, critic)):
        assert sum(isinstance(layer, nn.LayerNorm) for layer in layers.modules()) == wanted[kind]
    assert all(not th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
    model.save(tmp_path / "model")
    loaded = SACAux.load(tmp_path / "model").policy.state_dict()
    assert all(th.equal(value, loaded[name]) for name, value in model.policy.state_dict().items())


def test_an_unknown_network_is_named() -> None:
    with pytest.raises(ValueError, match="unknown network 'resnet', expected one of mlp, layer_norm, simba"):
        SACAux("MlpPolicy", "Pendulum-v1", policy_kwargs={"network": "resnet"})
