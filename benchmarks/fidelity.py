"""
How well do short runs rank losses? From the runs of a search whose candidates have several seeds.

python benchmarks/fidelity.py runs/fidelity
"""

import argparse
import itertools
import json
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from sb3_aarl.callbacks import read_curve


def returns(folder: Path) -> pd.DataFrame:
    """
    The returns of the finished runs: one row for each loss and seed, one column for each checkpoint.

    :param folder: Folder of the search, or a copy of its ``candidates`` with ``run.json`` and ``curve.csv``
    """
    rows = {}
    for path in sorted(folder.rglob("run.json")):
        run = json.loads(path.read_text(encoding="utf-8"))
        curve = read_curve(path.with_name("curve.csv")) if path.with_name("curve.csv").exists() else []
        if len(curve) == len(run["checkpoints"]):
            rows[run["aux_loss"], run["seed"]] = {point.environment_steps: point.mean for point in curve}
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis(["loss", "seed"])


def study(scores: pd.DataFrame) -> pd.DataFrame:
    """
    For runs that end at each checkpoint: Spearman's correlation of one seed's AULC with the whole run of the same seed and
    with that of another one, and the deviations of the AULC between losses and between seeds of a loss.
    """
    seeds = [by_seed.droplevel("seed") for _, by_seed in scores.groupby("seed")]
    common = seeds[0].index
    for seed in seeds[1:]:
        common = common.intersection(seed.index)
    seeds = [seed.loc[common] for seed in seeds]
    last, rows = scores.columns[-1], {}
    for i, steps in enumerate(scores.columns, 1):
        short = np.array([seed.iloc[:, :i].mean(axis=1) for seed in seeds])
        targets = {"AULC": [seed.mean(axis=1) for seed in seeds], "return": [seed[last] for seed in seeds]}
        row = {"runs end at": f"{steps:,}"}
        for name, values in targets.items():
            pairs = itertools.permutations(range(len(seeds)), 2)
            row[f"{name}, same seed"] = np.mean([spearmanr(a, b).statistic for a, b in zip(short, values, strict=True)])
            row[f"{name}, other seed"] = np.mean([spearmanr(short[i], values[j]).statistic for i, j in pairs])
        noise = short.var(axis=0, ddof=1).mean()
        # The variance of the losses' means has a share of the noise in it.
        row["between losses"] = np.sqrt(max(0.0, short.mean(axis=0).var(ddof=1) - noise / len(seeds)))
        row["between seeds"] = np.sqrt(noise)
        rows[i] = row
    table = pd.DataFrame.from_dict(rows, orient="index").set_index("runs end at")
    table.attrs["losses"] = len(common)
    return table


def report(folder: Path) -> str:
    """What is printed of a search."""
    scores = returns(folder)
    table = study(scores)
    by_seed = scores.mean(axis=1).unstack("seed")
    lines = [
        f"{table.attrs['losses']} losses, seeds {sorted(set(scores.index.get_level_values('seed')))}",
        table.round(2).to_string(),
        by_seed.assign(mean=by_seed.mean(axis=1)).sort_values("mean").round(0).to_string(),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    print(report(parser.parse_args().folder))
