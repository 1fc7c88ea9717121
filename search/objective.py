"""The objective of a search: train one candidate, report its learning curve, return the area under it (AULC)."""

import contextlib
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import torch as th
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from stable_baselines3.common.utils import get_device

from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.callbacks import Evaluation
from search.config import SearchConfig
from search.provenance import commit, cpu
from search.space import suggest_aux_loss
from search.storage import study_id
from search.training import TrainingError, train_candidate


class CandidateFailed(RuntimeError):
    """A candidate could not be trained; the trial fails with the user attribute ``reason``, the study goes on."""


class Objective:
    """
    Trains the candidate that a trial proposes, and returns the mean AULC over the training seeds: to be maximized.

    Each evaluation is reported at its environment steps, and the trial is pruned if its pruner says so. With several
    seeds it is the curve of the first one that is reported: trials are compared like with like, and a pruned one is
    spared its other seeds.

    User attributes of a trial: ``loss`` (notation), ``canonical``, ``environment``, ``commit``, ``device`` (name of the GPU
    or the processor), ``threads``; ``curve`` (a list of [environment steps, mean, standard deviation] over the episodes
    of all seeds) and ``seconds`` of training when it ends; ``reason`` when it fails; ``interrupted`` when Ctrl-C stopped it.

    ``study.optimize(objective, catch=CandidateFailed)`` goes on after a candidate that failed.

    :param config: The search
    :param folder: Where every candidate has a folder of its own, with its learning curves. Those of another study that
        are there are passed over
    """

    def __init__(self, config: SearchConfig, folder: str | Path):
        self.config = config
        self.folder = Path(folder)
        self.commit = commit()

    def __call__(self, trial: optuna.Trial) -> float:
        """
        :param trial: Proposes the candidate
        :return: Mean AULC over the seeds
        :raises optuna.TrialPruned: for an invalid candidate, before anything is trained, and for a pruned one
        :raises CandidateFailed: when the training diverges, runs out of memory or its environment breaks
        """
        with end_noted(trial):
            loss = suggest_aux_loss(trial, self.config.max_horizon, self.config.operators)
            return self._train(trial, loss, self.config.environment, self.config.seeds, {}, None)

    def train(
        self,
        trial: optuna.Trial,
        aux_loss: AuxLoss | None,
        environment: str,
        seeds: Sequence[int],
        overrides: Mapping[str, Any] | None = None,
        name: str | None = None,
    ) -> float:
        """
        Train a given loss for a trial, for procedures that do not search.

        :param trial: Gets the reports and the user attributes
        :param aux_loss: The loss, None for none
        :param environment: Id of the environment
        :param seeds: Training seeds
        :param overrides: Merged over the hyper-parameters of the configuration
        :param name: Another trial of this name, loss, environment and seeds goes on where a killed one stopped; one at a
            time. None for the trial's place, or its number
        :return: Mean AULC over the seeds
        :raises optuna.TrialPruned: when the pruner says so
        :raises CandidateFailed: as above
        """
        with end_noted(trial):
            return self._train(trial, aux_loss, environment, seeds, overrides or {}, name)

    def _train(
        self,
        trial: optuna.Trial,
        aux_loss: AuxLoss | None,
        environment: str,
        seeds: Sequence[int],
        overrides: Mapping[str, Any],
        name: str | None,
    ) -> float:
        config = self.config
        hyperparameters = config.hyperparameters_for(environment, overrides)
        checkpoints = config.checkpoints_for(environment)
        folder = self.folder / _folder_name(trial.study, name or _name(trial), aux_loss, environment, seeds)
        attributes = {
            "loss": "none" if aux_loss is None else str(aux_loss),
            "canonical": "none" if aux_loss is None else str(aux_loss.canonical()),
            "environment": environment,
            "commit": self.commit,
            "device": device_name(hyperparameters.get("device", "auto")),
            "threads": th.get_num_threads(),
        }
        for key, value in attributes.items():
            trial.set_user_attr(key, value)

        curves: list[list[Evaluation]] = []
        pruned = False

        def report(evaluation: Evaluation) -> bool:
            nonlocal pruned
            if not curves:
                trial.report(evaluation.mean, evaluation.environment_steps)
                # After the last evaluation nothing is left to spare.
                pruned = evaluation.environment_steps != checkpoints[-1] and trial.should_prune()
            return not pruned

        scores = []
        for seed in seeds:
            run = train_candidate(
                environment,
                aux_loss,
                hyperparameters,
                seed,
                checkpoints,
                config.evaluation_episodes,
                folder / f"seed-{seed}",
                on_evaluation=report,
            )
            curves.append(run.curve)
            scores.append(run.aulc)
            if pruned:
                break
        trial.set_user_attr("curve", mean_curve(curves))
        trial.set_user_attr("seconds", round(sum(curve[-1].seconds for curve in curves), 1))
        if pruned:
            raise optuna.TrialPruned(f"pruned after {curves[0][-1].environment_steps} environment steps")
        return float(np.mean(scores))


@contextlib.contextmanager
def end_noted(trial: optuna.Trial) -> Iterator[None]:
    """
    Note why a training ended before its time, as the user attribute ``interrupted`` or ``reason``.

    Ctrl-C is not the candidate's fault, whenever it comes: the sampler gives the same one out again.

    :param trial: The training's trial
    :raises CandidateFailed: when the training diverges, runs out of memory or its environment breaks
    """
    try:
        yield
    except KeyboardInterrupt:
        trial.set_user_attr("interrupted", True)
        raise
    except (TrainingError, MemoryError, th.cuda.OutOfMemoryError) as error:
        reason = str(error) if isinstance(error, TrainingError) else f"{type(error).__name__}: {error}"
        trial.set_user_attr("reason", reason)
        raise CandidateFailed(reason) from error


def device_name(device: str) -> str:
    """
    What trains: ``GPU: `` and its name, or ``CPU: ``, the processor's name and how many of its cores may be used.

    :param device: As SB3 takes it
    """
    trains_on = get_device(device)
    return f"GPU: {th.cuda.get_device_name(trains_on)}" if trains_on.type == "cuda" else f"CPU: {cpu()}"


def mean_curve(curves: Sequence[Sequence[Evaluation]]) -> list[list[float]]:
    """
    The learning curve over several seeds.

    :param curves: One for each seed, of equal length and with equally many episodes
    :return: [environment steps, mean, standard deviation] over the episodes of all seeds, for every evaluation
    """
    points = []
    for evaluations in zip(*curves, strict=True):
        means, deviations = np.array([(evaluation.mean, evaluation.std) for evaluation in evaluations]).T
        # The variance of all episodes: within the seeds, and between them.
        points.append(
            [evaluations[0].environment_steps, float(means.mean()), float(np.sqrt((deviations**2).mean() + means.var()))]
        )
    return points


def make_pruner(config: SearchConfig) -> BasePruner:
    """
    Optuna's pruner of a configuration.

    :param config: The search
    """
    if config.pruner == "median":
        return MedianPruner()
    if config.pruner == "hyperband":
        return HyperbandPruner(min_resource=config.checkpoints[0], max_resource=config.checkpoints[-1])
    return NopPruner()


def _name(trial: optuna.Trial) -> str:
    """The same for a trial that takes up what another one, killed, had begun."""
    # From the storage: a Trial shows its user attributes as they were before the sampler gave it a place.
    frozen = trial.study._storage.get_trial(trial._trial_id)
    if "stage" in frozen.user_attrs:
        return f"stage-{frozen.user_attrs['stage']}-place-{frozen.user_attrs['place']}"
    # Other samplers may propose a loss twice at the same time. A heartbeat's copy knows whose copy it is.
    return f"trial-{frozen.system_attrs.get('failed_trial', frozen.number)}"


def _folder_name(study: optuna.Study, name: str, aux_loss: AuxLoss | None, environment: str, seeds: Sequence[int]) -> str:
    """Readable, and different wherever anything of it differs."""
    label = re.sub(r"[^a-z0-9]+", "-", name.lower())[:80].strip("-")
    digest = hashlib.sha256(f"{study_id(study)} {name} {aux_loss} {environment} {list(seeds)}".encode()).hexdigest()
    return f"{label}-{digest[:12]}"
