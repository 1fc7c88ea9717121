"""The program ``aarl`` as a process of its own."""

import os
import signal
import subprocess
import sys
from pathlib import Path


def start(*arguments: object, folder: Path) -> subprocess.Popen[str]:
    """The program, in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "sb3_aarl.search.cli.main", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent), "COLUMNS": "200"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        # Tests in the background (nohup, CI) may ignore Ctrl-C, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def aarl(*arguments: object, folder: Path) -> str:
    """Run the program to its end, which must be a good one."""
    process = start(*arguments, folder=folder)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    return output
