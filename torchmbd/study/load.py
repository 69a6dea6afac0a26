"""Load experiment files: from a file and overrides to a study, or to one error with all faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torchmbd.errors import InputError
from torchmbd.study.assemble import S, study_of
from torchmbd.study.check import check, figure_faults
from torchmbd.study.file_errors import Fault, StudyError, located, mentioned
from torchmbd.study.overrides import override
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


def load(path: str | Path, overrides: Sequence[str] = (), kind: type[S] = StudySettings) -> S | FiguresPlan:
    """Return the study of a file, or the plan of its figures; StudyError with every fault, each with its line."""
    document = read_yaml(path)
    override(document, overrides)
    return study_of_document(document, Path(path), tuple(overrides), kind)


def study_of_document(
    document: Document, path: Path, overrides: tuple[str, ...], kind: type[S] = StudySettings
) -> S | FiguresPlan:
    """Return the study or figures of the contents of a file `path`."""
    sections, faults = validate(document.data)
    folder, figures = path.absolute().parent, kind_of(document.data) is Figures
    system, more = (None, figure_faults(sections, folder)) if figures else check(sections, folder)
    if faults or more or (system is None and not figures):
        raise StudyError(document.source, located(faults + more, document.lines))
    if system is None:
        return FiguresPlan(Figures.model_validate(document.data), path, overrides)
    try:
        return study_of(StudyFile.model_validate(document.data), system, path, overrides, kind)
    except InputError as error:  # of the study as a whole
        fault = Fault(mentioned(str(error), document.lines), f": {error}")
        raise StudyError(document.source, located([fault], document.lines)) from error


def load_study(path: str | Path, overrides: Sequence[str] = (), kind: type[S] = StudySettings) -> S:
    """Load a file that optimizes or sweeps; InputError for one that draws figures."""
    study = load(path, overrides, kind)
    if isinstance(study, FiguresPlan):
        fault = Fault(("figures",), ": draws figures; allowed here: a study or a sweep")
        raise StudyError(str(path), located([fault], read_yaml(path).lines))
    return study
