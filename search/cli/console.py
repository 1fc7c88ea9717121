"""What commands print: text, tables, progress."""

import contextlib
from collections.abc import Callable, Iterator
from datetime import timedelta
from typing import TYPE_CHECKING

from rich.console import Console, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    import pandas as pd

console = Console()
errors = Console(stderr=True, soft_wrap=True)
FOLDED = ("Loss", "variant")


def say(text: object, style: str | None = None) -> None:
    """Print text as it is: its brackets are no markup, and only its own lines end."""
    console.print(str(text), style=style, markup=False, soft_wrap=True, highlight=False)


@contextlib.contextmanager
def live() -> Iterator[Callable[[RenderableType, object], None]]:
    """A function that shows progress: in place on a terminal, elsewhere as one more line where the state has changed."""
    if console.is_terminal:
        with Live(console=console, refresh_per_second=2) as display:
            yield lambda shown, state: display.update(shown)
        return
    last: object = None

    def show(line: RenderableType, state: object) -> None:
        nonlocal last
        if state != last:
            last = state
            say(line)

    yield show


def time_to_go(seconds: float | None) -> str:
    """An estimate such as ``0:10:00 to go``."""
    return f"{'?' if seconds is None else timedelta(seconds=round(seconds))} to go"


def show_table(frame: "pd.DataFrame", title: str) -> None:
    """Print a table of texts as wide as it is, because numbers that are cut are wrong. Only losses are folded."""
    table = Table(title=title, title_justify="left")
    for position, column in enumerate(frame.columns):
        folds = column in FOLDED
        table.add_column(
            escape(str(column)),
            justify="left" if folds or position == 0 else "right",
            overflow="fold",
            no_wrap=not folds,
            max_width=max(40, console.width - 60) if folds else None,
        )
    for row in frame.itertuples(index=False, name=None):
        table.add_row(*map(escape, row))
    print_wide(table)


def print_wide(table: Table) -> None:
    """Print a table as wide as it is."""
    Console(width=1000).print(table)
