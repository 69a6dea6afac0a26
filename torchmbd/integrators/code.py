"""The C++ of a step of generalized-alpha for one topology: straight-line code from step.py, around it march.cpp.

    residual          R(z)                              matrix           entries of dR/dz that are not always zero
    finish            the new state                     boundary         values that tangents need
    residual_tangent  R_z dz + R_x dx + R_b db          finish_tangent   tangents of the new state

One design variable at a time, so that the code does not depend on how many there are; all data may depend on them.
Beside the code stand the tables of a sparse factorization: rates in their order, then constraints by least degree. So the
time per link of a chain is constant.
Checked in tests/integrators/test_compiled.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from torchmbd.errors import MbdError
from torchmbd.integrators.step import Model, State, Weights
from torchmbd.numerics.emit import PRELUDE, Emitter
from torchmbd.numerics.pair import Pair, separate
from torchmbd.numerics.scalars import Tape
from torchmbd.system.saddle import Saddle
from torchmbd.system.topology import Prescribed, Topology

MOST = 400_000  # operations, beyond which a compiler takes too long
_IN = "struct In { const V *x, *d, *z, *dx, *dd, *dz, *b; const double* u; };\n"


class Layout(NamedTuple):
    """Data of a system in the order in which compiled code takes them: names and components."""

    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, data: dict[str, Any]) -> Layout:
        names = tuple(sorted(data))
        return cls(names, tuple(tuple(data[name].shape[:-2]) for name in names))

    @property
    def size(self) -> int:
        return sum(int(np.prod(s, dtype=int)) for s in self.shapes)


class Inputs:
    """Numbers of a tape for everything that a step is made of."""

    def __init__(self, tape: Tape, T: Topology, layout: Layout, given: Prescribed):
        self.T, self.layout, self.given = T, layout, given
        self.z, self.dz = (tape.inputs(name, T.n_v + T.rows, 1, 1) for name in ("z", "dz"))
        sizes = [T.n_q, T.n_v, T.n_v, T.n_v, T.rows]
        self.x, self.dx = (_cut(tape.inputs(name, sum(sizes)), [(n, 1, 1) for n in sizes]) for name in ("x", "dx"))
        shapes = [(*s, 1, 1) for s in layout.shapes]
        self.data, self.tangents = (_cut(tape.inputs(name, layout.size), shapes) for name in ("d", "dd"))
        uniform = [(len(Weights._fields),), *(tuple(y.shape) for y in _parts(given))]
        self.uniform = _cut(tape.inputs("u", sum(int(np.prod(s, dtype=int)) for s in uniform)), uniform)

    @property
    def flat(self) -> list[np.ndarray]:
        """All of them; what `rebuilt` takes."""
        return [self.z, self.dz, *self.x, *self.dx, *self.data, *self.tangents, *self.uniform]

    def function(self, saddle: Saddle, f: Callable[..., Any]) -> Callable[..., Any]:
        """f(step, z, dz) as a function of flat tensors."""

        def flat(*tensors: Tensor) -> Any:
            rest = iter(tensors)
            z, dz = _take(rest, 2)
            x = State(*(Pair.of(*both) for both in zip(_take(rest, 5), _take(rest, 5), strict=True)))
            n = len(self.layout.names)
            both = zip(_take(rest, n), _take(rest, n), strict=True)
            data = {name: Pair.of(*pair) for name, pair in zip(self.layout.names, both, strict=True)}
            weights, A, r, t = _take(rest, 4)
            laws = [None if law is None else tuple(_take(rest, len(law))) for law in self.given.laws]
            model = Model(self.T, saddle, Weights(*weights.unbind(0)), data)
            return f(model.step(x, Prescribed(laws, A, r, t)), z, dz)

        return flat


def _take(rest: Iterator[Tensor], count: int) -> list[Tensor]:
    return [next(rest) for _ in range(count)]


def _parts(given: Prescribed) -> list[Tensor]:
    return [given.A, given.r, given.t, *(part for law in given.laws if law is not None for part in law)]


def _cut(numbers: np.ndarray, shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
    ends = np.cumsum([int(np.prod(s, dtype=int)) for s in shapes])[:-1]
    return [x.reshape(s) for x, s in zip(np.split(numbers, ends), shapes, strict=True)]


def source(T: Topology, layout: Layout, given: Prescribed) -> str:
    """C++ of a topology; `given` shows the shapes of what is prescribed."""
    tape, saddle = Tape(), Saddle(T)
    inputs = Inputs(tape, T, layout, given)

    def traced(f: Callable[..., Any]) -> list[np.ndarray]:
        with separate():
            return tape.trace(inputs.function(saddle, f), *inputs.flat)

    (R,) = traced(lambda step, z, dz: step.residual(z))
    (K,) = traced(lambda step, z, dz: step.matrix(z))
    (dR,) = traced(lambda step, z, dz: step.residual(Pair.of(z, dz)).tangent)
    new = traced(lambda step, z, dz: [y.value for y in step.finish(z, dz)])
    moved = traced(lambda step, z, dz: [y.tangent for y in step.finish(z, dz)])
    if len(tape.op) > MOST:
        raise MbdError(f"a step has {len(tape.op)} operations; more than {MOST} are not compiled")
    arrays = {name: f"in.{name}" for name in ("x", "d", "z", "dx", "dd", "dz", "u")}
    emitter = Emitter(tape, arrays)
    tangents = [_flat([dR]), _flat(moved)]
    inner = _boundary(tape, emitter, [*tangents[0], *tangents[1]])
    known = {node: f"in.b[{i}]" for i, node in enumerate(inner)}
    n = T.n_v + T.rows
    entries = [(i, node) for i, node in enumerate(_flat([K])) if node != tape.zero]
    functions = [
        emitter.function("residual", _flat([R])),
        emitter.function("matrix", [node for _, node in entries]),
        emitter.function("finish", _flat(new)),
        emitter.function("boundary", inner),
        emitter.function("residual_tangent", tangents[0], known),
        emitter.function("finish_tangent", tangents[1], known),
    ]
    pattern = np.zeros((n, n), dtype=bool)
    pattern.flat[[i for i, _ in entries]] = True
    sizes = {"N_Q": T.n_q, "N_V": T.n_v, "ROWS": T.rows, "BOUNDARY": len(inner), "ROOM": emitter.room}
    constants = "".join(f"constexpr int {k} = {v};\n" for k, v in (sizes | {"MATRIX": len(entries)}).items())
    tables = _table("PLACES", [i for i, _ in entries]) + factorization(pattern, T.n_v)
    return "\n".join([PRELUDE, _IN, constants, tables, *functions, (Path(__file__).parent / "march.cpp").read_text()])


def _flat(arrays: Sequence[np.ndarray]) -> list[int]:
    return [int(i) for x in arrays for i in x.ravel()]


def _boundary(tape: Tape, emitter: Emitter, outputs: list[int]) -> list[int]:
    """Values that the operations on tangents need, other than inputs."""
    moving = {i for i, op in enumerate(tape.op) if op == "input" and tape.args[i][0] in ("dx", "dd", "dz")}
    order = emitter.order(outputs)
    for node in order:
        if any(a in moving for a in tape.args[node]):
            moving.add(node)
    needed = {a for node in order if node in moving for a in tape.args[node]} | set(outputs)
    return sorted(a for a in needed if a not in moving and tape.op[a] not in ("input", "constant"))


def factorization(pattern: np.ndarray, first: int) -> str:
    """Tables of the elimination of a matrix with a pattern: the `first` rows in their order, the others by least degree."""
    n = len(pattern)
    full = pattern | pattern.T | np.eye(n, dtype=bool)
    left, order = full.copy(), []
    remaining = list(range(n))
    rows: list[list[int]] = []
    while remaining:
        some = [i for i in remaining if i < first][:1] or remaining
        pivot = min(some, key=lambda i: int(left[i].sum()))
        remaining.remove(pivot)
        beside = [i for i in remaining if left[pivot, i]]
        left[np.ix_(beside, beside)] = True
        left[:, pivot] = False
        order.append(pivot)
        rows.append(beside)
    starts = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).tolist()
    flat = [i for r in rows for i in r]
    return _table("ORDER", order) + _table("START", starts) + _table("BESIDE", flat)


def _table(name: str, numbers: Sequence[int]) -> str:
    return f"static const int {name}[] = {{{', '.join(map(str, numbers)) or '0'}}};\n"
