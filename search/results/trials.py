"""Trials of a study for plots, notes and reports: their loss, generation, learning curve and ancestors."""

import math
from collections.abc import Iterable, Sequence

from optuna import Trial
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState


def score_of(trial: FrozenTrial) -> float | None:
    """The score of a completed trial; None for all others, and where it is not finite."""
    finished = trial.state == TrialState.COMPLETE and trial.value is not None and math.isfinite(trial.value)
    return trial.value if finished else None


def ranked(trials: Iterable[FrozenTrial], direction: StudyDirection = StudyDirection.MAXIMIZE) -> list[FrozenTrial]:
    """The trials that have a score, the best first."""
    sign = -1 if direction == StudyDirection.MAXIMIZE else 1
    scores = [(score, trial) for trial in trials if (score := score_of(trial)) is not None]
    return [trial for _, trial in sorted(scores, key=lambda scored: (sign * scored[0], scored[1].number))]


def lineage(trial: FrozenTrial | Trial, trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """All ancestors of a trial. The line through the first parent of each comes first, back to its end."""
    ancestors: dict[int, FrozenTrial] = {}
    stack = list(reversed(trial.user_attrs.get("parents", ())))
    while stack:
        number = stack.pop()
        if number not in ancestors:
            ancestors[number] = trials[number]
            stack.extend(reversed(trials[number].user_attrs.get("parents", ())))
    return list(ancestors.values())
