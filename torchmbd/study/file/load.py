"""Load experiment files: from a file and overrides to a study, or to one error with all faults.

Checked in tests/study/file/test_load.py, tests/study/file/test_kinds.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from torchmbd.errors import InputError
from torchmbd.registry import Registry
from torchmbd.study.estimate import print_estimate
from torchmbd.study.figures import FIGURES
from torchmbd.study.file.assemble import study_of
from torchmbd.study.file.check import built_system, section_faults, study_fault
from torchmbd.study.file.faults import Fault, StudyError, located
from torchmbd.study.file.kind import Kind, Source
from torchmbd.study.file.model import forget_files
from torchmbd.study.file.overrides import override
from torchmbd.study.file.parameter_values import with_values_of_file
from torchmbd.study.file.schema import StudyFile
from torchmbd.study.file.validation import validate
from torchmbd.study.file.yaml_file import read_yaml
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.study.settings import StudySettings


def load(path: str | Path, overrides: Sequence[str] = ()) -> tuple[Kind, Any]:
    """Return what a file asks for, with its kind; StudyError with every fault, each with its line."""
    document = read_yaml(path)
    with_values_of_file(document, Path(path).absolute().parent)
    # Of single values, or of the name of the file.
    override(document, overrides, kind_of(document.data).named_by_parameters)
    with_values_of_file(document, Path(path).absolute().parent)
    return read_experiment(Source(document, Path(path), tuple(overrides)))


def read_experiment(source: Source) -> tuple[Kind, Any]:
    """Return what the contents of a file ask for, with its kind."""
    forget_files()
    document = source.document
    if absent := _absent(document.data):
        raise StudyError(document.source, located(absent, document.lines))
    kind = kind_of(document.data)
    sections, faults = validate(document.data, kind.sections)
    experiment: Any = kind.read(source, sections, [_with_absence(fault, kind) for fault in faults])
    if isinstance(experiment, list):
        raise StudyError(document.source, located(experiment, document.lines))
    return kind, experiment


def kind_of(data: Any) -> Kind:
    """Return the kind of a file."""
    keys = data if isinstance(data, dict) else ()
    return next((KINDS[section] for section in KINDS if section in keys), STUDY)


def _absent(data: Any) -> list[Fault]:
    """The sections by which a file is of a kind that an extension has which is not installed.

    Other sections of such a file cannot be checked, as they are those of its kind.
    """
    keys = [str(key) for key in data] if isinstance(data, dict) else []
    return [Fault((key,), f": {absence}") for key in keys if (absence := KINDS.absence(key))]


def _with_absence(fault: Fault, kind: Kind) -> Fault:
    """The fault of an unknown section, with a hint where no extension is installed that might know it."""
    fields = kind.sections.model_fields.items()
    unknown = len(fault.path) == 1 and fault.path[0] not in [field.alias or name for name, field in fields]
    absence = KINDS.missing(str(fault.path[0])) if unknown else None
    return replace(fault, text=f"{fault.text}; {absence}") if absence else fault


def load_study(path: str | Path, overrides: Sequence[str] = ()) -> StudySettings:
    """Load a file that optimizes or sweeps; InputError for another."""
    kind, study = load(path, overrides)
    if isinstance(study, StudySettings):
        return study
    section = next(section for section in KINDS if KINDS[section] is kind)
    lines = read_yaml(path).lines
    raise StudyError(str(path), located([Fault((section,), f": {kind.purpose}")], lines))


def _read_study(source: Source, sections: dict[str, Any], faults: list[Fault]) -> StudySettings | list[Fault]:
    lines = source.document.lines
    system, of_model = built_system(sections, source.folder)
    faults = faults + of_model
    refusal = None
    if system is not None and not faults:
        try:
            return study_of(StudyFile.model_construct(**sections), system, source.path, source.overrides)
        except InputError as error:
            refusal = error
    if of_model:
        sections = {key: x for key, x in sections.items() if key not in ("model", "options", "parameters")}
    faults += section_faults(sections, system, source.folder, lines)
    if refusal is not None and not faults:  # of the study as a whole
        faults = [study_fault(refusal, sections, lines)]
    return faults


def _check_study(study: StudySettings, console: Console) -> int:
    cost = print_estimate(study, console)
    return 0 if cost is None or cost.resolved else UNVERIFIED


#: The kind of files without a section of another.
STUDY = Kind("optimizes, or sweeps a variable", StudyFile, _read_study, run_study, _check_study)
#: Section -> the kind of files that have it.
KINDS: Registry[Kind] = Registry("experiments", {"figures": FIGURES})
