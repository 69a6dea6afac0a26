"""A torch function, run once, then repeated from its operations alone.

    Recorded(f, inputs)()      f() again: its inputs are tensors that keep their place and get other numbers

An operation on small tensors costs a microsecond; what Python, views and allocation add around it costs several. So the
operations of one run are noted, and repeated one after another into memory that was laid out once:

    views                          made once, for what they look at keeps its place
    what depends on no input       computed once
    an operation done twice        done once
    results                        into an arena, in which memory of what nobody reads any more is used again: it stays
                                   near the processor

Only for functions of fixed shapes without branches on numbers, as those that are written out as scalar code (scalars.py);
one that asks for a number is `Unrepeatable`. Compared once with the function itself, on numbers a little different.
Checked in tests/numerics/test_recorded.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from torchmbd.errors import MbdError

_ALIGNED = 8  # doubles
_MOVED = 2.0**-12  # by which inputs are changed for a comparison, relative
_EQUAL = 1e-9  # of the largest: products of matrices are rounded as their memory lies


class Unrepeatable(MbdError):
    """A function whose operations may be others the next time."""


class Recorded:
    """f: () -> tensors, repeated; the results keep their place as well, until the next call."""

    def __init__(self, f: Callable[[], Sequence[Tensor]], inputs: Iterable[Tensor]):
        inputs, recorder = list(inputs), _Recorder()
        with torch.no_grad(), recorder:
            found = f()
        repeated, twins = _once(_repeated(recorder.calls, _homes(inputs)))
        place = _Arena(repeated, _homes(found), twins)
        self._steps = [_operation(call, place) for call in repeated]
        self.results = [place(x) for x in found]
        self._compare(f, inputs)

    def _compare(self, f: Callable[[], Sequence[Tensor]], inputs: list[Tensor]) -> None:
        """With other numbers: what a function takes out of torch has been noted as a constant."""
        numbers = [x for x in inputs if x.is_floating_point()]
        before = [x.clone() for x in numbers]
        with torch.no_grad():
            for x in numbers:
                x.mul_(1.0 + _MOVED)
            same = all(_same(x, y) for x, y in zip(self(), f(), strict=True))
            for x, old in zip(numbers, before, strict=True):
                x.copy_(old)
        if not same:
            raise Unrepeatable("repeated with other numbers, a function has other results")

    def __call__(self) -> list[Tensor]:
        """The results for what is in the inputs now."""
        with torch.inference_mode():
            for step in self._steps:
                step()
        return self.results


class _Call(NamedTuple):
    """An operation: `writes` are the homes of what it makes or changes, `reads` those of its arguments."""

    func: Any
    args: list
    kwargs: dict
    made: Any
    reads: set[int]
    writes: set[int]


class _Recorder(TorchDispatchMode):
    """Notes operations; views change nothing and are left out."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[_Call] = []
        self.alive: list[Any] = []  # so that no address is given twice

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        made = func(*args, **kwargs)
        self.alive.append(made)
        reads = _homes([*args, *kwargs.values()])
        writes = _homes([made]) - reads
        if func._schema.is_mutable:
            writes |= _homes([x for x, a in zip(args, func._schema.arguments, strict=False) if a.is_write])
        if writes or not isinstance(made, (Tensor, list, tuple)):
            self.calls.append(_Call(func, _mapped(args, _itself), kwargs, made, reads, writes))
        return made

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # True: torch imports its compiler, a second, to keep it away from here


def _repeated(calls: list[_Call], inputs: set[int]) -> list[_Call]:
    """The operations that depend on the inputs, and those that begin what such an operation changes later."""
    moving, size = set(inputs), 0
    while len(moving) > size:
        size = len(moving)
        moving.update(home for call in calls if not call.reads.isdisjoint(moving) for home in call.writes)
    made = {home for call in calls for home in call.writes - call.reads}
    for call in calls:
        if not call.writes and not moving.isdisjoint(call.reads):
            raise Unrepeatable(f"{call.func} asks for a number, on which a function may branch")
        if torch.Tag.nondeterministic_seeded in call.func.tags or not call.writes <= made:
            raise Unrepeatable(f"{call.func} is random, or changes what is not the function's own")
        if torch.Tag.dynamic_output_shape in call.func.tags and not moving.isdisjoint(_choosing(call)):
            raise Unrepeatable(f"{call.func} makes as many numbers as others say")
    return [call for call in calls if not moving.isdisjoint(call.reads | call.writes)]


def _choosing(call: _Call) -> set[int]:
    """What says how many numbers an operation makes: of an index, its masks."""
    if call.func.overloadpacket.__name__ != "index":
        return call.reads
    return _homes([x for x in _tensors(call.args[1:]) if x.dtype in (torch.bool, torch.uint8)])


def _once(calls: list[_Call]) -> tuple[list[_Call], dict[int, int]]:
    """Operations without those that were done before on the same numbers, and for their homes where the results are."""
    changed = {home for call in calls for home in call.writes & call.reads}
    first: dict[Any, int] = {}
    twins: dict[int, int] = {}
    kept = []

    def key(x: Any) -> Any:
        if isinstance(x, Tensor):
            home = _home(x)
            return twins.get(home, home), x.storage_offset(), x.shape, x.stride()
        return tuple(key(y) for y in x) if isinstance(x, (list, tuple)) else repr(x)

    for call in calls:
        floats = isinstance(call.made, Tensor) and call.made.dtype == torch.float64  # others are not in the arena
        if floats and changed.isdisjoint(call.reads | call.writes):
            home = _home(call.made)
            before = first.setdefault((call.func, key(call.args), key(sorted(call.kwargs.items()))), home)
            if before != home:
                twins[home] = before
                continue
        kept.append(call._replace(reads={twins.get(home, home) for home in call.reads}))
    return kept, twins


class _Arena:
    """Maps tensors of the recorded run to where they are when it is repeated."""

    def __init__(self, calls: list[_Call], results: set[int], twins: dict[int, int]):
        self.twins = twins
        sizes: dict[int, int] = {}
        last: dict[int, int] = {}
        for i, call in enumerate(calls):
            for x in _tensors([call.made]):
                home = _home(x)
                if home in call.writes - call.reads and home not in sizes and x.dtype == torch.float64:
                    sizes[home] = -(-x.untyped_storage().nbytes() // (8 * _ALIGNED)) * _ALIGNED
            last.update(dict.fromkeys(call.reads | call.writes, i))
        last.update((twins.get(home, home), len(calls)) for home in results)
        self.starts: dict[int, int] = {}
        room = _Room()
        for i, call in enumerate(calls):
            for home in sorted(call.writes):
                if home in sizes and home not in self.starts:
                    self.starts[home] = room.take(sizes[home])
            for home in call.writes | call.reads:
                if home in self.starts and last[home] == i:
                    room.free(self.starts[home], sizes[home])
        device = next((x.device for call in calls for x in _tensors([call.made])), None)
        self.memory = torch.empty(room.size, dtype=torch.float64, device=device)

    def __call__(self, x: Any) -> Any:
        """The tensor that has the place of x."""
        if not isinstance(x, Tensor):
            return x
        home = _home(x)
        start = self.starts.get(self.twins.get(home, home))
        return x if start is None else self.memory.as_strided(x.shape, x.stride(), start + x.storage_offset())


class _Room:
    """Intervals of memory, taken as near to its beginning as possible."""

    def __init__(self) -> None:
        self.size = 0
        self._gaps: list[tuple[int, int]] = []  # start, size; in order, none beside another

    def take(self, size: int) -> int:
        for i, (start, room) in enumerate(self._gaps):
            if room >= size:
                self._gaps[i : i + 1] = [(start + size, room - size)] if room > size else []
                return start
        start = self.size
        if self._gaps and sum(self._gaps[-1]) == self.size:
            start = self._gaps.pop()[0]
        self.size = start + size
        return start

    def free(self, start: int, size: int) -> None:
        joined: list[tuple[int, int]] = []
        for gap in sorted([*self._gaps, (start, size)]):
            if joined and sum(joined[-1]) == gap[0]:
                joined[-1] = (joined[-1][0], joined[-1][1] + gap[1])
            else:
                joined.append(gap)
        self._gaps = joined


def _operation(call: _Call, place: _Arena) -> Callable[[], Any]:
    """The operation, writing to where its results belong."""
    name = call.func.overloadpacket.__name__
    args, kwargs = _mapped(call.args, place), {k: place(x) for k, x in call.kwargs.items()}
    (made,) = _mapped([call.made], place)
    if call.func._schema.is_mutable:
        return partial(
            getattr(args[0], name) if name.endswith("_") else partial(call.func, args[0]), *args[1:], **kwargs
        )
    if name in ("new_zeros", "zeros_like", "zeros"):
        return made.zero_
    if name in ("clone", "_to_copy"):
        return partial(made.copy_, args[0])
    public = getattr(torch.linalg if name.startswith("linalg_") else torch, name.removeprefix("linalg_"), None)
    if isinstance(made, Tensor) and public is not None:
        direct = partial(public, *args, **kwargs, out=made)
        try:
            direct()
        except (TypeError, RuntimeError):  # has no `out`, or none of this form
            pass
        else:
            return direct
    return partial(_copied, partial(call.func, *args, **kwargs), list(_tensors([made])))


def _copied(f: Callable[[], Any], places: list[Tensor]) -> None:
    for place, x in zip(places, _tensors([f()]), strict=True):
        place.copy_(x)


def _tensors(arguments: Iterable[Any]) -> Iterator[Tensor]:
    """The tensors among arguments of an operation, those in lists as well."""
    for x in arguments:
        if isinstance(x, Tensor):
            yield x
        elif isinstance(x, (list, tuple)):
            yield from (y for y in x if isinstance(y, Tensor))


def _mapped(arguments: Iterable[Any], f: Callable[[Any], Any]) -> list[Any]:
    """A copy of arguments with f of each, and of what is in lists."""
    return [[f(y) for y in x] if isinstance(x, (list, tuple)) else f(x) for x in arguments]


def _itself(x: Any) -> Any:
    return x


def _home(x: Tensor) -> int:
    """The address of the memory of a tensor; 0: it has no numbers."""
    return x.untyped_storage().data_ptr()


def _homes(arguments: Iterable[Any]) -> set[int]:
    return {_home(x) for x in _tensors(arguments)} - {0}


def _same(x: Tensor, y: Tensor) -> bool:
    size = float(y.nan_to_num(0.0, 0.0, 0.0).abs().amax()) if y.numel() else 0.0
    return torch.allclose(x, y, rtol=0.0, atol=_EQUAL * size, equal_nan=True)
