"""By task: how much losses differ beside their seeds (F), in the mean return up to each quarter; two losses beside a third."""

from pathlib import Path

import numpy as np
from scipy.stats import ttest_1samp

from sb3_aarl.callbacks import read_curve

RUNS = Path(__file__).parent / "runs"


def main() -> None:
    returns: dict[str, dict[str, dict[str, list[float]]]] = {}
    for path in sorted(RUNS.glob("*/*/seed-*/curve.csv")):
        loss, task, seed = path.parent.parts[-3:]
        returns.setdefault(task, {}).setdefault(loss, {})[seed] = [evaluation.mean for evaluation in read_curve(path)]
    for task, found in returns.items():
        of_losses = {loss: seeds for loss, seeds in found.items() if len(seeds) == 2}  # the others are not finished
        values = np.array([list(of_seeds.values()) for of_seeds in of_losses.values()])  # losses, seeds, evaluations
        means = values.cumsum(axis=2) / np.arange(1, values.shape[2] + 1)
        fractions = 2 * means.mean(axis=1).var(axis=0, ddof=1) / means.var(axis=1, ddof=1).mean(axis=0)
        print(task, "F at each quarter:", np.round(fractions, 2), dict(zip(of_losses, np.round(means[:, :, -1]), strict=True)))
    for loss in ("aarl_state", "no_loss"):
        ratios = [np.mean(list(of[loss].values())) / np.mean(list(of["forward"].values())) for of in returns.values()]
        print(loss, "/ forward, by task:", np.round(ratios, 2), "p", round(float(ttest_1samp(ratios, 1).pvalue), 3))


if __name__ == "__main__":
    main()
