"""What commands print: text, tables, progress."""

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import track
from rich.table import Table

if TYPE_CHECKING:
    import pandas as pd
    from sb3_aarl.search.training.folder import Run

console = Console()
errors = Console(stderr=True, soft_wrap=True)
FOLDED = ("Loss", "variant", "notation")


def say(text: object, style: str | None = None) -> None:
    """Print text as it is: its brackets are no markup, and only its own lines end."""
    console.print(str(text), style=style, markup=False, soft_wrap=True, highlight=False)


class Messages(logging.Handler):
    """Messages of loggers, on stderr: above the progress, which a handler that knows only the stream would write into."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message."""
        errors.print(self.format(record), markup=False, highlight=False)


@contextlib.contextmanager
def live() -> Iterator[Callable[[str, object], None]]:
    """
    A function that shows progress, on stderr: in place on a terminal; elsewhere, as in a job's log, as one more line with the
    time where the state has changed.
    """
    if errors.is_terminal:
        with Live(console=errors, refresh_per_second=2) as display:
            # What is longer than the terminal is wide would be cut.
            yield lambda line, state: display.update(line.replace("; ", "\n"))
        return
    last_state: object = None

    def show(line: str, state: object) -> None:
        nonlocal last_state
        if state != last_state:
            last_state = state
            errors.print(f"{datetime.now():%H:%M:%S} {line}", markup=False, highlight=False)

    yield show


def time_to_go(seconds: float | None) -> str:
    """An estimate such as ``0:10:00 to go``."""
    if seconds == 0:
        return "finished"
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
    Console(width=1000).print(table)


def show_costs(kinds: "Mapping[str, Sequence[Run]]", workers: int) -> None:
    """Measure one run of each kind, and show what all of them would cost."""
    from sb3_aarl.search.training.setup import measure

    table, n_all, hours_of_all = Table("", "runs", "hours of each", "core hours"), 0, 0.0
    for name, runs in track(kinds.items(), "Measuring", console=errors, transient=True):
        hours = measure(runs[0])
        n_all, hours_of_all = n_all + len(runs), hours_of_all + len(runs) * hours
        table.add_row(name, str(len(runs)), f"{hours:.2g}", f"{len(runs) * hours * runs[0].threads:.2g}")
    console.print(table)
    at_once = max(1, min(workers, n_all))
    say(f"All: {n_all} runs, {hours_of_all / at_once:.2g} hours with {workers} at once, beside evaluations. Nothing started.")
