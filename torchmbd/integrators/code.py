"""The C++ of one topology: straight-line code out of torch functions, around it texts that are the same for all.

    step      a step of generalized-alpha (step.py), driven by march.cpp
    adjoint   the derivative of the same step in reverse mode, driven by adjoint.cpp
    rates     the index-1 right-hand side (equations.py), driven by rates.cpp

Tangents are written out for one design variable, pullbacks for one response, so that the code does not depend on how many
there are; all data may depend on the design. What they need of the values is kept from the values ("boundary"). Beside the
code stand the tables of a sparse factorization: rates in their order, then constraints by least degree. So the time per
link of a chain is constant.
Checked in tests/integrators/test_compiled.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import MbdError
from torchmbd.integrators.layout import Layout, distinct, moving
from torchmbd.integrators.step import Model, State, Weights
from torchmbd.numerics.emit import PRELUDE, Emitter
from torchmbd.numerics.jet import Jet
from torchmbd.numerics.pair import Pair, separate, value
from torchmbd.numerics.reverse import pullback
from torchmbd.numerics.scalars import Tape
from torchmbd.system import equations
from torchmbd.system.saddle import Saddle
from torchmbd.system.topology import Prescribed, Topology

MOST = 400_000  # operations, beyond which a compiler takes too long
_IN = "struct In { const V *x, *d, *z, *dx, *dd, *dz, *y, *mu, *b; const double* u; };\n"
_MOVING = ("dx", "dd", "dz", "y", "mu")  # what differs from one variable, or from one response, to the next


class Code(NamedTuple):
    """Functions of a tape that a driver calls; results of f(z, dz, state, data, uniform), see `Writer.traced`.

    values, tangents   name -> f, without and with the tangents of one variable
    matrix             f of the iteration matrix
    driver             its text
    pulled             name -> the derivatives of values by arrays, weighted with an array
    """

    values: dict[str, Callable[..., Any]]
    tangents: dict[str, Callable[..., Any]]
    matrix: Callable[..., Any]
    driver: str
    pulled: Mapping[str, Pulled] = MappingProxyType({})


class Pulled(NamedTuple):
    """Derivatives of sum(weights * values[of]) by the numbers of the arrays `by`, one array after another."""

    of: str
    weights: str
    by: tuple[str, ...]


def step(T: Topology, given: Prescribed) -> tuple[Code, list[int], list[tuple[int, ...]]]:
    """Code of a step, sizes of the parts of its state, shapes of what all lanes share.

    `given` shows those of the laws: () for laws with design variables, which are moving.
    """
    saddle = Saddle(T)

    def of(f: Callable[..., Any]) -> Callable[..., Any]:
        def traced(z: Tensor, dz: Tensor, state: list[Pair], data: dict[str, Pair], uniform: Iterator[Tensor]) -> Any:
            weights = Weights(*next(uniform).unbind(0))
            A, r, t = (next(uniform) for _ in range(3))
            laws: list = [law if law is None else tuple(next(uniform) for _ in law) for law in given.laws]
            for i in [i for i, law in enumerate(laws) if law == ()]:
                laws[i] = tuple(data[moving(i)][k] for k in range(T.primitives[i].driven))
            return f(Model(T, saddle, weights, data).step(State(*state), Prescribed(laws, A, r, t)), z, dz)

        return traced

    values = {
        "residual": of(lambda step, z, dz: step.residual(z)),
        "finish": of(lambda step, z, dz: torch.cat([y.value for y in step.finish(z, dz)])),
    }
    tangents = {
        "residual_tangent": of(lambda step, z, dz: step.residual(Pair.of(z, dz)).tangent),
        "finish_tangent": of(lambda step, z, dz: torch.cat([y.tangent for y in step.finish(z, dz)])),
    }
    code = Code(values, tangents, of(lambda step, z, dz: step.matrix(z)), "march.cpp")
    parts = [given.A, given.r, given.t, *(part for law in given.laws if law is not None for part in law)]
    return code, [T.n_q, T.n_v, T.n_v, T.n_v, T.rows], [(len(Weights._fields),), *(tuple(x.shape) for x in parts)]


def adjoint(T: Topology, given: Prescribed) -> tuple[Code, list[int], list[tuple[int, ...]]]:
    """Code of a step in reverse mode; the arguments and the rest of what is returned as of `step`."""
    code, state, uniform = step(T, given)
    pulled = {
        "pull_end": Pulled("finish", "y", ("z", "x")),
        "pull_unknowns": Pulled("residual", "mu", ("z",)),
        "pull_known": Pulled("residual", "mu", ("x", "d")),
    }
    return code._replace(tangents={}, driver="adjoint.cpp", pulled=pulled), state, uniform


def rates(T: Topology, drives: list[tuple | None]) -> tuple[Code, list[int], list[tuple[int, ...]]]:
    """Code of the right-hand side; `drives`: laws with their slopes (Topology.law_jets), which show their shapes."""
    saddle = Saddle(T)
    eye = torch.eye(3, dtype=torch.float64)[..., None, None, None]  # no carriers but the ground

    def of(f: Callable[..., Any]) -> Callable[..., Any]:
        def traced(z: Tensor, dz: Tensor, state: list[Pair], data: dict[str, Pair], uniform: Iterator[Tensor]) -> Any:
            rate, t = next(uniform), next(uniform)
            jets = [d and tuple(Jet(*(next(uniform) for _ in range(3))) for _ in d) for d in drives]
            given = Prescribed([d and tuple(jet.value for jet in d) for d in jets], eye, 0.0 * eye[0], t)
            return f(z, state, data, given, jets, rate)

        return traced

    def residual(z: Any, state: list[Any], data: dict[str, Any], given: Prescribed, jets: list, rate: Any) -> Any:
        at = equations.placement(T, data, state[0], given)
        return equations.stabilized_residual(T, data, at, state[1], z[: T.n_v], z[T.n_v :], jets, rate)

    def plain(f: Callable[..., Any]) -> Callable[..., Any]:
        return of(lambda z, x, data, *rest: f(z, [value(y) for y in x], {k: value(y) for k, y in data.items()}, *rest))

    def matrix(z: Tensor, x: list[Any], data: dict[str, Any], given: Prescribed, *_: Any) -> Tensor:
        return saddle.matrix(data, equations.placement(T, data, x[0], given))

    values = {
        "residual": plain(lambda z, *rest: residual(torch.zeros_like(z), *rest)),
        "kinematics": plain(lambda z, x, *_: equations.coordinate_rates(T, *x)),
    }
    tangents = {
        "residual_tangent": of(lambda *rest: residual(*rest).tangent),
        "kinematics_tangent": of(lambda z, x, *_: equations.coordinate_rates(T, *x).tangent),
    }
    parts = [x for d in drives if d is not None for jet in d for x in jet.parts]
    return (
        Code(values, tangents, plain(matrix), "rates.cpp"),
        [T.n_q, T.n_v],
        [(), (), *(tuple(x.shape) for x in parts)],
    )


KINDS: dict[str, Callable[..., tuple[Code, list[int], list[tuple[int, ...]]]]] = {
    "step": step,
    "adjoint": adjoint,
    "rates": rates,
}


def source(T: Topology, layout: Layout, kind: str, sample: Any) -> str:
    """C++ of a topology; `sample` is the second argument of the kind."""
    code, state, uniform = KINDS[kind](T, sample)
    return _Writer(T, layout, state, uniform).text(code)


class _Writer:
    """Numbers of a tape for everything that functions are made of, and the functions written out."""

    def __init__(self, T: Topology, layout: Layout, state: list[int], uniform: list[tuple[int, ...]]):
        self.T, self.layout, self.tape = T, layout, Tape()
        inputs, n = self.tape.inputs, len(layout.names)
        self.counts = [1, 1, len(state), len(state), n, n, len(uniform)]
        parts = [(k, 1, 1) for k in state]
        self.arrays: dict[str, list[int]] = {}  # all numbers of an input array, in their order
        self.flat = [inputs(name, T.n_v + T.rows, 1, 1) for name in ("z", "dz")]
        self.arrays["z"] = self.flat[0].ravel().tolist()
        for name, shapes in (("x", parts), ("dx", parts)):
            numbers = inputs(name, sum(_size(s) for s in shapes))
            self.arrays[name] = numbers.tolist()
            self.flat += _cut(numbers, shapes)
        self.flat += self._data("d") + self._data("dd")
        self.flat += _cut(inputs("u", sum(_size(s) for s in uniform)), uniform)

    def _data(self, array: str) -> list[np.ndarray]:
        """Numbers of the data, or of their tangents; of those that hold every number twice one half stands for both."""
        found, start = [], 0
        for name, shape in zip(self.layout.names, self.layout.shapes, strict=True):
            taken, index, signs = distinct(name, shape)
            numbers = self.tape.inputs(array, len(taken), start=start)
            start += len(taken)
            signed = {
                1: numbers,
                -1: np.array([self.tape.call("neg", int(x)) for x in numbers] if -1 in signs else numbers),
                0: np.full_like(numbers, self.tape.zero),
            }
            flat = [signed[sign][i] for i, sign in zip(index.tolist(), signs.tolist(), strict=True)]
            found.append(np.array(flat, dtype=np.int64).reshape(*shape, 1, 1))
        self.arrays[array] = self.tape.inputs(array, start).tolist()
        return found

    def traced(self, f: Callable[..., Any]) -> list[int]:
        """f of numbers z, dz, a list of pairs (the state), the data by name, and an iterator of what all lanes share."""

        def flat(*tensors: Tensor) -> Tensor:
            rest = iter(tensors)
            (z,), (dz,), x, dx, d, dd, u = ([next(rest) for _ in range(n)] for n in self.counts)
            state, data = ([Pair.of(*both) for both in zip(*p, strict=True)] for p in ((x, dx), (d, dd)))
            return f(z, dz, state, dict(zip(self.layout.names, data, strict=True)), iter(u))

        with separate():
            (found,) = self.tape.trace(flat, *self.flat)
        self._check_length()
        return [int(i) for i in found.ravel()]

    def _check_length(self) -> None:
        if len(self.tape.op) > MOST:
            raise MbdError(f"a step has more than {MOST} operations: it is not compiled")

    def text(self, code: Code) -> str:
        """The whole C++ text."""
        n = self.T.n_v + self.T.rows
        values, tangents = ({k: self.traced(f) for k, f in fs.items()} for fs in (code.values, code.tangents))
        entries = [(i, node) for i, node in enumerate(self.traced(code.matrix)) if node != self.tape.zero]
        pulled = {name: self._pulled(values[what.of], what) for name, what in code.pulled.items()}
        moving = tangents | {name: [node for _, node in found] for name, found in pulled.items()}
        emitter = Emitter(self.tape, {name: f"in.{name}" for name in ("x", "d", "z", "u", *_MOVING)})
        inner = self._boundary(emitter, [node for outputs in moving.values() for node in outputs])
        known = {node: f"in.b[{i}]" for i, node in enumerate(inner)}
        functions = [] if pulled else [emitter.function(name, outputs) for name, outputs in values.items()]
        functions.append(emitter.function("matrix", [node for _, node in entries]))
        functions.append(emitter.function("boundary", inner))
        functions += [emitter.function(name, outputs, known) for name, outputs in moving.items()]
        pattern = np.zeros((n, n), dtype=bool)
        pattern.flat[[i for i, _ in entries]] = True
        sizes = {"N_Q": self.T.n_q, "N_V": self.T.n_v, "ROWS": self.T.rows, "ROOM": emitter.room}
        sizes |= {"BOUNDARY": len(inner), "MATRIX": len(entries)}
        sizes |= {name.upper(): len(found) for name, found in pulled.items()}
        constants = "".join(f"constexpr int {k} = {v};\n" for k, v in sizes.items())
        tables = _table("PLACES", [i for i, _ in entries]) + factorization(pattern, self.T.n_v)
        tables += "".join(_table(f"{name.upper()}_AT", [i for i, _ in found]) for name, found in pulled.items())
        texts = [(Path(__file__).parent / name).read_text() for name in ("factors.cpp", code.driver)]
        return "\n".join([PRELUDE, _IN, constants, tables, *functions, *texts])

    def _pulled(self, outputs: list[int], what: Pulled) -> list[tuple[int, int]]:
        """Place and number of each derivative that is not zero."""
        weights = self.tape.inputs(what.weights, len(outputs)).tolist()
        by = [node for array in what.by for node in self.arrays[array]]
        found = pullback(self.tape, outputs, weights, by)
        self._check_length()
        return [(i, node) for i, node in enumerate(found) if node != self.tape.zero]

    def _boundary(self, emitter: Emitter, outputs: list[int]) -> list[int]:
        """Values that the operations on tangents need, other than inputs."""
        tape = self.tape
        moving = {i for i, op in enumerate(tape.op) if op == "input" and tape.args[i][0] in _MOVING}
        order = emitter.order(outputs)
        for node in order:
            if any(a in moving for a in tape.args[node]):
                moving.add(node)
        needed = {a for node in order if node in moving for a in tape.args[node]} | set(outputs)
        return sorted(a for a in needed if a not in moving and tape.op[a] not in ("input", "constant"))


def _size(shape: tuple[int, ...]) -> int:
    return int(np.prod(shape, dtype=int))


def _cut(numbers: np.ndarray, shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
    ends = np.cumsum([_size(s) for s in shapes])[:-1]
    return [x.reshape(s) for x, s in zip(np.split(numbers, ends), shapes, strict=True)]


def factorization(pattern: np.ndarray, first: int) -> str:
    """Tables of the elimination of a matrix with a pattern: the `first` rows in their order, the others by least degree."""
    n = len(pattern)
    left = pattern | pattern.T | np.eye(n, dtype=bool)
    remaining, order = list(range(n)), []
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
    return _table("ORDER", order) + _table("START", starts) + _table("BESIDE", [i for r in rows for i in r])


def _table(name: str, numbers: Sequence[int]) -> str:
    return f"TABLE {name}[] = {{{', '.join(map(str, numbers)) or '0'}}};\n"
