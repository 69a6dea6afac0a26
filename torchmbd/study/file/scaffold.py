"""`torchmbd new`: a first experiment file with every section explained, for a model of the user's or for an example.

A model of the user is built once, so that the file names its parameters, bodies and options. Those of the example are listed
here, since to build it would import torch, which takes seconds. Checked in tests/study/file/test_scaffold.py.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchmbd.errors import InputError

EXAMPLE = '''"""A robot arm: a laminated strip that a motor turns by a quarter, from rest to rest. Make it your own."""

import torchmbd as mbd


def build(layers: int = 2, length: float = 0.5, move: float = 0.3) -> mbd.System:
    """Arm of `length` [m] that is turned within `move` seconds."""
    carbon = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
    angles = mbd.deg([45.0 if k % 2 == 0 else -45.0 for k in range(layers)])  # these become design variables
    laminate = mbd.Laminate(carbon, angles=angles, thickness=4e-3 / layers)
    mesh = mbd.mesh.rectangle(length=length, width=0.05, cells=(8, 2))
    upright = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # columns: axes of the mesh in ground axes
    place = {"position": (length / 2, 0, 0), "axes": upright}
    arm = mbd.FlexibleBody.plate(  # the edge that the hub holds, and four vibrations with this edge held
        "arm", mesh, laminate, modes=4, reduction="craig-bampton", interface=["left"], **place
    )
    hub = mbd.RigidBody("hub", mass=0.2, inertia=(1e-4, 1e-4, 1e-4))
    ground = mbd.Ground()
    return mbd.System(
        bodies=[hub, arm],
        joints=[
            mbd.Revolute(ground.at(0, 0, 0), hub.at(0, 0, 0), axis="z"),
            mbd.Drive(ground, hub, axis="z", angle=mbd.SmoothStep(size=mbd.deg(90.0), duration=move)),
            mbd.Fixed(hub.at(0, 0, 0), arm.at("left")),
        ],
    )
'''

TEXT = """\
# {question}
# torchmbd check {name} says whether it is valid and what it costs, torchmbd run {name} runs it,
# torchmbd schema > study.schema.json lets an editor complete it.

# model: file.py:function or package.module:function, returns a torchmbd.System; options: arguments of that function
model: {model}
options: {options}

design:                       # design variables: parameters of the model with bounds; start: as the model is built
{design}
simulate:                     # SI units; more keys are options of the method
  duration: 0.4               # seconds
  steps: 200

minimize:                     # integral, mean, rms, max, min, final ... of strain_energy, displacement, velocity ...
  integral: {{strain_energy: {body}}}
subject_to:                   # each at_most, at_least or equal: a number, or initial, its value at the start
  - {{max: {{strain_energy: {body}}}, at_most: initial}}

optimizer:
  name: auto                  # or sqcqp, slsqp, mmfd, lbfgs, trust-constr, mma, ccsaq, ipopt, differential_evolution
  max_iterations: 30
starts:                       # where the optimizer starts: the model's own design and points between the bounds
  sampler: sobol
  count: 8
  seed: 7

tracking:
  experiment: {experiment:<16}# in MLflow; torchmbd ui shows it
"""


@dataclass(frozen=True)
class Parts:
    """The parts of a model that an experiment file names: a flexible body, parameters with their values [SI], options."""

    body: str
    parameters: Mapping[str, np.ndarray]
    options: Mapping[str, int | float]


EXAMPLE_PARTS = Parts(
    "arm", {"arm.laminate.angles": np.radians([45.0, -45.0])}, {"layers": 2, "length": 0.5, "move": 0.3}
)


def write_experiment(file: Path, model: str | None = None) -> list[Path]:
    """Write an experiment file, and an example model beside it if none is given; return the paths of both."""
    if file.suffix not in (".yaml", ".yml"):
        raise InputError("file", str(file), "a name that ends in .yaml")
    example = file.with_name(f"{file.stem.replace('-', '_')}_model.py")
    written = [file] if model else [file, example]
    for new in written:
        if new.exists():
            raise InputError("file", str(new), "a name that is free", state="exists already", noun=f"{new}")
    if model:
        file_text = text(file, model, parts_of(model, file.absolute().parent))
    else:
        file_text = text(file, f"{example.name}:build", EXAMPLE_PARTS)
    file.parent.mkdir(parents=True, exist_ok=True)
    if not model:
        example.write_text(EXAMPLE, encoding="utf-8")
    file.write_text(file_text, encoding="utf-8")
    return written


def parts_of(model: str, folder: Path) -> Parts:
    """Build a model, `path/to/file.py:function` below the folder or `package.module:function`, and return its parts."""
    from torchmbd.multibody.bodies import FlexibleBody
    from torchmbd.study.file.model import build_model, find_model

    try:
        function = find_model(model, folder)
    except InputError as error:
        raise InputError("model", model, error.allowed, error.hint, shown=repr(model), state=error.state) from error
    needed = [p.name for p in inspect.signature(function).parameters.values() if p.default is p.empty]
    if needed:
        raise InputError(
            "model",
            model,
            "a function whose arguments all have defaults",
            noun=f"model {model!r}",
            state=f"needs the arguments {', '.join(needed)}",
        )
    system = build_model(function, {})
    bodies = [body.name for body in system.bodies if isinstance(body, FlexibleBody)]
    if not bodies:
        raise InputError(
            "model",
            model,
            "a system with at least one flexible body",
            state="has no flexible body",
            noun=f"model {model!r}",
        )
    parameters = {name: x.detach().numpy() for name, x in system.named_parameters() if x.requires_grad}
    return Parts(bodies[0], parameters, _options(function))


def text(file: Path, model: str, parts: Parts) -> str:
    """Return the text of an experiment file."""
    return TEXT.format(
        question=f"Which design of {parts.body} stores least strain energy?",
        name=file.name,
        model=model,
        options="{" + ", ".join(f"{name}: {value}" for name, value in parts.options.items()) + "}",
        design="".join(_variable(name, x) for name, x in parts.parameters.items()),
        body=parts.body,
        experiment=file.stem,
    )


def _variable(name: str, x: np.ndarray) -> str:
    """Return the line of one parameter with its bounds.

    Bounds of angles are -90 and 90 degrees, or 90 degrees about each angle where one lies outside; of other values half and
    twice the value, of zeros plus and minus the largest value of the parameter (or 1).
    """
    x = x.ravel()
    if name.endswith("angles"):
        unit, x = "deg", np.degrees(x)
        within = np.abs(x).max() <= 90.0
        lower, upper = ("-90", "90") if within else (_listed(x - 90.0), _listed(x + 90.0))
    else:
        from torchmbd.math.units import NONE, quantity  # with torch, which the model has imported

        unit = quantity(name) or NONE
        largest = np.abs(x).max() or 1.0
        ends = np.where(x == 0.0, -largest, 0.5 * x), np.where(x == 0.0, largest, 2.0 * x)
        lower, upper = _listed(np.minimum(*ends)), _listed(np.maximum(*ends))
    return f"  {name}: {{start: {_listed(x, 6)}, lower: {lower}, upper: {upper}, unit: {unit}}}\n"


def _listed(x: np.ndarray, digits: int = 4) -> str:
    return str([float(f"{v:.{digits}g}") for v in x])


def _options(function: Callable[..., Any]) -> dict[str, int | float]:
    return {
        p.name: p.default
        for p in inspect.signature(function).parameters.values()
        if isinstance(p.default, (int, float)) and not isinstance(p.default, bool)
    }
