"""Scalar code: a torch function as a list of scalar operations.

    f: tensors -> tensors        traced to operators (make_fx), every operator then element by element
    Tape                         the scalar operations; constants are folded, and equal operations are one

Multiplications by zero and one, index tables, gathers, reshapes and concatenations make no operations: a body without an
eccentric mass, a constant direction or an absent tangent costs nothing. The other operations become C++ (codegen/).
Only operators of fixed shape without branches can be translated; others raise `Untraceable`.
Checked in tests/extensions/native/codegen/test_scalars.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx.node import map_arg

from torchmbd.errors import MbdError

UNARY = {"neg": lambda x: -x, "sqrt": math.sqrt, "sin": math.sin, "cos": math.cos, "exp": math.exp, "abs": abs}
UNARY |= {"log": math.log, "tanh": math.tanh}
BINARY = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "max": max,
    "min": min,
    "gt": lambda x, y: float(x > y),
    "ge": lambda x, y: float(x >= y),
    "atan2": math.atan2,
}
TERNARY = {"where": lambda c, x, y: x if c > 0.0 else y}
_COMMUTATIVE = ("add", "mul", "max", "min")


class Untraceable(MbdError):
    """A function has an operator that cannot be translated to scalar code."""


class Tape:
    """Scalar operations, each known by its number.

    op    name, "input" or "constant"
    args  numbers of the arguments; of an input its array and index, of a constant its value
    """

    def __init__(self) -> None:
        self.op: list[str] = []
        self.args: list[tuple] = []
        self._known: dict[tuple, int] = {}
        self.zero, self.unit = self.constant(0.0), self.constant(1.0)

    def _node(self, op: str, *args: Any) -> int:
        key = (op, *args)
        if key not in self._known:
            self._known[key] = len(self.op)
            self.op.append(op)
            self.args.append(args)
        return self._known[key]

    def constant(self, x: float) -> int:
        """A number."""
        return self._node("constant", float(x) + 0.0)  # +0.0: there is one zero

    def inputs(self, array: str, *shape: int, start: int = 0) -> np.ndarray:
        """Elements of an input array from `start` on, in row-major order."""
        places = range(start, start + math.prod(shape))
        return np.array([self._node("input", array, i) for i in places], dtype=np.int64).reshape(shape)

    def is_constant(self, a: int) -> bool:
        """True if a number does not depend on inputs."""
        return self.op[a] == "constant"

    def call(self, op: str, *args: int) -> int:
        """An operation, simplified."""
        if all(self.op[a] == "constant" for a in args):
            f: Any = UNARY.get(op) or BINARY.get(op) or TERNARY[op]
            try:
                return self.constant(f(*(self.args[a][0] for a in args)))
            except (ArithmeticError, ValueError):  # infinite or undefined: computed at run time
                return self._node(op, *args)
        if op in _SIMPLER:
            simpler = _SIMPLER[op](self, *args)
            if simpler is not None:
                return simpler
        return self._node(op, *(sorted(args) if op in _COMMUTATIVE else args))

    def _is_neg(self, a: int) -> bool:
        return self.op[a] == "neg"

    def add(self, a: int, b: int) -> int | None:
        if a == self.zero or b == self.zero:
            return b if a == self.zero else a
        if self._is_neg(b):
            return self.call("sub", a, self.args[b][0])
        return self.call("sub", b, self.args[a][0]) if self._is_neg(a) else None

    def sub(self, a: int, b: int) -> int | None:
        if b == self.zero:
            return a
        if a == self.zero:
            return self.call("neg", b)
        if a == b:
            return self.zero
        return self.call("add", a, self.args[b][0]) if self._is_neg(b) else None

    def mul(self, a: int, b: int) -> int | None:
        for x, y in ((a, b), (b, a)):
            if x == self.zero:
                return x
            if x == self.unit:
                return y
            if self.is_constant(x) and self.args[x][0] == -1.0:
                return self.call("neg", y)
            if self._is_neg(x):
                return self.call("neg", self.call("mul", self.args[x][0], y))
        return None

    def div(self, a: int, b: int) -> int | None:
        if a == self.zero:
            return a
        if not self.is_constant(b) or self.args[b][0] == 0.0:
            return None
        return self.call("mul", a, self.constant(1.0 / self.args[b][0]))

    def neg(self, a: int) -> int | None:
        if self._is_neg(a):
            return self.args[a][0]
        return self.call("sub", *reversed(self.args[a])) if self.op[a] == "sub" else None

    def where(self, condition: int, a: int, b: int) -> int | None:
        if self.is_constant(condition):
            return a if self.args[condition][0] > 0.0 else b
        return a if a == b else None

    def trace(self, f: Callable[..., Any], *arguments: np.ndarray) -> list[np.ndarray]:
        """Results, as numbers of this tape, of a torch function of float64 tensors whose entries are numbers of this tape."""
        from torch.fx.experimental.proxy_tensor import make_fx  # takes a second to import

        generator = torch.Generator().manual_seed(0)  # leaves the global one of the user unchanged
        example = [torch.rand(x.shape, dtype=torch.float64, generator=generator) for x in arguments]
        with torch.no_grad():
            graph = make_fx(f)(*example)
        return _Run(self, graph).run(arguments)


_SIMPLER = {"add": Tape.add, "sub": Tape.sub, "mul": Tape.mul, "div": Tape.div, "neg": Tape.neg, "where": Tape.where}


class _Run:
    """Evaluates a traced graph operator by operator; tensors that do not depend on inputs stay tensors."""

    def __init__(self, tape: Tape, graph: torch.fx.GraphModule):
        self.tape, self.graph = tape, graph

    def run(self, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        values: dict[Any, Any] = {}
        remaining = iter(arguments)
        for node in self.graph.graph.nodes:
            if node.op == "placeholder":
                values[node] = next(remaining)
            elif node.op == "get_attr":
                values[node] = getattr(self.graph, node.target)
            elif node.op == "output":
                outputs = map_arg(node.args[0], lambda n: values[n])
                return [self.ids(x) for x in (outputs if isinstance(outputs, (list, tuple)) else [outputs])]
            else:
                args, kwargs = map_arg((node.args, node.kwargs), lambda n: values[n])
                values[node] = self.apply(node.target, args, kwargs)
        raise AssertionError("a graph has an output")

    def ids(self, x: Any) -> np.ndarray:
        """Numbers of the tape of a tensor or a Python number."""
        if isinstance(x, np.ndarray):
            return x
        x = torch.as_tensor(x, dtype=torch.float64)
        return np.array([self.tape.constant(v) for v in x.flatten().tolist()], dtype=np.int64).reshape(x.shape)

    def apply(self, target: Any, args: Any, kwargs: Any) -> Any:
        if not _symbolic([*args, *kwargs.values()]):
            return target(*args, **kwargs)
        name = target.overloadpacket.__name__ if hasattr(target, "overloadpacket") else target.__name__
        f = getattr(self, f"op_{name}", None)
        if f is not None:
            return f(*args, **kwargs)
        scalar = {"maximum": "max", "minimum": "min", "clamp_min": "max", "clamp_max": "min"}.get(name, name)
        if scalar in UNARY or scalar in BINARY:
            return self.each(scalar, *args)
        raise Untraceable(f"the operator {name!r} cannot be written out")

    def each(self, op: str, *args: Any) -> np.ndarray:
        """An elementwise operation."""
        arrays = np.broadcast_arrays(*(self.ids(x) for x in args))
        call = self.tape.call
        flat = [call(op, *xs) for xs in zip(*(x.ravel().tolist() for x in arrays), strict=True)]
        return np.array(flat, dtype=np.int64).reshape(arrays[0].shape)

    def _total(self, xs: list[int]) -> int:
        call, total = self.tape.call, self.tape.zero
        for x in xs:
            total = call("add", total, x)
        return total

    def op_add(self, a: Any, b: Any, alpha: float = 1.0) -> np.ndarray:
        return self.each("add", a, b if alpha == 1.0 else self.each("mul", b, alpha))

    def op_sub(self, a: Any, b: Any, alpha: float = 1.0) -> np.ndarray:
        return self.each("sub", a, b if alpha == 1.0 else self.each("mul", b, alpha))

    def op_rsub(self, a: Any, b: Any, alpha: float = 1.0) -> np.ndarray:
        return self.op_sub(b, a, alpha)

    def op_reciprocal(self, a: Any) -> np.ndarray:
        return self.each("div", 1.0, a)

    def op_rsqrt(self, a: Any) -> np.ndarray:
        return self.each("div", 1.0, self.each("sqrt", a))

    def op_pow(self, a: Any, exponent: Any) -> np.ndarray:
        if isinstance(exponent, float) and exponent == 0.5:
            return self.each("sqrt", a)
        if isinstance(a, (int, float)) or not isinstance(exponent, (int, float)) or exponent not in range(1, 9):
            raise Untraceable(f"the power {exponent!r} cannot be written out: must be 1/2, or 1 to 8")
        half = a if exponent < 4 else self.op_pow(a, exponent // 2)
        square = self.each("mul", half, half) if exponent > 1 else a
        return self.each("mul", a, square) if exponent > 1 and exponent % 2 else square

    def op_where(self, condition: Any, a: Any, b: Any) -> np.ndarray:
        return self.each("where", condition, a, b)

    def op_lt(self, a: Any, b: Any) -> np.ndarray:
        return self.each("gt", b, a)

    def op_le(self, a: Any, b: Any) -> np.ndarray:
        return self.each("ge", b, a)

    def op_logical_not(self, a: Any) -> np.ndarray:
        return self.each("sub", 1.0, a)

    def op_logical_and(self, a: Any, b: Any) -> np.ndarray:
        return self.each("mul", a, b)

    def op_logical_or(self, a: Any, b: Any) -> np.ndarray:
        return self.each("max", a, b)

    op_bitwise_and, op_bitwise_or, op_bitwise_not = op_logical_and, op_logical_or, op_logical_not

    def op_sign(self, a: Any) -> np.ndarray:
        return self.each("sub", self.each("gt", a, 0.0), self.each("gt", 0.0, a))

    def op_clamp(self, a: Any, low: Any = None, high: Any = None) -> np.ndarray:
        a = a if low is None else self.each("max", a, low)
        return a if high is None else self.each("min", a, high)

    def op_sum(self, a: np.ndarray, dims: Any = None, keepdim: bool = False) -> np.ndarray:
        dims = range(a.ndim) if dims is None else [d % a.ndim for d in ([dims] if isinstance(dims, int) else dims)]
        kept = [d for d in range(a.ndim) if d not in dims]
        count, each = (math.prod(a.shape[d] for d in some) for some in (kept, dims))
        rows = a.transpose(*kept, *dims).reshape(count, each)
        total = np.array([self._total(row) for row in rows.tolist()], dtype=np.int64)
        return total.reshape([1 if d in dims else n for d, n in enumerate(a.shape) if keepdim or d not in dims])

    def op_mm(self, a: Any, b: Any) -> np.ndarray:
        a, b = self.ids(a), self.ids(b)
        return self.op_sum(self.each("mul", a[:, :, None], b[None]), 1)

    def op_bmm(self, a: Any, b: Any) -> np.ndarray:
        return np.stack([self.op_mm(x, y) for x, y in zip(self.ids(a), self.ids(b), strict=True)])

    def op_linalg_cross(self, a: Any, b: Any, dim: int = -1) -> np.ndarray:
        a, b = np.broadcast_arrays(self.ids(a), self.ids(b))
        a, b = np.moveaxis(a, dim, 0), np.moveaxis(b, dim, 0)
        parts = [
            self.each("sub", self.each("mul", a[j], b[k]), self.each("mul", a[k], b[j]))
            for j, k in ((1, 2), (2, 0), (0, 1))
        ]
        return np.moveaxis(np.stack(parts), 0, dim)

    def op_cat(self, parts: Sequence[Any], dim: int = 0) -> np.ndarray:
        return np.concatenate([self.ids(x) for x in parts], dim)

    def op_stack(self, parts: Sequence[Any], dim: int = 0) -> np.ndarray:
        return np.stack([self.ids(x) for x in parts], dim)

    def op_view(self, a: np.ndarray, shape: Sequence[int]) -> np.ndarray:
        return a.reshape(shape)

    op__unsafe_view = op_reshape = op_view

    def op_expand(self, a: np.ndarray, shape: Sequence[int]) -> np.ndarray:
        lead = len(shape) - a.ndim
        return np.broadcast_to(a, [a.shape[i - lead] if n == -1 else n for i, n in enumerate(shape)])

    def op_slice(self, a: np.ndarray, dim: int = 0, start: Any = None, stop: Any = None, step: int = 1) -> np.ndarray:
        return a[(slice(None),) * (dim % a.ndim) + (slice(start, stop, step),)]

    def op_select(self, a: np.ndarray, dim: int, index: int) -> np.ndarray:
        return np.asarray(a.take(index, dim))

    def op_index_select(self, a: np.ndarray, dim: int, index: Tensor) -> np.ndarray:
        return a.take(index.numpy(), dim)

    def op_index(self, a: np.ndarray, index: Sequence[Any]) -> np.ndarray:
        return a[tuple(slice(None) if i is None else i.numpy() for i in index)]

    def op_unsqueeze(self, a: np.ndarray, dim: int) -> np.ndarray:
        return np.expand_dims(a, dim)

    def op_squeeze(self, a: np.ndarray, dim: Any) -> np.ndarray:
        dims = [d for d in ([dim] if isinstance(dim, int) else dim) if a.shape[d] == 1]
        return np.squeeze(a, tuple(dims))

    def op_permute(self, a: np.ndarray, dims: Sequence[int]) -> np.ndarray:
        return a.transpose(dims)

    def op_transpose(self, a: np.ndarray, i: int, j: int) -> np.ndarray:
        return a.swapaxes(i, j)

    def op_t(self, a: np.ndarray) -> np.ndarray:
        return a.T

    def op_unbind(self, a: np.ndarray, dim: int = 0) -> list[np.ndarray]:
        return [np.asarray(x) for x in np.moveaxis(a, dim, 0)]

    def op_getitem(self, a: Sequence[Any], i: int) -> Any:
        return a[i]

    def op_constant_pad_nd(self, a: np.ndarray, pad: Sequence[int], value: float = 0.0) -> np.ndarray:
        width = [(0, 0)] * (a.ndim - len(pad) // 2) + list(zip(pad[-2::-2], pad[::-2], strict=True))
        return np.pad(a, width, constant_values=self.tape.constant(value))

    def op_zeros_like(self, a: np.ndarray, **_: Any) -> Tensor:
        return torch.zeros(a.shape, dtype=torch.float64)

    def op_ones_like(self, a: np.ndarray, **_: Any) -> Tensor:
        return torch.ones(a.shape, dtype=torch.float64)

    def op_full_like(self, a: np.ndarray, value: float, **_: Any) -> Tensor:
        return torch.full(a.shape, value, dtype=torch.float64)

    def op_new_zeros(self, _: np.ndarray, shape: Sequence[int], **__: Any) -> Tensor:
        return torch.zeros(tuple(shape), dtype=torch.float64)

    def op_clone(self, a: np.ndarray, **_: Any) -> np.ndarray:
        return a

    op_contiguous = op__to_copy = op_detach = op_alias = op_clone


def _symbolic(args: Any) -> bool:
    return any(_symbolic(a) if isinstance(a, (list, tuple)) else isinstance(a, np.ndarray) for a in args)
