"""The workers of a study: each makes the problem once, from the experiment file, or by unpickling one made in Python.

Optimizers, evaluations on disk and tracking stay in the process of the study, so a study is the same on any cluster.
Assumed: workers find the model's file at the same path, and have the same torchmbd (a hash of both is compared).
Checked in tests/study/test_dask_evaluator.py, tests/study/test_cluster.py.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

from torchmbd.errors import InputError, MbdError
from torchmbd.optimization.multistart.workers import Workers, pickle_problem, unpickle_problem
from torchmbd.study.cluster import load_cluster
from torchmbd.study.file.assemble import study_of
from torchmbd.study.file.model import build_model, find_model, forget_files
from torchmbd.study.file.schema import StudyFile
from torchmbd.study.record.paths import problem_key
from torchmbd.study.settings import StudySettings

_ADDRESS = re.compile(r"(tcp|tls|ws|wss)://\S+:\d+")


def study_workers(study: StudySettings, key: str, rows: int, workers: int = 0, scheduler: str | None = None) -> Workers:
    """Return workers for a study; entering their context starts them.

    key        hash of its problem (paths.problem_key)
    rows       number of constraints of the problem
    workers    processes of this machine (0: one for each core) or of SLURM's jobs
    scheduler  address of a scheduler, or a cluster file (.yaml); None: processes of this machine
    """
    if workers < 0:
        raise InputError("workers", workers, "0 (one for each core) or more", shown=f"{workers}")
    make, arguments = unpickle_problem, ()
    if study.origin is None:
        arguments = pickle_problem(study.simulated)
    else:
        make = _problem_of_file
        arguments = json.dumps(study.resolved()), str(study.origin.file.absolute().parent), key
    if scheduler is not None and scheduler.endswith((".yaml", ".yml")):
        slurm = load_cluster(scheduler)
        if not workers:
            raise InputError(
                "workers", 0, "1 or more with a cluster file, because it is the number of workers of all jobs together"
            )
        if shutil.which("sbatch") is None:
            raise InputError(
                "scheduler",
                scheduler,
                hint="a machine of the cluster",
                noun=f"scheduler = {scheduler!r}: this machine",
                state="has no sbatch",
            )
        return Workers(make, arguments, rows, workers, start=slurm.start, problem=study.simulated)
    if scheduler is not None and not _ADDRESS.fullmatch(scheduler):
        raise InputError("scheduler", scheduler, "tcp://host:8786, tls:, ws:, wss:, or a cluster file .yaml")
    return Workers(make, arguments, rows, workers, scheduler, problem=study.simulated)


def _problem_of_file(study_json: str, folder: str, key: str) -> Any:
    """Return the problem of an experiment file, given as JSON, in the folder of that file; called on a worker."""
    forget_files()
    data = StudyFile.model_validate(json.loads(study_json))
    system = build_model(find_model(data.model, Path(folder)), data.options)
    problem = study_of(data, system, Path(folder) / "worker").simulated
    if problem_key(problem) != key:
        raise MbdError("a worker has another model file or another torchmbd than the study: must have the same")
    return problem
