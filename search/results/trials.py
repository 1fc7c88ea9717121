"""Trials of a study for plots and reports: their loss, generation, learning curve and ancestors."""

import math
from collections.abc import Iterable, Sequence

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


def lineage(trial: FrozenTrial, trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """All ancestors of a trial, the latest first."""
    line, wanted = [], set(trial.user_attrs.get("parents", ()))
    for earlier in reversed(trials[: trial.number]):
        if earlier.number in wanted:
            line.append(earlier)
            wanted |= set(earlier.user_attrs.get("parents", ()))
    return line
