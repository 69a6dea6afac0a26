"""Optimizers behind one door: arrays only, no mechanics."""

from torchmbd.optimizers import evolution as evolution
from torchmbd.optimizers import ipopt as ipopt
from torchmbd.optimizers import mmfd as mmfd
from torchmbd.optimizers import moving_asymptotes as moving_asymptotes
from torchmbd.optimizers import slsqp as slsqp
from torchmbd.optimizers import trust_constr as trust_constr
from torchmbd.optimizers.criteria import Criteria, ManyCriteria
from torchmbd.optimizers.discrete import Candidate, Certificate, DiscreteResult, optimize_discrete
from torchmbd.optimizers.door import optimize
from torchmbd.optimizers.minima import Minimum
from torchmbd.optimizers.multistart import Study, multistart
from torchmbd.optimizers.optimizer import OPTIMIZERS, STATUSES, Evaluation, Iterate, OptimizationResult, Problem
from torchmbd.optimizers.pareto import Front, ParetoPoint, pareto_front
from torchmbd.optimizers.processes import Processes
from torchmbd.optimizers.robust import RobustProblem
from torchmbd.optimizers.sampling import Starts, given, latin_hypercube, sobol

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
    "OptimizationResult",
    "ParetoPoint",
    "Problem",
    "Processes",
    "RobustProblem",
    "Starts",
    "Study",
    "given",
    "latin_hypercube",
    "multistart",
    "optimize",
    "optimize_discrete",
    "pareto_front",
    "sobol",
]
