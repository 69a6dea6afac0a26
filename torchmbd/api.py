"""The public names of `mbd.` that are of the core; `import torchmbd` alone imports none of them, see torchmbd/__init__.py.

Checked in tests/test_api.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchmbd import examples, io, optimization, viz
from torchmbd.design import (
    RMS,
    Acceleration,
    Angle,
    AtPeaks,
    AtTime,
    AtTimes,
    Constraint,
    DesignSpace,
    Displacement,
    Final,
    Frequency,
    History,
    Integral,
    Mass,
    Max,
    Mean,
    MeanFrequency,
    Measure,
    Min,
    Position,
    Problem,
    Reaction,
    RelativeDisplacement,
    SmoothMax,
    StrainEnergy,
    Tradeoff,
    Velocity,
    WeightedSum,
    history,
    measure,
)
from torchmbd.design.aggregate import Aggregate
from torchmbd.design.differences import Differences
from torchmbd.design.ply_failure import PlyFailure, PlyStress
from torchmbd.design.scenarios import Scenarios
from torchmbd.design.sharpening import sharpen
from torchmbd.design.verification import verify
from torchmbd.diagnosis.truncation import static_truncation
from torchmbd.errors import DesignFailure, InputError, MbdError, SimulationFailure
from torchmbd.fem import mesh, reduction, sections
from torchmbd.fem.elements import BeamLine, GivenSection
from torchmbd.fem.exact_beam import BeamState, ExactBeam, SectionTable
from torchmbd.fem.materials import Laminate, Ply, Strength, progressive_failure
from torchmbd.fem.mesh import Mesh
from torchmbd.integrate import Event, Phase, Trajectory
from torchmbd.math.angles import deg
from torchmbd.math.variable import variable
from torchmbd.multibody import forces
from torchmbd.multibody.bodies import FlexibleBeam, FlexibleBody, Frame, Ground, Interface, RigidBody
from torchmbd.multibody.forces import (
    AxialSpringDamper,
    AxialStop,
    BeamElement,
    Bushing,
    ControlHistory,
    Controller,
    Force,
    PlaneContact,
    Pressure,
    RotationalSpringDamper,
    RotationalStop,
    SpringDamper,
    Temperature,
    Torque,
    signals,
)
from torchmbd.multibody.joints import (
    ConstantSpeed,
    Cylindrical,
    DistanceJoint,
    Drive,
    Fixed,
    JointCoupling,
    Planar,
    PointOnCurve,
    PointOnPlane,
    Prismatic,
    Revolute,
    Sine,
    SmoothStep,
    Spherical,
    Universal,
)
from torchmbd.multibody.statics import NaturalModes, natural_frequencies
from torchmbd.multibody.system import Chain, Dynamics, System, split
from torchmbd.optimization import optimize
from torchmbd.process import threads
from torchmbd.registry import public_names, rooms
from torchmbd.results.ply_history import PlyHistory
from torchmbd.results.section_history import SectionHistory
from torchmbd.simulation import Equilibrium, Simulation, equilibrium, simulate

if TYPE_CHECKING:
    from torchmbd.study.record.stored_run import LoadedStudy
    from torchmbd.study.study import Study


def __getattr__(name: str) -> Any:
    """Import `Study` at the first access: it imports tracking and reports."""
    if name != "Study":
        raise AttributeError(f"module 'torchmbd.api' has no attribute {name!r}")
    from torchmbd.study.study import Study

    return Study


def load(run: str, uri: str | None = None, model: str | Path | Sequence[str | Path] = ()) -> LoadedStudy:
    """Load a study of the tracking store: system, best design, motion; see torchmbd.study.record.stored_run.

    run    run id, its beginning, or the name of a study (its latest run)
    uri    the MLflow store; default: MLFLOW_TRACKING_URI, else ./mlflow.db
    model  the Python file, or module, of the model: "studies/arm.py", "package.module"; a list of several if the phases are
           in another file. `load` does not execute any other file that the store names

    >>> study = mbd.load("arm", model="arm_model.py")  # after `torchmbd new arm.yaml` and `torchmbd run arm.yaml`
    >>> study.x.shape, study.value > 0.0, study.motion.status
    ((2,), True, ['ok'])
    """
    from torchmbd.study.record.stored_run import load_run  # imports pydantic, rich and figures

    return load_run(run, uri, model)


def problem_of(file: str | Path, *assignments: str) -> Problem:
    """The problem of an experiment file, for tasks that files have no keys for, such as other criteria of the same motion.

    file         the experiment file (YAML)
    assignments  overrides of single values, as at the command line: "options.layers=2"

    The problem does not contain the tolerances and increments of the file. Add them by RobustProblem and optimize_discrete.
    Nothing is tracked. Raises InputError with every fault of the file.

    >>> problem = mbd.problem_of("arm.yaml", "simulate.steps=100")  # after `torchmbd new arm.yaml`
    >>> problem.names
    ['arm.laminate.angles[0]', 'arm.laminate.angles[1]']
    """
    from torchmbd.study.file.load import load_study

    return load_study(file, assignments).simulated


#: Room of the core -> its public names, `mbd.<room>.<name>`; those of extensions are in torchmbd/extensions/__init__.py.
ROOMS = {
    "optimization": "OptimizationResult Processes RobustProblem latin_hypercube multistart optimize_discrete pareto_front "
    "sobol",
    "reduction": "craig_bampton eigenpair_branches eigenpairs modal_basis spectral_function",
}


def all_names() -> list[str]:
    """Return every public name as it stands behind `mbd.`: at the top and in rooms, such as "simulate" and "io.read_bdf"."""
    in_rooms = [f"{room}.{name}" for room, names in ROOMS.items() for name in names.split()]
    return [*__all__, *rooms(), *in_rooms, *public_names()]


__all__ = [
    "RMS",
    "Acceleration",
    "Aggregate",
    "Angle",
    "AtPeaks",
    "AtTime",
    "AtTimes",
    "AxialSpringDamper",
    "AxialStop",
    "BeamElement",
    "BeamLine",
    "BeamState",
    "Bushing",
    "Chain",
    "ConstantSpeed",
    "Constraint",
    "ControlHistory",
    "Controller",
    "Cylindrical",
    "DesignFailure",
    "DesignSpace",
    "Differences",
    "Displacement",
    "DistanceJoint",
    "Drive",
    "Dynamics",
    "Equilibrium",
    "Event",
    "ExactBeam",
    "Final",
    "Fixed",
    "FlexibleBeam",
    "FlexibleBody",
    "Force",
    "Frame",
    "Frequency",
    "GivenSection",
    "Ground",
    "History",
    "InputError",
    "Integral",
    "Interface",
    "JointCoupling",
    "Laminate",
    "Mass",
    "Max",
    "MbdError",
    "Mean",
    "MeanFrequency",
    "Measure",
    "Mesh",
    "Min",
    "NaturalModes",
    "Phase",
    "Planar",
    "PlaneContact",
    "Ply",
    "PlyFailure",
    "PlyHistory",
    "PlyStress",
    "PointOnCurve",
    "PointOnPlane",
    "Position",
    "Pressure",
    "Prismatic",
    "Problem",
    "Reaction",
    "RelativeDisplacement",
    "Revolute",
    "RigidBody",
    "RotationalSpringDamper",
    "RotationalStop",
    "Scenarios",
    "SectionHistory",
    "SectionTable",
    "Simulation",
    "SimulationFailure",
    "Sine",
    "SmoothMax",
    "SmoothStep",
    "Spherical",
    "SpringDamper",
    "StrainEnergy",
    "Strength",
    "Study",
    "System",
    "Temperature",
    "Torque",
    "Tradeoff",
    "Trajectory",
    "Universal",
    "Velocity",
    "WeightedSum",
    "deg",
    "equilibrium",
    "examples",
    "forces",
    "history",
    "io",
    "load",
    "measure",
    "mesh",
    "natural_frequencies",
    "optimization",
    "optimize",
    "problem_of",
    "progressive_failure",
    "reduction",
    "sections",
    "sharpen",
    "signals",
    "simulate",
    "split",
    "static_truncation",
    "threads",
    "variable",
    "verify",
    "viz",
]
