"""Operators of torch on arrays with loops (array.py)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from torchmbd.extensions.native.codegen.array import (
    OPERATORS,
    Array,
    Traced,
    array,
    broadcast_loops,
    insert_axis,
    replace_loop,
    select_component,
    zeros,
)
from torchmbd.extensions.native.codegen.pieces import Pieces
from torchmbd.extensions.native.codegen.program import Program, product
from torchmbd.extensions.native.codegen.size import AnySize, Index, Size, Untraceable, constant_index


def program_of(*xs: Any) -> Program:
    """The program of the first traced tensor among arguments and lists of arguments."""
    for x in xs:
        if isinstance(x, Traced):
            return x.program  # pyright: ignore[reportAttributeAccessIssue]
        if isinstance(x, (list, tuple)):
            for y in x:
                if isinstance(y, Traced):
                    return y.program  # pyright: ignore[reportAttributeAccessIssue]
    raise AssertionError("no argument is traced")


def _each(op: str, *xs: Any) -> Any:
    """An elementwise operation."""
    pieces = [x for x in xs if isinstance(x, Pieces)]
    if len(pieces) == 1 and all(x is pieces[0] or _is_constant_along(x, pieces[0]) for x in xs):
        whole = pieces[0]
        return whole.each(lambda part: _each(op, *(part if x is whole else _for_part(x, whole, part) for x in xs)))
    program = program_of(*xs)
    numbers, loops = broadcast_loops([array(program, x) for x in xs])
    wide = np.broadcast_arrays(*numbers)
    flat = [program.call(op, *ns) for ns in zip(*(x.ravel().tolist() for x in wide), strict=True)]
    return Array(program, np.array(flat, dtype=np.int64).reshape(wide[0].shape), loops)


def _is_constant_along(x: Any, pieces: Pieces) -> bool:
    """True if x is constant along the axis of the pieces."""
    if isinstance(x, (int, float)):
        return True
    if isinstance(x, Pieces):
        return False
    shape, count = tuple(x.shape), len(pieces.shape) - pieces.axis
    return len(shape) < count or shape[-count] == 1


def _for_part(x: Any, pieces: Pieces, part: Array) -> Any:
    """x with further axes of length 1, so that it broadcasts with a part of the pieces."""
    if isinstance(x, (int, float)):
        return x
    more = part.dim() - len(pieces.shape)
    count = len(pieces.shape) - pieces.axis
    for _ in range(more if len(x.shape) >= count else 0):
        x = x.unsqueeze(len(x.shape) - count)
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
    program = program_of(parts)
    parts = [x if isinstance(x, Pieces) else array(program, x) for x in parts]
    dim %= len(parts[0].shape)
    kept = [x for x in parts if x.shape[dim] != 0]
    if not kept:
        return parts[0]
    if len(kept) == 1:
        return kept[0]
    if all(isinstance(x, Array) and x.loops[dim] is None for x in kept):
        return _cat_components(program, kept, dim)
    joined: list[tuple[Array, int]] = []
    for x in kept:
        if isinstance(x, Pieces) and x.axis == dim:
            joined += x.parts
        else:
            joined.append((x.as_array(), 1))
    return Pieces(dim, joined)


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
    numbers, loops = broadcast_loops(singles)
    wide = np.broadcast_arrays(*numbers)
    return Array(program, np.concatenate(wide, dim), loops)


def _select(x: Any, d: int, i: int) -> Array:
    return select_component(x.as_array(), d % len(x.shape), i)


def _unsqueeze(x: Any, dim: int) -> Any:
    dim %= len(x.shape) + 1
    if isinstance(x, Array):
        return insert_axis(x, dim)
    if dim > x.axis:
        return Pieces(x.axis, [(insert_axis(p, dim + k - 1), k) for p, k in x.parts])
    return Pieces(x.axis + 1, [(insert_axis(p, dim), k) for p, k in x.parts])


def _flatten(x: Any, start: int = 0, end: int = -1) -> Any:
    end %= len(x.shape)
    if start == end:
        return x
    x = x.as_array()
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
        x = x.as_array()
    if x.loops[dim] is None:
        shape = x.numbers.shape
        numbers = x.numbers.reshape(*shape[:dim], *sizes, *shape[dim + 1 :])
        return Array(x.program, numbers, (*x.loops[:dim], *(None,) * len(sizes), *x.loops[dim + 1 :]))

    def where(index: list[Index]) -> Index:
        total = constant_index(0)
        for n, i in zip(sizes, index, strict=True):
            total = total.times(n).plus(i)
        return total

    return replace_loop(x, dim, sizes, where)


def _transpose(x: Any, i: int, j: int) -> Array:
    x = x.as_array()
    loops = list(x.loops)
    loops[i], loops[j] = loops[j], loops[i]
    return Array(x.program, x.numbers.swapaxes(i, j), tuple(loops))


def _permute(x: Any, *dims: Any) -> Array:
    x, order = x.as_array(), dims[0] if isinstance(dims[0], (tuple, list)) else dims
    return Array(x.program, x.numbers.transpose(order), tuple(x.loops[d] for d in order))


def _sum(x: Any, dim: Any = None) -> Array:
    x = x.as_array()
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
    x = x.as_array()
    v = x.loops[dim]
    if isinstance(index, Tensor):
        if v is not None:
            raise Untraceable("a loop is gathered by a constant table")
        return Array(x.program, x.numbers.take(index.numpy(), dim), x.loops)
    if v is None:
        raise Untraceable("components are gathered by a table that is known at run time")
    return replace_loop(x.stored(), dim, (index.size,), lambda places: index.lookup(places[0]))


def _expand(x: Any, *shape: Any) -> Array:
    x = x.as_array()
    sizes = list(shape[0] if len(shape) == 1 and isinstance(shape[0], (tuple, list)) else shape)
    lead = len(sizes) - len(x.shape)
    for _ in range(lead):
        x = _unsqueeze(x, 0)
    for d, n in enumerate(sizes):
        if isinstance(n, int) and n == -1:
            sizes[d] = x.shape[d]
    return _each("add", x, zeros(x.program, sizes))


def _new_zeros(x: Any, *shape: Any, **_: Any) -> Array:
    return zeros(x.program, shape[0] if len(shape) == 1 and isinstance(shape[0], (tuple, list)) else shape)


def _zeros_like(x: Any, **_: Any) -> Array:
    return zeros(x.program, x.shape)


def _full_like(x: Any, number: float, **_: Any) -> Array:
    return zeros(x.program, x.shape, number)


def _add(x: Any, y: Any, alpha: Any = 1.0) -> Any:
    return _each("add", x, y if isinstance(alpha, float) and alpha == 1.0 else _each("mul", y, alpha))


def _sub(x: Any, y: Any, alpha: Any = 1.0) -> Any:
    return _each("sub", x, y if isinstance(alpha, float) and alpha == 1.0 else _each("mul", y, alpha))


def _clamp(x: Any, low: Any = None, high: Any = None, *, min: Any = None, max: Any = None) -> Any:
    low, high = (low if low is not None else min), (high if high is not None else max)
    x = x if low is None else _each("max", x, low)
    return x if high is None else _each("min", x, high)


def _stack(parts: Sequence[Any], dim: int = 0) -> Any:
    program = program_of(parts)
    return _cat([_unsqueeze(array(program, x), dim) for x in parts], dim)


def _unbind(x: Any, dim: int = 0) -> list[Array]:
    return [_select(x, dim, i) for i in range(x.shape[dim])]


def _narrow(x: Any, dim: int, start: AnySize, length: AnySize) -> Any:
    return x[(slice(None),) * dim + (slice(start, start + length),)]


def _unary(op: str) -> Callable[[Any], Any]:
    return lambda x: x.each(lambda part: _each(op, part)) if isinstance(x, Pieces) else _each(op, x)


def _binary(op: str) -> Callable[[Any, Any], Any]:
    return lambda x, y: _each(op, x, y)


OPERATORS |= {
    "each": _each,
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
OPERATORS |= {op: _unary(op) for op in ("neg", "sqrt", "sin", "cos", "exp", "abs", "log", "tanh")}
