"""The objective for ``study.optimize`` of a user's own: train one candidate in this process, return its score."""

from pathlib import Path

import optuna

from sb3_aarl.callbacks import Evaluation
from search.evolution.space import suggest_aux_loss
from search.execution.driver import candidate_folder, score
from search.execution.runs import mean_curve
from search.studies.config import SearchConfig
from search.studies.search import runs_of
from search.training.run import prepare_run, train


class Objective:
    """
    Trains the candidate of a trial, and returns the mean AULC over the training seeds: to be maximized.

    Each evaluation is reported at its environment steps, and the trial is pruned if its pruner says so. Several seeds are
    trained one after the other; the curve of the first one is reported, and a pruned trial is spared the other seeds.
    ``study.optimize(objective, catch=(FloatingPointError,))`` goes on after a loss that diverges.

    The trial has the user attributes that the driver of a search writes: ``loss`` and ``canonical`` (notation),
    ``environment``, ``curve``, ``seconds``; ``reason`` of a failure; ``interrupted`` after Ctrl-C.

    :param config: The search
    :param folder: Folder of the search; the runs are in its folder ``candidates``
    """

    def __init__(self, config: SearchConfig, folder: str | Path):
        self.config = config
        self.folder = Path(folder)
        self.make_runs = runs_of(config)

    def __call__(self, trial: optuna.Trial) -> float:
        """Train the candidate of a trial; TrialPruned is raised where it is not valid, too."""
        loss = suggest_aux_loss(trial, self.config.max_horizon, self.config.operators)
        trial.set_user_attr("loss", str(loss))
        trial.set_user_attr("canonical", str(loss.canonical()))
        trial.set_user_attr("environment", self.config.environment)
        folder = candidate_folder(self.folder, trial)
        curves: list[list[Evaluation]] = []
        pruned = False

        def report(curve: list[Evaluation]) -> bool:
            nonlocal pruned
            if not curves:
                _report(trial, curve)
                # After the last evaluation there is nothing left to spare.
                pruned = len(curve) < len(self.config.checkpoints) and trial.should_prune()
            return not pruned

        try:
            for run in self.make_runs(loss):
                path = folder / f"seed-{run.seed}"
                prepare_run(path, run)
                curves.append(train(path, on_evaluation=report))
                if pruned:
                    break
        except FloatingPointError as error:
            trial.set_user_attr("reason", str(error))
            raise
        except KeyboardInterrupt:
            trial.set_user_attr("interrupted", True)
            raise
        _report(trial, curves[0])  # a run that was finished before has no evaluations left
        trial.set_user_attr("curve", mean_curve(curves))
        trial.set_user_attr("seconds", round(sum(curve[-1].seconds for curve in curves), 1))
        if pruned:
            raise optuna.TrialPruned(f"pruned after {curves[0][-1].environment_steps} environment steps")
        return score(curves)


def _report(trial: optuna.Trial, curve: list[Evaluation]) -> None:
    """Report what the trial does not have yet."""
    known = trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values
    for evaluation in curve:
        if evaluation.environment_steps not in known:
            trial.report(evaluation.mean, evaluation.environment_steps)
