"""AuxHead: source tokens -> predictor -> operator <- target tokens through the momentum encoder."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_aarl.aux_loss import AuxLoss, Token
from sb3_aarl.buffers import WindowSamples, map_parts
from sb3_aarl.operators import Operator


@dataclass(frozen=True)
class AuxOptions:
    """
    How the auxiliary loss is trained: the keys of ``SACAux(aux_kwargs=...)``.

    :param learning_rate: Of its optimizer, may be a schedule; None for SACAux's ``learning_rate``
    :param batch_size: Windows for each update, None for SACAux's ``batch_size``
    :param tau: Polyak coefficient of the momentum encoder (paper, table 7)
    :param predictor_width: Hidden units of the predictor (paper, table 7), None for twice its input (the public reference)
    :param joint: Whether one optimizer trains the encoder on the weighted sum of critic and auxiliary loss (equation 1).
        By default the auxiliary loss has an optimizer of its own for encoder and predictor, as in CURL
    :param coef: Weight lambda of the auxiliary loss in that sum; for ``joint`` alone, since an Adam of its own divides a
        constant factor out again
    """

    learning_rate: float | Schedule | None = None
    batch_size: int | None = None
    tau: float = 0.05
    predictor_width: int | None = 256
    joint: bool = False
    coef: float = 1.0

    def __post_init__(self) -> None:
        for name in ("batch_size", "predictor_width"):
            if getattr(self, name) is not None and not getattr(self, name) >= 1:
                raise ValueError(f"aux_kwargs: {name} must be at least 1, not {getattr(self, name)}")
        if not 0 <= self.tau <= 1:
            raise ValueError(f"aux_kwargs: tau must be between 0 and 1, not {self.tau}")
        if not 0 <= self.coef < float("inf"):
            raise ValueError(f"aux_kwargs: coef must be a finite number of at least 0, not {self.coef}")
        if self.coef != 1 and not self.joint:
            raise ValueError("aux_kwargs: coef needs joint=True; without it, set learning_rate")


class AuxHead(nn.Module):
    """
    The trainable part of an auxiliary loss beside the encoder: a predictor with one hidden layer, and the operator.

    States go through an encoder, actions and rewards enter source and target as they are (paper, figure 1).

    :param loss: The auxiliary loss
    :param latent_dim: Width of a latent state
    :param action_dim: Width of an action
    :param predictor_width: Hidden units of the predictor, None for twice its input
    """

    def __init__(self, loss: AuxLoss, latent_dim: int, action_dim: int, predictor_width: int | None = 256):
        super().__init__()
        self.loss = loss
        width = {"s": latent_dim, "a": action_dim, "r": 1}
        source_dim, target_dim = (
            sum(width[token.kind] for token in tokens) for tokens in (loss.source_tokens, loss.target_tokens)
        )
        hidden = 2 * source_dim if predictor_width is None else predictor_width
        self.predictor = nn.Sequential(nn.Linear(source_dim, hidden), nn.ReLU(), nn.Linear(hidden, target_dim))
        self.operator = Operator(loss.operator, loss.negatives, target_dim)
        # The observations of a window, for WindowReplayBuffer.sample_windows: first the source's, then the target's. One
        # that both name is there twice, so that images are augmented twice.
        self.offsets = offsets(loss.source_tokens, "s") + offsets(loss.target_tokens, "s")

    def forward(
        self,
        windows: WindowSamples,
        encode: Callable[[PyTorchObs], th.Tensor],
        encode_target: Callable[[PyTorchObs], th.Tensor],
    ) -> th.Tensor:
        """
        The value of the loss, a scalar.

        :param windows: Windows of the loss's horizon with the observations at ``offsets``
        :param encode: The encoder that is trained, from observations (n, ...) to latent states (n, latent_dim)
        :param encode_target: The momentum encoder; no gradient is kept of it
        """
        n_source = len(offsets(self.loss.source_tokens, "s"))
        source = self._embed(windows, self.loss.source_tokens, slice(n_source), encode)
        with th.no_grad():
            target = self._embed(windows, self.loss.target_tokens, slice(n_source, None), encode_target)
        prediction = self.predictor(source).to(target.dtype)
        with th.autocast(prediction.device.type, enabled=False):
            return self.operator(prediction, target)

    def _embed(
        self, windows: WindowSamples, tokens: Sequence[Token], positions: slice, encode: Callable[[PyTorchObs], th.Tensor]
    ) -> th.Tensor:
        """Latent states, actions and rewards of the tokens side by side, (batch, d); all states in one encoder pass."""
        parts: list[th.Tensor] = []
        n_states = len(offsets(tokens, "s"))
        if n_states:
            # One batch, in the order of memory.
            latent = encode(map_parts(lambda part: part.transpose(0, 1)[positions].flatten(end_dim=1), windows.observations))
            parts += latent.chunk(n_states)
        # One by one: to index with a list, a GPU has to wait.
        parts += [windows.actions[:, offset] for offset in offsets(tokens, "a")]
        parts += [windows.rewards[:, offset] for offset in offsets(tokens, "r")]
        return th.cat(parts, dim=1)


def offsets(tokens: Sequence[Token], kind: str) -> list[int]:
    """Offsets from the window's start of the tokens of one kind: ``s``, ``a`` or ``r``."""
    return [token.offset for token in tokens if token.kind == kind]
