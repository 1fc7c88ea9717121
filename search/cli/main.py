"""The program ``aarl``. Imports that take seconds are made in the commands that need them."""

import logging
import signal
import sys
from importlib import metadata
from typing import Annotated, Any

import typer
from sb3_aarl.search.cli import matrices, results, search, train
from sb3_aarl.search.cli.console import Messages, errors
from typer.core import TyperGroup

# Extras of modules; of the others that are not always installed it is `search`.
EXTRAS = {"psycopg": "postgres", "ray": "ray", "submitit": "slurm"}


class Program(TyperGroup):
    """Ends with one line and a code: 2 for input that cannot be used, 1 for runs that failed, 130 for an interruption."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            errors.print("Interrupted. The same command resumes it, each run from its last evaluation.")
            raise typer.Exit(130) from None
        except Exception as error:
            line = explain(error)
            if line is None:
                raise
            errors.print(f"Error: {line}", style="red", markup=False, highlight=False)
            raise typer.Exit(1 if isinstance(error, (FloatingPointError, RuntimeError)) else 2) from None


def explain(error: Exception) -> str | None:
    """One line, without passwords, about an error that a user can fix; None for another one."""
    driver = error.__cause__ if type(error) is ImportError else None
    if isinstance(driver, ModuleNotFoundError):  # of a database, which Optuna's error does not name
        return explain(driver) if driver.name in EXTRAS else f"{driver}, which this database needs"
    kinds: list[type[Exception]] = [ValueError, OSError, FloatingPointError]
    problems = str(error).splitlines() if isinstance(error, ValueError) else [str(error)]
    line = "\n".join(" ".join(problem.split()) for problem in problems)
    if isinstance(error, OSError) and error.filename is not None:
        line = f"{error.filename}: {error.strerror}"
    if isinstance(error, ModuleNotFoundError):
        module = (error.name or "").partition(".")[0]
        return f"{line}: pip install 'sb3-aarl[{EXTRAS.get(module, 'search')}]'"
    if "gymnasium" in sys.modules:
        from gymnasium.error import Error

        kinds.append(Error)  # such as one about a library that renders
    if "sb3_aarl.search.execution.storage" in sys.modules:
        from optuna.exceptions import StorageInternalError
        from sb3_aarl.search.execution.driver import RunFailed
        from sb3_aarl.search.execution.storage import cause
        from sb3_aarl.search.training.provenance import hide_password
        from sqlalchemy.exc import SQLAlchemyError

        kinds += [RunFailed, StorageInternalError, SQLAlchemyError]
        line = hide_password(cause(error) if isinstance(error, StorageInternalError) else line)
    # A closed pipe, as of `| head`, is Typer's.
    return line if isinstance(error, tuple(kinds)) and not isinstance(error, BrokenPipeError) else None


app = typer.Typer(cls=Program, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
for group in (train, search, matrices, results):
    app.add_typer(group.app)


def show_version(wanted: bool) -> None:
    """Print the version, and end."""
    if wanted:
        print(metadata.version("sb3-aarl"))
        raise typer.Exit


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", callback=show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Auxiliary losses for reinforcement learning: train with one, search for better ones."""


def main() -> None:
    """Run the program. SIGTERM, with which clusters announce the end of a job, is an interruption like Ctrl-C."""
    logging.basicConfig(format="%(message)s", handlers=[Messages()])
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    app()


if __name__ == "__main__":
    main()
