"""Where studies keep what they must not lose: a folder of the working directory, and the names of things in it.

    .torchmbd/evaluations.db      every evaluation (evaluations.py)
    .torchmbd/<study>/            what the tracking store does not have yet (torchmbd.tracking.spool)

TORCHMBD_STORE names another folder. A study is known by a hash of all that its course depends on, so that the same
command goes on with it. Checked in tests/experiment/test_place.py.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
from functools import cache
from pathlib import Path
from typing import Any

import torch

from torchmbd.experiment.load import FiguresPlan, Plan
from torchmbd.experiment.model import find_function, find_model

_NUMBERS = ("model", "options", "design", "simulate", "minimize", "subject_to")
_UNCONCERNED = ("cli.py", "process.py", "bare.py", "experiment", "tracking", "viz", "optimizers")  # for an evaluation


def place() -> Path:
    """Return the folder of all studies (absolute)."""
    return Path(os.environ.get("TORCHMBD_STORE") or ".torchmbd").absolute()


def evaluations_file() -> Path:
    """Return the file of all evaluations."""
    return place() / "evaluations.db"


def problem_key(plan: Plan) -> str:
    """Return the hash of what the numbers of an evaluation depend on."""
    resolved = plan.study.resolved()
    depends: dict[str, Any] = {key: resolved[key] for key in _NUMBERS if key in resolved}
    design = resolved["design"].items()  # bounds move the search, not the numbers
    depends["design"] = {
        name: {k: v for k, v in variable.items() if k in ("start", "unit")} for name, variable in design
    }
    depends["source"] = model_source(plan)
    return _hash([depends, _code(), torch.__version__])


def study_key(plan: Plan, uri: str) -> str:
    """Return the hash of what the course of a study depends on."""
    return _hash([plan.study.resolved(), model_source(plan), _code(), plan.name, uri])


def figures_key(plan: FiguresPlan, uri: str) -> str:
    """Return the hash of what figures are asked for."""
    return _hash([plan.study.resolved(), plan.name, uri])


def model_source(plan: Plan) -> str:
    """Return the hash of the files that the model and its phases come from."""
    folder, phases = plan.file.absolute().parent, plan.study.simulate.phases
    made_by = [find_model(plan.study.model, folder)] + ([find_function(phases, folder)] if phases else [])
    files = [inspect.getsourcefile(function) for function in made_by]
    return _hash([hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files if file is not None])


@cache
def _code() -> str:
    """Return the hash of torchmbd's own source: a store must not answer for other code."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        if file.relative_to(package).parts[0] not in _UNCONCERNED:
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _hash(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:24]
