"""Tensors whose axes may be loops, with which functions of torch are traced to a program.

    Array    an axis is a number of components, which are separate numbers, or a loop of a size known at run time
    Pieces   several arrays flattened and joined along one axis, such as the coordinates of all bodies (pieces.py)
    Table    integers that are known at run time, for `index_select` and `SymbolicSegmentSum` (segment_sum.py)

Operators of torch are in operators.py. Another operator, or shapes that do not fit for every size, raise `Untraceable`.
Checked in tests/extensions/native/codegen/test_array.py: against torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.extensions.native.codegen.program import Program
from torchmbd.extensions.native.codegen.size import (
    AnySize,
    Index,
    Lookup,
    Size,
    Untraceable,
    Variable,
    constant_index,
    loop_index,
)
from torchmbd.math.pair import Pair

Loops = tuple[Variable | None, ...]
OPERATORS: dict[str, Callable[..., Any]] = {}  # of torch, by name: operators.py


class Table(NamedTuple):
    """Integers in memory: `size` of them from `start` on."""

    name: str
    size: AnySize
    start: AnySize = 0

    def __getitem__(self, rows: slice) -> Table:
        start, stop = slice_bounds(rows, self.size)
        return Table(self.name, stop - start, self.start + start)

    def lookup(self, index: Index) -> Index:
        """The entry at an index."""
        return Index(0, ((1, Lookup(self.name, index.plus(self.start))),))


class Traced:
    """An argument of torch operators in place of a tensor."""

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

    def as_array(self) -> Array:
        """The tensor as one Array."""
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
        """The contents of a buffer from `start` on in row-major order; adds the buffer if there is none of this name."""
        if name not in program.buffers:
            program.buffer(name, 0, kind)
        return cls.from_indices(program, shape, lambda index: program.load(name, index.plus(start)))

    @classmethod
    def from_indices(cls, program: Program, shape: Sequence[AnySize], number: Callable[[Index], int]) -> Array:
        """The array of number(index) at row-major indices."""
        loops = new_variables(shape)
        extents = component_shape(shape, loops)
        numbers = np.empty(extents, dtype=np.int64)
        for k in np.ndindex(*extents):
            index = constant_index(0)
            for i, n, v in zip(k, shape, loops, strict=True):
                index = index.times(n).plus(loop_index(v) if v is not None else i)
            numbers[k] = number(index)
        return cls(program, numbers, loops)

    @property
    def shape(self) -> tuple[AnySize, ...]:
        return tuple(n if v is None else v.size for n, v in zip(self.numbers.shape, self.loops, strict=True))

    @property
    def variables(self) -> list[Variable]:
        """Variables of the loops."""
        return [v for v in self.loops if v is not None]

    def as_array(self) -> Array:
        return self

    def map_numbers(self, f: Callable[[list[int]], list[int]]) -> Array:
        """The array of f(numbers)."""
        flat = self.numbers.ravel().tolist()
        return Array(self.program, np.array(f(flat), dtype=np.int64).reshape(self.numbers.shape), self.loops)

    def with_loops(self, loops: Sequence[Variable | None]) -> Array:
        """The array with other loop variables."""
        mapping = {
            v: loop_index(w)
            for v, w in zip(self.loops, loops, strict=True)
            if v is not None and w is not None and v != w
        }
        renamed = self.map_numbers(lambda numbers: self.program.substitute_all(numbers, mapping)) if mapping else self
        return Array(self.program, renamed.numbers, tuple(loops))

    def stored(self) -> Array:
        """The array as loads from buffers."""

        def loaded(numbers: list[int]) -> list[int]:
            loads = self.program.stored(numbers)
            return [loads[x] for x in numbers]

        return self.map_numbers(loaded)

    def __getitem__(self, key: Any) -> Array:
        key = key if isinstance(key, tuple) else (key,)
        result, d = self, 0
        rest = len(self.shape) - sum(k is not None and k is not Ellipsis for k in key)
        for k in key:
            if k is Ellipsis:
                d += rest
            elif k is None:
                result, d = insert_axis(result, d), d + 1
            elif isinstance(k, slice):
                result, d = slice_axis(result, d, k), d + 1
            else:
                result = select_component(result, d, k)
        return result


def new_variables(shape: Sequence[AnySize]) -> Loops:
    """A loop variable for each axis whose size is not a number, else None."""
    used: dict[Size, int] = {}
    variables: list[Variable | None] = []
    for n in shape:
        if isinstance(n, Size):
            used[n] = used.get(n, -1) + 1
            variables.append(Variable(n, used[n]))
        else:
            variables.append(None)
    return tuple(variables)


def component_shape(shape: Sequence[AnySize], loops: Sequence[Variable | None]) -> list[int]:
    """Lengths of axes in `Array.numbers`: 1 for loops."""
    return [n if v is None and isinstance(n, int) else 1 for n, v in zip(shape, loops, strict=True)]


def slice_bounds(rows: slice, size: AnySize) -> tuple[AnySize, AnySize]:
    """Start and end of a slice of an axis."""
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
        return x.as_array()
    t = torch.as_tensor(x, dtype=torch.float64)
    numbers = np.array([program.constant(v) for v in t.flatten().tolist()], dtype=np.int64)
    return Array(program, numbers.reshape(tuple(t.shape)))


def broadcast_loops(arrays: Sequence[Array]) -> tuple[list[np.ndarray], Loops]:
    """Numbers of arrays that broadcast, over common loop variables, and these."""
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
        variables = [x.loops[d] for x in wide if x.loops[d] is not None]
        extents = {x.numbers.shape[d] for x in wide}
        if variables and (len({v.size for v in variables}) > 1 or extents != {1}):  # pyright: ignore[reportOptionalMemberAccess]
            raise Untraceable(f"shapes {[x.shape for x in wide]} do not fit for every size")
        free = [v for v in variables if v not in loops]
        if variables and not free:
            size, number = variables[0].size, 0  # pyright: ignore[reportOptionalMemberAccess]
            taken = {w for x in wide for w in x.loops[d + 1 :]}
            while Variable(size, number) in loops or Variable(size, number) in taken:
                number += 1
            free = [Variable(size, number)]
        loops.append(free[0] if variables else None)
    same = [x.with_loops([w if v is not None else None for v, w in zip(x.loops, loops, strict=True)]) for x in wide]
    return [x.numbers for x in same], tuple(loops)


def slice_axis(x: Array, d: int, rows: slice) -> Array:
    """A slice of axis d."""
    v = x.loops[d]
    if v is None:
        start, stop = rows.start, rows.stop
        if isinstance(start, Size) or isinstance(stop, Size):
            raise Untraceable(f"components of {x.shape} cannot be cut at {rows}")
        numbers = x.numbers[(slice(None),) * d + (rows,)]
        return Array(x.program, numbers, x.loops)
    start, stop = slice_bounds(rows, v.size)
    length = stop - start
    if start == 0 and length == v.size:
        return x
    return replace_loop(x, d, (length,), lambda index: index[0].plus(start))


def replace_loop(x: Array, d: int, sizes: Sequence[AnySize], where: Callable[[list[Index]], Index]) -> Array:
    """The array with the loop of axis d replaced by axes of some sizes; `where` gives its index from those of the new axes."""
    v = x.loops[d]
    assert v is not None
    others = {w for i, w in enumerate(x.loops) if i != d and w is not None}
    new: list[Variable | None] = []
    for n in sizes:
        number = 0
        while isinstance(n, Size) and (Variable(n, number) in others or Variable(n, number) in new):
            number += 1
        new.append(Variable(n, number) if isinstance(n, Size) else None)
    extents = component_shape(sizes, new)
    blocks = []
    for k in np.ndindex(*extents):
        index = where([loop_index(w) if w is not None else constant_index(i) for i, w in zip(k, new, strict=True)])
        blocks.append(x.map_numbers(lambda numbers, index=index: x.program.substitute_all(numbers, {v: index})).numbers)
    shape = x.numbers.shape
    if not blocks:
        numbers = np.empty((*shape[:d], *extents, *shape[d + 1 :]), dtype=np.int64)  # pyright: ignore
    else:
        numbers = np.stack([b.squeeze(d) for b in blocks], d).reshape(*shape[:d], *extents, *shape[d + 1 :])
    return Array(x.program, numbers, (*x.loops[:d], *new, *x.loops[d + 1 :]))


def select_component(x: Array, d: int, i: int) -> Array:
    """Component i of axis d."""
    if x.loops[d] is not None:
        x = replace_loop(x, d, (1,), lambda index: index[0].plus(i))
        i = 0
    return Array(x.program, np.asarray(x.numbers.take(i, d)), x.loops[:d] + x.loops[d + 1 :])


def insert_axis(x: Array, dim: int) -> Array:
    """The array with one more axis of one component."""
    return Array(x.program, np.expand_dims(x.numbers, dim), (*x.loops[:dim], None, *x.loops[dim:]))


def zeros(program: Program, shape: Sequence[AnySize], number: float = 0.0) -> Array:
    loops = new_variables(shape)
    extents = component_shape(shape, loops)
    return Array(program, np.full(extents, program.constant(number)), loops)  # pyright: ignore
