"""Draw docs/images/architecture.png: what SACAux is made of by default, and which loss trains which part."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

# What is drawn at a point: its name, what is known of it (of the three lowest the class), its width and its colour.
BOXES = {
    "actor_loss": (1.05, 5.85, "actor loss", "each third step", 1.8, "#ffffff"),
    "critic_loss": (3.05, 5.85, "critic loss", "1-step returns", 1.8, "#ffffff"),
    "aux_loss": (5.05, 5.85, "auxiliary loss", "AuxLoss", 1.8, "#ffffff"),
    "actor": (1.05, 4.15, "actor", "Actor", 1.8, "#fbe3c6"),
    "critic": (3.05, 4.15, "Q networks", "Critic: batch norm", 1.8, "#cfe3f7"),
    "predictor": (5.05, 4.15, "predictor", "AuxHead", 1.8, "#d5ecd2"),
    "encoder": (2.05, 2.25, "encoder", "SimbaEncoder, PixelEncoder, ...", 3.8, "#cfe3f7"),
    "momentum": (5.05, 2.25, "momentum\nencoder", "follows slowly", 1.8, "#e4eef8"),
    "window": (3.05, 0.6, "states, actions, rewards", "WindowReplayBuffer", 5.8, "#eeeeee"),
}
HEIGHT = 1.1
GRADIENT, NO_GRADIENT = "#1f5f9f", "#888888"


def box(axes: Axes, x: float, y: float, name: str, note: str, width: float, colour: str) -> None:
    corner = (x - width / 2 + 0.05, y - HEIGHT / 2 + 0.05)
    axes.add_patch(FancyBboxPatch(corner, width - 0.1, HEIGHT - 0.1, "round,pad=0.05", fc=colour, ec="#444444"))
    weight = "bold" if name.endswith("loss") else "normal"
    axes.text(x, y + 0.17 * bool(note), name, ha="center", va="center", fontsize=15, weight=weight)
    axes.text(x, y - (0.37 if "\n" in name else 0.22), note, ha="center", va="center", fontsize=11.5, color="#444444")


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], gradient: bool = True, bend: float = 0) -> None:
    style = {
        "arrowstyle": "-|>",
        "mutation_scale": 18,
        "linewidth": 2.2,
        "color": GRADIENT if gradient else NO_GRADIENT,
        "linestyle": "-" if gradient else (0, (3, 1.5)),
        "connectionstyle": f"arc3,rad={bend}",
        "shrinkA": 0,
        "shrinkB": 0,
    }
    axes.annotate("", end, start, arrowprops=style)


def top(name: str, aside: float = 0) -> tuple[float, float]:
    return BOXES[name][0] + aside, BOXES[name][1] + HEIGHT / 2 + 0.02


def bottom(name: str, aside: float = 0) -> tuple[float, float]:
    return BOXES[name][0] + aside, BOXES[name][1] - HEIGHT / 2 - 0.02


def main() -> None:
    figure = Figure(figsize=(6.6, 7.05))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 6.6), ylim=(-0.55, 6.5))
    axes.axis("off")
    for values in BOXES.values():
        box(axes, *values)
    for name in ("actor", "critic", "predictor"):
        arrow(axes, top(name), bottom(f"{'aux' if name == 'predictor' else name}_loss"))
    arrow(axes, top("encoder", -1), bottom("actor"), gradient=False)
    arrow(axes, top("encoder", 1), bottom("critic"))
    arrow(axes, top("encoder", 1.5), bottom("predictor", -0.3))
    arrow(axes, (3.97, 2.25), (4.13, 2.25), gradient=False)
    arrow(axes, (5.97, 2.4), (5.97, 5.75), gradient=False, bend=0.22)
    arrow(axes, top("window", -1), bottom("encoder"), gradient=False)
    arrow(axes, top("window", 2), bottom("momentum"), gradient=False)
    note = {"fontsize": 13, "color": "#444444", "va": "center"}
    axes.text(0.95, 3.25, "detached", ha="right", **note)
    axes.text(5.55, 3.22, "target", ha="center", **note)
    for x, gradient, text in ((0.3, True, "gradient flows back"), (3.6, False, "no gradient")):
        arrow(axes, (x, -0.3), (x + 0.7, -0.3), gradient)
        axes.text(x + 0.8, -0.3, text, **note)
    figure.savefig(Path(__file__).parent / "images" / "architecture.png", dpi=110)


if __name__ == "__main__":
    main()
