"""The JSON schema of experiment files, for completion and error marks in editors.

It is made from the classes of schema.py and the registries of names; names of the model are checked by `torchmbd check` only.
In VS Code: `# yaml-language-server: $schema=study.schema.json` on top of a file.
Checked in tests/study/test_json_schema.py.
"""

from __future__ import annotations

import re
from typing import Any

from pydantic import TypeAdapter

from torchmbd.design.response_spec import FUNCTION, SCALED, SEVERAL, SINGLE, SUM
from torchmbd.design.responses import COMBINATORS, OF_DESIGN, RESPONSES
from torchmbd.integrate.registry import INTEGRATORS
from torchmbd.optimization import OPTIMIZERS
from torchmbd.study.key_meanings import KEYS
from torchmbd.study.schema import LIMIT_KINDS, OBJECTIVE_KEYS, SAMPLERS, UNITS, Figures, StudyFile


def json_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) of a file: a study or figures."""
    study, figures = StudyFile.model_json_schema(), Figures.model_json_schema()
    parts = figures.pop("$defs") | study.pop("$defs")
    for part, field, names in (
        ("Variable", "unit", UNITS),
        ("Starts", "sampler", SAMPLERS),
        ("Optimizer", "name", OPTIMIZERS),
        ("Simulation", "method", INTEGRATORS),
    ):
        parts[part]["properties"][field]["enum"] = list(names)
    for integrator in INTEGRATORS.values():
        for name, kind in integrator.option_types().items():
            parts["Simulation"]["properties"].setdefault(name, TypeAdapter(kind).json_schema())
    parts["History"] = _history()
    parts["Measure"] = _measure()
    limit = parts["Constraint"]["properties"]["at_most"]["anyOf"][:2]
    own: dict[str, Any] = {kind: {"anyOf": limit} for kind in LIMIT_KINDS} | {
        "scale": {"type": "number", "exclusiveMinimum": 0},
        "unit": {"type": "string", "enum": list(UNITS)},
    }
    parts["Constraint"] = {
        "type": "object",
        "description": "A response of `Measure` with one limit.",
        "properties": _measure()["properties"] | own,
        "oneOf": [{"required": [kind]} for kind in LIMIT_KINDS],
    }
    asked = {"$ref": "#/$defs/Measure"}
    study["properties"] |= {"minimize": asked, "maximize": asked}
    study["properties"]["tradeoff"] = {"type": "object", "minProperties": 2, "additionalProperties": asked}
    study["oneOf"] = [{"required": [key]} for key in OBJECTIVE_KEYS]
    for name, meanings in KEYS.items():
        section: Any = {**parts, "StudyFile": study, "Figures": figures}[name]["properties"]
        for key, meaning in meanings.items():
            section[key] = section[key] | {"description": meaning}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "torchmbd experiment",
        "if": {"required": ["figures"]},
        "then": figures,
        "else": study,
        "$defs": parts,
    }


def _history() -> dict[str, Any]:
    words = {name: {"type": ["string", "object"], "description": _first(kind)} for name, kind in RESPONSES.items()}
    return {"type": "object", "properties": words | _operations("History")}


def _measure() -> dict[str, Any]:
    of_history = {name: {"$ref": "#/$defs/History", "description": _first(kind)} for name, kind in COMBINATORS.items()}
    of_design = {name: {"type": ["string", "object"], "description": _first(kind)} for name, kind in OF_DESIGN.items()}
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
    one: dict[str, Any] = {"$ref": f"#/$defs/{kind}"}
    several = {"type": "array", "minItems": 2, "items": {"anyOf": [one, {"type": "number"}]}}
    function = {
        "type": "string",
        "description": "package.module:function or path/to/file.py:function; more keys are its options",
    }
    return (
        {name: several | {"description": MEANINGS[name]} for name in SEVERAL}
        | {name: one | {"description": MEANINGS[name]} for name in (*SINGLE, SCALED)}
        | {FUNCTION: function, "by": {"type": "number", "description": MEANINGS["by"]}}
    )


def _first(kind: type) -> str:
    return re.sub(r"\s+", " ", (kind.__doc__ or "").strip().partition("\n")[0])
