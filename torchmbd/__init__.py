"""Optimization of flexible multibody systems made of composite materials, with exact gradients.

system = mbd.System(bodies, joints)      structure and topology
motion = mbd.simulate(system, ...)       transient motion, with sensitivities
problem = mbd.Problem(system, ...)       what to minimize, subject to what
result = mbd.optimize(problem)           exact gradients inside
"""

from torchmbd import forces, mesh, sections, viz
from torchmbd.bodies import FlexibleBody, Frame, Ground, RigidBody
from torchmbd.design import (
    RMS,
    Acceleration,
    AtPeaks,
    AtTime,
    AtTimes,
    Constraint,
    DesignSpace,
    Displacement,
    Final,
    Frequency,
    Integral,
    Mass,
    Max,
    Mean,
    Min,
    Position,
    Problem,
    Reaction,
    RelativeDisplacement,
    SmoothMax,
    StrainEnergy,
    Velocity,
    WeightedSum,
    history,
    measure,
)
from torchmbd.design.differences import Differences
from torchmbd.design.lamination import LaminationRules
from torchmbd.design.ply_failure import PlyFailure
from torchmbd.elements import BeamLine, GivenSection
from torchmbd.errors import InputError, MbdError, SimulationFailure
from torchmbd.forces import (
    AxialSpringDamper,
    Bushing,
    Force,
    RotationalSpringDamper,
    SpringDamper,
    Torque,
)
from torchmbd.integrators import Trajectory, simulate
from torchmbd.integrators.ply_history import PlyHistory
from torchmbd.joints import Cylindrical, Distance, Drive, Fixed, Prismatic, Revolute, Spherical, Universal
from torchmbd.materials import Laminate, Ply, Strength
from torchmbd.mesh import Mesh
from torchmbd.numerics.angles import deg
from torchmbd.optimizers import OptimizationResult, multistart, optimize, sobol
from torchmbd.reduction import craig_bampton, eigenpair_branches, eigenpairs, modal_basis
from torchmbd.system import Dynamics, System

__version__ = "0.1.0"

__all__ = [
    "RMS",
    "Acceleration",
    "AtPeaks",
    "AtTime",
    "AtTimes",
    "AxialSpringDamper",
    "BeamLine",
    "Bushing",
    "Constraint",
    "Cylindrical",
    "DesignSpace",
    "Differences",
    "Displacement",
    "Distance",
    "Drive",
    "Dynamics",
    "Final",
    "Fixed",
    "FlexibleBody",
    "Force",
    "Frame",
    "Frequency",
    "GivenSection",
    "Ground",
    "InputError",
    "Integral",
    "Laminate",
    "LaminationRules",
    "Mass",
    "Max",
    "MbdError",
    "Mean",
    "Mesh",
    "Min",
    "OptimizationResult",
    "Ply",
    "PlyFailure",
    "PlyHistory",
    "Position",
    "Prismatic",
    "Problem",
    "Reaction",
    "RelativeDisplacement",
    "Revolute",
    "RigidBody",
    "RotationalSpringDamper",
    "SimulationFailure",
    "SmoothMax",
    "Spherical",
    "SpringDamper",
    "StrainEnergy",
    "Strength",
    "System",
    "Torque",
    "Trajectory",
    "Universal",
    "Velocity",
    "WeightedSum",
    "craig_bampton",
    "deg",
    "eigenpair_branches",
    "eigenpairs",
    "forces",
    "history",
    "measure",
    "mesh",
    "modal_basis",
    "multistart",
    "optimize",
    "sections",
    "simulate",
    "sobol",
    "viz",
]
