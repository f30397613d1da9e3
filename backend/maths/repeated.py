"""The same step many times over, which a GPU of CUDA is told once.

A step of ours is a dozen small operations, and a GPU is done with each before the next is asked for. A CUDA
graph holds what a step asks for, and asks for all of it at once (benchmarks.md, "On a GPU").
"""

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

State = tuple[Tensor, ...]
Step = Callable[[State], State]


def repeated(step: Step, state: State, times: int) -> State:
    """The state after so many steps.

    A step leaves what it is given as it is, and reads nothing back to the CPU. All that differs from one step
    to the next is in the state, whose tensors keep their shapes and have no gradients.
    """
    if state[0].device.type == "cuda" and times > 1:
        return _replayed(step, state, times)
    for _ in range(times):
        state = step(state)
    return state


def _replayed(step: Step, state: State, times: int) -> State:
    aside, now = _aside(), torch.cuda.current_stream()
    aside.wait_stream(now)
    with torch.cuda.stream(aside):
        # a graph reads and writes the same memory each time; the step before it loads what steps need
        held = tuple(values.clone() for values in step(state))
        graph = torch.cuda.CUDAGraph()
        graph.capture_begin()
        try:
            _write(held, step(held))
        finally:
            graph.capture_end()
        for _ in range(times - 1):
            graph.replay()
    now.wait_stream(aside)
    return held


def _write(held: State, new: State) -> None:
    """Each in its place; what a step only moves to another place is read before that is written over."""
    moved = [any(values is other for other in held) for values in new]
    values = [value.clone() if is_moved else value for value, is_moved in zip(new, moved, strict=True)]
    for place, value in zip(held, values, strict=True):
        place.copy_(value)


@cache
def _aside() -> torch.cuda.Stream:
    """Graphs are not taken of the stream that all else runs on."""
    return torch.cuda.Stream()  # type: ignore[no-untyped-call]
