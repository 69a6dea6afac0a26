"""Pages of the reference that come from the program: public names, keys of experiment files, commands.

Each function returns Markdown; generated.py writes it into the pages.
Checked in tests/experiments/test_documentation.py.
"""

from __future__ import annotations

import functools
import inspect
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import torchmbd as mbd
from torchmbd import api
from torchmbd.registry import public_names, rooms
from torchmbd.study.file.json_schema import json_schema
from torchmbd.study.file.scaffold import write_experiment

ROOT = Path(__file__).parents[2]
ROOMS = ("io", *api.ROOMS, *rooms())  # whose names have places of their own in GROUPS
GROUPS: dict[str, str] = {
    "materials": "Ply Laminate fibers.SteeredLaminate fibers.FiberField lamination.LaminationParameters Strength "
    "fatigue.SNCurve lamination.LaminationRules lamination.recover_stacks lamination.recover_blended_stacks "
    "progressive_failure deg fibers lamination fatigue",
    "meshes": "Mesh BeamLine mesh sections GivenSection SectionTable io.read_beamdyn io.read_windio",
    "bodies": "Ground RigidBody FlexibleBody io.read_bdf io.write_bdf io.write_model io.write_ply_book io.read_mesh "
    "io.read_matrix Frame Interface io",
    "joints": "Revolute Spherical Universal Prismatic Cylindrical Planar PointOnPlane PointOnCurve DistanceJoint Fixed "
    "JointCoupling Drive ConstantSpeed Sine SmoothStep",
    "force_elements": "SpringDamper AxialSpringDamper RotationalSpringDamper Bushing BeamElement Force Torque Pressure "
    "Temperature AxialStop RotationalStop PlaneContact forces variable",
    "feedback": "Controller ControlHistory signals",
    "systems": "System Dynamics static_truncation io.read_urdf io.read_mjcf examples",
    "exact_beams": "ExactBeam BeamState FlexibleBeam split Chain",
    "simulation": "simulate Simulation equilibrium Equilibrium vibrations.campbell vibrations.CampbellDiagram "
    "vibrations.frozen_poles vibrations.linearize vibrations.LinearSystem buckling.linear_buckling "
    "buckling.BucklingModes natural_frequencies NaturalModes Trajectory Phase Event threads vibrations "
    "buckling",
    "results": "SectionHistory PlyHistory viz viz.animate_mode viz.campbell viz.data_and_model viz.fiber_paths "
    "viz.mode_motion viz.root_locus viz.save_mesh viz.save_modes viz.save_motion",
    "histories": "StrainEnergy Position Displacement Velocity Acceleration RelativeDisplacement Reaction Angle "
    "buckling.BucklingIndex PlyFailure PlyStress History history",
    "measures": "Integral Mean RMS Max Min SmoothMax Aggregate Final AtTime AtTimes AtPeaks Frequency MeanFrequency Mass "
    "buckling.BucklingFactor vibrations.SystemFrequency vibrations.DampingRatio vibrations.StabilityMargin "
    "vibrations.CriticalSpeed vibrations.CampbellClearance vibrations.StabilityLimit "
    "vibrations.FrequencyResponse WeightedSum fatigue.Damage fatigue.EquivalentLoad fatigue.FatigueDamage "
    "fatigue.rainflow fibers.FiberCurvature fibers.FiberDivergence lamination.LaminationRegion Measure measure",
    "problems": "Problem Constraint DesignSpace Tradeoff Scenarios Differences Study load problem_of openmdao_component",
    "optimization": "optimize sharpen optimization.multistart optimization.optimize_discrete optimization.pareto_front "
    "optimization.OptimizationResult optimization.RobustProblem optimization.Processes verify "
    "optimization.sobol optimization.latin_hypercube optimization",
    "identification": "identification.identify identification.Identification identification.Experiment "
    "identification.TimeSeries identification.StaticCurve identification.ModalData identification.FrequencyResponseData "
    "identification.Channel identification",
    "modes": "reduction.modal_basis reduction.craig_bampton reduction.eigenpairs reduction.eigenpair_branches "
    "reduction.spectral_function reduction",
    "errors": "MbdError InputError SimulationFailure DesignFailure",
}


_WIDTH = 110  # characters of a signature in one line
_HIDDEN = ("equations", "actions")  # methods of the contracts, which docs/how-to/extend.md explains


def group(name: str) -> str:
    """The public names of a group with signatures, docstrings and methods, each below its heading."""
    entries = GROUPS[name].split()
    return "\n".join(_entry(entry, attrgetter(entry)(mbd), 3, entries) for entry in entries)


def _entry(name: str, entry: Any, level: int, others: Collection[str] = ()) -> str:
    """A name with its members; members of a module that are among the names `others` have a place of their own."""
    head = f"{'#' * level} {name}\n"
    text = verbatim_columns(entry.__doc__ or "")
    if isinstance(entry, ModuleType):
        members = [(f"{name}.{key}", getattr(entry, key)) for key in _names(name, entry) if name not in ROOMS]
        members = [(key, member) for key, member in members if key not in others and not _is_public(member)]
    else:
        head += f"\n```python\n{_signature(name, entry)}\n```\n"
        members = [(f"{name}.{key}", member) for key, member in _methods(entry)]
    return "\n".join([head, text, *(_entry(key, member, level + 1) for key, member in members)])


def _names(name: str, module: ModuleType) -> list[str]:
    """Names that a public module and its extensions offer, functions and classes with a docstring alone."""
    defined = [key for key, x in vars(module).items() if getattr(x, "__module__", None) == module.__name__]
    names = [key for key in getattr(module, "__all__", defined) if not key.startswith("_")]
    names += [key.removeprefix(f"{name}.") for key in public_names() if key.startswith(f"{name}.")]
    return [key for key in dict.fromkeys(names) if callable(x := getattr(module, key)) and x.__doc__]


def _is_public(entry: Any) -> bool:
    return any(getattr(mbd, key) is entry for key in mbd.__all__)


def _methods(entry: Any) -> Iterator[tuple[str, Any]]:
    """Methods and properties that a class defines and explains."""
    for key, member in vars(entry).items() if inspect.isclass(entry) else ():
        member = getattr(member, "__func__", member)
        kinds = (property, functools.cached_property)
        if key[0] != "_" and key not in _HIDDEN and member.__doc__ and (callable(member) or isinstance(member, kinds)):
            yield key, member


def _signature(name: str, entry: Any) -> str:
    """Name, arguments and result as in the source: in one line, or a line for each argument."""
    if isinstance(entry, property | functools.cached_property):
        get = entry.fget if isinstance(entry, property) else entry.func
        return f"{name}{_result(inspect.signature(get), ': ')}"  # pyright: ignore[reportArgumentType]
    try:
        signature = inspect.signature(entry)
    except ValueError:  # an exception
        return name
    words, kind = [], None
    for argument in signature.parameters.values():
        if argument.name in ("self", "cls") and not words:
            continue
        if kind is inspect.Parameter.POSITIONAL_ONLY != argument.kind:
            words.append("/")
        if argument.kind is inspect.Parameter.KEYWORD_ONLY and kind not in (argument.kind, argument.VAR_POSITIONAL):
            words.append("*")
        words.append(_argument(argument))
        kind = argument.kind
    result = "" if inspect.isclass(entry) else _result(signature)
    line = f"{name}({', '.join(words)}){result}"
    return line if len(line) <= _WIDTH else "\n".join([f"{name}(", *(f"    {word}," for word in words), f"){result}"])


def _argument(argument: inspect.Parameter) -> str:
    stars = {argument.VAR_POSITIONAL: "*", argument.VAR_KEYWORD: "**"}.get(argument.kind, "")
    kind = "" if argument.annotation is argument.empty else f": {_type(argument.annotation)}"
    if argument.default is argument.empty:
        return f"{stars}{argument.name}{kind}"
    default = repr(argument.default)
    default = "..." if default.startswith("<") else default  # made when called, or a function
    return f"{argument.name}{kind} = {default}" if kind else f"{argument.name}={default}"


def _result(signature: inspect.Signature, sign: str = " -> ") -> str:
    kind = signature.return_annotation
    return "" if kind is signature.empty else f"{sign}{_type(kind)}"


def _type(annotation: Any) -> str:
    return annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)


def verbatim_columns(docstring: str) -> str:
    """The first paragraph as text; then blocks, because Markdown runs aligned columns of arguments together."""
    first, _, rest = inspect.cleandoc(docstring).partition("\n\n")
    if "\n" in first:
        first, rest = "", f"{first}\n\n{rest}".rstrip()
    parts = [_plain(first)] if first else []
    for language, paragraphs in groupby(rest.split("\n\n") if rest.strip() else [], _language):
        text = "\n\n".join(paragraphs).strip("\n")
        parts.append(f"```{language}\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def _plain(text: str) -> str:
    """Text without marks of Markdown, except for `code`: brackets are shapes and units, stars are products."""
    signs = str.maketrans({"[": "&#91;", "*": "&#42;", "<": "&lt;"})
    return "`".join(part if k % 2 else part.translate(signs) for k, part in enumerate(text.split("`")))


def _language(paragraph: str) -> str:
    return "pycon" if paragraph.startswith(">>> ") else "text"


def file(path: str) -> str:
    """A file of the repository as a block with its name; tests/page_blocks.py writes it where the page is run."""
    text = (ROOT / path).read_text(encoding="utf-8")
    language = {".py": "python", ".yaml": "yaml"}[Path(path).suffix]
    return f'```{language} title="{Path(path).name}"\n{text}```\n'


def experiments() -> str:
    """A table of the shipped experiment files: the question of each, and a picture of its mechanism."""
    pictures = {name: name for name in ("slider_crank", "two_link_arm", "spatial_arm")} | {"sar_antenna": "antenna"}
    rows = []
    for path in sorted((ROOT / "configs").rglob("*.yaml")):
        if path.parent.name != "configs":
            picture, text = pictures.get(path.parent.name), path.read_text(encoding="utf-8")
            question = text.partition("\n")[0].removeprefix("# ")
            motion = "" if picture is None else f"[{picture.replace('_', ' ')}](images/{picture}.svg)"
            rows.append(f"| `{path.relative_to(ROOT)}` | {_cell(question)} | {motion} |")
    return "\n".join(["| file | question | motion |", "|---|---|---|", *rows, ""])


def commands() -> str:
    """Every command with its arguments, as the command line tells them."""
    from torchmbd.cli import app

    with patch.object(sys, "argv", ["torchmbd"]):  # else a page that `python -m` makes says "torchmbd run -m ..."
        text = app.generate_docs(output_format="markdown")
    return text[text.index("## torchmbd run") :]


def first_file() -> str:
    """The commented file that `torchmbd new arm.yaml` writes."""
    with tempfile.TemporaryDirectory() as folder:
        file, *_ = write_experiment(Path(folder) / "arm.yaml")
        return f"```yaml\n{file.read_text(encoding='utf-8')}```\n"


_TOP = {
    "(top of the file)": "StudyFile",
    "(top of a file of pictures)": "Figures",
    "(top of a file of measurements)": "IdentificationFile",
}
_SECTIONS = ("Variable", "Simulation", "Constraint", "Scenario", "Setting", "Combine", "Optimizer", "Starts", "Range")
_SECTIONS += ("Identify", "Unknown", "Prior", "ExperimentData", "TimeSeriesData", "StaticCurveData", "ModalDataKeys")
_SECTIONS += ("ChannelData",)


def file_keys() -> str:
    """A table of keys for each section of an experiment file, from its schema."""
    schema = json_schema()
    sections = {title: schema["$defs"][name] for title, name in _TOP.items()}
    sections |= {name: schema["$defs"][name] for name in _SECTIONS}
    sections["Tracking"] = schema["$defs"]["Tracking"]
    responses = schema["$defs"]["Measure"]["properties"]  # which a constraint has as well, and which have a table below
    histories = schema["$defs"]["History"]["properties"]
    beside = {"Constraint": responses, "ChannelData": histories}
    tables = [_keys(name, section, beside.get(name, ())) for name, section in sections.items()]
    words = {"Measure": "of a whole motion or of the design", "History": "of every time"}
    for name, what in words.items():
        properties = schema["$defs"][name]["properties"]
        rows = [f"| `{key}` | {_cell(entry.get('description', ''))} |" for key, entry in properties.items()]
        tables.append("\n".join([f"### {name}: {what}\n", "| word | what it is |", "|---|---|", *rows, ""]))
    return "\n".join(tables)


def _keys(name: str, section: Mapping[str, Any], others: Collection[str]) -> str:
    """A table of the keys of a section but those of `others`."""
    required = section.get("required", ())
    rows = []
    for key, entry in ((key, entry) for key, entry in section["properties"].items() if key not in others):
        default = "required" if key in required else _default(entry)
        rows.append(f"| `{key}` | {_cell(entry.get('description', ''))} | {_kind(entry)} | {default} |")
    said = _cell((section.get("description") or "").partition("\n")[0])
    head = ["| key | meaning | takes | default |", "|---|---|---|---|"]
    return "\n".join([f"### {name}\n", f"{said}\n", *head, *rows, ""])


def _default(entry: Mapping[str, Any]) -> str:
    return f"`{entry['default']}`" if entry.get("default") is not None else ""


def _kind(entry: Mapping[str, Any]) -> str:
    """What a key takes, in words."""
    if "$ref" in entry:
        return entry["$ref"].rpartition("/")[2]
    if "enum" in entry:
        return ", ".join(f"`{word}`" for word in entry["enum"])
    if "anyOf" in entry:
        return " or ".join(dict.fromkeys(_kind(kind) for kind in entry["anyOf"] if kind.get("type") != "null"))
    if "const" in entry:
        return f"`{entry['const']}`"
    if entry.get("type") == "array":
        return f"list of {_kind(entry['items'])}" if "items" in entry else "list"
    if entry.get("type") == "object":
        inner = entry.get("additionalProperties")
        return f"mapping of names to {_kind(inner)}" if isinstance(inner, Mapping) else "mapping"
    limits = {"exclusiveMinimum": ">", "minimum": ">=", "maximum": "<=", "exclusiveMaximum": "<"}
    bounds = [f"{sign} {entry[key]}" for key, sign in limits.items() if key in entry]
    kinds = entry.get("type", "any")
    words = ["text" if kind == "string" else kind for kind in ([kinds] if isinstance(kinds, str) else kinds)]
    return " ".join([" or ".join(words), *bounds])


def _cell(text: str) -> str:
    return _plain(text).replace("|", "\\|")
