"""The design space: entries of named parameters of a system as one vector b with bounds.

b [n] = (rod.laminate.angles[0], rod.laminate.angles[1], ..., rod.laminate.thickness[0], ...)     SI units and radians

Linked entries are linear functions of other entries and no part of b:

    links={"rod.laminate.angles[1]": {"rod.laminate.angles[0]": -1.0}}      a balanced pair +-theta
    all entries = map @ b + offset          map [entries, n], sparse: one number in the row of each entry that is free

Links are not needed for bodies that share a laminate, nor for a laminate with symmetric=True.
Checked in tests/design/test_space.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Sized
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from torchmbd.errors import InputError, Path, unknown
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.math.plausible_units import check_parameter
from torchmbd.math.units import shown
from torchmbd.multibody.system import System
from torchmbd.optimization.optimizer import require_inside

CONSTANT = "constant"  # key of a link's offset
MOST_TURNS = 100  # of an entry within a common period
ROUNDING = 1e-12  # of factors of links
_NOUNS = {"lower": "lower bound", "upper": "upper bound"}  # words of messages


class Links(NamedTuple):
    """The numbers of the map from variables to entries, in the order of entries: one 1 for each entry that is free."""

    entry: np.ndarray
    variable: np.ndarray
    factor: np.ndarray


class DesignSpace(FixedArguments):
    """Maps design vectors to parameters of a system.

    system     the model
    variables  names of parameters; default: every parameter that requires a gradient
    bounds     (lower, upper), each of which is a number for all entries, a number for each entry, or a mapping from parameter
               names to numbers; or a mapping from parameter names to pairs (lower, upper)
    start      initial design [n], or parameter name -> values of its entries; default: the values of the system
    links      entry -> {entry: factor, ..., "constant": offset}: entries that depend on others

    >>> mirrored = {"arm.laminate.angles[1]": {"arm.laminate.angles[0]": -1.0}}
    >>> space = mbd.DesignSpace(mbd.examples.arm(), bounds=mbd.deg([-90, 90]), links=mirrored)
    >>> space.names
    ['arm.laminate.angles[0]']
    >>> space.designs(mbd.deg([[30.0]]))["arm.laminate.angles"].rad2deg().round().tolist()
    [[30.0, -30.0]]
    """

    def __init__(
        self,
        system: System,
        variables: Sequence[str] | None = None,
        bounds: Any = (-np.inf, np.inf),
        start: Any = None,
        links: Mapping[str, Mapping[str, float]] | None = None,
    ):
        if not isinstance(system, System):
            raise InputError("system", system, "a System")
        self._span(dict(system.named_parameters()), variables, bounds, start, links, periods_of(system))

    @classmethod
    def of_parameters(
        cls,
        parameters: Mapping[str, Tensor],
        bounds: Any = (-np.inf, np.inf),
        start: Any = None,
        links: Mapping[str, Mapping[str, float]] | None = None,
    ) -> Self:
        """The space of parameters by name, of one system, of several, or of none; all of them are variables."""
        space = cls.__new__(cls)
        space._span(parameters, list(parameters), bounds, start, links, {})
        return space

    def _span(
        self,
        parameters: Mapping[str, Tensor],
        variables: Sequence[str] | None,
        bounds: Any,
        start: Any,
        links: Any,
        periods: Mapping[str, float],
    ) -> None:
        if isinstance(variables, str):
            raise InputError("variables", variables, f"a list of names, such as [{variables!r}]")
        for name in variables or ():
            if name not in parameters:
                raise unknown("parameter", name, parameters, ("variables", name))
        if variables and len(set(variables)) < len(variables):
            raise InputError("variables", list(variables), "must name each parameter once")
        self.variables = list(variables) if variables else [name for name, x in parameters.items() if x.requires_grad]
        if not self.variables:
            raise InputError(
                "variables",
                allowed="must have at least one design variable",
                state="has no parameter that requires a gradient",
                noun="the system",
            )
        self.shapes = {name: parameters[name].shape for name in self.variables}
        self.entries = [f"{name}[{i}]" for name in self.variables for i in range(parameters[name].numel())]
        self.links, self.offset = _linked(self.entries, links or {})
        free = [i for i, entry in enumerate(self.entries) if entry not in (links or {})]
        self.names = [self.entries[i] for i in free]
        self._places: dict[str, list[int]] = {}
        for i, name in enumerate(self.names):
            self._places.setdefault(_parameter(name), []).append(i)
        values = torch.cat([parameters[name].detach().flatten() for name in self.variables]).numpy()[free]
        self.lower, self.upper = self._bounds(bounds)
        for name, low, high in zip(self.names, self.lower, self.upper, strict=True):
            if not low <= high:
                allowed = f"below upper = {shown(name, high)}, or equal to it"
                noun = f"{_NOUNS['lower']} of {name}"
                raise InputError(("lower", name), low, allowed, noun=noun, shown=shown(name, low))
        self.start = self.point("start", start, values)
        #: How far each variable may move until all entries that follow it are the same again [n]; 0: never.
        of_entries = np.array([periods.get(_parameter(x), 0.0) for x in self.entries])
        self.period = _common_periods(self.links, of_entries, len(self.names))

    def _indices(self, parameter: str) -> list[int]:
        """Indices in b of the entries of a parameter."""
        return self._places.get(parameter, [])

    @cached_property
    def map(self) -> csr_array:
        """Derivatives of all entries with respect to the variables [entries, n]."""
        entry, variable, factor = self.links
        return csr_array((factor, (entry, variable)), (len(self.entries), len(self.names)))

    def slopes(self, by_entries: np.ndarray) -> np.ndarray:
        """Derivatives with respect to the variables [..., n], from those with respect to all entries [..., entries]."""
        flat = by_entries.reshape(-1, len(self.entries)) @ self.map
        return np.ascontiguousarray(flat).reshape(*by_entries.shape[:-1], len(self.names))

    def _free(self, indices: Sequence[int]) -> str:
        """Which entries of a parameter are free, "" if all are."""
        name = _parameter(self.names[indices[0]])
        free = ", ".join(self.names[i].removeprefix(name) for i in indices)
        return f" (of {free}; the others follow)" * (len(indices) < self.shapes[name].numel())

    def _bounds(self, bounds: Any) -> tuple[np.ndarray, np.ndarray]:
        if not isinstance(bounds, Mapping):
            lower, upper = _pair(("bounds",), bounds)
        else:
            pairs = {name: _pair(("bounds", name), pair) for name, pair in bounds.items()}
            lower, upper = ({name: pair[k] for name, pair in pairs.items()} for k in (0, 1))
        without = np.full(len(self.names), np.inf)
        return self.vector("lower", lower, -without), self.vector("upper", upper, without)

    def vector(self, argument: str, x: Any, default: np.ndarray, noun: str = "") -> np.ndarray:
        """Numbers [n], one for each design variable, in the units of their parameters; InputError for invalid numbers.

        argument  its name, such as "start"; the paths of errors are this name, the parameter and the entry
        noun      the words for it in messages
        x         a number for all, or one for each; or parameter name -> such numbers of its entries; None: `default`
        default   numbers of parameters that a mapping does not name [n]
        """
        what = noun or _NOUNS.get(argument, argument)
        if x is not None and not isinstance(x, Mapping):
            numbers = _numbers((argument,), what, x, len(self.names))
            x = {name: numbers[i] for name in self.variables if (i := self._indices(name))}
        result = np.array(default, dtype=float)
        for name, numbers in (x or {}).items():
            if name not in self.shapes:
                raise unknown(f"{what} of parameter", name, self.shapes, (argument, name))
            indices = self._indices(name)
            if not indices:
                state, allowed = "is given, but every entry follows others", "left out"
                raise InputError((argument, name), numbers, allowed, noun=f"{what} of {name}", state=state)
            path, words = (argument, name), f"{what} of {name}"
            result[indices] = _numbers(path, words, numbers, len(indices), self._free(indices))
            check_parameter(f"{what} of", name, torch.from_numpy(result[indices]), path)
        return result

    def point(self, argument: str, x: Any, default: np.ndarray) -> np.ndarray:
        """A design [n] within the bounds; arguments as in `vector`."""
        result = self.vector(argument, x, default)
        require_inside(argument, self.names, self.lower, result, self.upper, shown)
        return result

    def designs(self, X: np.ndarray | Tensor) -> dict[str, Tensor]:
        """Parameters by name [lanes, ...] of design vectors [lanes, n]."""
        free = np.asarray(X, dtype=float)
        if free.ndim != 2 or free.shape[1] != len(self.names):
            raise InputError(
                "designs", free, f"must have shape [lanes, {len(self.names)}]", state=f"have shape {free.shape}"
            )
        rows = torch.from_numpy(np.ascontiguousarray(free @ self.map.T) + self.offset)
        result, start = {}, 0
        for name, shape in self.shapes.items():
            size = shape.numel()
            result[name] = rows[:, start : start + size].reshape(-1, *shape)
            start += size
        return result


def _linked(entries: list[str], links: Mapping[str, Mapping[str, float]]) -> tuple[Links, np.ndarray]:
    """The numbers of the map from the free entries to all entries, and the offset [entries]."""
    if not isinstance(links, Mapping):
        raise InputError("links", links, "a mapping entry -> {entry: factor, ...}")
    free = {entry: k for k, entry in enumerate(entry for entry in entries if entry not in links)}
    known = set(entries)
    for linked, terms in links.items():
        if linked not in known:
            noun, state = f"links: {linked}", "is not an entry of a design variable"
            raise InputError(("links", linked), terms, entries, noun=noun, state=state)
        if not isinstance(terms, Mapping):
            raise InputError(("links", linked), terms, "a mapping {entry: factor}", noun=f"link of {linked!r}")
        for source in terms:
            if source not in free and source != CONSTANT:
                noun, state = f"link of {linked}: {source}", "is not an entry, or follows others"
                names = [*free, CONSTANT]
                raise InputError(("links", linked, source), terms[source], names, noun=noun, state=state)
    if not free:
        raise InputError("links", allowed="must leave at least one free entry", state="leave no entry free")
    numbers: list[tuple[int, int, float]] = []
    offset = np.zeros(len(entries))
    for row, entry in enumerate(entries):
        if entry in links:
            for source, factor in links[entry].items():
                value = float(_numbers(("links", entry, source), f"link of {entry}", factor, 1)[0])
                if source == CONSTANT:
                    check_parameter(
                        f"{CONSTANT} in the link of", _parameter(entry), torch.tensor([value]), ("links", entry)
                    )
                    offset[row] = value
                else:
                    numbers.append((row, free[source], value))
        else:
            numbers.append((row, free[entry], 1.0))
    rows, columns, factors = zip(*sorted(numbers), strict=True)
    return Links(np.array(rows), np.array(columns), np.array(factors)), offset


def periods_of(system: System) -> dict[str, float]:
    """Name -> period [rad] of the parameters whose modules state one: pi of ply angles.

    A parameter that several modules share repeats itself where it does so for each of them.
    """
    named = list(system.named_parameters(remove_duplicate=False))
    shared: dict[int, list[float]] = {}
    for name, x in named:
        module, _, field = name.rpartition(".")
        shared.setdefault(id(x), []).append(getattr(system.get_submodule(module), "periods", {}).get(field, 0.0))
    return {name: period for name, x in named if (period := _common_multiple(shared[id(x)]))}


def _common_periods(links: Links, periods: np.ndarray, count: int) -> np.ndarray:
    """The period of each of `count` variables, from the periods of all entries [entries]."""
    each: list[list[float]] = [[] for _ in range(count)]
    for entry, variable, factor in zip(*links, strict=True):
        if factor:
            each[variable].append(periods[entry] / abs(factor))
    return np.array([_common_multiple(x) for x in each])


def _common_multiple(periods: Sequence[float]) -> float:
    """The least whole multiple of all periods; 0 where one of them is 0, or their ratio is not a simple fraction."""
    if not all(periods):
        return 0.0
    ratios = [Fraction(x / periods[0]).limit_denominator(MOST_TURNS) for x in periods]
    if any(abs(float(ratio) * periods[0] / x - 1.0) > ROUNDING for ratio, x in zip(ratios, periods, strict=True)):
        return 0.0
    return periods[0] * math.lcm(*(x.numerator for x in ratios)) / math.gcd(*(x.denominator for x in ratios))


def _parameter(entry: str) -> str:
    """The parameter of an entry: `rod.laminate.angles` of `rod.laminate.angles[0]`."""
    return entry.rpartition("[")[0]


def _pair(path: Path, x: Any) -> Any:
    if not isinstance(x, Sized) or len(x) != 2:
        raise InputError(path, x, "two entries, (lower, upper)", noun=" of ".join(map(str, path)))
    return x


def _numbers(path: Path, noun: str, x: Any, size: int, which: str = "") -> np.ndarray:
    """Numbers [size] from one for all entries, or one for each; InputError for other values.

    path, noun  the keys to the numbers, and the words for them in messages
    """
    try:
        numbers = [float(y) for y in x] if isinstance(x, (tuple, list)) else x
        values = np.asarray(numbers.detach().numpy() if isinstance(numbers, Tensor) else numbers, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(path, x, "numbers", noun=noun) from error
    if values.ndim > 1 or (values.ndim == 1 and len(values) != size):
        count = len(values) if values.ndim == 1 else f"the shape {values.shape} of"
        state, allowed = f"has {count} values", f"must have {size}{which}, or one number for all"
        raise InputError(path, x, allowed, noun=noun, state=state)
    if np.isnan(values).any():
        raise InputError(path, x, "numbers", noun=noun)
    return np.broadcast_to(values, (size,)).copy()
