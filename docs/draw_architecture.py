"""Draw docs/images/architecture.png: what SACAux is made of, and which loss trains which part."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

# What is drawn at a point: its name, its class, its colour. Losses are bold.
BOXES = {
    "window": (1.05, 3.1, "states, actions,\nrewards", "WindowReplayBuffer", "#eeeeee"),
    "encoder": (3.7, 3.1, "encoder", "SimbaEncoder, ...", "#cfe3f7"),
    "momentum": (3.7, 0.7, "momentum\nencoder", "in critic_target", "#e4eef8"),
    "actor": (6.6, 4.7, "actor", "Actor, DetachedEncoder", "#fbe3c6"),
    "critic": (6.6, 3.1, "Q networks", "Critic", "#cfe3f7"),
    "predictor": (6.6, 1.5, "predictor", "AuxHead", "#d5ecd2"),
    "actor_loss": (9.4, 4.7, "actor loss", "", "#ffffff"),
    "critic_loss": (9.4, 3.1, "critic loss", "", "#ffffff"),
    "aux_loss": (9.4, 1.5, "auxiliary loss", "AuxLoss", "#ffffff"),
}
WIDTH, HEIGHT = 2.0, 1.05
GRADIENT, NO_GRADIENT = "#1f5f9f", "#888888"


def box(axes: Axes, x: float, y: float, name: str, class_name: str, colour: str) -> None:
    corner = (x - WIDTH / 2, y - HEIGHT / 2)
    axes.add_patch(FancyBboxPatch(corner, WIDTH, HEIGHT, "round,pad=0.02,rounding_size=0.12", fc=colour, ec="#444444"))
    weight = "bold" if name.endswith("loss") else "normal"
    axes.text(x, y + 0.18 * bool(class_name), name, ha="center", va="center", fontsize=13, weight=weight)
    axes.text(x, y - 0.36, class_name, ha="center", va="center", fontsize=8.5, family="monospace", color="#444444")


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], gradient: bool, bend: float = 0) -> None:
    style = {
        "arrowstyle": "-|>",
        "mutation_scale": 18,
        "linewidth": 2,
        "color": GRADIENT if gradient else NO_GRADIENT,
        "linestyle": "-" if gradient else (0, (4, 2)),
        "connectionstyle": f"arc3,rad={bend}",
        "shrinkA": 0,
        "shrinkB": 0,
    }
    axes.annotate("", end, start, arrowprops=style)


def side(name: str, where: str) -> tuple[float, float]:
    """The middle of a side of a box."""
    x, y = BOXES[name][:2]
    dx, dy = {"left": (-1, 0), "right": (1, 0), "top": (0, 1), "bottom": (0, -1)}[where]
    return x + dx * (WIDTH / 2 + 0.05), y + dy * (HEIGHT / 2 + 0.05)


def main() -> None:
    figure = Figure(figsize=(10.4, 5.4))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-0.1, 10.55), ylim=(-0.75, 5.4))
    axes.axis("off")
    for values in BOXES.values():
        box(axes, *values)
    arrow(axes, side("window", "right"), side("encoder", "left"), gradient=False)
    arrow(axes, side("window", "bottom"), side("momentum", "left"), gradient=False, bend=0.25)
    arrow(axes, side("encoder", "top"), side("actor", "left"), gradient=False, bend=-0.25)
    arrow(axes, side("encoder", "right"), side("critic", "left"), gradient=True)
    arrow(axes, (side("encoder", "right")[0], 2.8), side("predictor", "left"), gradient=True)
    arrow(axes, side("momentum", "right"), side("aux_loss", "bottom"), gradient=False, bend=0.2)
    arrow(axes, side("encoder", "bottom"), side("momentum", "top"), gradient=False)
    for name in ("actor", "critic", "predictor"):
        arrow(axes, side(name, "right"), side(f"{'aux' if name == 'predictor' else name}_loss", "left"), gradient=True)
    note = {"fontsize": 11, "color": "#444444", "va": "center"}
    axes.text(3.62, 1.87, "follows slowly", ha="right", **note)
    axes.text(4.05, 4.78, "detached", ha="center", **note)
    axes.text(7.2, 0.02, "target", ha="center", **note)
    for x, gradient, text in ((1.2, True, "gradient flows back"), (5.6, False, "no gradient")):
        arrow(axes, (x, -0.5), (x + 0.9, -0.5), gradient)
        axes.text(x + 1.05, -0.5, text, **note)
    figure.savefig(Path(__file__).parent / "images" / "architecture.png", dpi=110)


if __name__ == "__main__":
    main()
