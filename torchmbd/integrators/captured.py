"""The march on a device: steps of one kind are captured once as a graph of operations, then launched as one.

A step has some thousand operations, and each is over sooner than Python begins the next. So the operations of a step
(recorded already, repeated.py) are captured, values and tangents together. A graph reads and writes where it did when it
was captured: the state, what is prescribed, factors and numbers of corrections are copied there before it is launched. The
host asks for nothing but at a look, every `CHECK` steps.

Steps of a kind differ by numbers only (march.Kind). The first of a kind is done operation by operation, in the stream that
will be captured, which makes what is made once: records, handles and workspaces of libraries.
Checked in tests/integrators/test_device.py: on a stand-in for a device, and on a device where there is one.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.forces.written import writable
from torchmbd.integrators import repeated
from torchmbd.integrators.history import Record
from torchmbd.integrators.march import Kind, Made, March
from torchmbd.integrators.step import State, Weights
from torchmbd.numerics.scalars import Untraceable
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.elimination import Factored
from torchmbd.system.topology import Prescribed

Capture = Callable[[Callable[[], Any]], tuple[Any, Callable[[], None]]]


def cuda_graph(f: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
    """What f returns, without numbers yet, and what makes them whenever it is called."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=torch.cuda.current_stream()):
        found = f()
    return found, graph.replay


@cache
def side_stream(device: torch.device) -> torch.cuda.Stream:
    """Where steps are made: the default stream cannot be captured, and libraries keep workspaces for each stream."""
    return torch.cuda.Stream(device)


@contextmanager
def beside(device: torch.device) -> Iterator[None]:
    """In the side stream of a device, after what has been asked of the current one, and before what will be."""
    with torch.cuda.device(device):
        now, stream = torch.cuda.current_stream(), side_stream(device)
        stream.wait_stream(now)
        with torch.cuda.stream(stream):
            yield
        now.wait_stream(stream)


GRAPHS: dict[str, Capture] = {"cuda": cuda_graph}  # type of device -> how operations are captured


def placed_on(dynamics: Dynamics, device: torch.device) -> Dynamics:
    """The dynamics on a device. InputError where a law of a force cannot be there."""
    if device == dynamics.device:
        return dynamics
    try:
        laws = [tuple(map(writable, action.laws)) for action in dynamics.topology.actions]
    except Untraceable as error:
        raise InputError(
            f"device is '{device}', but a law of a force cannot be written out for it: {error}; allowed: device='cpu', or laws "
            "of operators of torch that work elementwise, without branches in Python"
        ) from error
    there = dynamics.to(device)
    T = there.topology
    actions = tuple(replace(action, laws=own) for action, own in zip(T.actions, laws, strict=True))
    there.topology = there.saddle.T = replace(T, actions=actions)
    return there


def march(dynamics: Dynamics, w: Weights, iterations: tuple[int, int], refresh: int) -> March:
    """The march of a system on its device."""
    model, capture = repeated.model(dynamics, w), GRAPHS.get(dynamics.device.type)
    if capture is None:
        return March(dynamics, model, iterations, refresh)
    return CapturedMarch(capture, dynamics, model, iterations, refresh)


class CapturedMarch(March):
    """March by graphs; a state that it returns lasts until the next step."""

    def __init__(self, capture: Capture | None, dynamics: Dynamics, *arguments: Any):
        super().__init__(dynamics, *arguments)
        self.capture = capture
        self.graphs: dict[Kind, _Graph | None] = {}  # None: a kind that has been seen once

    def run(self, x: State, schedule: Sequence[Prescribed], record: Record, first: int = 0, place: int = 1) -> State:
        """As of any march."""
        device = self.dynamics.device
        with beside(device) if device.type == "cuda" else nullcontext():
            return self._marched(x, schedule, record, first, place)

    def _marched(self, x: State, schedule: Sequence[Prescribed], record: Record, first: int, place: int) -> State:
        return super().run(x, schedule, record, first, place)

    def made(self, kind: Kind, x: State, given: Any) -> Made:
        """As of any march."""
        if self.capture is None or kind.begins:
            return super().made(kind, x, given)
        if kind not in self.graphs:
            self.graphs[kind] = None
            return super().made(kind, x, given)
        graph = self.graphs[kind]
        if graph is None:
            try:
                graph = self.graphs[kind] = _Graph(self, kind, x, given)
            except RuntimeError as error:
                warnings.warn(f"steps cannot be captured, which makes them slow: {error}", stacklevel=2)
                self.capture = None
                return super().made(kind, x, given)
        return graph(self, x, given)

    def as_written(self, kind: Kind, x: State, given: Any) -> Made:
        """A step operation by operation."""
        return super().made(kind, x, given)


class _Graph:
    """Steps of one kind; numbers that they depend on keep their place."""

    def __init__(self, march: CapturedMarch, kind: Kind, x: State, given: Prescribed):
        assert march.capture is not None
        x, given, H = x.map(repeated.own), repeated.own_given(given), march.H
        kept = H, march.passes
        self._numbers = _numbers(x, given, Factored(H.LU.clone(), H.pivots.clone()), march.passes.clone())
        LU, pivots, passes = self._numbers[-3:]
        march.H, march.passes = Factored(LU, pivots), passes
        try:
            self._found, self._replay = march.capture(lambda: march.as_written(kind, x, given))
        finally:
            march.H, march.passes = kept

    def __call__(self, march: CapturedMarch, x: State, given: Prescribed) -> Made:
        """The step from x."""
        for mine, new in zip(self._numbers, _numbers(x, given, march.H, march.passes), strict=True):
            mine.copy_(new)
        self._replay()
        return self._found._replace(sizes=self._found.sizes.clone())


def _numbers(x: State, given: Prescribed, H: Factored, passes: Tensor) -> list[Tensor]:
    """All that a step depends on."""
    return [*repeated.numbers(x, given), H.LU, H.pivots, passes]
