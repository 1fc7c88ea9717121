"""
How good are the losses that a search finds? The samplers on synthetic objectives whose optimum is known.

Every sampler has 500 noisy evaluations; those of its proposals that are no valid loss are pruned and cost nothing. From
the five losses with the best noisy scores (different canonical forms) the best true value counts, as cross-validation
would find it. It is normalised: 0 is the mean of random losses, 1 the optimum. The noise of an evaluation is as large as
the standard deviation of random losses, or ``NOISE`` times as large. All objectives look at the canonical form only.

With ``--emulated`` they search landscapes like that of a real search (``emulator.py``), and start from the losses that it
was given: 150 runs, then a race of 60 runs between the ten losses that the surrogate rates highest, the same for all samplers.
What counts is the true value of the loss that is chosen in the end, above that of the best given one.

``MORE`` are of the same kinds and were drawn after the sampler was finished, to see whether it is good at the first ones only.
"""

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import optuna
from emulator import NOISE as NOISE_OF_A_RUN
from emulator import Emulator
from saving import save_result
from sb3_aarl.search.evolution.racing import next_runs, standings
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import MAX_HORIZON, loss_to_params, random_loss, suggest_aux_loss
from sb3_aarl.search.evolution.surrogate import TokenModel
from scipy.stats import mannwhitneyu, ttest_rel

from sb3_aarl.aux_loss import AuxLoss, Token

N_TOKENS = 3 * MAX_HORIZON + 1
SAMPLERS: dict[str, Callable[[int], optuna.samplers.BaseSampler]] = {
    "random": lambda seed: optuna.samplers.RandomSampler(seed=seed),
    "nsga2": lambda seed: optuna.samplers.NSGAIISampler(seed=seed),
    "tpe": lambda seed: optuna.samplers.TPESampler(seed=seed),
    "paper": lambda seed: AuxLossSampler(seed=seed),
    "screened": lambda seed: AuxLossSampler(seed=seed, screening=32),
}
# With the losses that they start from. Those of Optuna get them enqueued.
EMULATED: dict[str, Callable[[int, list[AuxLoss]], optuna.samplers.BaseSampler]] = {
    "nsga2": lambda seed, given: optuna.samplers.NSGAIISampler(population_size=28, seed=seed),
    "tpe": lambda seed, given: optuna.samplers.TPESampler(seed=seed),
    "paper": lambda seed, given: AuxLossSampler(seed=seed, initial=given, **FIRST, population_size=28),
    "screened": lambda seed, given: AuxLossSampler(seed=seed, initial=given, **FIRST, population_size=28, screening=32),
    "ours": lambda seed, given: AuxLossSampler(seed=seed, initial=given, **FIRST, **OURS),
    "ours, again": lambda seed, given: AuxLossSampler(seed=seed, initial=given, **FIRST, **OURS, again=0.2),
}
FIRST: dict[str, Any] = {"n_random": 20, "n_prior": 4}
OURS: dict[str, Any] = {"population_size": 12, "screening": 32, "climbing": 30, "parent_selection": "posterior"}
SEARCH_RUNS, RACE_RUNS, FINALISTS = 150, 60, 10


class Objective(Protocol):
    """What a loss is worth, from both masks of its canonical form, and what the best one is worth."""

    optimum: float

    def __call__(self, source: np.ndarray, target: np.ndarray) -> float: ...


class Tokens:
    """
    Each token has a value of its own around the value of its kind: signs as in the paper's table 5 (Cheetah-Run).

    :param seed: Seed of the values
    :param spread: Their deviation around that of their kind
    :param by_kind: Whether kinds have values; else all are around 0
    :param decay: Of the values with each step: what is far away matters less
    """

    def __init__(self, seed: int = 1, spread: float = 0.4, by_kind: bool = True, decay: float = 0.8) -> None:
        rng = np.random.default_rng(seed)
        values = {"s": (-0.3, 1.0), "a": (0.4, -0.7), "r": (0.2, -0.5)}  # in source and target
        kinds = np.array([values[Token.of(i).kind] for i in range(N_TOKENS)]).T * by_kind
        self.weights = kinds + rng.normal(0, spread, kinds.shape)
        self.weights *= decay ** (np.arange(N_TOKENS) // 3)
        self.weights[0, 0] = 1.0  # s_t is in the optimum, which makes it a valid and canonical one
        self.optimum = float(self.weights[self.weights > 0].sum())

    def __call__(self, source: np.ndarray, target: np.ndarray) -> float:
        return float(self.weights[0] @ source + self.weights[1] @ target)


class Patterns:
    """Gains and losses for whole patterns (paper, section 3.3), at some offsets, and a price for every token."""

    PRICE = 0.05
    PATTERNS = (
        ("{s_t, a_t} -> {s_t+1}", 3.0),  # forward dynamics
        ("{s_t, a_t, a_t+1} -> {s_t+2}", 3.0),
        ("{s_t, a_t, a_t+1, a_t+2} -> {s_t+3}", 2.0),
        ("{s_t} -> {s_t+2, s_t+3}", 1.5),
        ("{s_t, r_t} -> {s_t+1}", 1.0),
        ("{s_t, a_t} -> {s_t+4, s_t+5}", 1.0),
        ("{s_t+1, a_t} -> {s_t}", -1.0),  # inverse dynamics
        ("{s_t, a_t} -> {r_t}", -1.5),  # reward prediction
        ("{s_t, s_t+1} -> {a_t}", -3.0),  # action inference
        ("{s_t} -> {s_t}", -2.0),  # reconstruction
        ("{s_t+1} -> {s_t+1}", -1.0),
    )

    def __init__(self) -> None:
        self.patterns = [(*_masks(AuxLoss.parse(text)), gain) for text, gain in self.PATTERNS]
        gains = [(source, target) for source, target, gain in self.patterns if gain > 0]
        # Tokens that belong to no pattern with a gain only cost: the optimum is the union of some of these patterns.
        unions = (
            (np.any([s for s, _ in chosen], axis=0), np.any([t for _, t in chosen], axis=0))
            for size in range(1, len(gains) + 1)
            for chosen in combinations(gains, size)
        )
        self.optimum = max(self(source, target) for source, target in unions)

    def __call__(self, source: np.ndarray, target: np.ndarray) -> float:
        value = -self.PRICE * (source.sum() + target.sum())
        for needed_source, needed_target, gain in self.patterns:
            value += gain * (source[needed_source].all() and target[needed_target].all())
        return float(value)


class Pairs:
    """
    Half of the value lies in single tokens that are as in a hidden loss, half in pairs that both have to be.

    :param seed: Seed of the hidden loss and the values
    :param only: Whether single tokens have no value
    """

    def __init__(self, seed: int = 3, only: bool = False) -> None:
        rng = np.random.default_rng(seed)
        self.hidden = (rng.random(2 * N_TOKENS) < 0.4) & (np.tile(np.arange(N_TOKENS), 2) < 22)  # horizon 7
        self.hidden[0] = self.hidden[N_TOKENS + 21] = True
        self.single = rng.exponential(size=2 * N_TOKENS)
        self.pairs = np.array([rng.choice(2 * N_TOKENS, size=2, replace=False) for _ in range(60)])
        self.double = rng.exponential(size=60)
        self.double *= self.single.sum() / self.double.sum()
        self.single *= not only
        self.optimum = float(self.single.sum() + self.double.sum())

    def __call__(self, source: np.ndarray, target: np.ndarray) -> float:
        right = np.concatenate([source, target]) == self.hidden
        return float(self.single @ right + self.double @ right[self.pairs].all(axis=1))


class Interactions:
    """
    Tokens, and pairs of them that are worth more or less together. The optimum is the best of 30 local ones, found by
    changing one token at a time.

    :param seed: Seed of the values
    :param strength: Deviation of the pairs' values
    """

    def __init__(self, seed: int, strength: float) -> None:
        rng = np.random.default_rng(seed)
        self.weights = Tokens(seed).weights.ravel()
        self.pairs = np.array([rng.choice(2 * N_TOKENS, 2, replace=False) for _ in range(80)])
        self.together = rng.normal(0, strength, 80) * 0.8 ** ((self.pairs % N_TOKENS // 3).max(axis=1) / 2)
        self.optimum = max(self._climb(rng.random(2 * N_TOKENS) < 0.5) for _ in range(30))

    def _climb(self, chosen: np.ndarray) -> float:
        chosen[0] = True  # s_t: valid and canonical
        reached = self._value(chosen)
        while True:
            neighbours = [np.where(np.arange(len(chosen)) == i, ~chosen, chosen) for i in range(1, len(chosen))]
            best = max(neighbours, key=self._value)
            if self._value(best) <= reached:
                return reached
            chosen, reached = best, self._value(best)

    def _value(self, chosen: np.ndarray) -> float:
        return float(self.weights @ chosen + self.together @ chosen[self.pairs].all(axis=1))

    def __call__(self, source: np.ndarray, target: np.ndarray) -> float:
        return self._value(np.concatenate([source, target]))


class Shape:
    """What matters is the horizon and the shares of each kind of token, whichever they are."""

    optimum = 5.0

    def __call__(self, source: np.ndarray, target: np.ndarray) -> float:
        horizon = max(1, -(-int(np.flatnonzero(source | target)[-1]) // 3))
        value = 2.0 * target[::3].sum() / (horizon + 1) - 1.0 * (source[::3].sum() - 1) / horizon
        value += 1.5 * source[1::3].sum() / horizon - 1.0 * target[1::3].sum() / horizon
        value += 1.5 * (1 - target[2::3].sum() / horizon)
        return float(value - 0.3 * abs(horizon - 5))


class Product:
    """A product of how complete the source is, how complete the target is, and how little else there is."""

    optimum = 1.0

    def __init__(self) -> None:
        self.source, self.target = _masks(
            AuxLoss.parse("{s_t, a_t, a_t+1, a_t+2, a_t+3, r_t+1, s_t+2} -> {s_t+1, s_t+3, s_t+4, r_t+3}")
        )

    def __call__(self, source: np.ndarray, target: np.ndarray) -> float:
        surplus = (source & ~self.source).sum() + (target & ~self.target).sum()
        needed = (0.2 + 0.8 * source[self.source].mean()) * (0.2 + 0.8 * target[self.target].mean())
        return float(needed * 0.95**surplus)


OBJECTIVES: dict[str, Callable[[], Objective]] = {
    "tokens": Tokens,
    "patterns": Patterns,
    "pairs": Pairs,
    "shape": Shape,
    "product": Product,
}
MORE: dict[str, Callable[[], Objective]] = {
    "tokens 7": lambda: Tokens(7),
    "tokens 8": lambda: Tokens(8),
    "tokens 9": lambda: Tokens(9, spread=1.0, by_kind=False, decay=1.0),
    "pairs 11": lambda: Pairs(11),
    "pairs 12": lambda: Pairs(12, only=True),
    "together 13": lambda: Interactions(13, 0.5),
    "together 14": lambda: Interactions(14, 1.0),
}
NOISE = {"tokens 7": 2.0, "tokens 8": 0.5, "together 14": 2.0}


def _masks(loss: AuxLoss) -> tuple[np.ndarray, np.ndarray]:
    """Both masks of the canonical form, as long as the longest horizon needs."""
    loss = loss.canonical()
    masks = np.zeros((2, N_TOKENS), dtype=bool)
    masks[:, : len(loss.source)] = loss.source, loss.target
    return masks[0], masks[1]


def run(cell: tuple[str, str, int, int]) -> dict[str, float | int | str]:
    """One search; the true value of the best of its top five, normalised."""
    objective_name, sampler_name, seed, n_evaluations = cell
    started = time.process_time()
    objective = {**OBJECTIVES, **MORE}[objective_name]()
    rng = np.random.default_rng(0)
    at_random = [objective(*_masks(random_loss(rng))) for _ in range(5000)]
    mean, deviation = float(np.mean(at_random)), float(np.std(at_random))

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(direction="maximize", sampler=SAMPLERS[sampler_name](seed))
    noise = np.random.default_rng([seed, 1])
    scores: dict[AuxLoss, tuple[float, float]] = {}
    n_done = n_invalid = 0
    while n_done < n_evaluations:
        trial = study.ask()
        try:
            loss = suggest_aux_loss(trial).canonical()
        except optuna.TrialPruned:
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            n_invalid += 1
            continue
        value = objective(*_masks(loss))
        score = value + NOISE.get(objective_name, 1.0) * deviation * noise.standard_normal()
        study.tell(trial, score)
        scores[loss] = max(scores.get(loss, (-np.inf, value)), (score, value))
        n_done += 1
    top_five = sorted(scores.values(), reverse=True)[:5]
    best = (max(value for _, value in top_five) - mean) / (objective.optimum - mean)
    seconds = time.process_time() - started
    key: dict[str, float | int | str] = {"objective": objective_name, "sampler": sampler_name, "seed": seed}
    return {**key, "best": best, "different": len(scores), "invalid": n_invalid, "seconds": round(seconds, 2)}


def run_emulated(cell: tuple[str, int]) -> dict[str, float | int | str]:
    """One search on one landscape, and the race between its best."""
    name, seed = cell
    started = time.process_time()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    emulator, noise = Emulator(seed), np.random.default_rng([seed, 1])
    sampler = EMULATED[name](seed, emulator.given)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    if not isinstance(sampler, AuxLossSampler):
        for loss in emulator.given:
            study.enqueue_trial(loss_to_params(loss))
    runs: list[tuple[AuxLoss, float]] = []
    while len(runs) < SEARCH_RUNS:
        trial = study.ask()
        try:
            loss = suggest_aux_loss(trial).canonical()
        except optuna.TrialPruned:
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            continue
        runs.append((loss, emulator(loss) + NOISE_OF_A_RUN * noise.standard_normal()))
        study.tell(trial, runs[-1][1])
    model = TokenModel(MAX_HORIZON)
    model.add([loss for loss, _ in runs], [score for _, score in runs])
    finalists = sorted({loss for loss, _ in runs}, key=lambda loss: (-model.rating(loss), str(loss)))[:FINALISTS]
    scores = np.full((FINALISTS, RACE_RUNS), np.nan)
    while missing := next_runs(scores, RACE_RUNS):
        for row, column in missing:
            scores[row, column] = emulator(finalists[row]) + NOISE_OF_A_RUN * noise.standard_normal()
    values = [emulator(loss) - emulator.best_given for loss in finalists]
    chosen = values[int(np.argmax(standings(scores).mean))]
    seconds = time.process_time() - started
    found = {"chosen": chosen, "best finalist": max(values), "different": len(model.scores), "seconds": round(seconds, 2)}
    return {"sampler": name, "landscape": seed, **found}


def report_emulated(cells: list[dict]) -> dict:
    """Print mean and standard error of what each sampler chose, and the paired p of ours against each."""
    values = {name: {cell["landscape"]: cell["chosen"] for cell in cells if cell["sampler"] == name} for name in EMULATED}
    table: dict = {}
    print(f"{'':12} {'n':>3} {'above':>6} {'s.e.':>5} {'ours above it':>14} {'p':>8}")
    for name, chosen in values.items():
        if len(chosen) < 2:
            continue
        both = sorted(chosen.keys() & values["ours"].keys())
        differences = [values["ours"][at] - chosen[at] for at in both]
        row = {"n": len(chosen), "mean": float(np.mean(list(chosen.values())))}
        row |= {"error": float(np.std(list(chosen.values()), ddof=1) / np.sqrt(len(chosen)))}
        row |= {"difference": float(np.mean(differences)) if both else np.nan}
        row |= {"p": float(ttest_rel([values["ours"][at] for at in both], [chosen[at] for at in both]).pvalue)}
        table[name] = row
        print(f"{name:12} {row['n']:3} {row['mean']:6.1f} {row['error']:5.1f} {row['difference']:14.1f} {row['p']:8.2g}")
    return table


def report(cells: list[dict]) -> dict:
    """Print means and deviations, and Mann-Whitney's two-sided p for every pair; also over all objectives at once."""
    tables: dict = {}
    for objective in [*OBJECTIVES, *MORE, "all"]:
        found = [cell for cell in cells if objective in ("all", cell["objective"])]
        values = {name: [cell["best"] for cell in found if cell["sampler"] == name] for name in SAMPLERS}
        values = {name: those for name, those in values.items() if those}
        if not values:
            continue
        print(f"\n{objective:11} {'n':>3} {'mean':>7} {'dev.':>6}   p against " + " ".join(f"{name:>9}" for name in values))
        tables[objective] = {}
        for name, those in values.items():
            p = {other: float(mannwhitneyu(those, values[other]).pvalue) for other in values if other != name}
            row = {"n": len(those), "mean": float(np.mean(those)), "deviation": float(np.std(those)), "p": p}
            tables[objective][name] = row
            marks = " ".join(f"{p[other]:9.2g}" if other in p else f"{'-':>9}" for other in values)
            print(f"{name:10} {row['n']:4} {row['mean']:7.3f} {row['deviation']:6.3f}   {'':9} {marks}")
    return tables


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--emulated", action="store_true", help="landscapes like that of a real search")
    parser.add_argument("--evaluations", type=int, default=500)
    parser.add_argument("--seeds", type=int, default=20, help="or landscapes")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--objectives", nargs="+", default=list(OBJECTIVES), choices={**OBJECTIVES, **MORE})
    parser.add_argument("--samplers", nargs="+", choices={**SAMPLERS, **EMULATED})
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, help="JSON with all cells; what it has already is not run again")
    args = parser.parse_args()

    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    settings = {"emulated": args.emulated, "evaluations": SEARCH_RUNS + RACE_RUNS if args.emulated else args.evaluations}
    names: tuple[str, ...] = ("sampler", "landscape") if args.emulated else ("objective", "sampler", "seed")
    function: Callable[[Any], dict] = run_emulated if args.emulated else run
    seeds = range(args.first, args.first + args.seeds)
    if args.emulated:
        wanted: list[tuple] = [(name, seed) for seed in seeds for name in args.samplers or EMULATED]
    else:
        samplers = args.samplers or SAMPLERS
        wanted = [(o, s, seed) for seed in seeds for s in samplers for o in args.objectives]
    done: list[dict] = []
    if args.out and args.out.exists():
        before = json.loads(args.out.read_text())
        if differs := [key for key, value in settings.items() if before.get(key, False) != value]:
            parser.error(f"{args.out} has other {', '.join(differs)}")
        done = before["cells"]
    known = {tuple(cell[name] for name in names) for cell in done}
    todo = [key if args.emulated else (*key, args.evaluations) for key in wanted if key not in known]
    # Spawned, not forked: the children of a process with threads hang now and then.
    with multiprocessing.get_context("spawn").Pool(args.processes) as pool:
        for cell in pool.imap_unordered(function, todo):
            done.append(cell)
            print(f"{len(done)}/{len(known) + len(todo)}", cell, flush=True)
            if args.out:
                args.out.parent.mkdir(parents=True, exist_ok=True)
                args.out.write_text(json.dumps({**settings, "cells": done}))
    done.sort(key=lambda cell: [cell[name] for name in names])
    tables = report_emulated(done) if args.emulated else report(done)
    if args.out:
        save_result(args.out, **settings, tables=tables, cells=done)


if __name__ == "__main__":
    main()
