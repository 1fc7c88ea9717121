"""The defaults beside DR.Q and MR.Q: returns of each task, their shares, and how many runs keep what they had."""

import statistics
from pathlib import Path

from sb3_aarl.callbacks import read_curve

RUNS = Path(__file__).parent / "runs" / "sac_aux"
# Means at 100,000 environment steps, from their published result files.
PUBLISHED = {
    "cheetah-run": (638, 648),
    "walker-walk": (936, 891),
    "reacher-hard": (923, 806),
    "finger-spin": (819, 733),
    "hopper-stand": (347, 177),
    "quadruped-run": (845, 613),
    "HalfCheetah-v4": (9439, 7872),
    "Hopper-v4": (2258, 2249),
    "Walker2d-v4": (4151, 3127),
    "Ant-v4": (3817, 2801),
}


def main() -> None:
    shares, kept = [], []
    print(
        "| task | seeds | returns at 10,000 to 100,000 environment steps, mean | last | of DR.Q | of MR.Q | kept |\n"
        + "|---" * 7
        + "|"
    )
    for task, anchors in PUBLISHED.items():
        curves = [[point.mean for point in read_curve(path)] for path in sorted((RUNS / task).glob("seed-*/curve.csv"))]
        means = [statistics.mean(values) for values in zip(*curves, strict=True)]
        deviation = f" ± {statistics.stdev(curve[-1] for curve in curves):,.0f}" if len(curves) > 1 else ""
        ratios = [statistics.mean(curve[-2:]) / max(curve[:-2]) for curve in curves]
        shares.append([means[-1] / anchor for anchor in anchors])
        kept += ratios
        returns = ", ".join(f"{mean:,.0f}" for mean in means)
        cells = [task, len(curves), returns, f"{means[-1]:,.0f}{deviation}"]
        cells += [f"{shares[-1][0]:.2f}", f"{shares[-1][1]:.2f}", ", ".join(f"{ratio:.2f}" for ratio in ratios)]
        print(f"| {' | '.join(map(str, cells))} |")
    for name, of_tasks in zip(("DR.Q", "MR.Q"), zip(*shares, strict=True), strict=True):
        print(f"\nshare of {name}: mean {statistics.mean(of_tasks):.2f}, median {statistics.median(of_tasks):.2f}", end="")
    print(f"; kept at least 0.8: {sum(ratio >= 0.8 for ratio in kept)} of {len(kept)} runs")


if __name__ == "__main__":
    main()
