"""The folder of the working directory in which studies keep their state, and the hashes that identify studies.

    .torchmbd/evaluations.db      every evaluation (evaluations.py)
    .torchmbd/<study>/            a study that has not finished (unfinished.py)

The environment variable TORCHMBD_STORE names another folder. A study is identified by a hash of all that its results
depend on, so that the same command continues it. Checked in tests/study/record/test_paths.py.
"""

from __future__ import annotations

import hashlib
import json
import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
import torchdiffeq

from torchmbd.design import Problem
from torchmbd.design.differences import Differences
from torchmbd.math.digest import digest, source_digest
from torchmbd.tracking.uri import StoreURI

_PACKAGE = Path(__file__).parents[2]
_SHOWN = ("cli.py", "tracking", "viz")  # sources that no number of a study depends on
_SEARCHES = (
    "study",
    *(f"optimization/{part}" for part in ("methods", "multistart", "discrete")),
)  # they choose designs


def studies_folder() -> Path:
    """Return the folder of all studies (absolute)."""
    return Path(os.environ.get("TORCHMBD_STORE") or ".torchmbd").absolute()


def make_studies_folder() -> Path:
    """Return the folder of all studies, made for the user alone if it is new."""
    folder = studies_folder()
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def private(path: str, flags: int) -> int:
    """Open a file that the user alone can read, as the `opener` of `open`."""
    return os.open(path, flags, mode=0o600)


def evaluations_file() -> Path:
    """Return the file of all evaluations."""
    return studies_folder() / "evaluations.db"


def problem_key(problem: Any) -> str:
    """Return the hash of all that the numbers of an evaluation depend on.

    These are the system with all its tensors and laws, the settings of the simulation, the responses, the source of
    torchmbd that an evaluation enters, and the versions of the packages that compute. Bounds of the design variables
    affect the search alone, except those of a min-max problem and of forward differences (`settings`). What was done with
    the system before does not count.
    """
    if isinstance(problem, (Problem, Differences)):
        cases = problem.cases(problem.start[None]) if hasattr(problem, "cases") else []
        varied = [simulation.system.get_parameter(name) for simulation, _ in cases for name in problem.space.variables]
        built = digest(*problem.settings(), ignored=varied)
    else:
        built = digest(problem)
    return numbers_key(built)


def numbers_key(built: str) -> str:
    """Return the hash of a digest with the source of torchmbd and the versions of the packages that compute."""
    versions = [package.__version__ for package in (torch, np, scipy, torchdiffeq)]
    return _hash([built, _code(_PACKAGE, (*_SHOWN, *_SEARCHES)), versions])


def search_key(problem: Any, *settings: Any) -> str:
    """Return the hash of all that the designs of a search depend on: its problem, its settings and the source of torchmbd."""
    return _hash([digest(*settings), problem_key(problem), _code(_PACKAGE, _SHOWN)])


def relative_store(uri: StoreURI | str) -> str:
    """Return the text of a URI, a SQLite file relative to the folder of studies, so that both can be copied."""
    file = StoreURI(uri).file
    return str(StoreURI(uri)) if file is None else f"sqlite:///{os.path.relpath(file, studies_folder())}"


def file_key(data: Any, name: str, uri: StoreURI | str) -> str:
    """Return the hash of an experiment file: of its data, which JSON can have, its name and its store."""
    return _hash([data, name, relative_store(uri)])


@cache
def _code(package: Path, without: tuple[str, ...]) -> str:
    """Return the digest of the source of torchmbd: evaluations of another version are not used."""
    return source_digest(package, without)


def _hash(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:24]
