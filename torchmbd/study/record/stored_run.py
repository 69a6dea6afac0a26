"""Load a study from the tracking store: the system with its best design, the problem, the motion.

    study = mbd.load("3f2a9c", model="arm.py")    a run id or the beginning of one, or the name of a study (its latest)
    study.system, study.x, study.value, study.motion

Of the artifacts only config.yaml and design.yaml are read, by the strict reader of experiment files; none is executed or
unpickled. Loading executes the model, which is code. Others may be able to write to the store, and could name any file there:
so only files and modules that the caller names are executed.
Checked in tests/study/record/test_stored_run.py.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchmbd.design import Problem
from torchmbd.design.response_spec import functions
from torchmbd.errors import InputError, warn
from torchmbd.integrate import Trajectory
from torchmbd.multibody.system import System
from torchmbd.study.file.faults import Fault, StudyError, located
from torchmbd.study.file.kind import Source
from torchmbd.study.file.load import read_experiment
from torchmbd.study.file.schema import OBJECTIVE_KEYS
from torchmbd.study.file.yaml_file import Document, read_yaml
from torchmbd.study.record.paths import problem_key
from torchmbd.study.settings import StudySettings
from torchmbd.summary import Summary
from torchmbd.tracking.catalog import Entry, fetch, find
from torchmbd.tracking.store import store_uri
from torchmbd.tracking.uri import StoreURI


@dataclass(frozen=True, repr=False)
class LoadedStudy(Summary):
    """A study loaded from the store.

    entry  its run in the store
    study  its settings
    x      best design [n], SI units and radians
    value  objective of the best design, from the store
    """

    entry: Entry
    study: StudySettings
    x: np.ndarray
    value: float

    def _summary(self) -> list[tuple[str, Any]]:
        best = f"{self.value:.8g} at {self.study.columns.named(self.x)}"
        return [
            *self.study._summary(),
            ("run", f"{self.entry.run_id[:8]}, {self.entry.status.lower()}"),
            ("best", best),
        ]

    @property
    def problem(self) -> Problem:
        return self.study.simulated

    @property
    def system(self) -> System:
        """The model with the best design in its parameters."""
        return self.problem.system

    @cached_property
    def motion(self) -> Trajectory:
        """The motion of the best design, simulated at the first access."""
        return self.problem.motion(self.x)


Models = str | Path | Sequence[str | Path]


def load_run(run: str, uri: str | StoreURI | None = None, model: Models = ()) -> LoadedStudy:
    """Load the best design of a study.

    run    run id, its beginning, or the name of a study
    uri    the MLflow store; default: MLFLOW_TRACKING_URI, else ./mlflow.db
    model  the Python file, or module, of the model, which is executed; several where phases or responses come from another
    """
    store = store_uri(uri)
    entry = find(store, run)
    with tempfile.TemporaryDirectory(prefix="torchmbd-") as scratch:
        files = {name: fetch(store, entry, name, Path(scratch)) for name in ("config.yaml", "design.yaml")}
        for name, file in files.items():
            if file is None:
                raise InputError(
                    "run",
                    entry.run_id,
                    "a study of one objective that ended",
                    state=f"has no {name}",
                    noun=f"run {entry.run_id[:8]} ({entry.kind}, {entry.status.lower()})",
                )
        config, design = (read_yaml(file) for file in files.values() if file is not None)
    if isinstance(config.data, dict) and "problem" in config.data:
        raise InputError(
            "run",
            entry.run_id,
            "a study of a file",
            hint="run() of the same mbd.Study, which reads all evaluations from the disk",
            state="was made in Python",
            noun=f"run {entry.run_id[:8]}",
        )
    config.source = f"config.yaml of run {entry.run_id[:8]}"
    folder = _model_folder(config, [model] if isinstance(model, (str, Path)) else list(model))
    _, study = read_experiment(Source(config, folder / f"{entry.name}.yaml"))
    if not isinstance(study, StudySettings):
        raise InputError(
            "run", entry.run_id, "a study", state=f"is a record of {entry.kind}", noun=f"run {entry.run_id[:8]}"
        )
    key = entry.tags.get("problem_key")
    if key and key != problem_key(study.simulated):
        warn(
            f"{config.data['model']}, a file that it reads, torchmbd or torch has changed since run {entry.run_id[:8]}, so a "
            "new motion may differ from the record of the run",
        )
    x = _set_design(study, design.data, design.source, design.lines)
    return LoadedStudy(entry, study, x, entry.metrics.get("objective", float("nan")))


def _model_folder(config: Document, named: list[str | Path]) -> Path:
    """Return the folder of the files that a study executes; InputError unless each of them is in `named`."""
    data = config.data if isinstance(config.data, dict) else {}
    simulate = data.get("simulate")
    specs = [data.get("model"), simulate.get("phases") if isinstance(simulate, dict) else None]
    specs += functions([data.get(key) for key in (*OBJECTIVE_KEYS, "subject_to")])
    folders = set()
    for code in {spec.rpartition(":")[0] for spec in specs if isinstance(spec, str)}:
        parts = Path(code).parts
        paths = [Path(name).absolute() for name in named]
        if not code.endswith(".py") and code in named:
            continue
        matching = [path for path in paths if code.endswith(".py") and path.parts[-len(parts) :] == parts]
        if not matching:
            raise InputError(
                "model",
                allowed="the path of that Python file, or the name of that module, if you trust it",
                state=f"is {[str(name) for name in named]}, but {config.source} executes {code!r}",
            )
        folders.add(matching[0].parents[len(parts) - 1])
    if len(folders) > 1:
        raise InputError(
            "model",
            [str(name) for name in named],
            "files below one folder, as in the study",
            shown=f"{[str(name) for name in named]}",
        )
    return folders.pop() if folders else Path()


def _set_design(study: StudySettings, data: object, source: str, lines: dict) -> np.ndarray:
    """Set the parameters of the system to the design in `data`, and return it as a vector [n]."""
    problem = study.simulated
    parameters = dict(problem.system.named_parameters())
    faults, parts = [], []
    values = data if isinstance(data, dict) else {}
    for name in problem.space.variables:
        numbers = values.get(name)
        if (
            not isinstance(numbers, list)
            or not all(isinstance(x, float) for x in numbers)
            or len(numbers) != parameters[name].numel()
        ):
            faults.append(Fault((name,), f"= {numbers!r}: must be a list of {parameters[name].numel()} numbers"))
            continue
        parts.append(np.array(numbers))
        with torch.no_grad():
            parameters[name].copy_(torch.tensor(numbers, dtype=parameters[name].dtype).reshape(parameters[name].shape))
    if faults:
        raise StudyError(source, located(faults, lines))
    entries = np.concatenate(parts)
    places = {name: k for k, name in enumerate(problem.space.entries)}
    return entries[[places[name] for name in problem.space.names]]
