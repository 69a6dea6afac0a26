"""A run of the store as Python objects again: the system with its best design, the problem, the motion.

    study = mbd.load("3f2a9c")          a run id or the beginning of one, or the name of a study (its latest run)
    study.system, study.x, study.value, study.motion

What is read are YAML files only (config.yaml, design.yaml), by the strict reader of experiment files: no artifact is
ever executed or unpickled. The model comes from where it comes from when a study is run: an importable module, or a
Python file below `folder` on this machine. A store cannot make it another function (see model.py).
Checked in tests/experiment/test_archive.py.
"""

from __future__ import annotations

import tempfile
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from torchmbd.design import Problem
from torchmbd.errors import InputError
from torchmbd.experiment.assemble import problem_of
from torchmbd.experiment.faults import Fault, StudyError, located
from torchmbd.experiment.load import Plan, plan_of
from torchmbd.experiment.place import problem_key
from torchmbd.experiment.yaml_file import read_yaml
from torchmbd.integrators import Trajectory
from torchmbd.system import System
from torchmbd.tracking.catalog import Entry, fetch, find
from torchmbd.tracking.store import store_uri


@dataclass(frozen=True)
class LoadedStudy:
    """A study of the store.

    x      best design [n], SI units and radians
    value  its objective, as the store has it
    """

    entry: Entry
    plan: Plan
    x: np.ndarray
    value: float

    @cached_property
    def problem(self) -> Problem:
        return problem_of(self.plan)

    @property
    def system(self) -> System:
        """The model with the best design in its parameters."""
        return self.plan.system

    @cached_property
    def motion(self) -> Trajectory:
        """The motion of the best design, simulated when first asked for."""
        return self.problem.motion(self.x)


def load_run(run: str, uri: str | None = None, folder: str | Path = ".") -> LoadedStudy:
    """Load the best design of a study.

    run     run id, its beginning, or the name of a study
    uri     the MLflow store; default: MLFLOW_TRACKING_URI, else ./mlflow.db
    folder  where the model's file lies, if it is a file
    """
    store = store_uri(uri)
    entry = find(store, run)
    with tempfile.TemporaryDirectory(prefix="torchmbd-") as scratch:
        files = {name: fetch(store, entry, name, Path(scratch)) for name in ("config.yaml", "design.yaml")}
        for name, file in files.items():
            if file is None:
                raise InputError(
                    f"run {entry.run_id[:8]} ({entry.status.lower()}) has no {name}; allowed: a study that ended"
                )
        config, design = (read_yaml(file) for file in files.values() if file is not None)
    config.source = f"config.yaml of run {entry.run_id[:8]}"
    plan = plan_of(config, Path(folder) / f"{entry.name}.yaml", ())
    if not isinstance(plan, Plan):
        raise InputError(f"run {entry.run_id[:8]} is one of figures; allowed: a study")
    said = entry.tags.get("problem_key")
    if said and said != problem_key(plan):
        warnings.warn(
            f"{plan.study.model} or what it reads, torchmbd or torch has changed since run {entry.run_id[:8]}: "
            "its numbers may be others now",
            stacklevel=3,
        )
    x = _insert(plan, design.data, design.source, design.lines)
    return LoadedStudy(entry, plan, x, entry.metrics.get("objective", float("nan")))


def _insert(plan: Plan, data: object, source: str, lines: dict) -> np.ndarray:
    """Set the parameters of the system to a design of the store, and return it as a vector [n]."""
    own = dict(plan.system.named_parameters())
    faults, parts = [], []
    values = data if isinstance(data, dict) else {}
    for name in plan.study.design:
        found = values.get(name)
        if (
            not isinstance(found, list)
            or not all(isinstance(x, float) for x in found)
            or len(found) != own[name].numel()
        ):
            faults.append(Fault((name,), f"= {found!r}: must be a list of {own[name].numel()} numbers"))
            continue
        parts.append(np.array(found))
        with torch.no_grad():
            own[name].copy_(torch.tensor(found, dtype=own[name].dtype).reshape(own[name].shape))
    if faults:
        raise StudyError(source, located(faults, lines))
    return np.concatenate(parts)
