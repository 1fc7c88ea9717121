"""Draw docs/images/curves.png: the class's defaults (agent/proof) on all tasks that they were run on, beside published agents."""

from pathlib import Path

import pandas as pd
from paper_figures import learning_curves_plot, read_curves

RESULTS = Path(__file__).parent
VARIANTS = {"sac_aux": "SACAux", "no_loss": "SACAux without a loss", "sac": "SB3's SAC"}
# Means of 10 seeds at 50,000 and 100,000 environment steps, read on 2026-11-27. DR.Q: github.com/dmksjfl/DR.Q, results/drq.csv. SAC:
# on DeepMind Control SimBa's (github.com/SonyResearch/simba, results/sac.csv), on Gymnasium's tasks CrossQ's
# (github.com/DAVIAN-Robotics/SimbaV2, results/baseline/sac.csv).
PUBLISHED = {
    "cheetah-run": {"DR.Q": (464, 638), "SAC": (179, 329)},
    "walker-walk": {"DR.Q": (771, 936), "SAC": (341, 783)},
    "reacher-hard": {"DR.Q": (287, 923), "SAC": (252, 605)},
    "finger-spin": {"DR.Q": (487, 819), "SAC": (399, 614)},
    "quadruped-run": {"DR.Q": (440, 845), "SAC": (89, 103)},
    "hopper-stand": {"DR.Q": (27, 347), "SAC": (4, 56)},
    "HalfCheetah-v4": {"DR.Q": (8114, 9439), "SAC": (4212, 6156)},
    "Walker2d-v4": {"DR.Q": (1658, 4151), "SAC": (384, 690)},
    "Hopper-v4": {"DR.Q": (1987, 2258), "SAC": (530, 1103)},
    "Ant-v4": {"DR.Q": (2433, 3817), "SAC": (448, 747)},
}


def main() -> None:
    curves = read_curves(RESULTS / "agent" / "proof" / "runs")
    ours = curves.loc[curves["variant"] == "sac_aux", "env"]
    curves = curves[curves["variant"].isin(VARIANTS) & curves["env"].isin(set(ours) & PUBLISHED.keys())]
    curves["variant"] = pd.Categorical(curves["variant"].map(VARIANTS), list(VARIANTS.values()))
    curves["env"] = pd.Categorical(curves["env"], list(PUBLISHED))
    figure = learning_curves_plot(curves.sort_values(["env", "variant"]), columns=2, width=2.7)
    for axes in figure.axes:
        published = PUBLISHED[axes.get_title().partition("\n")[0]]
        for agent, symbol in zip(("DR.Q", "SAC"), ("_", "x"), strict=True):
            axes.scatter([50_000, 100_000], published[agent], marker=symbol, s=90, color="black", zorder=3)
        axes.set_ylim(bottom=min(0, axes.get_ylim()[0]))
    figure.savefig(RESULTS.parent / "docs" / "images" / "curves.png", dpi=140, bbox_inches="tight")


if __name__ == "__main__":
    main()
