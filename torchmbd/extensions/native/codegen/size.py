"""Sizes that are known at run time, and indices: polynomials of them.

    Size    sum of coefficient * product of named sizes; a plain number is an int
    Index   offset + sum of stride * (loop variable, or entry of a table)

Checked in tests/extensions/native/codegen/test_array.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

from torchmbd.extensions.native.codegen.scalars import Untraceable

__all__ = [
    "AnySize", "Index", "Lookup", "Size", "Untraceable", "Variable", "constant_index", "loop_index", "loop_variables",
    "with_substitutions",
]  # fmt: skip


class Size:
    """A polynomial of named sizes with integer coefficients; a constant polynomial is an int instead."""

    __slots__ = ("_hash", "terms")

    def __init__(self, name: str):
        self.terms: tuple[tuple[tuple[str, ...], int], ...] = (((name,), 1),)
        self._hash = hash(self.terms)

    @staticmethod
    def of(terms: Mapping[tuple[str, ...], int]) -> Size | int:
        """The polynomial of terms with nonzero coefficients; an int if it is constant."""
        nonzero = tuple(sorted((k, c) for k, c in terms.items() if c))
        if not nonzero:
            return 0
        if len(nonzero) == 1 and nonzero[0][0] == ():
            return nonzero[0][1]
        size = Size.__new__(Size)
        size.terms, size._hash = nonzero, hash(nonzero)
        return size

    def __add__(self, other: Size | int) -> Size | int:
        terms = dict(self.terms)
        for k, c in _terms(other):
            terms[k] = terms.get(k, 0) + c
        return Size.of(terms)

    __radd__ = __add__

    def __neg__(self) -> Size | int:
        return self * -1

    def __sub__(self, other: Size | int) -> Size | int:
        return self + (-1 * other)

    def __rsub__(self, other: int) -> Size | int:
        return -self + other

    def __mul__(self, other: Size | int) -> Size | int:
        terms: dict[tuple[str, ...], int] = {}
        for k, c in self.terms:
            for m, d in _terms(other):
                both = tuple(sorted(k + m))
                terms[both] = terms.get(both, 0) + c * d
        return Size.of(terms)

    __rmul__ = __mul__

    def __floordiv__(self, other: int) -> Size | int:
        if any(c % other for _, c in self.terms):
            raise Untraceable(f"the size {self} is not divisible by {other}")
        return Size.of({k: c // other for k, c in self.terms})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Size) and self.terms == other.terms

    def __hash__(self) -> int:
        return self._hash

    def __lt__(self, other: Size | int) -> bool:
        """True if code for all sizes must assume that self may be less: true for any two sizes that differ."""
        return self != other

    def __repr__(self) -> str:
        return " + ".join("*".join((str(c), *k)) for k, c in self.terms)


AnySize = Size | int


def _terms(x: AnySize) -> tuple[tuple[tuple[str, ...], int], ...]:
    return x.terms if isinstance(x, Size) else (((), x),)


class Variable(NamedTuple):
    """A loop variable 0 ... size - 1, the `number`-th of its size."""

    size: Size
    number: int


class Lookup(NamedTuple):
    """An entry of a table of integers."""

    table: str
    index: Index


class Index(NamedTuple):
    """A position in a buffer: offset + sum of stride * atom."""

    offset: AnySize
    terms: tuple[tuple[AnySize, Variable | Lookup], ...] = ()

    def plus(self, other: Index | AnySize) -> Index:
        if not isinstance(other, Index):
            return Index(self.offset + other, self.terms)
        strides: dict[Variable | Lookup, AnySize] = {}
        for stride, atom in (*self.terms, *other.terms):
            strides[atom] = strides.get(atom, 0) + stride
        terms = sorted(((s, a) for a, s in strides.items() if s != 0), key=_order)
        return Index(self.offset + other.offset, tuple(terms))

    def times(self, factor: AnySize) -> Index:
        return Index(self.offset * factor, tuple((s * factor, a) for s, a in self.terms))


def _order(term: tuple[AnySize, Variable | Lookup]) -> str:
    return repr(term)


def loop_index(variable: Variable) -> Index:
    """The index that is a loop variable."""
    return Index(0, ((1, variable),))


def constant_index(offset: AnySize) -> Index:
    """A constant index."""
    return Index(offset)


@lru_cache(maxsize=100_000)
def loop_variables(index: Index) -> frozenset[Variable]:
    """Loop variables that an index depends on."""
    result: set[Variable] = set()
    for _, atom in index.terms:
        result |= {atom} if isinstance(atom, Variable) else loop_variables(atom.index)
    return frozenset(result)


def with_substitutions(index: Index, mapping: Mapping[Variable, Index]) -> Index:
    """The index with other indices in place of some variables."""
    if not loop_variables(index) & mapping.keys():
        return index
    result = Index(index.offset)
    for stride, atom in index.terms:
        if isinstance(atom, Variable):
            inner = mapping.get(atom, loop_index(atom))
        else:
            inner = Index(0, ((1, Lookup(atom.table, with_substitutions(atom.index, mapping))),))
        result = result.plus(inner.times(stride))
    return result


def evaluated(size: AnySize, values: Mapping[str, int]) -> int:
    """The integer that a size is for some values of the named sizes."""
    if isinstance(size, int):
        return size
    total = 0
    for names, c in size.terms:
        for name in names:
            c = c * values[name]
        total += c
    return total
