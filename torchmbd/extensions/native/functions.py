"""The C++ of a kind of mechanisms: generated functions of the equations of motion, called by drivers.

    step      a step of a one-step method (step.py), driven by steps.cpp
    adjoint   the derivative of the same step in reverse mode, driven by adjoint.cpp
    rates     the index-1 right-hand side (equations.py), driven by rates.cpp
    start     accelerations and smooth start of a motion (smooth_start.py) with their derivative in reverse, driven by start.cpp

Tangents are those of one design variable, pullbacks those of one response, so that the code does not depend on how many
there are; all data may depend on the design.
Checked in tests/extensions/native/test_steps.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchmbd.extensions.native.codegen.array import Array
from torchmbd.extensions.native.codegen.emit import PRELUDE, size_text
from torchmbd.extensions.native.codegen.module import Module
from torchmbd.extensions.native.codegen.pieces import Pieces
from torchmbd.extensions.native.codegen.program import Program, Write, product
from torchmbd.extensions.native.codegen.reverse import Pullback
from torchmbd.extensions.native.codegen.size import AnySize, Index, Lookup, Size, constant_index, loop_index
from torchmbd.extensions.native.symbolic import (
    Kind,
    SymbolicBlocks,
    SymbolicTopology,
    buffer_name,
    data_arrays,
    moving_shapes,
    shapes,
)
from torchmbd.integrate.smooth_start import third_rates_of_constraints
from torchmbd.integrate.step import Model, Weights
from torchmbd.math.jet import Jet
from torchmbd.math.pair import Pair, separate_tangents, value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.topology import Prescribed
from torchmbd.multibody.saddle.blocks import Slopes
from torchmbd.results.state import State


class _Traced:
    """Inputs of the functions of a kind, and the module that they are collected in."""

    def __init__(self, kind: Kind):
        self.kind = kind
        self.program = Program([Size("M")])
        T = self.T = SymbolicTopology(kind, self.program)
        self.blocks = SymbolicBlocks(T)
        self.names = [*shapes(kind), *moving_shapes(kind)]
        self.values = data_arrays(self.program, kind, "d_")
        tangents = data_arrays(self.program, kind, "e_")
        self.data: Any = {name: Pair.of(x, tangents[name]) for name, x in self.values.items()}
        moving = [
            "dx",
            "dz",
            "y",
            "mu",
            "strength_tangents",
            "signal_bars",
            *(f"e_{buffer_name(name)}" for name in self.names),
        ]
        self.module = Module(self.program, moving)
        self.step_numbers: AnySize = 0  # weights of the method and what drives prescribe, so far
        self.entries: AnySize = 0  # of the matrix

    def state(self, sizes: Sequence[AnySize]) -> list[Any]:
        """Parts of the state as pairs [n, 1, 1]."""
        parts, start = [], 0
        for n in sizes:
            x, dx = (Array.input(self.program, name, (n, 1, 1), start) for name in ("x", "dx"))
            parts.append(Pair.of(x, dx))
            start = start + n
        return parts

    def of_step(self, *shape: AnySize) -> Any:
        """The next number of a step: weights of the method and what drives prescribe, for each lane."""
        x = Array.input(self.program, "u", shape, self.step_numbers)
        self.step_numbers = self.step_numbers + product(shape)
        return x

    def prescribed(self) -> Prescribed:
        """Drives and bodies of known motion at the end of a step."""
        C = self.T.known_bodies
        A, r, t = self.of_step(3, 3, C, 1, 1), self.of_step(3, C, 1, 1), self.of_step()
        laws: list[tuple | None] = []
        for i, (kind, varies) in enumerate(self.kind.primitives):
            n = Size(f"P{i}")
            if not kind.driven:
                laws.append(None)
            elif varies:
                laws.append(tuple(self.data[f"~moving {i}"][k] for k in range(kind.driven)))
            else:
                laws.append(tuple(self.of_step(n, 1, 1) for _ in range(kind.driven)))
        return Prescribed(laws, A, r, t)

    def output(self, buffer: str, parts: Sequence[Any]) -> list[Write]:
        """Writes of arrays [n, 1, 1], one after another, to an output."""
        if buffer not in self.program.buffers:
            self.program.buffer(buffer, 0, "output")
        writes: list[Write] = []
        start: AnySize = 0
        for x in parts:
            writes += _written(self.program, buffer, x, start)
            start = start + (x.shape[0] if isinstance(x, Pieces) else product(x.shape))
        if buffer == "entries":
            self.entries = start
        return writes

    def text(self, *drivers: str) -> str:
        """The whole C++ text, with these files behind the generated functions."""
        functions = self.module.text()
        folder = Path(__file__).parent
        texts = [(folder / name).read_text() for name in ("factors.cpp", *drivers)]
        return "\n".join([PRELUDE, self._declarations(), functions, *texts])

    def _declarations(self) -> str:
        """Sizes, tables, and the struct of inputs and outputs."""
        program = self.program
        sizes = sorted(_names(program))
        tables = sorted(_tables(program))
        lines = [f"struct N {{ long {', '.join(sizes)}; }};", "struct Tables { const int "]
        lines[-1] += ", ".join(f"*{name}" for name in tables or ["none"]) + "; };"
        names = "|".join(" ".join(group) for group in (sizes, tables, self._constants()))
        lines.append(f'extern "C" const char* needed() {{ return "{names}"; }}')
        lines.append("struct In {\n  N n;\n  Tables tables;\n  V* w;\n  const long* o;\n  const V* slopes;")
        fields = {"lanes": "const V", "uniform": "const double", "output": "V"}
        always = {"x": "lanes", "z": "lanes", "dx": "lanes", "dz": "lanes", "u": "lanes", "signals": "output"}
        always |= {
            "strengths": "lanes",
            "strength_tangents": "lanes",
            "strength_bars": "output",
            "signal_bars": "lanes",
        }
        kinds = {name: b.kind for name, b in program.buffers.items() if b.kind != "scratch"}
        for name, kind in (always | kinds).items():
            lines.append(f"  {fields[kind]}* {name};")
        lines.append("};")
        lines += self._pointed()
        T = self.T
        all_shapes = shapes(self.kind) | moving_shapes(self.kind)
        data = sum((product(shape) for shape in all_shapes.values()), 0)
        for name, size in {"N_Q": T.n_q, "N_V": T.n_v, "ROWS": T.rows, "ENTRIES": self.entries, "DATA": data}.items():
            lines.append(f"#define {name} {size_text(size)}")
        return "\n".join(lines)

    def _constants(self) -> list[str]:
        """Inputs that are the same for all lanes and steps."""
        return sorted(name for name, b in self.program.buffers.items() if b.kind == "uniform")

    def _pointed(self) -> list[str]:
        """Functions that say where the data, their tangents and their cotangents are."""
        all_shapes = shapes(self.kind) | moving_shapes(self.kind)
        lines = []
        for function, prefix, kind in (
            ("data", "d_", "const V*"),
            ("data_tangents", "e_", "const V*"),
            ("data_bars", "b_", "V*"),
        ):
            lines.append(f"static inline void point_{function}(In& in, {kind} at) {{\n  const N& n = in.n;\n  (void)n;")
            for name, shape in all_shapes.items():
                field = prefix + buffer_name(name)
                if field in self.program.buffers:
                    lines.append(f"  in.{field} = at;")
                lines.append(f"  at += {size_text(product(shape))};")
            lines.append("  (void)at;\n}")
        lines.append("static inline void point_constants(In& in, const double* const* at) {\n  (void)in, (void)at;")
        lines += [f"  in.{name} = at[{i}];" for i, name in enumerate(self._constants())]
        return [*lines, "}"]


def _names(program: Program) -> set[str]:
    """Names of all sizes that a program may use."""
    result = {"B", "F", "M", "V", "W", "C"}

    def add(size: AnySize) -> None:
        if isinstance(size, Size):
            for names, _ in size.terms:
                result.update(names)

    def index(x: Index) -> None:
        add(x.offset)
        for stride, atom in x.terms:
            add(stride)
            if isinstance(atom, Lookup):
                index(atom.index)
            else:
                add(atom.size)

    for node, op in enumerate(program.op):
        if op == "load":
            index(program.args[node][1])
    for buffer in program.buffers.values():
        add(buffer.size)
        for write in buffer.writes:
            index(write.index)
            for v in write.variables:
                add(v.size)
    return result


def _tables(program: Program) -> set[str]:
    tables: set[str] = set()

    def index(x: Index) -> None:
        for _, atom in x.terms:
            if isinstance(atom, Lookup):
                tables.add(atom.table)
                index(atom.index)

    for node, op in enumerate(program.op):
        if op == "load":
            index(program.args[node][1])
    for buffer in program.buffers.values():
        for write in buffer.writes:
            index(write.index)
    return tables


def _written(program: Program, buffer: str, x: Any, start: AnySize) -> list[Write]:
    """Writes of an array in row-major order."""
    if isinstance(x, Pieces):
        assert x.axis == 0
        writes = []
        for part, length in zip((p for p, _ in x.parts), x.lengths(), strict=True):
            writes += _written(program, buffer, part, start)
            start = start + length
        return writes
    writes = []
    loops = x.variables
    for k in np.ndindex(*x.numbers.shape):
        index = constant_index(0)
        for i, n, v in zip(k, x.shape, x.loops, strict=True):
            index = index.times(n).plus(loop_index(v) if v is not None else i)
        over = tuple(sorted(loops, key=program.rank))
        writes.append(Write(buffer, over, index.plus(start), int(x.numbers[k]), False))
    return writes


class _Step(_Traced):
    """The functions of a step."""

    def __init__(self, kind: Kind):
        super().__init__(kind)
        T = self.T
        self.sizes = [T.n_q, T.n_v, T.n_v, T.n_v, T.rows]
        weights = Weights(*(self.of_step() for _ in Weights._fields))
        prescribed = self.prescribed()
        self.model = Model(T, _Saddle(self.blocks), weights, self.data, None)  # pyright: ignore  # it compares no unknowns
        self.step: Any = self.model.step(State(*self.state(self.sizes)), prescribed)
        n = T.n_v + T.rows
        self.z, self.dz = (Array.input(self.program, name, (n, 1, 1)) for name in ("z", "dz"))

    def residual(self, name: str = "R") -> list[Write]:
        return self.output(name, [self.step.residual(self.z)])

    def finish(self, name: str = "next") -> list[Write]:
        return self.output(name, list(self.step.finish(self.z)))

    def signals(self) -> list[Write]:
        return self.output("signals", self.T.links.signals(self.step.action_states(self.z)))

    def matrix(self) -> list[Write]:
        blocks, slopes = self.step.matrix(self.z)
        entries = [blocks[name] for name, _ in self.blocks.shapes()]
        if slopes is not None:
            entries += [slopes[0][name] for name, _ in self.blocks.action_shapes()] + [slopes[1]]
        return self.output("entries", [x.as_array() for x in entries if 0 not in x.shape])


class _Saddle:
    """Saddle whose matrix is its blocks."""

    def __init__(self, blocks: SymbolicBlocks):
        self.blocks = blocks

    def matrix(self, data: Any, placed: Any, slopes: Slopes) -> Any:
        """Blocks by name, and the slopes of the actions or None."""
        blocks = self.blocks(data, placed, slopes)
        if not self.blocks.T.actions:
            return blocks, None
        states = equations.action_states(self.blocks.T, data, placed, slopes.v)
        return blocks, self.blocks.action_slopes(data, placed, states, slopes)


def _step(kind: Kind) -> str:
    with separate_tangents():
        s = _Step(kind)
        s.module.values = {"signals": s.signals(), "residual": s.residual(), "finish": s.finish(), "matrix": s.matrix()}
        residual = s.step.residual(Pair.of(s.z, s.dz)).tangent
        signals = s.T.links.signals(s.step.action_states(Pair.of(s.z, s.dz)))
        finish = [y.tangent for y in s.step.finish(s.z, s.dz)]
        s.module.moving = {"residual_tangent": s.output("R", [residual]), "finish_tangent": s.output("next", finish)}
        s.module.moving["signal_tangents"] = s.output("signals", [x.tangent for x in signals])
    return s.text("feedback.cpp", "steps.cpp")


def _adjoint(kind: Kind) -> str:
    with separate_tangents():
        s = _Step(kind)
        p = s.program
        residual, finish, signals = s.residual(), s.finish(), s.signals()
        s.module.values = {"matrix": s.matrix(), "signals": list(signals)}
        for name in ("y", "mu", "signal_bars"):
            p.buffer(name, 0, "lanes")
        for name in ("z_bar", "x_bar", "strength_bars", *(f"b_{buffer_name(name)}" for name in s.names)):
            p.buffer(name, 0, "output")
        for name in ("R", "next"):
            p.buffers.pop(name)
        of_state, of_z, of_strengths = {"x": "x_bar"}, {"z": "z_bar"}, {"strengths": "strength_bars"}
        of_data = {f"d_{buffer_name(name)}": f"b_{buffer_name(name)}" for name in s.names}
        s.module.moving = {
            "pull_end": Pullback(p, of_z | of_state)(finish, lambda index: p.load("y", index)),
            "pull_unknowns": Pullback(p, of_z | of_strengths)(residual, lambda index: p.load("mu", index)),
            "pull_known": Pullback(p, of_state | of_data | of_strengths)(
                residual, lambda index: p.call("neg", p.load("mu", index))
            ),
            "pull_signals_unknowns": Pullback(p, of_z)(signals, lambda index: p.load("signal_bars", index)),
            "pull_signals_known": Pullback(p, of_state | of_data)(signals, lambda index: p.load("signal_bars", index)),
        }
    return s.text("feedback.cpp", "adjoint.cpp")


class _Accelerations:
    """The residual of the accelerations at a state, and what drives prescribe there."""

    def __init__(self, s: _Traced):
        T, self.T = s.T, s.T
        self.rate, t = s.of_step(), s.of_step()
        self.jets: list[Any] = []
        for i, (primitive, _) in enumerate(s.kind.primitives):
            n = Size(f"P{i}")
            parts = [Jet(*(s.of_step(n, 1, 1) for _ in range(3))) for _ in range(primitive.driven)]
            self.jets.append(tuple(parts) if parts else None)
        self.eye = Array.input(s.program, "ground_A", (3, 3, T.known_bodies, 1, 1), kind="uniform")
        self.origin = Array.input(s.program, "ground_r", (3, T.known_bodies, 1, 1), kind="uniform")
        self.prescribed = self.known([d and tuple(jet.value for jet in d) for d in self.jets], t)
        self.z = Array.input(s.program, "z", (T.n_v + T.rows, 1, 1))

    def known(self, laws: list[tuple | None], t: Any) -> Prescribed:
        """The placement of the ground and the values of drives; systems with other prescribed bodies are not compiled."""
        return Prescribed(laws, self.eye, self.origin, t)  # pyright: ignore[reportArgumentType]

    def placement(self, data: Any, q: Any) -> Any:
        return equations.placement(self.T, data, q, self.prescribed)  # pyright: ignore[reportArgumentType]

    def residual(self, z: Any, data: Any, q: Any, v: Any) -> Any:
        T, placed = self.T, self.placement(data, q)
        return equations.stabilized_residual(T, data, placed, v, z[: T.n_v], z[T.n_v :], self.jets, self.rate)  # pyright: ignore

    def matrix(self, s: _Traced, q: Any) -> list[Write]:
        blocks = s.blocks(s.values, self.placement(s.values, q))
        entries = [blocks[name] for name, _ in s.blocks.shapes()]
        return s.output("entries", [x.as_array() for x in entries if 0 not in x.shape])


def _rates(kind: Kind) -> str:
    with separate_tangents():
        s = _Traced(kind)
        T = s.T
        q, v = s.state([T.n_q, T.n_v])
        of = _Accelerations(s)
        plain = value(q), value(v)

        def signals(data: Any, q: Any, v: Any) -> list[Any]:
            states = equations.action_states(T, data, of.placement(data, q), v)  # pyright: ignore
            return T.links.signals(states)

        s.module.values = {
            "signals": s.output("signals", signals(s.values, *plain)),
            "residual": s.output("R", [of.residual(of.z * 0.0, s.values, *plain)]),
            "kinematics": s.output("next", [equations.coordinate_rates(T, *plain)]),  # pyright: ignore
            "matrix": of.matrix(s, plain[0]),
        }
        s.module.moving = {
            "signal_tangents": s.output("signals", [x.tangent for x in signals(s.data, q, v)]),
            "residual_tangent": s.output("R", [of.residual(of.z, s.data, q, v).tangent]),
            "kinematics_tangent": s.output("next", [equations.coordinate_rates(T, q, v).tangent]),  # pyright: ignore
        }
    return s.text("feedback.cpp", "rates.cpp")


def _start(kind: Kind) -> str:
    with separate_tangents():
        s = _Traced(kind)
        T: Any = s.T
        p, data = s.program, s.values
        q, v, vd = (value(x) for x in s.state([T.n_q, T.n_v, T.n_v]))
        by_turning, by_third, h = s.of_step(), s.of_step(), s.of_step()  # the first two: see start.cpp
        of = _Accelerations(s)
        laws: list[tuple | None] = [
            tuple(s.of_step(Size(f"P{i}"), 1, 1) for _ in range(primitive.driven)) or None
            for i, (primitive, _) in enumerate(kind.primitives)
        ]

        def along(z: Any) -> Any:
            placed = of.placement(data, q)
            end = equations.placement(T, data, equations.advance(T, q, h * v), of.known(laws, of.prescribed.t + h))
            here = equations.constraints(T, placed)
            turning, third = third_rates_of_constraints(T, data, end, here, v, vd, h)
            return equations.along_constraints(T, data, placed, z, by_turning * turning, by_third * third)

        s.module.values = {
            "accelerations": s.output("R", [of.residual(of.z * 0.0, data, q, v)]),
            "third_rates": s.output("R", [along(of.z * 0.0)]),
            "matrix": of.matrix(s, q),
        }
        solved = [s.output("solved", [x]) for x in (of.residual(of.z, data, q, v), along(of.z))]
        p.buffers.pop("solved")
        p.buffer("mu", 0, "lanes")
        for name in ("x_bar", *(f"b_{buffer_name(name)}" for name in s.names)):
            p.buffer(name, 0, "output")
        by = {"x": "x_bar"} | {f"d_{buffer_name(name)}": f"b_{buffer_name(name)}" for name in s.names}
        s.module.moving = {
            f"pull_{name}": Pullback(p, by)(writes, lambda index: p.load("mu", index))
            for name, writes in zip(("accelerations", "third_rates"), solved, strict=True)
        }
    return s.text("start.cpp")


_KINDS: dict[str, Callable[[Kind], str]] = {"step": _step, "adjoint": _adjoint, "rates": _rates, "start": _start}


def source(kind: Kind, function: str) -> str:
    """C++ of a kind of mechanisms: "step", "adjoint", "rates" or "start"."""
    return _KINDS[function](kind)
