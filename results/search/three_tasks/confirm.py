"""
Whether one loss is better than others over all tasks and seeds: ``python results/search/three_tasks/confirm.py RUNS LOSS``.

RUNS has a folder LOSS/TASK/seed-N for each run. Of a run the mean return of its evaluations counts, as a share of DR.Q's
return at 100,000 environment steps. Of each other loss it prints the difference of the mean shares, its two-sided p when
runs are exchanged within each task, and the difference that a test at 0.05 would have seen with a probability of 0.8.
"""

import sys
from pathlib import Path
from statistics import fmean

import numpy as np
from scipy.stats import norm

from sb3_aarl.callbacks import read_curve

# DR.Q's returns at 100,000 environment steps, ten seeds (results/drq.csv of its code).
REFERENCE = {
    "ball_in_cup-catch": 962,
    "cheetah-run": 638,
    "finger-spin": 819,
    "hopper-stand": 347,
    "quadruped-run": 845,
    "quadruped-walk": 920,
    "reacher-hard": 923,
    "walker-run": 610,
    "walker-walk": 936,
}
PERMUTATIONS = 99_999


def shares(folder: Path) -> dict[str, list[float]]:
    """The shares of a loss's runs by task."""
    found: dict[str, list[float]] = {}
    for path in sorted(folder.glob("*/seed-*/curve.csv")):
        task = path.parent.parent.name
        found.setdefault(task, []).append(fmean(point.mean for point in read_curve(path)) / REFERENCE[task])
    return found


def compare(ours: dict[str, list[float]], others: dict[str, list[float]]) -> tuple[float, float, float]:
    """Difference of the means over tasks, its p, and what would have been seen with a probability of 0.8."""
    pairs = [(np.array(ours[task]), np.array(others[task])) for task in ours]
    rng = np.random.default_rng(0)
    difference, exchanged, variance = 0.0, np.zeros(PERMUTATIONS), 0.0
    for first, second in pairs:
        difference += (first.mean() - second.mean()) / len(pairs)
        mixed = rng.permuted(np.tile(np.concatenate([first, second]), (PERMUTATIONS, 1)), axis=1)
        exchanged += (mixed[:, : len(first)].mean(axis=1) - mixed[:, len(first) :].mean(axis=1)) / len(pairs)
        variance += (first.var(ddof=1) / len(first) + second.var(ddof=1) / len(second)) / len(pairs) ** 2
    p = (1 + np.sum(np.abs(exchanged) >= abs(difference) - 1e-12)) / (1 + PERMUTATIONS)
    return difference, float(p), float((norm.ppf(0.975) + norm.ppf(0.8)) * np.sqrt(variance))


def main(runs: str, loss: str) -> None:
    ours = shares(Path(runs) / loss)
    for folder in sorted(path for path in Path(runs).iterdir() if path.name != loss):
        others = shares(folder)
        gains = [f"{task} {np.mean(ours[task]) - np.mean(others[task]):+.2f}" for task in ours]
        difference, p, visible = compare(ours, others)
        print(f"{loss} - {folder.name}: {difference:+.3f}, p {p:.3g}, visible {visible:.3f} ({', '.join(gains)})")


if __name__ == "__main__":
    main(*sys.argv[1:])
