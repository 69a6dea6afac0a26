"""A topology whose counts and tables are known at run time: what the equations of motion are traced with.

    sizes    B bodies, F flexible, M modes, V vectors, W vectors of flexible bodies, C prescribed bodies and the ground, U
    independent rates, E and G entries of the maps between them and all rates; P0, P1, ... primitives of each kind,
             J beam elements; K counted angles; A0, A1, ... actions of each kind and form of law; of unit multipliers (R) and
             unit strengths (D): arguments on flexible bodies, pairs, pairs with flexible bodies (RT, RP, RF)

What is not a count is part of the kind (`Kind`): one library serves all mechanisms of a kind.
Checked in tests/extensions/native/.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from torchmbd.extensions.native.codegen.array import Array, Table
from torchmbd.extensions.native.codegen.program import Program
from torchmbd.extensions.native.codegen.segment_sum import SymbolicSegmentSum
from torchmbd.extensions.native.codegen.size import AnySize, Size
from torchmbd.math.pair import Pair
from torchmbd.multibody.equations.beams import SHAPES as BEAMS
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equations.turns import Turns
from torchmbd.multibody.equations.unit_forces import UnitForces
from torchmbd.multibody.forces.action import Turn
from torchmbd.multibody.forces.feedback import Port
from torchmbd.multibody.forces.laws import data_fields
from torchmbd.multibody.forces.parametric_law import ParametricLaw
from torchmbd.multibody.joints.primitive import Primitive
from torchmbd.multibody.saddle.blocks import SaddleBlocks


class LawForm(NamedTuple):
    """A law without the numbers that are data of the code.

    kind         class of the law
    data_fields  names of the fields that hold these numbers
    plain        names and values of other fields, which are compiled
    inner        form of the law that it contains, or None
    """

    kind: type
    data_fields: tuple[str, ...]
    plain: tuple[tuple[str, Any], ...]
    inner: Any


class Form(NamedTuple):
    """A kind of action with a form of law: a LawForm, or a law that is compiled as it is."""

    kind: type
    law: Any
    center: float


class Kind(NamedTuple):
    """Everything of a mechanism that its code depends on.

    primitives   kinds of primitives, and whether what their laws prescribe depends on the design
    forms        of actions, in the order in which they come
    data         names of the data
    """

    primitives: tuple[tuple[type, bool], ...]
    forms: tuple[Form, ...]
    flexible: bool
    attached_flexible: bool
    condensed: bool
    turns: bool
    row_flexible: bool
    action_flexible: bool
    beams: bool
    data: tuple[str, ...]

    @classmethod
    def of(cls, T: Topology, data: Any, blocks: SaddleBlocks) -> Kind:
        return cls(
            tuple((type(p), p.varies) for p in T.primitives),
            tuple(groups(T)),
            T.flexible > 0,
            T.attached_flexible > 0,
            T.rates is not None,
            T.turns is not None,
            bool(blocks.rows.flexible_pairs),
            bool(blocks.actions.flexible_pairs),
            T.beams is not None,
            tuple(sorted(set(data) & SHAPES.keys())),
        )


def form(law: Any) -> tuple[Any, list[Any]]:
    """Form of a law, and its numbers in order; a number of the design is (key, row of the data)."""
    if isinstance(law, ParametricLaw):
        rows = dict(law.rows)
        shape, numbers = form(law.law)
        names = data_fields(law.law)
        variable = [(law.key, rows[name]) if name in rows else x for name, x in zip(names, numbers, strict=False)]
        return shape, variable + numbers[len(names) :]
    if isinstance(law, Port):
        return Port, []
    names = data_fields(law)
    if not names:
        return law, []
    others = {f.name: getattr(law, f.name) for f in fields(law) if f.name not in names}
    inner, numbers = form(others.pop("law")) if "law" in others else (None, [])
    return LawForm(type(law), names, tuple(others.items()), inner), [*(getattr(law, name) for name in names), *numbers]


def groups(T: Topology) -> dict[Form, list[tuple[int, int, Any]]]:
    """Actions of each form: number of the kind, number among these, law."""
    members: dict[Form, list[tuple[int, int, Any]]] = {}
    for a, action in enumerate(T.actions):
        for i, law in enumerate(action.laws):
            center = float(getattr(law, "center", 0.0)) if isinstance(action, Turn) else 0.0
            members.setdefault(Form(type(action), form(law)[0], center), []).append((a, i, law))
    return members


@dataclass(frozen=True)
class _Numbered(ParametricLaw):
    """The law of all actions of a form; its numbers are data."""

    middle: float = 0.0

    @property
    def center(self) -> float:
        return self.middle

    def at(self, data: Any) -> Any:
        count = numbers_of(self.law)
        return _law(self.law, iter([data[self.key][i] for i in range(count)] if count else []))


def numbers_of(shape: Any) -> int:
    """Numbers of a form of law."""
    return len(shape.data_fields) + numbers_of(shape.inner) if isinstance(shape, LawForm) else 0


def _law(shape: Any, numbers: Any) -> Any:
    if shape is Port:
        return Port(None)  # pyright: ignore[reportArgumentType]
    if not isinstance(shape, LawForm):
        return shape
    values = dict(shape.plain) | {name: next(numbers) for name in shape.data_fields}
    if shape.inner is not None:
        values["law"] = _law(shape.inner, numbers)
    return shape.kind(**values)


B, F, M, V, W, C, U, E, G, J, K = (Size(name) for name in ["B", "F", "M", "V", "W", "C", "U", "E", "G", "J", "K"])
# Components and loops of each datum.
SHAPES: dict[str, tuple[AnySize, ...]] = {
    "mass": (B,),
    "S0": (3, B),
    "P0": (3, 3, B),
    "mu": (B,),
    "SR": (6, M, F),
    "C0": (3, 3, M, F),
    "C1": (3, 3, M, M, F),
    "H": (3, M, M, F),
    "Kr": (M, M, F),
    "K2": (M, M, M, F),
    "D": (M, M, F),
    "V0": (6, M, F),
    "V1": (6, M, M, F),
    "L": (6, 6, F),
    "Y": (3, M, W),
    "E": (3, M, M, W),
    "x": (3, V),
    "gravity": (3, 1),
    **{name: (*core, J) for name, core in BEAMS.items()},
}


def primitive_count(i: int) -> Size:
    return Size(f"P{i}")


def constants_name(i: int) -> str:
    """Of the datum that holds the constants of primitives of a kind."""
    return f"~constants {i}"


def action_count(i: int) -> Size:
    return Size(f"A{i}")


def shapes(kind: Kind) -> dict[str, tuple[AnySize, ...]]:
    """Of all data that code of a kind takes, those of the laws included, in order; see `moving_shapes`."""
    result = {name: SHAPES[name] for name in kind.data}
    for i, (primitive, _) in enumerate(kind.primitives):
        if primitive.constants:
            result[constants_name(i)] = (primitive.constants, primitive_count(i))
    for i, action_form in enumerate(kind.forms):
        if numbers_of(action_form.law):
            result[f"~law {i}"] = (numbers_of(action_form.law), action_count(i))  # stored [actions, numbers]
    return result


def moving_shapes(kind: Kind) -> dict[str, tuple[AnySize, ...]]:
    """Of what laws with design variables prescribe, by kind of primitive: they change from step to step."""
    return {f"~moving {i}": (p.driven, primitive_count(i)) for i, (p, varies) in enumerate(kind.primitives) if varies}


class SymbolicTopology:
    """Topology with symbolic counts and tables; mechanism.py has the numbers of these."""

    def __init__(self, kind: Kind, program: Program):
        self.kind = kind
        self.bodies = B
        self.flexible = F if kind.flexible else 0
        self.modes = M if kind.flexible else 0
        self.attached_flexible = W if kind.attached_flexible else 0
        self.vectors, self.known_bodies, self.prescribed_bodies = V, C, ()
        self.n_rates = 6 * B + self.modes * self.flexible
        self.turn_count = K if kind.turns else 0
        self.n_q = B + self.n_rates + self.turn_count
        self.turns = _turns(program) if kind.turns else None
        self.n_v = U if kind.condensed else self.n_rates
        self.vector_body, self.vector_origin = Table("vector_body", V), Table("vector_origin", V)
        self.vector_flexible = Table("vector_flexible", W)
        self.vector_sum = SymbolicSegmentSum(Table("argument_vectors", V), V)
        self.action_sum = SymbolicSegmentSum(Table("action_vectors", V), V)
        self.body_sum = SymbolicSegmentSum(Table("body_groups", 2 * V), 2 * B)
        self.modal_sum = SymbolicSegmentSum(self.vector_flexible, self.flexible)
        self.beams = _Beams() if kind.beams else None
        self.spread = self.gather = None
        if kind.condensed:
            self.spread = _SparseMap(program, "spread", E, self.n_rates)
            self.gather = _SparseMap(program, "gather", G, U)
        self.primitives, start = (), 0
        for i, (p, _) in enumerate(kind.primitives):
            counts = [(primitive_count(i), start + k * primitive_count(i)) for k in range(p.angles)]
            self.primitives += (self._primitive(program, i, p, tuple(Table("turns", *x) for x in counts)),)
            start = start + p.angles * primitive_count(i)
        self.actions = tuple(
            form.kind((), (_Numbered(f"~law {i}", (), form.law, form.center),)) for i, form in enumerate(kind.forms)
        )
        self.rows = sum((p.rows * primitive_count(i) for i, p in enumerate(self.primitives)), 0)
        self.links = SymbolicLinks(kind, program)

    @staticmethod
    def _primitive(program: Program, i: int, kind: type[Primitive], turns: tuple[Any, ...]) -> Primitive:
        primitive = kind((), (), turns)
        if kind.constants:
            shape = (kind.constants, primitive_count(i))
            # in place of the numbers of a mechanism, which this property computes
            vars(primitive)["numbers"] = stored_data(program, f"d_{buffer_name(constants_name(i))}", shape)
        return primitive

    def row_slices(self) -> list[tuple[Primitive, slice]]:
        result, start = [], 0
        for i, primitive in enumerate(self.primitives):
            stop = start + primitive.rows * primitive_count(i)
            result.append((primitive, slice(start, stop)))
            start = stop
        return result

    def arguments(self, g: Any) -> list[list[Any]]:
        return self._gathered(g, self.primitives, "argument_vectors", primitive_count)

    def action_arguments(self, g: Any) -> list[list[Any]]:
        return self._gathered(g, self.actions, "action_vectors", action_count)

    @staticmethod
    def _gathered(g: Any, kinds: tuple, table: str, count: Any) -> list[list[Any]]:
        result, start = [], 0
        for i, kind in enumerate(kinds):
            n = count(i)
            result.append([g.index_select(1, Table(table, n, start + k * n)) for k in range(len(kind.arguments))])
            start = start + len(kind.arguments) * n
        return result

    def modal_identity(self, like: Any) -> Any:
        """The identity [modes, modes, 1, 1, 1], in memory."""
        return Array.input(like.program, "unit", (M, M, 1, 1, 1), kind="uniform")


def _turns(program: Program) -> Turns:
    """Turns with symbolic tables."""
    first: Any = Table("turns_first", K)
    second: Any = Table("turns_second", K)
    axes: Any = Array.input(program, "turns_axes", (5, 3, K, 1, 1), kind="uniform")
    return Turns(first, second, axes)


class SymbolicLinks:
    """Links (multibody/forces/feedback.py) in traced code: strengths of actions whose laws are called back are inputs."""

    def __init__(self, kind: Kind, program: Program):
        self.kind, self.program = kind, program
        self.count = sum((action_count(i) for i, _ in self._forms()), 0)

    def _forms(self) -> list[tuple[int, Form]]:
        return [(i, action_form) for i, action_form in enumerate(self.kind.forms) if action_form.law is Port]

    def strengths(self, states: list[tuple], law_strengths: list[Any], t: Any, data: Any) -> list[Any]:
        """Of all forms [n, 1, 1]."""
        result, start = list(law_strengths), 0
        for i, _ in self._forms():
            n = action_count(i)
            f, df = (Array.input(self.program, name, (n, 1, 1), start) for name in ("strengths", "strength_tangents"))
            result[i] = Pair.of(f, df) if isinstance(states[i][0], Pair) else f
            start = start + n
        return result

    def signals(self, states: list[tuple]) -> list[Any]:
        """s of all actions whose laws are called back, and then s'."""
        return [states[i][k] for k in range(2) for i, _ in self._forms()]


class _Beams:
    """beams.Beams with symbolic tables."""

    def __init__(self):
        self.body_sum = SymbolicSegmentSum(Table("beam_groups", 4 * J), 2 * B)

    def select(self, x: Any, dim: int) -> tuple[Any, Any]:
        return x.index_select(dim, Table("beam_ends", J)), x.index_select(dim, Table("beam_ends", J, J))


class _SparseMap:
    """index_maps.SparseMap with symbolic entries: a row, a column and a factor each."""

    def __init__(self, program: Program, name: str, entries: Size, rows: AnySize):
        self.column, self.rows = Table(f"{name}_column", entries), rows
        self.sum = SymbolicSegmentSum(Table(f"{name}_row", entries), rows)
        self.factor = Array.input(program, f"{name}_factor", (entries, 1, 1), kind="uniform")

    def __call__(self, x: Any) -> Any:
        if hasattr(x, "tangent"):
            return x.map(self)
        entries = x.index_select(0, self.column) * self.factor
        return self.sum(entries.unsqueeze(0))[0]


class _UnitForces:
    """UnitForces with symbolic tables; `letter` R or D."""

    blocks: Any = UnitForces.blocks

    def __init__(self, name: str, letter: str, arguments: AnySize, flexible: bool):
        bent, pairs, bent_pairs = (Size(f"{letter}{x}") for x in "TPF")
        self.pairs, self.flexible_pairs = pairs, bent_pairs if flexible else 0
        self.pair_body, self.argument_vector = (
            Table(f"{name}_pair_body", pairs),
            Table(f"{name}_argument_vector", arguments),
        )
        self.turn_sum = SymbolicSegmentSum(Table(f"{name}_argument_pair", arguments), pairs)
        self.force_sum = SymbolicSegmentSum(Table(f"{name}_point_pair", arguments), pairs)
        self.flexible_arguments = Table(f"{name}_bent_argument", bent)
        self.flexible_vector = Table(f"{name}_bent_vector", bent)
        self.modal_sum = SymbolicSegmentSum(Table(f"{name}_bent_pair", bent), self.flexible_pairs)

    def shapes(self, modes: Any, name: str) -> list[tuple[str, tuple]]:
        return [
            (f"{name}_force", (3, self.pairs)),
            (f"{name}_torque", (3, self.pairs)),
            (f"{name}_modal", (modes, self.flexible_pairs)),
        ]


class SymbolicBlocks(SaddleBlocks):
    """SaddleBlocks of a kind."""

    def __init__(self, T: Any):
        self.T = T
        rows = sum((p.rows * len(p.arguments) * primitive_count(i) for i, p in enumerate(T.primitives)), 0)
        strengths = sum((len(a.arguments) * action_count(i) for i, a in enumerate(T.actions)), 0)
        self.rows: Any = _UnitForces("row", "R", rows, T.kind.row_flexible)
        self.actions: Any = _UnitForces("action", "D", strengths, T.kind.action_flexible)
        self._body_sum = SymbolicSegmentSum(Table("vector_body_only", V), B)

    def _beam_shapes(self) -> list[tuple[str, tuple]]:
        return [("beam", (12, 12, J))] if self.T.beams is not None else []


def data_arrays(program: Program, kind: Kind, prefix: str) -> dict[str, Any]:
    """The data of a kind [component..., 1, 1], each in a buffer of its own; `prefix` of tangents."""
    arrays = {name: stored_data(program, prefix + buffer_name(name), shape) for name, shape in shapes(kind).items()}
    for name, shape in moving_shapes(kind).items():  # in the order in which they are given
        arrays[name] = Array.input(program, prefix + buffer_name(name), shape)[..., None, None]
    return arrays


def buffer_name(name: str) -> str:
    """Of a datum, in C++."""
    return name.replace("~", "").replace(" ", "_")


def stored_data(program: Program, name: str, shape: tuple[AnySize, ...]) -> Array:
    """A datum whose loops are outermost in memory, the last of them first; components innermost."""
    order = memory_order(shape)
    memory = Array.input(program, name, [shape[d] for d in order])
    back = [order.index(d) for d in range(len(shape))]
    numbers = memory.numbers.transpose(back)
    array = Array(program, numbers, tuple(memory.loops[d] for d in back))
    return array[..., None, None]


def memory_order(shape: tuple[AnySize, ...]) -> list[int]:
    """Axes of a datum in the order in which they are stored: the last loop, the other loops, components."""
    loops = [d for d, n in enumerate(shape) if isinstance(n, Size)]
    return loops[-1:] + loops[:-1] + [d for d, n in enumerate(shape) if not isinstance(n, Size)]
