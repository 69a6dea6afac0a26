"""The JSON schema of experiment files, for completion and error marks in editors.

It is made from the classes of schema.py and the registries of names; names of the model are checked by `torchmbd check` only.
In VS Code: `# yaml-language-server: $schema=study.schema.json` on top of a file.
Checked in tests/study/test_json_schema.py.
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
from torchmbd.extensions.vibrations.ports_by_name import NamedPort
from torchmbd.identification import (
    Channel,
    Experiment,
    FrequencyResponseData,
    ModalData,
    StaticCurve,
    TimeSeries,
    identify,
)
from torchmbd.identification.losses import LOSSES
from torchmbd.integrate import simulate
from torchmbd.integrate.registry import INTEGRATORS
from torchmbd.optimization import OPTIMIZERS, optimize, sobol
from torchmbd.study import schema
from torchmbd.study.identify_schema import (
    ChannelData,
    ExperimentData,
    FrequencyResponseKeys,
    IdentificationFile,
    Identify,
    ModalDataKeys,
    PortKeys,
    Prior,
    StaticCurveData,
    TimeSeriesData,
    Unknown,
)
from torchmbd.study.scenario_keys import Combine, Scenario, Setting
from torchmbd.study.schema import (
    LIMIT_KINDS,
    OBJECTIVE_KEYS,
    SAMPLERS,
    UNITS,
    Figures,
    Optimizer,
    Range,
    Simulation,
    StudyFile,
    Tracking,
    Variable,
)
from torchmbd.study.study import Study

#: Section of a file -> what is constructed of it. Its keys are described by its docstring, or by the first of these.
CONSTRUCTORS: dict[type, Sequence[Any]] = {
    StudyFile: (Problem,),
    Figures: (),
    Variable: (),
    Simulation: (*(base for x in INTEGRATORS.values() for base in type(x).__mro__[:2]), Problem, simulate),
    schema.Constraint: (Constraint,),
    Scenario: (),
    Setting: (),
    Combine: (Scenarios,),
    Optimizer: (optimize,),
    schema.Starts: (sobol,),
    Range: (),
    Tracking: (Study,),
    IdentificationFile: (),
    Identify: (identify,),
    Unknown: (),
    Prior: (),
    ChannelData: (Channel,),
    TimeSeriesData: (TimeSeries,),
    StaticCurveData: (StaticCurve,),
    ModalDataKeys: (ModalData,),
    FrequencyResponseKeys: (FrequencyResponseData,),
    PortKeys: (NamedPort,),
    ExperimentData: (Experiment,),
    schema.Motion: (*(base for x in INTEGRATORS.values() for base in type(x).__mro__[:2]), simulate),
}


_ENTRY = re.compile(r"(\w+(?:, \w+)*) {2,}(\S.*)")  # of a docstring: names, two spaces or more, meaning


def meanings(documented: object) -> dict[str, str]:
    """Argument -> its meaning in the docstring of a function or class; names that share a line share their meaning."""
    result: dict[str, str] = {}
    names: list[str] = []
    for line in inspect.cleandoc(getattr(documented, "__doc__", None) or "").splitlines():
        if entry := _ENTRY.fullmatch(line):
            names = [] if entry[2].startswith("as in ") else entry[1].split(", ")  # explained there
            result |= dict.fromkeys(names, entry[2])
        elif line.startswith("  ") and names:
            result |= {name: f"{result[name]} {line.strip()}" for name in names}
        else:
            names = []
    return result


def json_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) of a file: a study, figures or an identification."""
    kinds = {x.__name__: x.model_json_schema() for x in (StudyFile, Figures, IdentificationFile)}
    study = kinds["StudyFile"]
    parts: dict[str, Any] = {}
    for file in kinds.values():
        parts |= file.pop("$defs")
    for part, field, names in (
        ("Variable", "unit", UNITS),
        ("Unknown", "unit", UNITS),
        ("Motion", "method", INTEGRATORS),
        ("Identify", "loss", LOSSES),
        ("Starts", "sampler", SAMPLERS),
        ("Optimizer", "name", OPTIMIZERS),
        ("Simulation", "method", INTEGRATORS),
    ):
        parts[part]["properties"][field]["enum"] = list(names)
    for integrator in INTEGRATORS.values():
        for name, kind in integrator.option_types().items():
            for motion in ("Simulation", "Motion"):
                parts[motion]["properties"].setdefault(name, TypeAdapter(kind).json_schema())
    parts["History"] = _history()
    parts["Measure"] = _measure()
    limit = parts["Constraint"]["properties"]["at_most"]["anyOf"][:2]
    types: dict[str, Any] = {kind: {"anyOf": limit} for kind in LIMIT_KINDS} | {
        "scale": {"type": "number", "exclusiveMinimum": 0},
        "unit": {"type": "string", "enum": list(UNITS)},
    }
    parts["Constraint"] = {
        "type": "object",
        "properties": _measure()["properties"] | types,
        "oneOf": [{"required": [kind]} for kind in LIMIT_KINDS],
    }
    of_channel = {key: x for key, x in parts["ChannelData"]["properties"].items() if key != "response"}
    parts["ChannelData"] = {"type": "object", "properties": of_channel | _history()["properties"]}
    measure = {"$ref": "#/$defs/Measure"}
    study["properties"] |= {"minimize": measure, "maximize": measure}
    study["properties"]["tradeoff"] = {"type": "object", "minProperties": 2, "additionalProperties": measure}
    study["oneOf"] = [{"required": [key]} for key in OBJECTIVE_KEYS]
    for section, constructors in CONSTRUCTORS.items():
        part: Any = (kinds | parts)[section.__name__]
        part["description"] = _first(section)
        sources = [meanings(source) for source in (section, *constructors)]
        for key, entry in part["properties"].items():
            text = next((known[key] for known in sources if key in known), None)
            if text is not None:
                part["properties"][key] = entry | {"description": text[0].upper() + text[1:].removesuffix(".") + "."}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "torchmbd experiment",
        "if": {"required": ["figures"]},
        "then": {"$ref": "#/$defs/Figures"},
        "else": {
            "if": {"required": ["identify"]},
            "then": {"$ref": "#/$defs/IdentificationFile"},
            "else": {"$ref": "#/$defs/StudyFile"},
        },
        "$defs": kinds | parts,
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


def _first(kind: type) -> str:
    return re.sub(r"\s+", " ", (kind.__doc__ or "").strip().partition("\n")[0])
