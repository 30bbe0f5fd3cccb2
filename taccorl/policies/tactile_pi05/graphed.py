"""A chunk of actions as one CUDA graph: the same kernels as in eager mode, started by one call instead of some ten thousand.

π0.5 at batch 1 keeps a GPU waiting for Python. Shapes of a robot's observations never change, so everything between
observation and actions is recorded once for each shape and then replayed: prefix once, then the denoising steps, no value
read back in between. Contact is a mask in it, as in any batch where only some rows have it.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

_WARM_UP_RUNS = 2  # libraries choose their kernels and take their workspaces before anything is recorded


class KeptConstants(TorchFunctionMode):
    """Context in which ``torch.tensor`` of Python numbers returns the same tensor again instead of a new one.

    LeRobot's pi05 makes such constants (attention blocks, times) in every denoising step, and each waits for the GPU; a
    graph cannot record that. Nothing writes into them."""

    def __init__(self) -> None:
        super().__init__()
        self._kept: dict[tuple[str, str], Tensor] = {}

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        if func is not torch.tensor:
            return func(*args, **(kwargs or {}))
        key = repr(args), repr(sorted((kwargs or {}).items()))
        if key not in self._kept:
            self._kept[key] = func(*args, **(kwargs or {}))
        return self._kept[key]


class GraphedCall:
    """``compute(*tensors)`` on a GPU, recorded as a CUDA graph for each combination of shapes. Weights may be changed in place,
    but not replaced."""

    def __init__(self, compute: Callable[..., Tensor]) -> None:
        """``compute``: function of tensors that returns one tensor, copies nothing to the CPU and draws no random number."""
        self._compute = compute
        self._recorded: dict[
            Any, tuple[torch.cuda.CUDAGraph, list[Tensor], Tensor]
        ] = {}
        self._constants = KeptConstants()

    def __call__(self, *inputs: Tensor) -> Tensor:
        key = tuple((tuple(x.shape), x.dtype, x.device) for x in inputs)
        if key not in self._recorded:
            self._recorded[key] = self._record(inputs)
        graph, held, out = self._recorded[key]
        for place, given in zip(held, inputs, strict=True):
            place.copy_(given)
        graph.replay()
        return out.clone()

    def _record(
        self, inputs: tuple[Tensor, ...]
    ) -> tuple[torch.cuda.CUDAGraph, list[Tensor], Tensor]:
        held = [x.clone() for x in inputs]
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream), self._constants:
            for _ in range(_WARM_UP_RUNS):
                self._compute(*held)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with self._constants, torch.cuda.graph(graph):
            out = self._compute(*held)
        return graph, held, out
