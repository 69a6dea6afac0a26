"""Load experiment files: from a file and overrides to a study, or to one error with all faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchmbd.errors import InputError
from torchmbd.study.assemble import S, study_of
from torchmbd.study.check import built_system, figure_faults, section_faults
from torchmbd.study.file_errors import Fault, StudyError, located, mentioned
from torchmbd.study.identify_plan import IdentificationPlan, plan_of
from torchmbd.study.identify_schema import IdentificationFile
from torchmbd.study.method_options import method_faults
from torchmbd.study.overrides import override
from torchmbd.study.parameter_values import with_values_of_file
from torchmbd.study.schema import Figures, StudyFile
from torchmbd.study.settings import StudySettings
from torchmbd.study.validation import kind_of, validate
from torchmbd.study.yaml_file import Document, read_yaml


@dataclass(frozen=True)
class FiguresPlan:
    """An experiment file that draws figures, with its overrides."""

    study: Figures
    file: Path
    overrides: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.file.stem


def load(
    path: str | Path, overrides: Sequence[str] = (), kind: type[S] = StudySettings
) -> S | FiguresPlan | IdentificationPlan:
    """Return the study of a file, or the plan of its figures or its fit; StudyError with every fault, each with its line."""
    document = read_yaml(path)
    with_values_of_file(document, Path(path).absolute().parent)
    override(document, overrides)  # of single values, or of the name of the file
    with_values_of_file(document, Path(path).absolute().parent)
    return study_of_document(document, Path(path), tuple(overrides), kind)


def study_of_document(
    document: Document, path: Path, overrides: tuple[str, ...], kind: type[S] = StudySettings
) -> S | FiguresPlan | IdentificationPlan:
    """Return the study, figures or identification of the contents of a file `path`."""
    sections, faults = validate(document.data)
    folder, lines, system = path.absolute().parent, document.lines, None
    if kind_of(document.data) is Figures:
        if not (faults := faults + figure_faults(sections, folder)):
            return FiguresPlan(Figures(**sections), path, overrides)
        raise StudyError(document.source, located(faults, lines))
    if kind_of(document.data) is IdentificationFile:
        return _identification(document, sections, faults, path, overrides)
    system, of_model = built_system(sections, folder)
    of_keys = method_faults(sections) + of_model
    faults += of_keys
    refusal = None
    if system is not None and not faults:
        try:
            return study_of(StudyFile.model_construct(**sections), system, path, overrides, kind)
        except InputError as error:
            refusal = error
    wrong = {fault.path[0] for fault in of_keys}
    faults += section_faults({key: x for key, x in sections.items() if key not in wrong}, system, folder, lines)
    if refusal is not None and not faults:  # of the study as a whole
        faults = [Fault(mentioned(str(refusal), lines), f": {refusal}")]
    raise StudyError(document.source, located(faults, lines)) from refusal


def _identification(
    document: Document, sections: dict[str, Any], faults: list[Fault], path: Path, overrides: tuple[str, ...]
) -> IdentificationPlan:
    """Return the identification of a file; its experiments are checked where its keys and its model are valid."""
    system, of_model = built_system(sections, path.absolute().parent)
    faults = faults + of_model + method_faults(sections)
    if system is not None and not faults:
        plan, faults = plan_of(IdentificationFile.model_construct(**sections), system, path, overrides)
        if plan is not None:
            return plan
    raise StudyError(document.source, located(faults, document.lines))


def load_study(path: str | Path, overrides: Sequence[str] = (), kind: type[S] = StudySettings) -> S:
    """Load a file that optimizes or sweeps; InputError for one that draws figures, or fits a model."""
    study = load(path, overrides, kind)
    if isinstance(study, FiguresPlan):
        fault = Fault(("figures",), ": draws figures; allowed here: a study or a sweep")
        raise StudyError(str(path), located([fault], read_yaml(path).lines))
    if isinstance(study, IdentificationPlan):
        fault = Fault(("identify",), ": fits a model; allowed here: a study or a sweep; mbd.identify in Python")
        raise StudyError(str(path), located([fault], read_yaml(path).lines))
    return study
