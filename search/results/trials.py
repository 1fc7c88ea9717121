"""What the trials of a study say, for plots, notes and reports: their loss, stage, learning curve and ancestors."""

import math
from collections.abc import Iterable, Sequence

from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from sb3_aarl.aux_loss import AuxLoss
from search.evolution.space import params_to_loss

# User attribute: list of [environment steps, mean return, standard deviation].
CURVE_KEY = "curve"


def loss_of(trial: FrozenTrial) -> AuxLoss | None:
    """The loss of a trial; None if it was never asked for one, or for one that is not valid."""
    try:
        return params_to_loss(trial.params)
    except (KeyError, ValueError):
        return None


def trained_loss_of(trial: FrozenTrial) -> AuxLoss | None:
    """The loss that a trial trains: :func:`loss_of`, or what was given to a run of a list of runs."""
    try:
        return loss_of(trial) or AuxLoss.parse(str(trial.user_attrs.get("loss")))
    except ValueError:
        return None


def stage_of(trial: FrozenTrial) -> int:
    """The stage of a trial; other samplers than AuxLossSampler have one stage only."""
    stage = trial.user_attrs.get("stage")
    return stage if isinstance(stage, int) else 1


def operation_of(trial: FrozenTrial) -> str:
    """What the candidate came from, ``-`` under other samplers."""
    return str(trial.user_attrs.get("operation", "-"))


def parents_of(trial: FrozenTrial) -> list[int]:
    """Numbers of the trials that a candidate stems from; a trial that had to wait for its place has a lower one than they."""
    parents = trial.user_attrs.get("parents")
    if not isinstance(parents, list):
        return []
    return [number for number in parents if isinstance(number, int) and number >= 0 and number != trial.number]


def curve_of(trial: FrozenTrial) -> list[tuple[int, float, float]]:
    """The learning curve of a trial as (environment steps, mean, standard deviation); empty if there is none."""
    try:
        return [(int(steps), float(mean), float(std)) for steps, mean, std in trial.user_attrs.get(CURVE_KEY, ())]
    except (TypeError, ValueError):
        return []


def score_of(trial: FrozenTrial) -> float | None:
    """The score of a completed trial; None for all others, and where it is not finite."""
    finished = trial.state == TrialState.COMPLETE and trial.value is not None and math.isfinite(trial.value)
    return trial.value if finished else None


def ranked(trials: Iterable[FrozenTrial], direction: StudyDirection = StudyDirection.MAXIMIZE) -> list[FrozenTrial]:
    """
    The trials that have a score, the best first.

    :param trials: Trials of a study
    :param direction: The study's
    """
    sign = -1 if direction == StudyDirection.MAXIMIZE else 1
    scores = {trial.number: score_of(trial) for trial in trials}
    scored = [(sign * score, number) for number, score in scores.items() if score is not None]
    by_number = {trial.number: trial for trial in trials}
    return [by_number[number] for _, number in sorted(scored)]


def lineage(trial: FrozenTrial, trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """
    All ancestors of a trial. The line through the first parent of each comes first, back to its end.

    :param trial: The trial
    :param trials: All trials of the study, in the order of numbers
    """
    ancestors: dict[int, FrozenTrial] = {}
    stack = parents_of(trial)[::-1]
    while stack:
        number = stack.pop()
        if number not in ancestors and number != trial.number and number < len(trials):
            ancestors[number] = trials[number]
            stack.extend(parents_of(trials[number])[::-1])
    return list(ancestors.values())
