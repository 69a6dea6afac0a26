"""A program: operations on numbers that depend on loop variables, and buffers in which they are stored.

    number   an operation of a tape (math/codegen/scalars.py), or what is loaded from a buffer at an index; it holds for each
             value of the loop variables that its index, or its arguments, depend on
    write    buffer[index] = number, or += number, for all values of some variables

A sum over an axis, a sum of segments and what is gathered by a table go through buffers; all else is one expression.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torchmbd.math.codegen.scalars import Tape
from torchmbd.math.codegen.size import AnySize, Index, Size, Variable, at, place, substituted, variables


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
            "scratch": made by the program; "output"
    order   among numbers: a scratch buffer is complete before number `order` is made
    """

    name: str
    size: AnySize
    kind: str
    writes: list[Write] = field(default_factory=list)
    order: int = 0


class Program(Tape):
    """The tape of several functions; see the module header. `inner`: sizes of axes that are looped over within others."""

    def __init__(self, inner: Iterable[Size] = ()) -> None:
        super().__init__()
        self.buffers: dict[str, Buffer] = {}
        self.inner = frozenset(inner)
        self._variables: dict[int, frozenset[Variable]] = {}
        self._stored: dict[int, int] = {}

    def buffer(self, name: str, size: AnySize, kind: str) -> Buffer:
        """A new buffer."""
        assert name not in self.buffers, name
        found = self.buffers[name] = Buffer(name, size, kind, order=len(self.op))
        return found

    def scratch(self, size: AnySize) -> Buffer:
        """A new buffer of the program's own."""
        return self.buffer(f"t{len(self.buffers)}", size, "scratch")

    def write(self, buffer: Buffer, over: Sequence[Variable], index: Index, number: int, adds: bool = False) -> None:
        """State what is stored in a buffer."""
        if adds and number == self.zero:
            return
        over = self.loops(over, index)
        buffer.writes.append(Write(buffer.name, over, index, number, adds))
        buffer.order = len(self.op)

    def loops(self, over: Iterable[Variable], index: Index) -> tuple[Variable, ...]:
        """The loops of a write, outermost first: of the inner ones those first that say where it writes."""
        kept = variables(index)
        return tuple(sorted(over, key=lambda v: (v.size in self.inner, v not in kept, *self.rank(v))))

    def rank(self, v: Variable) -> tuple:
        """Order of loops: outer ones first."""
        return v.size in self.inner, repr(v.size), v.number

    def load(self, buffer: str, index: Index) -> int:
        """What stands in a buffer: if it is known to be one number, that."""
        found = self.buffers[buffer]
        if found.kind == "scratch":
            for write in found.writes:
                mapping = None if write.adds else _matched(write, index)
                if mapping is not None:
                    return self.substitute(write.number, mapping)
        return self._node("load", buffer, index)

    def variables(self, number: int) -> frozenset[Variable]:
        """Loop variables that a number depends on."""
        found = self._variables.get(number)
        if found is None:
            for node in self.reachable([number], self._variables):
                self._variables[node] = self._own_variables(node)
            found = self._variables[number]
        return found

    def _own_variables(self, node: int) -> frozenset[Variable]:
        if self.op[node] == "constant":
            return frozenset()
        if self.op[node] == "load":
            return variables(self.args[node][1])
        return frozenset().union(*(self._variables[a] for a in self.args[node]))

    def operands(self, node: int) -> tuple[int, ...]:
        """Numbers that a number is made of."""
        return () if self.op[node] in ("constant", "load") else self.args[node]

    def reachable(self, numbers: Iterable[int], without: Any = ()) -> list[int]:
        """Numbers that some are made of, arguments first, but those of `without` and what only they need."""
        found: set[int] = set()
        stack = list(numbers)
        while stack:
            node = stack.pop()
            if node not in found and node not in without:
                found.add(node)
                stack += self.operands(node)
        return sorted(found)  # what is made comes after what it is made of

    def substitute(self, number: int, mapping: Mapping[Variable, Index]) -> int:
        """The number with other places for some variables."""
        return self.substitute_all([number], mapping)[0]

    def substitute_all(self, numbers: Sequence[int], mapping: Mapping[Variable, Index]) -> list[int]:
        """The same of many."""
        mapping = {v: x for v, x in mapping.items() if x != at(v)}
        if not mapping:
            return list(numbers)
        keys = mapping.keys()
        new: dict[int, int] = {}
        for node in self.reachable(numbers):
            if not self.variables(node) & keys:
                new[node] = node
            elif self.op[node] == "load":
                name, index = self.args[node]
                new[node] = self.load(name, substituted(index, mapping))
            else:
                new[node] = self.call(self.op[node], *(new[a] for a in self.args[node]))
        return [new[x] for x in numbers]

    def stored(self, numbers: Iterable[int]) -> dict[int, int]:
        """For each number one that is a constant or loaded: what is neither goes through a buffer."""
        missing = [
            x for x in dict.fromkeys(numbers) if self.op[x] not in ("constant", "load") and x not in self._stored
        ]
        groups: dict[tuple[Variable, ...], list[int]] = {}
        for x in missing:
            groups.setdefault(tuple(sorted(self.variables(x), key=self.rank)), []).append(x)
        for over, some in groups.items():
            buffer = self.scratch(len(some) * product(v.size for v in over))
            for k, x in enumerate(some):
                index = row_major(over).times(len(some)).plus(k)
                self.write(buffer, over, index, x)
            for k, x in enumerate(some):
                index = row_major(over).times(len(some)).plus(k)
                self._stored[x] = self._node("load", buffer.name, index)
        return {x: self._stored.get(x, x) for x in numbers}

    def sums(self, numbers: Sequence[int], over: Sequence[Variable]) -> list[int]:
        """Each number summed over some variables."""
        gone, result = set(over), {}
        groups: dict[tuple[Variable, ...], list[int]] = {}
        for x in dict.fromkeys(numbers):
            if x == self.zero:
                result[x] = x
            else:
                groups.setdefault(tuple(sorted(self.variables(x) - gone, key=self.rank)), []).append(x)
        for kept, some in groups.items():
            buffer = self.scratch(len(some) * product(v.size for v in kept))
            index = row_major(kept).times(len(some))
            for k, x in enumerate(some):
                self.write(buffer, (*kept, *over), index.plus(k), x, adds=True)
            for k, x in enumerate(some):
                result[x] = self._node("load", buffer.name, index.plus(k))
        return [result[x] for x in numbers]

    def sums_over(self, number: int, kept: Iterable[Variable], over: Sequence[Variable]) -> int:
        """A number summed over some variables, also those on which it does not depend."""
        own = sorted(kept, key=self.rank)
        buffer = self.scratch(product(v.size for v in own))
        self.write(buffer, (*own, *over), row_major(own), number, adds=True)
        return self._node("load", buffer.name, row_major(own))


def product(sizes: Iterable[AnySize]) -> AnySize:
    """Of sizes."""
    total: AnySize = 1
    for size in sizes:
        total = total * size
    return total


def row_major(over: Sequence[Variable]) -> Index:
    """Place of the values of some variables, the last of which runs fastest."""
    index = place(0)
    for v in over:
        index = index.times(v.size).plus(at(v))
    return index


def _matched(write: Write, index: Index) -> dict[Variable, Index] | None:
    """What the variables of a write are where it writes to an index; None: it may not, or not wholly."""
    if write.index.offset != index.offset or len(write.index.terms) != len(index.terms):
        return None
    wanted = dict(index.terms)
    found: dict[Variable, Index] = {}
    for stride, atom in write.index.terms:
        other = wanted.get(stride)
        if not isinstance(atom, Variable) or not isinstance(other, Variable) or other.size != atom.size:
            return None
        found[atom] = at(other)
    return found if len(found) == len(write.variables) else None
