"""Draw picture.png, and print the last row of each run, out of looks.jsonl."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

HERE = Path(__file__).parent
PANELS = {
    "ret": "return",
    "q_bias": "Q minus discounted return",
    "dead_q": "dead units of the Q heads",
    "rank": "effective rank",
}


def read_runs() -> dict[tuple[str, str], list[dict[str, Any]]]:
    """The rows of each run, by task and variant."""
    runs: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for line in (HERE / "looks.jsonl").read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        runs[row["task"], row["variant"]].append(row)
    return runs


def main() -> None:
    runs = read_runs()
    tasks = ("quadruped-run", "Walker2d-v4")
    figure, axes = plt.subplots(len(tasks), len(PANELS), figsize=(16, 6), sharex="row", constrained_layout=True)
    for line, task in zip(axes, tasks, strict=True):
        for axis, (key, title) in zip(line, PANELS.items(), strict=True):
            for (of, variant), rows in runs.items():
                if of == task and variant != "crossq512":
                    points = [(row["env_steps"], row[key]) for row in rows if row.get(key) is not None]
                    axis.plot(*zip(*points, strict=True), label=variant, color="black" if variant == "base" else None)
            axis.set_title(f"{task}: {title}", fontsize=9)
        line[0].legend(fontsize=7)
    figure.savefig(HERE / "picture.png", dpi=80)
    for (task, variant), rows in sorted(runs.items()):
        last = rows[-1]
        best = max(row["ret"] for row in rows)
        print(f"| {task} | {variant} | {last['env_steps']:,} | {last['ret']:.0f} | {best:.0f} | {last['q_bias']:.0f} |")


if __name__ == "__main__":
    main()
