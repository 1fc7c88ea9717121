"""Draw docs/images/curves.png, README's picture, from the runs that lie beside it: SACAux and SAC with the same sizes."""

from pathlib import Path

import pandas as pd

from search.results.plots import learning_curves_plot
from search.studies.benchmark import read_curves

RESULTS = Path(__file__).parent
# What the picture calls each variant, and the folder that it is in.
VARIANTS = {
    "aarl_state_small": ("SACAux, AARL-State", "choices_small"),
    "sac_dense_mlp_small": ("the same without auxiliary loss", "choices_small"),
    "sac_identity_small": ("SAC on the states", "choices_small"),
}


def main() -> None:
    curves = pd.concat(read_curves(RESULTS / folder) for folder in {folder for _, folder in VARIANTS.values()})
    curves = curves[curves["variant"].isin(VARIANTS)]
    curves["variant"] = curves["variant"].map({variant: name for variant, (name, _) in VARIANTS.items()})
    figure = learning_curves_plot(curves)
    figure.savefig(RESULTS.parent / "docs" / "images" / "curves.png", dpi=110, bbox_inches="tight")


if __name__ == "__main__":
    main()
