"""Health checks of a training run: values that are not finite, and Q values that have exploded."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

# A run whose Q values are this many times larger than rewards and entropy allow has diverged: healthy ones may overshoot
# early in training, exploding ones pass a factor of a thousand on their way to infinity.
EXPLODED = 1000.0
# The largest log density of a squashed Gaussian for each dimension of an action: SB3 clips the log standard deviation at
# -20, and the slope of tanh at 1e-6.
LARGEST_LOG_DENSITY = 34.0


class NonFiniteError(FloatingPointError):
    """An observation, reward, loss or output of the actor is NaN or infinite; the message names it and the step."""


class ExplodedError(FloatingPointError):
    """Q values are far larger than rewards allow; the message says how large they are and may be, and at which step."""


def check_finite(name: str, values: np.ndarray | dict[str, np.ndarray], place: str) -> None:
    """Raise a NonFiniteError with name and place of the values unless all are finite; they may be of any type."""
    for key, array in values.items() if isinstance(values, dict) else [("", values)]:
        if np.issubdtype(np.asarray(array).dtype, np.floating) and not np.isfinite(array).all():
            index = np.argwhere(~np.isfinite(array))[0].tolist()
            raise NonFiniteError(
                f"{name}{f' {key!r}' if key else ''} from the environment is not finite at {place} (index {index})"
            )


@dataclass
class QValueCheck:
    """Stops a run that has diverged long before its losses are infinite."""

    largest_reward: float = 0.0  # absolute, of all batches so far
    first_error: float = 0.0  # of the untrained Q values; large where an encoder passes on large observations

    def __call__(
        self, losses: Mapping[str, Mapping[int, float]], gamma: float, action_dim: int, describe: Callable[[int], str]
    ) -> None:
        """
        Compare losses, by name and gradient step, with what the sum of discounted rewards and entropies can be; raise an
        ExplodedError when a Q value is ``EXPLODED`` times larger.
        """
        errors = {step: loss**0.5 for step, loss in losses["critic_loss"].items()}
        values = {step: abs(loss) for step, loss in losses.get("actor_loss", {}).items()}  # minus the soft value of states
        self.largest_reward = max(self.largest_reward, *losses["largest_reward"].values())
        self.first_error = max(self.first_error, errors.get(1, 0), values.get(1, 0))
        if gamma >= 1:
            return
        # Untrained networks have values of about 1 even where rewards are tiny.
        reward = max(1.0, self.largest_reward) + max(losses["ent_coef"].values()) * LARGEST_LOG_DENSITY * action_dim
        bound = max(reward / (1 - gamma), self.first_error)
        for name, found in (("the error of the Q values", errors), ("the value of states", values)):
            step = max(found, key=lambda step: found[step], default=None)
            if step is not None and found[step] > EXPLODED * bound:
                raise ExplodedError(
                    f"{name} is {found[step]:.3g} at {describe(step)}; rewards of at most {self.largest_reward:.3g} and "
                    f"gamma={gamma} allow {bound:.3g}: the Q values have exploded"
                )
