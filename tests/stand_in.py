"""A stand-in for a device, on machines that have none: tensors that only meet their like, and that count what leaves.

Its name is "meta", a device that torch knows and has nothing for. Numbers lie in memory of the CPU, so the operations are
done for real, by the kernels of the CPU; what a device is strict about is checked for each of them:

    Elsewhere    a tensor of the device met one of the CPU that is no single number: torch on CUDA raises, or copies
    crossings    copies to the device or back, in "to device" and "to host"
    asked        operations by which the host waits for a number of the device, such as bool(x.any())
    in a graph   neither crossings nor questions: CUDA refuses to capture them

`capture` is what a CUDA graph is: operations noted while a function runs, later done again on the same memory, without the
Python around them. Notes have results that nothing has been written to: nan.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from torchmbd.integrators import arguments, captured
from torchmbd.numerics.recorded import _Recorder

DEVICE = torch.device("meta")
_aten = torch.ops.aten
_ASKING = {_aten._local_scalar_dense.default, _aten.nonzero.default, _aten.equal.default, _aten.masked_select.default}
_INDEXED = {_aten.index.Tensor, _aten.index_put_.default}
_COPIES = {_aten._to_copy.default, _aten.copy_.default}


class Elsewhere(RuntimeError):
    """Tensors of two devices met, or something is done that a graph cannot hold."""


class There(Tensor):
    """A tensor of the device; `numbers` is the same memory as a tensor of the CPU."""

    numbers: Tensor

    @staticmethod
    def __new__(cls, numbers: Tensor) -> There:
        found = Tensor._make_subclass(cls, numbers, False, dispatch_device=True, device_for_backend_keys=DEVICE)
        found.numbers = numbers
        return found

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        assert _here is not None, f"{func} after the device has gone"
        return _here.do(func, args, kwargs or {})


_here: StandIn | None = None


class StandIn(TorchDispatchMode):
    """The device, within a `with` block."""

    def __init__(self) -> None:
        super().__init__()
        self.crossings: Counter[str] = Counter()
        self.asked: Counter[str] = Counter()
        self.done = 0  # operations, other than of graphs
        self.launched = 0  # graphs
        self._notes: list[Callable[[], Any]] | None = None

    def __enter__(self) -> StandIn:
        global _here
        _here = self
        return super().__enter__()

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return self.do(func, args, kwargs or {})

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # True: torch imports its compiler, a second

    def do(self, func: Any, args: tuple, kwargs: dict) -> Any:
        """An operation, on the CPU's memory."""
        if func is torch.ops.prim.device.default:
            return DEVICE if isinstance(args[0], There) else func(*args)
        given = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
        there = [x for x in given if isinstance(x, There)]
        to = kwargs.get("device")
        new = to is not None and torch.device(to) == DEVICE and (not given or func in _COPIES)
        if not there and not new:  # torch uses the name for purposes of its own
            return func(*args, **kwargs)
        if func in _COPIES and (to is not None or (len(there) == 1 and len(given) == 2)):
            return self._copied(func, args, kwargs, given, to)
        for x in given:
            if not isinstance(x, There) and (x.device == DEVICE or x.dim() or func is _aten.index_select.default):
                raise Elsewhere(f"{func}: a tensor {tuple(x.shape)} of the CPU among those of the device")
        self._asks(func, given)
        self.done += 1
        plain = tree_map(_numbers, (args, {k: x for k, x in kwargs.items() if k != "device"}))
        made = func(*plain[0], **plain[1])
        if self._notes is not None:
            self._note(func, *plain, made)
        homes = {id(x.numbers): x for x in there}

        def ours(x: Any) -> Any:
            return homes[id(x)] if id(x) in homes else There(x) if isinstance(x, Tensor) else x

        return tree_map(ours, made)

    def _copied(self, func: Any, args: tuple, kwargs: dict, given: list, to: Any) -> Any:
        """To the device, or from there."""
        if self._notes is not None:
            raise Elsewhere(f"{func}: a graph holds no copy from one device to another")
        target = torch.device(to) if to is not None else (DEVICE if isinstance(args[0], There) else torch.device("cpu"))
        self.crossings["to device" if target == DEVICE else "to host"] += 1
        if func is _aten.copy_.default:
            _numbers(args[0]).copy_(_numbers(args[1]))
            return args[0]
        x = func(_numbers(args[0]), **{k: y for k, y in kwargs.items() if k != "device"})
        x = x.clone() if x is _numbers(args[0]) else x
        return There(x) if target == DEVICE else x

    def _asks(self, func: Any, given: list) -> None:
        masks = func in _INDEXED and any(x.dtype == torch.bool for x in given)
        if func in _ASKING or masks or (torch.Tag.dynamic_output_shape in func.tags and func is not _aten.index.Tensor):
            if self._notes is not None:
                raise Elsewhere(f"{func}: a graph cannot ask for a number")
            self.asked[str(func)] += 1

    def _note(self, func: Any, args: tuple, kwargs: dict, made: Any) -> None:
        """The operation, to be done again; its results go where they were."""
        places = [x for x in tree_flatten(made)[0] if isinstance(x, Tensor)]
        own = {x.untyped_storage().data_ptr() for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)}
        fresh = [x for x in places if x.untyped_storage().data_ptr() not in own]

        def again() -> None:
            found = [x for x in tree_flatten(func(*args, **kwargs))[0] if isinstance(x, Tensor)]
            for place, x in zip(places, found, strict=True):
                if any(place is y for y in fresh):
                    place.copy_(x)

        if fresh or func._schema.is_mutable:
            assert self._notes is not None
            self._notes.append(again)

    def capture(self, f: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
        """As captured.cuda_graph."""
        self._notes = notes = []
        try:
            found = f()
        finally:
            self._notes = None

        def replay() -> None:
            self.launched += 1
            with torch.inference_mode(), torch._C._DisableTorchDispatch():
                for again in notes:
                    again()

        return found, replay


def _numbers(x: Any) -> Any:
    return x.numbers if isinstance(x, There) else x


@contextmanager
def stand_in(monkeypatch: pytest.MonkeyPatch, graphs: bool = True) -> Iterator[StandIn]:
    """The device, which `simulate` knows by the name "meta"; with or without graphs."""
    noted = _Recorder.__torch_dispatch__

    def known(self: Any, func: Any, *arguments: Any) -> Any:
        """A device says where it is without an operation."""
        return DEVICE if func is torch.ops.prim.device.default else noted(self, func, *arguments)

    with monkeypatch.context() as patched, StandIn() as device:
        patched.setattr(_Recorder, "__torch_dispatch__", known)
        patched.setitem(arguments.DEVICES, "meta", lambda: True)
        if graphs:
            patched.setitem(captured.GRAPHS, "meta", device.capture)
        yield device
