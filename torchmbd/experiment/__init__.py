"""Experiments: a file in, a tracked study out."""

from torchmbd.experiment.faults import Fault, StudyError
from torchmbd.experiment.load import Plan, load
from torchmbd.experiment.run import run_plan

__all__ = ["Fault", "Plan", "StudyError", "load", "run_plan"]
