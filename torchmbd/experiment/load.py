"""From a file and overrides to a plan that can run, or one error with everything that is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchmbd.experiment.check import check
from torchmbd.experiment.columns import Columns
from torchmbd.experiment.faults import StudyError, place
from torchmbd.experiment.overrides import override
from torchmbd.experiment.schema import Study
from torchmbd.experiment.validation import validate
from torchmbd.experiment.yaml_file import read_yaml
from torchmbd.system import System


@dataclass(frozen=True)
class Plan:
    """A study, its system, and where it came from."""

    study: Study
    system: System
    columns: Columns
    file: Path
    overrides: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.file.stem


def load(path: str | Path, overrides: Sequence[str] = ()) -> Plan:
    """Read, override, validate and build; StudyError with every fault, each with its line."""
    document = read_yaml(path)
    override(document, overrides)
    sections, faults = validate(document.data)
    system, more = check(sections, Path(path).absolute().parent)
    if faults or more or system is None:
        known = [replace(fault, where=place(fault.path, document.lines)) for fault in faults + more]
        raise StudyError(str(path), known)
    study = Study.model_validate(document.data)
    return Plan(study, system, Columns.of(study.design, system), Path(path), tuple(overrides))
