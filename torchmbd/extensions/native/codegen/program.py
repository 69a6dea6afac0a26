"""A program: operations on numbers that depend on loop variables, and buffers in which they are stored.

    number   an operation of a tape (scalars.py), or a load from a buffer at an index; it has a value for each
             value of the loop variables that its index, or its arguments, depend on
    write    buffer[index] = number, or += number, for all values of some loop variables

A sum over an axis, a sum of segments and a gather by a table use buffers; all other operations are one expression.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torchmbd.extensions.native.codegen.scalars import Tape
from torchmbd.extensions.native.codegen.size import (
    AnySize,
    Index,
    Size,
    Variable,
    constant_index,
    loop_index,
    loop_variables,
    with_substitutions,
)


class Write(NamedTuple):
    """buffer[index] = number for all values of the variables; adds: += number."""

    buffer: str
    variables: tuple[Variable, ...]
    index: Index
    number: int
    adds: bool


@dataclass(eq=False)
class Buffer:
    """Numbers in memory.

    kind    "lanes": an input with a number for each lane; "uniform": an input that all lanes share;
            "scratch": written and read by the program; "output"
    order   a scratch buffer is complete before the number with this index is computed
    """

    name: str
    size: AnySize
    kind: str
    writes: list[Write] = field(default_factory=list)
    order: int = 0


class Program(Tape):
    """The tape of several functions; see the module header. `inner`: sizes of axes whose loops are inside of others."""

    def __init__(self, inner: Iterable[Size] = ()) -> None:
        super().__init__()
        self.buffers: dict[str, Buffer] = {}
        self.inner = frozenset(inner)
        self._variables: dict[int, frozenset[Variable]] = {}
        self._stored: dict[int, int] = {}

    def buffer(self, name: str, size: AnySize, kind: str) -> Buffer:
        """A new buffer."""
        assert name not in self.buffers, name
        self.buffers[name] = Buffer(name, size, kind, order=len(self.op))
        return self.buffers[name]

    def scratch(self, size: AnySize) -> Buffer:
        """A new scratch buffer."""
        return self.buffer(f"t{len(self.buffers)}", size, "scratch")

    def write(self, buffer: Buffer, over: Sequence[Variable], index: Index, number: int, adds: bool = False) -> None:
        """Append a write to a buffer."""
        if adds and number == self.zero:
            return
        over = self.loops(over, index)
        buffer.writes.append(Write(buffer.name, over, index, number, adds))
        buffer.order = len(self.op)

    def loops(self, over: Iterable[Variable], index: Index) -> tuple[Variable, ...]:
        """The loops of a write, outermost first; of the inner loops those first on which the index depends."""
        kept = loop_variables(index)
        return tuple(sorted(over, key=lambda v: (v.size in self.inner, v not in kept, *self.rank(v))))

    def rank(self, v: Variable) -> tuple:
        """Order of loops: outer ones first."""
        return v.size in self.inner, repr(v.size), v.number

    def load(self, buffer: str, index: Index) -> int:
        """The number at an index of a buffer: the written number if one write is known to be the one, else a load."""
        if self.buffers[buffer].kind == "scratch":
            for write in self.buffers[buffer].writes:
                mapping = None if write.adds else _matched(write, index)
                if mapping is not None:
                    return self.substitute(write.number, mapping)
        return self._node("load", buffer, index)

    def variables(self, number: int) -> frozenset[Variable]:
        """Loop variables that a number depends on."""
        if number not in self._variables:
            for node in self.reachable([number], self._variables):
                self._variables[node] = self._node_variables(node)
        return self._variables[number]

    def _node_variables(self, node: int) -> frozenset[Variable]:
        if self.op[node] == "constant":
            return frozenset()
        if self.op[node] == "load":
            return loop_variables(self.args[node][1])
        return frozenset().union(*(self._variables[a] for a in self.args[node]))

    def operands(self, node: int) -> tuple[int, ...]:
        """Arguments of a number; none of a constant or a load."""
        return () if self.op[node] in ("constant", "load") else self.args[node]

    def reachable(self, numbers: Iterable[int], without: Any = ()) -> list[int]:
        """Numbers with all their arguments, arguments first, but not those of `without` and what only they need."""
        result: set[int] = set()
        stack = list(numbers)
        while stack:
            node = stack.pop()
            if node not in result and node not in without:
                result.add(node)
                stack += self.operands(node)
        return sorted(result)  # arguments have smaller indices

    def substitute(self, number: int, mapping: Mapping[Variable, Index]) -> int:
        """The number with other indices in place of some variables."""
        return self.substitute_all([number], mapping)[0]

    def substitute_all(self, numbers: Sequence[int], mapping: Mapping[Variable, Index]) -> list[int]:
        """Numbers with other indices in place of some variables."""
        mapping = {v: x for v, x in mapping.items() if x != loop_index(v)}
        if not mapping:
            return list(numbers)
        keys = mapping.keys()
        new: dict[int, int] = {}
        for node in self.reachable(numbers):
            if not self.variables(node) & keys:
                new[node] = node
            elif self.op[node] == "load":
                name, index = self.args[node]
                new[node] = self.load(name, with_substitutions(index, mapping))
            else:
                new[node] = self.call(self.op[node], *(new[a] for a in self.args[node]))
        return [new[x] for x in numbers]

    def stored(self, numbers: Iterable[int]) -> dict[int, int]:
        """For each number the same value as a constant or a load; other numbers are written to a new buffer."""
        missing = [
            x for x in dict.fromkeys(numbers) if self.op[x] not in ("constant", "load") and x not in self._stored
        ]
        groups: dict[tuple[Variable, ...], list[int]] = {}
        for x in missing:
            groups.setdefault(tuple(sorted(self.variables(x), key=self.rank)), []).append(x)
        for over, group in groups.items():
            buffer = self.scratch(len(group) * product(v.size for v in over))
            for k, x in enumerate(group):
                index = row_major(over).times(len(group)).plus(k)
                self.write(buffer, over, index, x)
            for k, x in enumerate(group):
                index = row_major(over).times(len(group)).plus(k)
                self._stored[x] = self._node("load", buffer.name, index)
        return {x: self._stored.get(x, x) for x in numbers}

    def sums(self, numbers: Sequence[int], over: Sequence[Variable]) -> list[int]:
        """Each number summed over some variables."""
        summed, result = set(over), {}
        groups: dict[tuple[Variable, ...], list[int]] = {}
        for x in dict.fromkeys(numbers):
            if x == self.zero:
                result[x] = x
            else:
                groups.setdefault(tuple(sorted(self.variables(x) - summed, key=self.rank)), []).append(x)
        for kept, group in groups.items():
            buffer = self.scratch(len(group) * product(v.size for v in kept))
            index = row_major(kept).times(len(group))
            for k, x in enumerate(group):
                self.write(buffer, (*kept, *over), index.plus(k), x, adds=True)
            for k, x in enumerate(group):
                result[x] = self._node("load", buffer.name, index.plus(k))
        return [result[x] for x in numbers]

    def sums_over(self, number: int, kept: Iterable[Variable], over: Sequence[Variable]) -> int:
        """A number of `kept` variables summed over others, also those on which it does not depend."""
        kept = sorted(kept, key=self.rank)
        buffer = self.scratch(product(v.size for v in kept))
        self.write(buffer, (*kept, *over), row_major(kept), number, adds=True)
        return self._node("load", buffer.name, row_major(kept))


def product(sizes: Iterable[AnySize]) -> AnySize:
    """The product of sizes."""
    total: AnySize = 1
    for size in sizes:
        total = total * size
    return total


def row_major(over: Sequence[Variable]) -> Index:
    """Index of the values of some variables in row-major order: the last variable runs fastest."""
    index = constant_index(0)
    for v in over:
        index = index.times(v.size).plus(loop_index(v))
    return index


def _matched(write: Write, index: Index) -> dict[Variable, Index] | None:
    """Values of the variables of a write for which it writes to an index; None unless they are known for all values."""
    if write.index.offset != index.offset or len(write.index.terms) != len(index.terms):
        return None
    atoms = dict(index.terms)
    values: dict[Variable, Index] = {}
    for stride, atom in write.index.terms:
        other = atoms.get(stride)
        if not isinstance(atom, Variable) or not isinstance(other, Variable) or other.size != atom.size:
            return None
        values[atom] = loop_index(other)
    return values if len(values) == len(write.variables) else None


class Dependence:
    """Which numbers of a program depend on some buffers, directly or through scratch buffers."""

    def __init__(self, program: Program, buffers: Iterable[str]):
        self.program, self._of_buffer = program, dict.fromkeys(buffers, True)
        self._of_number: dict[int, bool] = {}

    def __call__(self, number: int) -> bool:
        """True if a number depends on the buffers."""
        program, known = self.program, self._of_number
        for x in program.reachable([number], known):
            if program.op[x] == "load":
                known[x] = self._buffer(program.args[x][0])
            else:
                known[x] = any(known[a] for a in program.operands(x))
        return known[number]

    def _buffer(self, name: str) -> bool:
        if name not in self._of_buffer:
            buffer = self.program.buffers[name]
            self._of_buffer[name] = buffer.kind == "scratch" and any(self(w.number) for w in buffer.writes)
        return self._of_buffer[name]
