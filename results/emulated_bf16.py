"""
``aarl benchmark`` for ``precision: bf16`` on a processor without instructions for bfloat16, where a gradient step (two layers
of 256 units, batches of 256) takes seven times as long as in float32, and here one and a half times.

Those instructions multiply bfloat16 numbers exactly, add up in float32 and round the sum to bfloat16. Here float32 does the
same: its products of such numbers are exact too. What is left is the order in which sums are added up, and numbers near zero
(below 1e-38), in which processors differ from each other as well. All else (what is rounded, and when) is PyTorch's own. It
tells how a training in bfloat16 learns, not what it costs. From states only: convolutions are not emulated. Run from the
repository, with the options of ``aarl benchmark``; runs say in their provenance.json that they were trained so, and those of
both programs are not compared.
"""

import sys
from pathlib import Path
from typing import Any

import optuna
import torch as th
from torch.utils._python_dispatch import TorchDispatchMode

from search.cli.main import main as cli
from search.execution.matrix import Cell
from search.studies import benchmark

PROGRAM = f"python results/{Path(__file__).name}"
PRODUCTS = {getattr(th.ops.aten, name).default for name in ("mm", "addmm", "bmm", "baddbmm")}


class EmulatedBfloat16(TorchDispatchMode):
    """Within it, matrix products of bfloat16 are computed in float32 and rounded."""

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None) -> Any:
        kwargs = kwargs or {}
        if func not in PRODUCTS or args[0].dtype != th.bfloat16:
            return func(*args, **kwargs)
        return func(*(arg.float() for arg in args), **kwargs).bfloat16()


class EmulatedBenchmark(benchmark.Benchmark):
    """A benchmark whose runs are trained within :class:`EmulatedBfloat16`."""

    def about(self, cell: Cell) -> dict[str, Any]:
        return {**super().about(cell), "program": PROGRAM}

    @property
    def trainings(self) -> dict[str, dict[str, Any]]:
        return {name: {**settings, "program": PROGRAM} for name, settings in super().trainings.items()}

    def train(self, trial: optuna.Trial, cell: Cell, folder: Path) -> float:
        with EmulatedBfloat16():
            return super().train(trial, cell, folder)


def load_benchmark(*args: Any, **kwargs: Any) -> EmulatedBenchmark:
    """``search.studies.benchmark.load_benchmark``, of files with ``precision: bf16`` and ``policy: MlpPolicy`` only."""
    loaded = load(*args, **kwargs)
    for variant, settings in loaded.hyperparameters.items():
        for name, needed in (("precision", "bf16"), ("policy", "MlpPolicy")):
            if any(values.get(name) != needed for values in settings.values()):
                raise ValueError(f"{loaded.files[variant]} does not say {name}: {needed}; aarl benchmark trains it")
    return EmulatedBenchmark(**vars(loaded))


load = benchmark.load_benchmark

if __name__ == "__main__":
    benchmark.load_benchmark = load_benchmark  # where the program looks for it
    cli.app(["benchmark", *sys.argv[1:]], prog_name=PROGRAM)
