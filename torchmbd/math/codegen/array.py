"""Tensors whose axes may be loops: what functions of torch are traced with, to be written out as a program.

    Array    an axis is a number of components, which are written out one by one, or a loop of a size known at run time
    Pieces   several arrays flattened and joined along one axis, such as the coordinates of all bodies (pieces.py)
    Table    integers that are known at run time, for `index_select` and `SymbolicSegmentSum` (segment_sum.py)

Operators of torch are in operators.py. One that is not known there, or a shape that does not fit for every size, is an
`Untraceable`: nothing is guessed.
Over 300 lines: the kinds of traced tensors are defined by each other.
Checked in tests/math/codegen/test_array.py: against torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.math.codegen.program import Program
from torchmbd.math.codegen.size import AnySize, Index, Lookup, Size, Untraceable, Variable, at, place
from torchmbd.math.pair import Pair

Loops = tuple[Variable | None, ...]
OPERATORS: dict[str, Callable[..., Any]] = {}  # of torch, by name: operators.py


class Table(NamedTuple):
    """Integers in memory: `size` of them from `start` on."""

    name: str
    size: AnySize
    start: AnySize = 0

    def __getitem__(self, rows: slice) -> Table:
        start, stop = bounds(rows, self.size)
        return Table(self.name, stop - start, self.start + start)

    def lookup(self, index: Index) -> Index:
        """The entry at an index."""
        return Index(0, ((1, Lookup(self.name, index.plus(self.start))),))


class Traced:
    """What operators of torch are given instead of tensors."""

    requires_grad = False
    dtype = torch.float64
    device = torch.device("cpu")

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name = func.__name__.strip("_")
        f = OPERATORS.get(name)
        if f is None:
            raise Untraceable(f"the operator {name!r} cannot be written out")
        return f(*args, **(kwargs or {}))

    def __add__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, Pair) else OPERATORS["each"]("add", self, other)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, Pair) else OPERATORS["each"]("sub", self, other)

    def __rsub__(self, other: Any) -> Any:
        return OPERATORS["each"]("sub", other, self)

    def __mul__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, Pair) else OPERATORS["each"]("mul", self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        return OPERATORS["each"]("div", self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return OPERATORS["each"]("div", other, self)

    def __neg__(self) -> Any:
        return OPERATORS["each"]("neg", self)

    def __gt__(self, other: Any) -> Any:
        return OPERATORS["each"]("gt", self, other)

    def __ge__(self, other: Any) -> Any:
        return OPERATORS["each"]("ge", self, other)

    def __lt__(self, other: Any) -> Any:
        return OPERATORS["each"]("gt", other, self)

    def __le__(self, other: Any) -> Any:
        return OPERATORS["each"]("ge", other, self)

    def __rmatmul__(self, other: Tensor) -> Any:
        return OPERATORS["matmul"](other, self)

    def __getattr__(self, name: str) -> Any:
        f = OPERATORS.get(name)
        if f is None:
            raise AttributeError(f"a traced tensor has no {name!r}")
        return lambda *args, **kwargs: f(self, *args, **kwargs)

    def to(self, *_: Any, **__: Any) -> Any:
        return self

    def dim(self) -> int:
        return len(self.shape)

    @property
    def shape(self) -> tuple[AnySize, ...]:
        raise NotImplementedError

    def solid(self) -> Array:
        raise NotImplementedError


class Array(Traced):
    """Numbers of a program [..]; an axis that is a loop has length one in `numbers`, and its variable in `loops`."""

    __slots__ = ("loops", "numbers", "program")

    def __init__(self, program: Program, numbers: np.ndarray, loops: Loops | None = None):
        self.program, self.numbers = program, numbers
        self.loops: Loops = (None,) * numbers.ndim if loops is None else tuple(loops)
        assert len(self.loops) == numbers.ndim

    @classmethod
    def input(
        cls, program: Program, name: str, shape: Sequence[AnySize], start: AnySize = 0, kind: str = "lanes"
    ) -> Any:
        """What stands in a buffer from `start` on in row-major order; a buffer that is not there is made."""
        if name not in program.buffers:
            program.buffer(name, 0, kind)
        return cls.placed(program, shape, lambda index: program.load(name, index.plus(start)))

    @classmethod
    def placed(cls, program: Program, shape: Sequence[AnySize], number: Callable[[Index], int]) -> Array:
        """The array of the numbers at row-major places."""
        loops = new_variables(shape)
        extents = components(shape, loops)
        numbers = np.empty(extents, dtype=np.int64)
        for k in np.ndindex(*extents):
            index = place(0)
            for i, n, v in zip(k, shape, loops, strict=True):
                index = index.times(n).plus(at(v) if v is not None else i)
            numbers[k] = number(index)
        return cls(program, numbers, loops)

    @property
    def shape(self) -> tuple[AnySize, ...]:
        return tuple(n if v is None else v.size for n, v in zip(self.numbers.shape, self.loops, strict=True))

    @property
    def variables(self) -> list[Variable]:
        """Of its loops."""
        return [v for v in self.loops if v is not None]

    def solid(self) -> Array:
        return self

    def mapped(self, f: Callable[[list[int]], list[int]]) -> Array:
        """The array of other numbers."""
        flat = self.numbers.ravel().tolist()
        return Array(self.program, np.array(f(flat), dtype=np.int64).reshape(self.numbers.shape), self.loops)

    def renamed(self, loops: Sequence[Variable | None]) -> Array:
        """The same over other variables."""
        mapping = {
            v: at(w) for v, w in zip(self.loops, loops, strict=True) if v is not None and w is not None and v != w
        }
        found = self.mapped(lambda some: self.program.substitute_all(some, mapping)) if mapping else self
        return Array(self.program, found.numbers, tuple(loops))

    def stored(self) -> Array:
        """The same, loaded from buffers."""

        def loaded(some: list[int]) -> list[int]:
            known = self.program.stored(some)
            return [known[x] for x in some]

        return self.mapped(loaded)

    def __getitem__(self, key: Any) -> Array:
        key = key if isinstance(key, tuple) else (key,)
        found, d = self, 0
        rest = len(self.shape) - sum(k is not None and k is not Ellipsis for k in key)
        for k in key:
            if k is Ellipsis:
                d += rest
            elif k is None:
                found, d = unsqueezed(found, d), d + 1
            elif isinstance(k, slice):
                found, d = sliced(found, d, k), d + 1
            else:
                found = selected(found, d, k)
        return found


def new_variables(shape: Sequence[AnySize]) -> Loops:
    """A variable for each size that is not a number."""
    used: dict[Size, int] = {}
    found: list[Variable | None] = []
    for n in shape:
        if isinstance(n, Size):
            used[n] = used.get(n, -1) + 1
            found.append(Variable(n, used[n]))
        else:
            found.append(None)
    return tuple(found)


def components(shape: Sequence[AnySize], loops: Sequence[Variable | None]) -> list[int]:
    """Lengths of axes in `Array.numbers`."""
    return [n if v is None and isinstance(n, int) else 1 for n, v in zip(shape, loops, strict=True)]


def bounds(rows: slice, size: AnySize) -> tuple[AnySize, AnySize]:
    """Begin and end of a slice."""
    if rows.step not in (None, 1):
        raise Untraceable("a slice with a step cannot be written out")
    ends = []
    for x, default in ((rows.start, 0), (rows.stop, size)):
        x = default if x is None else x
        if isinstance(x, int) and x < 0:
            x = size + x
        if isinstance(x, int) and isinstance(size, int):
            x = min(x, size)
        ends.append(x)
    return ends[0], ends[1]


def array(program: Program, x: Any) -> Array:
    """A tensor or a number as an array."""
    if isinstance(x, Traced):
        return x.solid()
    t = torch.as_tensor(x, dtype=torch.float64)
    numbers = np.array([program.constant(v) for v in t.flatten().tolist()], dtype=np.int64)
    return Array(program, numbers.reshape(tuple(t.shape)))


def aligned(arrays: Sequence[Array]) -> tuple[list[np.ndarray], Loops]:
    """Numbers of arrays that broadcast, over the same variables."""
    ndim = max(x.numbers.ndim for x in arrays)
    wide = [
        Array(
            x.program,
            x.numbers.reshape((1,) * (ndim - x.numbers.ndim) + x.numbers.shape),
            (None,) * (ndim - x.numbers.ndim) + x.loops,
        )
        for x in arrays
    ]
    loops: list[Variable | None] = []
    for d in range(ndim):
        own = [x.loops[d] for x in wide if x.loops[d] is not None]
        extents = {x.numbers.shape[d] for x in wide}
        if own and (len({v.size for v in own}) > 1 or extents != {1}):  # pyright: ignore[reportOptionalMemberAccess]
            raise Untraceable(f"shapes {[x.shape for x in wide]} do not fit for every size")
        free = [v for v in own if v not in loops]
        if own and not free:
            size, number = own[0].size, 0  # pyright: ignore[reportOptionalMemberAccess]
            taken = {w for x in wide for w in x.loops[d + 1 :]}
            while Variable(size, number) in loops or Variable(size, number) in taken:
                number += 1
            free = [Variable(size, number)]
        loops.append(free[0] if own else None)
    same = [x.renamed([w if v is not None else None for v, w in zip(x.loops, loops, strict=True)]) for x in wide]
    return [x.numbers for x in same], tuple(loops)


def sliced(x: Array, d: int, rows: slice) -> Array:
    v = x.loops[d]
    if v is None:
        start, stop = rows.start, rows.stop
        if isinstance(start, Size) or isinstance(stop, Size):
            raise Untraceable(f"components of {x.shape} cannot be cut at {rows}")
        numbers = x.numbers[(slice(None),) * d + (rows,)]
        return Array(x.program, numbers, x.loops)
    start, stop = bounds(rows, v.size)
    length = stop - start
    if start == 0 and length == v.size:
        return x
    return replaced(x, d, (length,), lambda index: index[0].plus(start))


def replaced(x: Array, d: int, sizes: Sequence[AnySize], where: Callable[[list[Index]], Index]) -> Array:
    """The array with a loop replaced by axes of some sizes: its place as a function of places along these."""
    v = x.loops[d]
    assert v is not None
    others = {w for i, w in enumerate(x.loops) if i != d and w is not None}
    new: list[Variable | None] = []
    for n in sizes:
        number = 0
        while isinstance(n, Size) and (Variable(n, number) in others or Variable(n, number) in new):
            number += 1
        new.append(Variable(n, number) if isinstance(n, Size) else None)
    extents = components(sizes, new)
    blocks = []
    for k in np.ndindex(*extents):
        index = where([at(w) if w is not None else place(i) for i, w in zip(k, new, strict=True)])
        blocks.append(x.mapped(lambda some, index=index: x.program.substitute_all(some, {v: index})).numbers)
    shape = x.numbers.shape
    if not blocks:
        numbers = np.empty((*shape[:d], *extents, *shape[d + 1 :]), dtype=np.int64)  # pyright: ignore
    else:
        numbers = np.stack([b.squeeze(d) for b in blocks], d).reshape(*shape[:d], *extents, *shape[d + 1 :])
    return Array(x.program, numbers, (*x.loops[:d], *new, *x.loops[d + 1 :]))


def selected(x: Array, d: int, i: int) -> Array:
    """One of an axis."""
    if x.loops[d] is not None:
        x = replaced(x, d, (1,), lambda index: index[0].plus(i))
        i = 0
    return Array(x.program, np.asarray(x.numbers.take(i, d)), x.loops[:d] + x.loops[d + 1 :])


def unsqueezed(x: Array, dim: int) -> Array:
    """The array with one more axis of one component."""
    return Array(x.program, np.expand_dims(x.numbers, dim), (*x.loops[:dim], None, *x.loops[dim:]))


def zeros(program: Program, shape: Sequence[AnySize], number: float = 0.0) -> Array:
    loops = new_variables(shape)
    extents = components(shape, loops)
    return Array(program, np.full(extents, program.constant(number)), loops)  # pyright: ignore
