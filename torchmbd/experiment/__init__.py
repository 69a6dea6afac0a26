"""Experiments: a file in, a tracked study out."""

from torchmbd.experiment.draw import run_figures
from torchmbd.experiment.faults import Fault, StudyError
from torchmbd.experiment.load import FiguresPlan, Plan, load, load_study
from torchmbd.experiment.run import run_plan

__all__ = ["Fault", "FiguresPlan", "Plan", "StudyError", "load", "load_study", "run_figures", "run_plan"]
