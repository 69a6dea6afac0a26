"""Tensors whose axes may be loops: what functions of torch are traced with, to be written out as a program.

    Array    an axis is a number of components, which are written out one by one, or a loop of a size known at run time
    Pieces   several arrays flattened and joined along one axis, such as the coordinates of all bodies
    Table    integers that are known at run time, for `index_select` and `SegmentSum`

An operator that is not known here, or a shape that does not fit for every size, is an `Untraceable`: nothing is guessed.
Checked in tests/numerics/codegen/test_array.py: against torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.numerics.codegen.program import Program, product, row_major
from torchmbd.numerics.codegen.size import (
    AnySize,
    Index,
    Lookup,
    Size,
    Untraceable,
    Variable,
    at,
    place,
)
from torchmbd.numerics.pair import Pair, value

Loops = tuple[Variable | None, ...]


class Table(NamedTuple):
    """Integers in memory: `size` of them from `start` on."""

    name: str
    size: AnySize
    start: AnySize = 0

    def __getitem__(self, rows: slice) -> Table:
        start, stop = _bounds(rows, self.size)
        return Table(self.name, stop - start, self.start + start)

    def lookup(self, index: Index) -> Index:
        """The entry at an index."""
        return Index(0, ((1, Lookup(self.name, index.plus(self.start))),))


class _Traced:
    """What operators of torch are given instead of tensors."""

    requires_grad = False
    dtype = torch.float64
    device = torch.device("cpu")

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name = func.__name__.strip("_")
        f = _OPERATORS.get(name)
        if f is None:
            raise Untraceable(f"the operator {name!r} cannot be written out")
        return f(*args, **(kwargs or {}))

    def __add__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, Pair) else _each("add", self, other)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, Pair) else _each("sub", self, other)

    def __rsub__(self, other: Any) -> Any:
        return _each("sub", other, self)

    def __mul__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, Pair) else _each("mul", self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        return _each("div", self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return _each("div", other, self)

    def __neg__(self) -> Any:
        return _each("neg", self)

    def __gt__(self, other: Any) -> Any:
        return _each("gt", self, other)

    def __ge__(self, other: Any) -> Any:
        return _each("ge", self, other)

    def __lt__(self, other: Any) -> Any:
        return _each("gt", other, self)

    def __le__(self, other: Any) -> Any:
        return _each("ge", other, self)

    def __rmatmul__(self, other: Tensor) -> Any:
        return _matmul(other, self)

    def __getattr__(self, name: str) -> Any:
        f = _OPERATORS.get(name)
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


class Array(_Traced):
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
                found, d = _unsqueeze(found, d), d + 1
            elif isinstance(k, slice):
                found, d = _sliced(found, d, k), d + 1
            else:
                found = _select(found, d, k)
        return found


class Pieces(_Traced):
    """Arrays joined along an axis: of part k the axes dim ... dim + merged[k] - 1 are flattened to one."""

    def __init__(self, dim: int, parts: Sequence[tuple[Array, int]]):
        self.axis, self.parts = dim, list(parts)
        self.program = self.parts[0][0].program
        self._solid: Array | None = None

    def lengths(self) -> list[AnySize]:
        """Of the parts along the axis."""
        return [product(x.shape[self.axis : self.axis + n]) for x, n in self.parts]

    @property
    def shape(self) -> tuple[AnySize, ...]:
        x, n = self.parts[0]
        total: AnySize = 0
        for length in self.lengths():
            total = total + length
        return (*x.shape[: self.axis], total, *x.shape[self.axis + n :])

    def each(self, f: Callable[[Array], Any]) -> Pieces:
        """A function of each part that leaves its axes."""
        return Pieces(self.axis, [(f(x), n) for x, n in self.parts])

    def solid(self) -> Array:
        """Through a buffer, as an array with one loop."""
        if self._solid is None:
            self._solid = _joined_in_memory(self)
        return self._solid

    def __getitem__(self, key: Any) -> Any:
        first = key[self.axis] if isinstance(key, tuple) and len(key) > self.axis else key
        before = key[: self.axis] if isinstance(key, tuple) else ()
        alone = len(key) == self.axis + 1 if isinstance(key, tuple) else self.axis == 0
        if alone and isinstance(first, slice) and all(k == slice(None) for k in before):
            found = self._some(first)
            if found is not None:
                return found
        return self.solid()[key]

    def _some(self, rows: slice) -> Pieces | None:
        """Whole parts; None if a boundary is within a part."""
        start, stop = _bounds(rows, self.shape[self.axis])
        ends: list[AnySize] = [0]
        for length in self.lengths():
            ends.append(ends[-1] + length)
        if start not in ends or stop not in ends:
            return None
        parts = self.parts[ends.index(start) : len(ends) - 1 - ends[::-1].index(stop)]
        return Pieces(self.axis, parts) if parts else None


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


def _bounds(rows: slice, size: AnySize) -> tuple[AnySize, AnySize]:
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


def _program(*xs: Any) -> Program:
    for x in xs:
        if isinstance(x, _Traced):
            return x.program  # pyright: ignore[reportAttributeAccessIssue]
        if isinstance(x, (list, tuple)):
            for y in x:
                if isinstance(y, _Traced):
                    return y.program  # pyright: ignore[reportAttributeAccessIssue]
    raise AssertionError("something is traced")


def array(program: Program, x: Any) -> Array:
    """A tensor or a number as an array."""
    if isinstance(x, _Traced):
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


def _each(op: str, *xs: Any) -> Any:
    """An elementwise operation."""
    pieces = [x for x in xs if isinstance(x, Pieces)]
    if len(pieces) == 1 and all(x is pieces[0] or _flat_along(x, pieces[0]) for x in xs):
        own = pieces[0]
        return own.each(lambda part: _each(op, *(part if x is own else _spread_along(x, own, part) for x in xs)))
    program = _program(*xs)
    numbers, loops = aligned([array(program, x) for x in xs])
    wide = np.broadcast_arrays(*numbers)
    flat = [program.call(op, *ns) for ns in zip(*(x.ravel().tolist() for x in wide), strict=True)]
    return Array(program, np.array(flat, dtype=np.int64).reshape(wide[0].shape), loops)


def _flat_along(x: Any, pieces: Pieces) -> bool:
    """Whether x is the same for all places along the axis of the pieces."""
    if isinstance(x, (int, float)):
        return True
    if isinstance(x, Pieces):
        return False
    shape, own = tuple(x.shape), len(pieces.shape) - pieces.axis
    return len(shape) < own or shape[-own] == 1


def _spread_along(x: Any, pieces: Pieces, part: Array) -> Any:
    if isinstance(x, (int, float)):
        return x
    more = part.dim() - len(pieces.shape)
    own = len(pieces.shape) - pieces.axis
    for _ in range(more if len(x.shape) >= own else 0):
        x = x.unsqueeze(len(x.shape) - own)
    return x


def _matmul(C: Tensor, x: Any) -> Any:
    """A constant matrix times the first axis."""
    if isinstance(x, Pieces):
        return x.each(lambda part: _matmul(C, part))
    rows = []
    for row in C.tolist():
        total: Any = None
        for j, c in enumerate(row):
            if c != 0.0:
                term = c * x[j : j + 1]
                total = term if total is None else total + term
        rows.append(_zeros_like(x[:1]) if total is None else total)
    return _cat(rows, 0)


def _cat(parts: Sequence[Any], dim: int = 0) -> Any:
    program = _program(parts)
    parts = [x if isinstance(x, Pieces) else array(program, x) for x in parts]
    dim %= len(parts[0].shape)
    kept = [x for x in parts if x.shape[dim] != 0]
    if not kept:
        return parts[0]
    if len(kept) == 1:
        return kept[0]
    if all(isinstance(x, Array) and x.loops[dim] is None for x in kept):
        return _cat_components(program, kept, dim)
    some: list[tuple[Array, int]] = []
    for x in kept:
        if isinstance(x, Pieces) and x.axis == dim:
            some += x.parts
        else:
            some.append((x.solid(), 1))
    return Pieces(dim, some)


def _cat_components(program: Program, parts: list[Array], dim: int) -> Array:
    shapes = []
    for d in range(parts[0].numbers.ndim):
        loops = {x.loops[d].size for x in parts if x.loops[d] is not None}  # pyright: ignore[reportOptionalMemberAccess]
        if d != dim and len(loops) > 1:
            raise Untraceable(f"shapes {[x.shape for x in parts]} cannot be joined along {dim}")
        shapes.append(loops)
    moved = [x.numbers.swapaxes(0, dim) for x in parts]
    count = [len(x) for x in moved]
    singles = [
        Array(program, x.numbers.swapaxes(0, dim)[i : i + 1].swapaxes(0, dim), x.loops)
        for x, n in zip(parts, count, strict=True)
        for i in range(n)
    ]
    numbers, loops = aligned(singles)
    wide = np.broadcast_arrays(*numbers)
    return Array(program, np.concatenate(wide, dim), loops)


def _joined_in_memory(pieces: Pieces) -> Array:
    program, dim = pieces.program, pieces.axis
    total = pieces.shape[dim]
    # Variables of the other axes are made the same in all parts.
    first, merged = pieces.parts[0]
    others = first.shape[:dim] + first.shape[dim + merged :]
    loops = new_variables(others)
    extents = components(others, loops)
    count = int(np.prod(extents, dtype=int))
    kept = sorted([v for v in loops if v is not None], key=program.rank)
    buffer = program.scratch(total * count * product(v.size for v in kept))
    start: AnySize = 0
    for x, n in pieces.parts:
        own = new_variables((*others[:dim], *x.shape[dim : dim + n], *others[dim:]))
        x = x.renamed([v if w is not None else None for v, w in zip(own, x.loops, strict=True)])
        outer = [v for d, v in enumerate(own) if v is not None and not dim <= d < dim + n]
        outer.sort(key=program.rank)
        inside = own[dim : dim + n]
        for k in np.ndindex(*x.numbers.shape):
            along = place(0)
            for i, size, v in zip(k[dim : dim + n], x.shape[dim : dim + n], inside, strict=True):
                along = along.times(size).plus(at(v) if v is not None else i)
            component = int(np.ravel_multi_index(k[:dim] + k[dim + n :], extents)) if extents else 0
            index = _composed(along.plus(start), outer, total, count, component)
            program.write(buffer, [v for v in own if v is not None], index, int(x.numbers[k]))
        start = start + product(x.shape[dim : dim + n])
    v = Variable(total, 0) if isinstance(total, Size) else None
    result_loops = (*loops[:dim], v, *loops[dim:])
    taken = [w for w in loops if w is not None and v is not None and w == v]
    assert not taken
    if v is None:
        raise Untraceable("pieces of a number of components cannot be joined")
    numbers = np.empty([*extents[:dim], 1, *extents[dim:]], dtype=np.int64)
    for k in np.ndindex(*numbers.shape):
        component = int(np.ravel_multi_index(k[:dim] + k[dim + 1 :], extents)) if extents else 0
        numbers[k] = program._node("load", buffer.name, _composed(at(v), kept, total, count, component))
    return Array(program, numbers, result_loops)


def _composed(along: Index, outer: Sequence[Variable], total: AnySize, count: int, component: int) -> Index:
    """Place in a buffer [outer..., along, component]."""
    return row_major(outer).times(total).plus(along).times(count).plus(component)


def _sliced(x: Array, d: int, rows: slice) -> Array:
    v = x.loops[d]
    if v is None:
        start, stop = rows.start, rows.stop
        if isinstance(start, Size) or isinstance(stop, Size):
            raise Untraceable(f"components of {x.shape} cannot be cut at {rows}")
        numbers = x.numbers[(slice(None),) * d + (rows,)]
        return Array(x.program, numbers, x.loops)
    start, stop = _bounds(rows, v.size)
    length = stop - start
    if start == 0 and length == v.size:
        return x
    return _replaced(x, d, (length,), lambda index: index[0].plus(start))


def _replaced(x: Array, d: int, sizes: Sequence[AnySize], where: Callable[[list[Index]], Index]) -> Array:
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


def _select(x: Any, d: int, i: int) -> Array:
    x = x.solid()
    d %= len(x.shape)
    if x.loops[d] is not None:
        x = _replaced(x, d, (1,), lambda index: index[0].plus(i))
        i = 0
    numbers = np.asarray(x.numbers.take(i, d))
    return Array(x.program, numbers, x.loops[:d] + x.loops[d + 1 :])


def _unsqueeze(x: Any, dim: int) -> Any:
    n = len(x.shape) + 1
    dim %= n
    if isinstance(x, Pieces):
        if dim > x.axis:
            return Pieces(x.axis, [(_unsqueeze(p, dim + k - 1), k) for p, k in x.parts])
        return Pieces(x.axis + 1, [(_unsqueeze(p, dim), k) for p, k in x.parts])
    return Array(x.program, np.expand_dims(x.numbers, dim), (*x.loops[:dim], None, *x.loops[dim:]))


def _flatten(x: Any, start: int = 0, end: int = -1) -> Any:
    end %= len(x.shape)
    if start == end:
        return x
    x = x.solid()
    loops = [v for v in x.loops[start : end + 1] if v is not None]
    extent = int(np.prod(x.numbers.shape[start : end + 1], dtype=int))
    if len(loops) > 1 or (loops and extent != 1):
        return Pieces(start, [(x, end - start + 1)])
    shape = x.numbers.shape
    numbers = x.numbers.reshape(*shape[:start], extent, *shape[end + 1 :])
    return Array(x.program, numbers, (*x.loops[:start], loops[0] if loops else None, *x.loops[end + 1 :]))


def _unflatten(x: Any, dim: int, sizes: Sequence[AnySize]) -> Any:
    dim %= len(x.shape)
    sizes = list(sizes)
    if -1 in sizes:
        known = product(n for n in sizes if n != -1)
        if isinstance(known, Size) or known == 0:
            raise Untraceable(f"the axis {x.shape[dim]} cannot be unflattened to {sizes}")
        sizes[sizes.index(-1)] = x.shape[dim] // known
    if product(sizes) != x.shape[dim]:
        raise Untraceable(f"the axis {x.shape[dim]} cannot be unflattened to {sizes}")
    if isinstance(x, Pieces):
        if dim == x.axis and len(x.parts) == 1:
            part, n = x.parts[0]
            if part.shape[dim : dim + n] == tuple(sizes):
                return part
        elif dim > x.axis:
            return Pieces(x.axis, [(_unflatten(p, dim + n - 1, sizes), n) for p, n in x.parts])
        x = x.solid()
    if x.loops[dim] is None:
        shape = x.numbers.shape
        numbers = x.numbers.reshape(*shape[:dim], *sizes, *shape[dim + 1 :])
        return Array(x.program, numbers, (*x.loops[:dim], *(None,) * len(sizes), *x.loops[dim + 1 :]))

    def where(index: list[Index]) -> Index:
        total = place(0)
        for n, i in zip(sizes, index, strict=True):
            total = total.times(n).plus(i)
        return total

    return _replaced(x, dim, sizes, where)


def _transpose(x: Any, i: int, j: int) -> Array:
    x = x.solid()
    loops = list(x.loops)
    loops[i], loops[j] = loops[j], loops[i]
    return Array(x.program, x.numbers.swapaxes(i, j), tuple(loops))


def _permute(x: Any, *dims: Any) -> Array:
    x, order = x.solid(), dims[0] if isinstance(dims[0], (tuple, list)) else dims
    return Array(x.program, x.numbers.transpose(order), tuple(x.loops[d] for d in order))


def _sum(x: Any, dim: Any = None) -> Array:
    x = x.solid()
    n = len(x.shape)
    dims = sorted({d % n for d in (range(n) if dim is None else [dim] if isinstance(dim, int) else dim)})
    over = [x.loops[d] for d in dims if x.loops[d] is not None]
    program = x.program
    kept = [d for d in range(n) if d not in dims]
    shape = [x.numbers.shape[d] for d in kept]
    each = int(np.prod([x.numbers.shape[d] for d in dims], dtype=int))
    rows = x.numbers.transpose(*kept, *dims).reshape(int(np.prod(shape, dtype=int)), each)
    totals = []
    for row in rows.tolist():
        total = program.zero
        for y in row:
            total = program.call("add", total, y)
        totals.append(total)
    if over:
        totals = program.sums(totals, over)
    return Array(program, np.array(totals, dtype=np.int64).reshape(shape), tuple(x.loops[d] for d in kept))


def _index_select(x: Any, dim: int, index: Any) -> Array:
    x = x.solid()
    v = x.loops[dim]
    if isinstance(index, Tensor):
        if v is not None:
            raise Untraceable("a loop is gathered by a constant table")
        return Array(x.program, x.numbers.take(index.numpy(), dim), x.loops)
    if v is None:
        raise Untraceable("components are gathered by a table that is known at run time")
    return _replaced(x.stored(), dim, (index.size,), lambda places: index.lookup(places[0]))


def _expand(x: Any, *shape: Any) -> Array:
    x = x.solid()
    wanted = list(shape[0] if len(shape) == 1 and isinstance(shape[0], (tuple, list)) else shape)
    lead = len(wanted) - len(x.shape)
    for _ in range(lead):
        x = _unsqueeze(x, 0)
    for d, n in enumerate(wanted):
        if isinstance(n, int) and n == -1:
            wanted[d] = x.shape[d]
    return _each("add", x, _zeros(x.program, wanted))


def _zeros(program: Program, shape: Sequence[AnySize], number: float = 0.0) -> Array:
    loops = new_variables(shape)
    extents = components(shape, loops)
    return Array(program, np.full(extents, program.constant(number)), loops)  # pyright: ignore


def _new_zeros(x: Any, *shape: Any, **_: Any) -> Array:
    return _zeros(x.program, shape[0] if len(shape) == 1 and isinstance(shape[0], (tuple, list)) else shape)


def _zeros_like(x: Any, **_: Any) -> Array:
    return _zeros(x.program, x.shape)


def _full_like(x: Any, number: float, **_: Any) -> Array:
    return _zeros(x.program, x.shape, number)


def _add(x: Any, y: Any, alpha: Any = 1.0) -> Any:
    return _each("add", x, y if isinstance(alpha, float) and alpha == 1.0 else _each("mul", y, alpha))


def _sub(x: Any, y: Any, alpha: Any = 1.0) -> Any:
    return _each("sub", x, y if isinstance(alpha, float) and alpha == 1.0 else _each("mul", y, alpha))


def _clamp(x: Any, low: Any = None, high: Any = None, *, min: Any = None, max: Any = None) -> Any:
    low, high = (low if low is not None else min), (high if high is not None else max)
    x = x if low is None else _each("max", x, low)
    return x if high is None else _each("min", x, high)


def _stack(parts: Sequence[Any], dim: int = 0) -> Any:
    program = _program(parts)
    return _cat([_unsqueeze(array(program, x), dim) for x in parts], dim)


def _unbind(x: Any, dim: int = 0) -> list[Array]:
    return [_select(x, dim, i) for i in range(x.shape[dim])]


def _narrow(x: Any, dim: int, start: AnySize, length: AnySize) -> Any:
    return x[(slice(None),) * dim + (slice(start, start + length),)]


class SegmentSum:
    """Sum the columns of arrays [k, n, ...], side by side, into groups [k, groups, ...]: `table` has the group of each.

    Group number `groups`, one more than there are, is left out. k may be flattened.
    """

    def __init__(self, table: Table, groups: AnySize):
        self.table, self.groups = table, groups

    def __call__(self, *parts: Any) -> Any:
        first = parts[0]
        if any(isinstance(x, Pair) for x in parts):
            tangents = [x.tangent if isinstance(x, Pair) else _zeros_like(x) for x in parts]
            return Pair.of(self(*(value(x) for x in parts)), self(*tangents))
        if isinstance(first, Pieces) and first.axis == 0 and len(parts) == len(first.parts) == 1:
            ((x, n),) = first.parts
            return Pieces(0, [(self._along([x], n), n)])
        return self._along([x.solid() for x in parts], 1)

    def _along(self, arrays: Sequence[Array], axis: int) -> Array:
        """Of columns along an axis."""
        program, first = arrays[0].program, arrays[0]
        others = first.shape[:axis] + first.shape[axis + 1 :]
        if self.groups == 0:
            return _zeros(program, (*others[:axis], 0, *others[axis:]))
        loops = new_variables(others)
        extents = components(others, loops)
        count = int(np.prod(extents, dtype=int))
        kept = sorted([v for v in loops if v is not None], key=program.rank)
        each = count * product(v.size for v in kept)
        buffer = program.scratch((self.groups + 1) * each)

        def where(group: Index, k: tuple[int, ...]) -> Index:
            component = int(np.ravel_multi_index(k, extents)) if extents else 0
            return group.times(each).plus(row_major(kept).times(count)).plus(component)

        start: AnySize = 0
        for x in arrays:
            (v,) = new_variables((x.shape[axis],))
            assert v is not None
            assert v not in loops
            x = x.renamed((*loops[:axis], v, *loops[axis:]))
            group = self.table.lookup(at(v).plus(start))
            for k in np.ndindex(*x.numbers.shape):
                index = where(group, k[:axis] + k[axis + 1 :])
                program.write(buffer, [v, *kept], index, int(x.numbers[k]), adds=True)
            start = start + v.size
        (out,) = new_variables((self.groups,))
        assert out is not None
        numbers = np.empty((*extents[:axis], 1, *extents[axis:]), dtype=np.int64)
        for k in np.ndindex(*numbers.shape):
            index = where(at(out), k[:axis] + k[axis + 1 :])
            numbers[k] = program._node("load", buffer.name, index) if buffer.writes else program.zero
        return Array(program, numbers, (*loops[:axis], out, *loops[axis:]))


def _unary(op: str) -> Callable[[Any], Any]:
    return lambda x: x.each(lambda part: _each(op, part)) if isinstance(x, Pieces) else _each(op, x)


def _binary(op: str) -> Callable[[Any, Any], Any]:
    return lambda x, y: _each(op, x, y)


_OPERATORS: dict[str, Callable[..., Any]] = {
    "add": _add,
    "radd": _add,
    "sub": _sub,
    "rsub": lambda x, y: _each("sub", y, x),
    "mul": _binary("mul"),
    "rmul": _binary("mul"),
    "div": _binary("div"),
    "truediv": _binary("div"),
    "rdiv": lambda x, y: _each("div", y, x),
    "rtruediv": lambda x, y: _each("div", y, x),
    "reciprocal": lambda x: _each("div", 1.0, x),
    "rsqrt": lambda x: _each("div", 1.0, _each("sqrt", x)),
    "square": lambda x: _each("mul", x, x),
    "maximum": _binary("max"),
    "minimum": _binary("min"),
    "gt": _binary("gt"),
    "ge": _binary("ge"),
    "lt": lambda x, y: _each("gt", y, x),
    "le": lambda x, y: _each("ge", y, x),
    "atan2": _binary("atan2"),
    "where": lambda c, x, y: _each("where", c, x, y),
    "clamp": _clamp,
    "clamp_min": lambda x, low: _clamp(x, low),
    "clamp_max": lambda x, high: _clamp(x, None, high),
    "matmul": _matmul,
    "rmatmul": lambda x, C: _matmul(C, x),
    "cat": _cat,
    "stack": _stack,
    "sum": _sum,
    "flatten": _flatten,
    "unflatten": _unflatten,
    "unsqueeze": _unsqueeze,
    "select": _select,
    "transpose": _transpose,
    "permute": _permute,
    "index_select": _index_select,
    "expand": _expand,
    "narrow": _narrow,
    "unbind": _unbind,
    "new_zeros": _new_zeros,
    "zeros_like": _zeros_like,
    "ones_like": lambda x, **_: _full_like(x, 1.0),
    "full_like": _full_like,
    "clone": lambda x, **_: x,
    "contiguous": lambda x, **_: x,
    "detach": lambda x: x,
}
_OPERATORS |= {op: _unary(op) for op in ("neg", "sqrt", "sin", "cos", "exp", "abs", "log", "tanh")}
