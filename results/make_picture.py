"""Draw docs/images/curves.png from the runs in this folder: SACAux's former defaults and SAC with the same sizes."""

from pathlib import Path

import pandas as pd
from paper_figures import learning_curves_plot, read_curves

RESULTS = Path(__file__).parent
FOLDERS = ("agent/tasks/runs", "paper/small/runs")
# What the picture calls each variant.
VARIANTS = {
    "forward_simba": "SACAux, its former defaults",
    "aarl_state_small": "SACAux, the paper's loss and encoder",
    "aarl_state_small_repeat_2": "SACAux, the paper's loss and encoder",
    "sac_states": "SAC",
    "sac_starts_5000": "SAC",
}
# Means of 10 seeds at 100,000 environment steps: result files of github.com/dmksjfl/DR.Q, and for MR.Q its own, read on
# 2026-11-23. DeepMind Control has action repeat 2 there, Gymnasium's tasks are v4.
PUBLISHED = {
    "cheetah-run": {"MR.Q": 648, "SimbaV2": 642, "DR.Q": 638},
    "HalfCheetah-v5": {"DR.Q": 9439, "SimbaV2": 7328},
    "Hopper-v5": {"SimbaV2": 2821, "DR.Q": 2258},
    "walker-walk": {"SimbaV2": 962, "DR.Q": 936},
}


def main() -> None:
    curves = pd.concat(read_curves(RESULTS / folder) for folder in FOLDERS)
    curves = curves[curves["variant"].isin(VARIANTS) & curves["env"].isin(PUBLISHED)].drop_duplicates()  # linked runs
    curves = curves[(curves["env"] != "walker-walk") | (curves["variant"] != "aarl_state_small")]  # action repeat 4 there
    curves["variant"] = pd.Categorical(curves["variant"].map(VARIANTS), list(dict.fromkeys(VARIANTS.values())))
    figure = learning_curves_plot(curves.sort_values(["env", "variant"]), columns=2, width=2.7)
    for axes in figure.axes:
        returns = PUBLISHED[axes.get_title().partition("\n")[0]]
        axes.scatter([100_000] * len(returns), list(returns.values()), marker="_", s=120, color="black", zorder=3)
        names = ", ".join(f"{name} {value:,}" for name, value in returns.items())
        axes.set_title(f"{axes.get_title()}\n— {names}", fontsize=9)
    figure.savefig(RESULTS.parent / "docs" / "images" / "curves.png", dpi=140, bbox_inches="tight")


if __name__ == "__main__":
    main()
