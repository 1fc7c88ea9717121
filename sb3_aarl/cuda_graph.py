"""A gradient step as CUDA graphs: recorded once, then launched as a whole instead of some hundred kernels one by one."""

import copy
import gc
import logging
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch as th
from torch.distributions import Distribution

logger = logging.getLogger(__name__)

# Steps that CUDA wants to see before it records: they are run as they are, and count like any other.
WARMUP_STEPS = 3


class _Recording(NamedTuple):
    graph: th.cuda.CUDAGraph
    inputs: list[th.Tensor]
    names: list[str]
    values: th.Tensor  # one for each name


class GraphedStep:
    """
    A function of tensors and flags that changes parameters in place, recorded as one CUDA graph for each combination of
    flags and shapes. Where it cannot be recorded one line of log says why, and it runs as it is from then on.

    :param step: From nested tuples and dicts of tensors, None, and flags, to scalars of one dtype by name, at least one. It
        must not wait for the GPU
    :param device: The CUDA device of all tensors
    """

    def __init__(self, step: Callable[..., dict[str, th.Tensor]], device: th.device):
        self.step = step
        self.device = device
        self.recordings: dict[Hashable, _Recording] = {}
        self.seen: Counter[Hashable] = Counter()
        self.stream = th.cuda.Stream(device)
        self.works = True

    def __deepcopy__(self, memo: dict[int, Any]) -> "GraphedStep":
        return GraphedStep(copy.deepcopy(self.step, memo), self.device)  # a recording belongs to the tensors it was made of

    def __call__(self, *arguments: Any) -> dict[str, th.Tensor]:
        with th.cuda.device(self.device):
            return self._run(arguments)

    def _run(self, arguments: tuple[Any, ...]) -> dict[str, th.Tensor]:
        if not self.works:
            return self.step(*arguments)
        key = _key(arguments)
        self.seen[key] += 1
        if self.seen[key] <= WARMUP_STEPS:
            self.stream.wait_stream(th.cuda.current_stream())
            with th.cuda.stream(self.stream), warnings.catch_warnings():
                # Optimizers that can be captured warn as long as they are not.
                warnings.filterwarnings("ignore", "This instance was constructed with capturable=True")
                outputs = self.step(*arguments)
            th.cuda.current_stream().wait_stream(self.stream)
            return outputs
        if key not in self.recordings:
            handled = sys.exc_info()[1]  # by whoever trains in an except clause
            try:
                self.recordings[key] = self._record(arguments)
            except RuntimeError as error:
                # What ends a recording only says that it was broken off.
                cause = error if error.__context__ in (None, handled) else error.__context__
                reason = str(cause).partition("\n")[0] or type(cause).__name__
                logger.warning("No CUDA graph, the gradient step runs kernel by kernel: %s", reason)
                self.works = False
                self.recordings.clear()
                try:
                    return self.step(*arguments)
                except RuntimeError as consequence:
                    # Some versions of PyTorch leave their random generator in the recording that was broken off.
                    raise RuntimeError(
                        "recording a CUDA graph failed for good: train in a new process, with compile=None"
                    ) from consequence
        graph, inputs, names, values = self.recordings[key]
        th._foreach_copy_(inputs, list(_leaves(arguments)))
        graph.replay()
        # The next replay writes the values anew.
        return dict(zip(names, values.clone().unbind(), strict=True))

    def _record(self, arguments: tuple[Any, ...]) -> _Recording:
        static = _map(th.clone, arguments)
        graph = th.cuda.CUDAGraph()
        # Garbage may be the graphs of another model: collected while this one is recorded, they would break it off.
        gc.collect()
        collects = gc.isenabled()
        gc.disable()
        try:
            # The stream is set here too: PyTorch does not set it back where a recording fails.
            with unchecked_distributions(), th.cuda.stream(self.stream), th.cuda.graph(graph, stream=self.stream):
                outputs = self.step(*static)
                values = th.stack(list(outputs.values()))
        finally:
            if collects:
                gc.enable()
        return _Recording(graph, list(_leaves(static)), list(outputs), values)


@contextmanager
def unchecked_distributions() -> Iterator[None]:
    """PyTorch's distributions check their parameters, for which they wait for the GPU; a recording cannot do that."""
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def _map(function: Callable[[th.Tensor], Any], value: Any) -> Any:
    if isinstance(value, th.Tensor):
        return function(value)
    if isinstance(value, dict):
        return {key: _map(function, part) for key, part in value.items()}
    if isinstance(value, tuple):
        parts = [_map(function, part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def _leaves(value: Any) -> Iterator[th.Tensor]:
    if isinstance(value, th.Tensor):
        yield value
    elif isinstance(value, (dict, tuple)):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _leaves(part)


def _key(value: Any) -> Hashable:
    """What a recording depends on: flags, which parts are None, and shapes and types of tensors."""
    if isinstance(value, th.Tensor):
        return tuple(value.shape), value.dtype
    if isinstance(value, (dict, tuple)):
        return tuple(_key(part) for part in (value.values() if isinstance(value, dict) else value))
    return value
