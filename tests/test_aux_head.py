"""AuxHead against an oracle that walks over the tokens one by one."""

import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from test_space import losses
from torch import nn

from sb3_aarl import AuxLoss
from sb3_aarl.aux_head import AuxHead
from sb3_aarl.buffers import WindowSamples

LATENT, ACTION, OBSERVATION = 3, 2, 4
Observations = th.Tensor | dict[str, th.Tensor]


class Encoder(nn.Module):
    """Any encoder: a linear map of all that is observed."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(OBSERVATION, LATENT)
        self.calls: list[bool] = []

    def forward(self, observations: Observations) -> th.Tensor:
        self.calls.append(th.is_grad_enabled())
        if isinstance(observations, dict):
            observations = th.cat([observations[key].flatten(start_dim=1) for key in ("image", "vector")], dim=1)
        return self.linear(observations.flatten(start_dim=1)).tanh()


def whole_windows(horizon: int, batch: int, kind: str) -> WindowSamples:
    """Windows with every observation; no two numbers in them are equal."""

    def observations(*shape: int) -> th.Tensor:
        return th.randn(batch, horizon + 1, *shape)

    if kind == "dict":
        seen: Observations = {"image": observations(1, 1, 3), "vector": observations(1)}
    else:
        seen = observations(1, 2, 2) if kind == "image" else observations(OBSERVATION)
    return WindowSamples(seen, th.randn(batch, horizon, ACTION), th.randn(batch, horizon, 1))


def gathered(windows: WindowSamples, offsets: list[int]) -> WindowSamples:
    """The buffer's sample of these observations alone."""
    seen = windows.observations
    if isinstance(seen, dict):
        return windows._replace(observations={key: value[:, offsets] for key, value in seen.items()})
    return windows._replace(observations=seen[:, offsets])


def embed(windows: WindowSamples, mask: tuple[bool, ...], encoder: Encoder) -> th.Tensor:
    """Row by row and token by token; states first, then actions, then rewards."""
    rows = []
    for b in range(len(windows.actions)):
        parts = []
        for kind in range(3):
            for offset in range(len(windows.actions[b]) + 1):
                index = 3 * offset + kind
                if index >= len(mask) or not mask[index]:
                    continue
                if kind == 0:
                    seen = windows.observations
                    one = (
                        {key: value[b, offset][None] for key, value in seen.items()}
                        if isinstance(seen, dict)
                        else seen[b, offset][None]
                    )
                    parts.append(encoder(one)[0])
                else:
                    parts.append((windows.actions, windows.rewards)[kind - 1][b, offset])
        rows.append(th.cat(parts))
    return th.stack(rows)


def oracle(head: AuxHead, windows: WindowSamples, encoder: Encoder, target_encoder: Encoder) -> th.Tensor:
    source = embed(windows, head.loss.source, encoder)
    target = embed(windows, head.loss.target, target_encoder).detach()
    first, *_, last = head.predictor
    hidden = source @ first.weight.T + first.bias
    return head.operator(hidden.clamp(min=0) @ last.weight.T + last.bias, target)


@settings(deadline=None, max_examples=25)
@given(losses(), st.sampled_from(["vector", "image", "dict"]), st.sampled_from([5, None]), st.integers(0, 99))
def test_value_and_gradients_against_the_oracle(loss: AuxLoss, kind: str, width: int | None, seed: int) -> None:
    th.manual_seed(seed)
    head = AuxHead(loss, LATENT, ACTION, width).double()
    encoder, target_encoder = Encoder().double(), Encoder().double()
    windows = whole_windows(loss.horizon, 4, kind)
    windows = WindowSamples(
        {key: value.double() for key, value in windows.observations.items()}
        if isinstance(windows.observations, dict)
        else windows.observations.double(),
        windows.actions.double(),
        windows.rewards.double(),
    )
    named = [i for mask in (loss.source, loss.target) for i in range(loss.horizon + 1) if mask[3 * i]]
    assert head.offsets == named

    trained = [*encoder.parameters(), *head.parameters()]
    value = head(gathered(windows, named), encoder, target_encoder)
    assert value.shape == ()
    # One pass of each encoder over all its states, and none of the target's with gradients.
    assert encoder.calls == [True]
    assert target_encoder.calls == ([False] if any(loss.target[::3]) else [])
    gradients = th.autograd.grad(value, trained, retain_graph=True)
    value.backward()
    assert all(parameter.grad is None for parameter in target_encoder.parameters())

    expected = oracle(head, windows, encoder, target_encoder)
    th.testing.assert_close(value, expected)
    for one, other in zip(gradients, th.autograd.grad(expected, trained), strict=True):
        th.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)


def test_widths_of_the_predictor() -> None:
    loss = AuxLoss.parse("{s_t, s_t+2, a_t+1, r_t, r_t+1} -> {s_t+1, a_t, a_t+1, r_t+1}", "bilinear")
    paper = AuxHead(loss, latent_dim=50, action_dim=6)
    public_code = AuxHead(loss, 50, 6, predictor_width=None)
    for head, width in ((paper, 256), (public_code, 2 * 108)):
        linear = [layer for layer in head.predictor if isinstance(layer, nn.Linear)]
        assert [(layer.in_features, layer.out_features) for layer in linear] == [(108, width), (width, 63)]
        assert [type(layer) for layer in head.predictor] == [nn.Linear, nn.ReLU, nn.Linear]
    assert paper.operator.weight.shape == (63, 63)
