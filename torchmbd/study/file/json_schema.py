"""The JSON schema of experiment files, for completion and error marks in editors.

It is made from the classes of schema.py and the registries of names; names of the model are checked by `torchmbd check` only.
In VS Code: `# yaml-language-server: $schema=study.schema.json` on top of a file.
Checked in tests/study/file/test_json_schema.py.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from typing import Any

from pydantic import TypeAdapter

from torchmbd.design import Constraint, Problem
from torchmbd.design.response_spec import FUNCTION, SCALED, SEVERAL, SINGLE, SUM
from torchmbd.design.responses import COMBINATORS, OF_DESIGN, RESPONSES
from torchmbd.design.scenarios import Scenarios
from torchmbd.integrate.registry import INTEGRATORS
from torchmbd.optimization import optimize, sobol
from torchmbd.simulation import simulate
from torchmbd.study.file import schema
from torchmbd.study.file.load import KINDS, STUDY
from torchmbd.study.file.scenario_keys import Combine
from torchmbd.study.file.schema import LIMIT_KINDS, OBJECTIVE_KEYS, StudyFile
from torchmbd.study.file.section import BESIDE
from torchmbd.study.study import Study

_OF_MOTION = (*(base for x in INTEGRATORS.values() for base in type(x).__mro__[:2]), simulate)
#: Section of a study -> what is constructed of it, whose docstrings explain the keys that its own does not.
CONSTRUCTORS: dict[type, Sequence[Any]] = {
    StudyFile: (Problem,),
    schema.Constraint: (Constraint,),
    schema.Motion: _OF_MOTION,
    schema.Simulation: (*_OF_MOTION[:-1], Problem, simulate),
    Combine: (Scenarios,),
    schema.Optimizer: (optimize,),
    schema.Starts: (sobol,),
    schema.Tracking: (Study,),
}


_ENTRY = re.compile(r"(\w+(?:, \w+)*) {2,}(\S.*)")  # of a docstring: names, two spaces or more, meaning


def meanings(docstring: str | None) -> dict[str, str]:
    """Argument -> its meaning in a docstring; names that share a line share their meaning."""
    result: dict[str, str] = {}
    names: list[str] = []
    for line in inspect.cleandoc(docstring or "").splitlines():
        if entry := _ENTRY.fullmatch(line):
            names = [] if entry[2].startswith("as in ") else entry[1].split(", ")  # explained there
            result |= dict.fromkeys(names, entry[2])
        elif line.startswith("  ") and names:
            result |= {name: f"{result[name]} {line.strip()}" for name in names}
        else:
            names = []
    return result


def json_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) of a file of any kind."""
    kinds = (STUDY, *KINDS.values())
    files = {kind.sections.__name__: kind.sections.model_json_schema() for kind in kinds}
    parts: dict[str, Any] = {}
    for file in files.values():
        parts |= file.pop("$defs")
    for integrator in INTEGRATORS.values():
        for name, option in integrator.option_types().items():
            for motion in parts.keys() & {"Simulation", "Motion"}:
                parts[motion]["properties"].setdefault(name, TypeAdapter(option).json_schema())
    responses = {"History": _history(), "Measure": _measure()}
    for part in parts.values():  # keys of a response stand beside those of the section
        if name := part.pop(BESIDE, None):
            part["properties"] |= responses[name]["properties"]
    limits = parts["Constraint"]["properties"]
    # No null.
    limits |= {key: limits[key] | {"anyOf": limits[key]["anyOf"][:-1]} for key in (*LIMIT_KINDS, "scale", "unit")}
    parts["Constraint"]["oneOf"] = [{"required": [key]} for key in LIMIT_KINDS]
    study, measure = files[StudyFile.__name__], {"$ref": "#/$defs/Measure"}
    study["properties"] |= {"minimize": measure, "maximize": measure}
    study["properties"]["tradeoff"] = {"type": "object", "minProperties": 2, "additionalProperties": measure}
    study["oneOf"] = [{"required": [key]} for key in OBJECTIVE_KEYS]
    constructors = CONSTRUCTORS | {section: x for kind in kinds for section, x in kind.constructors.items()}
    of_sections = {section.__name__: [source.__doc__ for source in x] for section, x in constructors.items()}
    for name, part in (files | parts).items():
        sources = [meanings(text) for text in (part.get("description"), *of_sections.get(name, ()))]
        part["description"] = _first_line(part.get("description"))
        for key, entry in part["properties"].items():
            text = next((known[key] for known in sources if key in known), None)
            if text is not None:
                part["properties"][key] = entry | {"description": text[0].upper() + text[1:].removesuffix(".") + "."}
    file: dict[str, Any] = {"$ref": f"#/$defs/{StudyFile.__name__}"}
    for section, kind in KINDS.items():
        file = {"if": {"required": [section]}, "then": {"$ref": f"#/$defs/{kind.sections.__name__}"}, "else": file}
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "torchmbd experiment"}
    return head | file | {"$defs": files | parts | responses}


def _history() -> dict[str, Any]:
    words = {
        name: {"type": ["string", "object"], "description": _first_line(kind.__doc__)}
        for name, kind in RESPONSES.items()
    }
    return {"type": "object", "properties": words | _operations("History")}


def _measure() -> dict[str, Any]:
    of_history = {
        name: {"$ref": "#/$defs/History", "description": _first_line(kind.__doc__)}
        for name, kind in COMBINATORS.items()
    }
    of_design = {
        name: {"type": ["string", "object"], "description": _first_line(kind.__doc__)}
        for name, kind in OF_DESIGN.items()
    }
    terms = {"type": "array", "items": {"$ref": "#/$defs/Measure"}}
    return {
        "type": "object",
        "properties": of_history | of_design | {SUM: terms | {"description": MEANINGS[SUM]}} | _operations("Measure"),
    }


MEANINGS = {
    "sum": "Sum of responses; each but the first may be a number.",
    "difference": "The first response less the others.",
    "product": "Product of responses; each but the first may be a number.",
    "quotient": "The first response divided by the others.",
    "absolute": "Absolute value of a response.",
    "squared": "Square of a response.",
    SCALED: "A response times the number `by`.",
    SUM: "Sum of measures, each times its `weight`; `normalize` says what each is divided by.",
    "by": "Factor of `scaled`.",
}


def _operations(kind: str) -> dict[str, Any]:
    """Operations on responses of a kind, and functions of one's own."""
    operand: dict[str, Any] = {"$ref": f"#/$defs/{kind}"}
    several = {"type": "array", "minItems": 2, "items": {"anyOf": [operand, {"type": "number"}]}}
    function = {
        "type": "string",
        "description": "package.module:function or path/to/file.py:function; more keys are its options",
    }
    return (
        {name: several | {"description": MEANINGS[name]} for name in SEVERAL}
        | {name: operand | {"description": MEANINGS[name]} for name in (*SINGLE, SCALED)}
        | {FUNCTION: function, "by": {"type": "number", "description": MEANINGS["by"]}}
    )


def _first_line(docstring: str | None) -> str:
    return re.sub(r"\s+", " ", (docstring or "").strip().partition("\n")[0])
