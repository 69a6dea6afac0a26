"""Optimizers by one contract: arrays only, no mechanics.

>>> starts = mbd.optimization.sobol(8, seed=1)  # of multistart, identify and studies
"""

from torchmbd.optimization.api import optimize
from torchmbd.optimization.criteria import Criteria, ManyCriteria
from torchmbd.optimization.discrete.branch_and_bound import Candidate, Certificate, DiscreteResult, optimize_discrete
from torchmbd.optimization.methods import auto as auto
from torchmbd.optimization.methods import evolution as evolution
from torchmbd.optimization.methods import ipopt as ipopt
from torchmbd.optimization.methods import lbfgs as lbfgs
from torchmbd.optimization.methods import mmfd as mmfd
from torchmbd.optimization.methods import moving_asymptotes as moving_asymptotes
from torchmbd.optimization.methods import slsqp as slsqp
from torchmbd.optimization.methods import sqcqp as sqcqp
from torchmbd.optimization.methods import trust_constr as trust_constr
from torchmbd.optimization.multistart.run import Minimum, MultistartResult, multistart
from torchmbd.optimization.multistart.sampling import Starts, latin_hypercube, sobol, starts_at
from torchmbd.optimization.multistart.workers import Processes
from torchmbd.optimization.optimizer import (
    OPTIMIZERS,
    STATUSES,
    Evaluation,
    Iterate,
    NonlinearProgram,
    OptimizationResult,
)
from torchmbd.optimization.pareto import Front, ParetoPoint, pareto_front
from torchmbd.optimization.robust import RobustProblem

__all__ = [
    "OPTIMIZERS",
    "STATUSES",
    "Candidate",
    "Certificate",
    "Criteria",
    "DiscreteResult",
    "Evaluation",
    "Front",
    "Iterate",
    "ManyCriteria",
    "Minimum",
    "MultistartResult",
    "NonlinearProgram",
    "OptimizationResult",
    "ParetoPoint",
    "Processes",
    "RobustProblem",
    "Starts",
    "latin_hypercube",
    "multistart",
    "optimize",
    "optimize_discrete",
    "pareto_front",
    "sobol",
    "starts_at",
]


def __dir__() -> list[str]:
    return [*__all__]
