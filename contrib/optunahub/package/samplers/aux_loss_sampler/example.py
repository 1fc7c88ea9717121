"""Find forward dynamics again: the objective counts the tokens in which a loss differs from it. Takes a second."""

from __future__ import annotations

from pathlib import Path

import optuna
import optunahub

from sb3_aarl import AuxLoss

# In the registry: optunahub.load_module("samplers/aux_loss_sampler")
module = optunahub.load_local_module("samplers/aux_loss_sampler", registry_root=str(Path(__file__).parents[2]))


def tokens(loss: AuxLoss) -> set[tuple[str, int]]:
    masks = {"source": loss.source, "target": loss.target}
    return {(side, index) for side, mask in masks.items() for index, is_there in enumerate(mask) if is_there}


FORWARD_DYNAMICS = tokens(AuxLoss.parse("{s_t, a_t} -> {s_t+1}"))


def objective(trial: optuna.Trial) -> float:
    loss = module.suggest_aux_loss(trial, max_horizon=3)
    # A real objective trains an agent with the loss: sb3_aarl.SACAux(..., aux_loss=loss).
    return -len(tokens(loss) ^ FORWARD_DYNAMICS)


sampler = module.AuxLossSampler(population_size=20, n_random=20, n_prior=0, max_horizon=3, n_generations=5, seed=0)
study = optuna.create_study(direction="maximize", sampler=sampler)
study.optimize(objective, callbacks=[sampler.stop_when_complete])
print(f"{len(study.trials)} trials, the best loss is {module.suggest_aux_loss(study.best_trial, max_horizon=3)}")
