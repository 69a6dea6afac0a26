"""Descriptions of responses in words, and their units, for axes of figures and columns of tables.

    heading(Integral(StrainEnergy("rod")))     integral of strain energy of rod [J s]

Checked in tests/design/test_words.py.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch

from torchmbd.design.aggregate import Aggregate
from torchmbd.design.functions import FunctionHistory, FunctionMeasure
from torchmbd.design.histories import Reaction
from torchmbd.design.measures import Frequency, Integral, Mass
from torchmbd.design.response import Combined, CombinedMeasure, History, Measure, Total
from torchmbd.design.responses import COMBINATORS, OF_DESIGN, RESPONSES
from torchmbd.design.weighted import WeightedSum

UNITS = {
    "strain_energy": "J",
    "position": "m",
    "displacement": "m",
    "velocity": "m/s",
    "acceleration": "m/s²",
    "relative_displacement": "m",
    "reaction": "N",
    "angle": "rad",
    "ply_failure": "",
    "ply_stress": "Pa",
    "frequency": "Hz",
    "mean_frequency": "Hz",
    "mass": "kg",
}
_JOINED = {torch.add: "{} + {}", torch.sub: "{} - {}", torch.mul: "{} · {}", torch.div: "{} / {}"}
Response = History | Measure


def words(response: Response, bodies: bool = True) -> str:
    """A description of a response, `integral of strain energy of rod`; without the names of bodies if `bodies` is False."""
    if isinstance(response, (FunctionHistory, FunctionMeasure)):
        inner = response.function
        inner = inner.func if isinstance(inner, partial) else inner
        return getattr(inner, "__name__", type(inner).__name__).strip("<>").replace("_", " ")
    if isinstance(response, (Combined, CombinedMeasure)):
        return _words_of_operation(response.operation, response.parts, bodies)
    if isinstance(response, WeightedSum):
        return "weighted sum"
    if isinstance(response, Aggregate):
        inner = list(dict.fromkeys(words(measure, bodies) for measure in response.operands))
        return f"aggregate of {' and '.join(inner)}" if len(inner) < 3 else "aggregate"
    if isinstance(response, Total):
        [*factors], measures = zip(*response.terms, strict=True)
        if len(measures) == 1:
            return _scaled(float(factors[0]), words(measures[0], bodies))
        if {*factors} <= {1.0, -1.0}:
            first, *others = (_scaled(float(w), words(m, bodies)) for w, m in response.terms)
            return first + "".join(f" - {x[1:]}" if x[0] == "-" else f" + {x}" for x in others)
        return "weighted sum"
    name = _name(response).replace("_", " ")
    inner = getattr(response, "history", None)
    if isinstance(inner, History):
        return f"{name} of {words(inner, bodies)}"
    if hasattr(response, "words"):  # of a class that says itself what its arguments mean
        return response.words(name)  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(response, Frequency) and response.number > 1:
        name = f"{name} {response.number}"
    if isinstance(response, Reaction) and response.kind == "torque":
        name = "reaction torque"
    axis = getattr(response, "axis", None)
    if isinstance(axis, str):
        name = f"{name} about {axis}" if name == "angle" else f"{axis} {name}"
    part = getattr(response, "body", getattr(response, "joint", None))
    if isinstance(response, Mass) and part is None:
        part = "all bodies"
    return f"{name} of {part}" if bodies and isinstance(part, str) else name


def unit(response: Response) -> str | None:
    """The SI unit of a response, such as `J s`; "" for a plain number; None if it is not known, as for a function."""
    if hasattr(response, "unit"):  # of a function, or of a class, which then needs no line above
        return response.unit  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(response, (Combined, CombinedMeasure)):
        return _unit_of_operation(response.operation, response.parts)
    if isinstance(response, WeightedSum) and response.normalize is not None:
        return ""
    if isinstance(response, Aggregate):
        units = {unit(measure) for measure in response.operands}
        return units.pop() if len(units) == 1 else None
    if isinstance(response, Total):
        units = {unit(measure) for _, measure in response.terms}
        return units.pop() if len(units) == 1 and {abs(w) for w, _ in response.terms} == {1.0} else None
    if isinstance(response, Reaction) and response.kind == "torque":
        return "N m"
    name = _name(response)
    if name in UNITS:
        return UNITS[name]
    inner = getattr(response, "history", None)
    of_history = unit(inner) if isinstance(inner, History) else None
    return of_history if of_history is None or not isinstance(response, Integral) else f"{of_history} s".strip()


def _name(response: Response) -> str:
    """The name in experiment files; of a class that these do not know that of the class, in the same form."""
    kind = type(response)
    names = (registry.name_of(kind) for registry in (RESPONSES, COMBINATORS, OF_DESIGN))
    return next(filter(None, names), re.sub(r"(?<=[a-z])(?=[A-Z])", "_", kind.__name__).lower())


def heading(response: Response) -> str:
    """A response as the title of an axis: `integral of strain energy of rod [J s]`."""
    name = unit(response)
    return f"{words(response)} [{name}]" if name else words(response)


def names_of_rows(problem: Any) -> list[str]:
    """Names of all rows that an optimizer sees as constraints of a problem, those of a min-max objective first."""
    text, suffixes = words(problem.objective), [f" in {name}" for name in getattr(problem, "scenarios", ())]
    names = [f"peak {k + 1}" for k in range(problem.peaks)]
    if suffixes and problem.peaks == len(suffixes):
        names = [f"{text}{suffix}" for suffix in suffixes]
    for constraint, part in zip(problem.constraints, problem.constraint_rows, strict=True):
        text, each = words(constraint.measure), constraint.measure.rows
        repeated = suffixes if suffixes and part.stop - part.start == each * len(suffixes) else [""]
        numbers = [f" {k + 1}" for k in range(each)] if each > 1 else [""]
        names += [text + suffix + number for suffix in repeated for number in numbers]
    return names


def _words_of_operation(operation: Any, parts: Sequence[Any], bodies: bool) -> str:
    texts = [words(part, bodies) if isinstance(part, (History, Measure)) else f"{part:g}" for part in parts]
    if operation is torch.abs:
        return f"|{texts[0]}|"
    if operation is torch.pow:
        return f"squared {texts[0]}" if parts[1] == 2 else f"({texts[0]})^{texts[1]}"
    if operation is torch.mul and not isinstance(parts[1], (History, Measure)):
        return _scaled(float(parts[1]), texts[0])
    return _JOINED[operation].format(*texts)


def _scaled(factor: float, text: str) -> str:
    return text if factor == 1.0 else f"-{text}" if factor == -1.0 else f"{factor:g} · {text}"


def _unit_of_operation(operation: Any, parts: Sequence[Any]) -> str | None:
    units = [unit(part) if isinstance(part, (History, Measure)) else "number" for part in parts]
    first, second = units[0], units[1] if len(units) > 1 else "number"
    if first is None or second is None:
        return None
    if operation is torch.abs or (operation is torch.mul and parts[1:] == (-1.0,)):
        return first
    if operation in (torch.add, torch.sub) and second in ("number", first):
        return first
    if operation is torch.div and first == second:
        return ""
    if (operation is torch.pow and parts[1] == 2) or (operation is torch.mul and first == second):
        return f"({first})²" if " " in first or "/" in first else f"{first}²" if first else ""
    return None
