"""Where studies keep what they must not lose: a folder of the working directory, and the names of things in it.

    .torchmbd/evaluations.db      every evaluation (evaluations.py)
    .torchmbd/<study>/            a study that has not finished (unfinished.py)

TORCHMBD_STORE names another folder. A study is known by a hash of all that its course depends on, so that the same
command goes on with it. Checked in tests/study/test_paths.py.
"""

from __future__ import annotations

import hashlib
import json
import os
from functools import cache
from pathlib import Path
from typing import Any

import torch

from torchmbd.study.check import vector
from torchmbd.study.digest import digest, sources
from torchmbd.study.load import FiguresPlan, Plan

_NUMBERS = ("model", "options", "simulate", "minimize", "subject_to")
_PACKAGE = Path(__file__).parents[1]
_UNCONCERNED = ("cli.py", "process.py", "study", "tracking", "viz", "optimization")  # for an evaluation
_FROM_FILE = ("study/assemble.py", "study/check.py", "study/columns.py", "study/schema.py")


def place() -> Path:
    """Return the folder of all studies (absolute)."""
    return Path(os.environ.get("TORCHMBD_STORE") or ".torchmbd").absolute()


def evaluations_file() -> Path:
    """Return the file of all evaluations."""
    return place() / "evaluations.db"


def problem_key(plan: Plan) -> str:
    """Return the hash of what the numbers of an evaluation depend on.

    These are the system as it is built, with all that its tensors and laws hold, wherever the model has it from; the
    settings; the code that computes; and torch's version. Bounds and the values of design variables move the search only.
    """
    study, system = plan.study, plan.system
    settings = {name: value for name, value in study.resolved().items() if name in _NUMBERS}
    start = vector(study.design, system, "start")
    start = start * plan.columns.factors[: start.size]  # without the extra variable
    varied = [system.get_parameter(name) for name in study.design]
    built = digest(system, plan.phases, start, settings, list(study.design), aside=varied)
    return _hash([built, _code(_PACKAGE), torch.__version__])


def study_key(plan: Plan, uri: str) -> str:
    """Return the hash of what the course of a study depends on."""
    return _hash([plan.study.resolved(), problem_key(plan), plan.name, uri])


def figures_key(plan: FiguresPlan, uri: str) -> str:
    """Return the hash of what figures are asked for."""
    return _hash([plan.study.resolved(), plan.name, uri])


@cache
def _code(package: Path) -> str:
    """Return the digest of torchmbd's own source: a store must not answer for other code."""
    parts = sorted(path.name for path in package.iterdir() if path.is_dir() or path.suffix == ".py")
    return sources(package, [*(part for part in parts if part not in _UNCONCERNED), *_FROM_FILE])


def _hash(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:24]
