"""Draw docs/images/curves.png: the class's defaults on the tasks of agent/proof, beside published agents."""

from pathlib import Path

import pandas as pd
from paper_figures import learning_curves_plot, read_curves

RESULTS = Path(__file__).parent
VARIANTS = {"sac_aux": "SACAux"}
# Means, read on 2026-11-27: of DR.Q at 50,000 and 100,000 environment steps (10 seeds; github.com/dmksjfl/DR.Q,
# results/drq.csv), and of SAC in CrossQ's code at 100,000 (2 to 10 seeds; github.com/DAVIAN-Robotics/SimbaV2,
# results/baseline/sac.csv). Both make one update a step.
PUBLISHED = {
    "cheetah-run": ((464, 638), 178),
    "walker-walk": ((771, 936), 449),
    "reacher-hard": ((287, 923), 602),
    "finger-spin": ((487, 819), 475),
    "quadruped-run": ((440, 845), 74),
    "hopper-stand": ((27, 347), 31),
    "HalfCheetah-v4": ((8114, 9439), 6156),
    "Walker2d-v4": ((1658, 4151), 690),
    "Hopper-v4": ((1987, 2258), 1103),
    "Ant-v4": ((2433, 3817), 747),
}


def main() -> None:
    curves = read_curves(RESULTS / "agent" / "proof" / "runs")
    curves = curves[curves["variant"].isin(VARIANTS) & curves["env"].isin(PUBLISHED)]
    curves["variant"] = pd.Categorical(curves["variant"].map(VARIANTS), list(VARIANTS.values()))
    curves["env"] = pd.Categorical(curves["env"], list(PUBLISHED))
    figure = learning_curves_plot(curves.sort_values(["env", "variant"]), columns=2, width=2.7)
    for axes in figure.axes:
        dr_q, sac = PUBLISHED[axes.get_title().partition("\n")[0]]
        axes.scatter([50_000, 100_000], dr_q, marker="_", s=120, color="black", zorder=3)
        axes.scatter([100_000], [sac], marker="x", s=40, color="black", zorder=3)
        axes.set_ylim(bottom=min(0, axes.get_ylim()[0]))
    figure.savefig(RESULTS.parent / "docs" / "images" / "curves.png", dpi=140, bbox_inches="tight")


if __name__ == "__main__":
    main()
