"""Q networks with layer norm and batch norm: against their formulas, and in a policy that is trained and saved."""

from pathlib import Path
from typing import Any

import pytest
import torch as th
from test_sac_aux import assert_same, everything, filled_model, make_model
from torch import nn
from torch.nn import functional as F

from sb3_aarl import SACAux
from sb3_aarl.networks import q_network


@pytest.mark.parametrize("norm", [None, "layer", "batch"])
def test_q_networks_are_their_formula(norm: str | None) -> None:
    network = q_network(norm, 3, [4, 5], nn.ReLU)
    for parameter in network.parameters():
        nn.init.normal_(parameter)
    parameters, h = iter(network.parameters()), th.randn(6, 3)
    x = h

    def normalized(h: th.Tensor) -> th.Tensor:
        dim, eps = (0, 1e-3) if norm == "batch" else (1, 1e-5)
        h = (h - h.mean(dim, keepdim=True)) / (h.var(dim, keepdim=True, unbiased=False) + eps).sqrt()
        return h * next(parameters) + next(parameters)

    for layer in range(3):
        h = normalized(h) if norm == "batch" else h
        h = F.linear(h, next(parameters), next(parameters))
        h = normalized(h) if norm == "layer" and layer < 2 else h
        h = h.relu() if layer < 2 else h
    th.testing.assert_close(network(x), h)


@pytest.mark.parametrize("norm", ["layer", "batch"])
@pytest.mark.parametrize("settings", [{}, {"use_sde": True, "n_steps": 3}], ids=str)
def test_a_policy_with_norms_is_trained_and_saved(norm: str, settings: dict[str, Any], tmp_path: Path) -> None:
    model = make_model(policy_kwargs={"critic_norm": norm}, **settings)
    before = everything(model)
    model.learn(60)
    assert all(not th.equal(value, before[name]) for name, value in model.critic.state_dict(prefix="policy.critic.").items())
    model.save(tmp_path / "model")
    assert_same(everything(SACAux.load(tmp_path / "model")), everything(model))


def test_batch_norm_sees_both_states_in_both_critics() -> None:
    model = filled_model(policy_kwargs={"critic_norm": "batch"})
    for _ in range(3):
        model.train(1, batch_size=16)
    batch, ent_coef = model.replay_buffer.sample(16)._replace(discounts=0.9), th.tensor(0.1)
    for parameter in (p for network in model.critic_target.q_networks for p in network.parameters()):
        nn.init.normal_(parameter)
    running = model.critic.qf0[0].running_mean.clone()
    th.manual_seed(1)
    loss = model._critic_loss(model.critic.trunk(batch.observations), batch, ent_coef)
    assert not th.equal(running, model.critic.qf0[0].running_mean)

    th.manual_seed(1)
    next_actions, next_log_prob = model.actor.action_log_prob(batch.next_observations)
    latent = th.cat([model.critic.encode(batch.observations), model.critic.encode(batch.next_observations)])
    x = th.cat([latent, th.cat([batch.actions, next_actions])], dim=1)
    values = []
    for network in (*model.critic.q_networks, *model.critic_target.q_networks):
        h = x
        for layer in network:
            if isinstance(layer, nn.BatchNorm1d):
                h = F.batch_norm(h, None, None, layer.weight, layer.bias, training=True, eps=1e-3)
            else:
                h = layer(h)
        values.append(h[:, 0])
    now, later = th.stack(values)[:2, :16], th.stack(values)[2:, 16:]
    wanted = batch.rewards[:, 0] + 0.9 * (1 - batch.dones[:, 0]) * (later.amin(0) - ent_coef * next_log_prob)
    th.testing.assert_close(loss, 0.5 * (now - wanted).pow(2).mean(1).sum())
