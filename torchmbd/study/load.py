"""From a file and overrides to a plan that can run, or one error with everything that is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torchmbd.design.response_spec import measure_of
from torchmbd.integrate import Phase
from torchmbd.multibody.system import System
from torchmbd.study.check import check, figure_faults
from torchmbd.study.columns import Columns
from torchmbd.study.file_errors import Fault, StudyError, located
from torchmbd.study.model import find_phases
from torchmbd.study.overrides import override
from torchmbd.study.schema import Figures, Study
from torchmbd.study.validation import kind_of, validate
from torchmbd.study.yaml_file import Document, read_yaml


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

    @property
    def phases(self) -> list[Phase] | None:
        """Those of the simulation, made anew."""
        spec = self.study.simulate.phases
        return None if spec is None else find_phases(spec, self.file.absolute().parent)


@dataclass(frozen=True)
class FiguresPlan:
    """Figures to be drawn, and where the order came from."""

    study: Figures
    file: Path
    overrides: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.file.stem


def load(path: str | Path, overrides: Sequence[str] = ()) -> Plan | FiguresPlan:
    """Read, override, validate and build; StudyError with every fault, each with its line."""
    document = read_yaml(path)
    override(document, overrides)
    return plan_of(document, Path(path), tuple(overrides))


def plan_of(document: Document, path: Path, overrides: tuple[str, ...]) -> Plan | FiguresPlan:
    """Validate and build what a document describes, as if it were the file `path`."""
    sections, faults = validate(document.data)
    folder, figures = path.absolute().parent, kind_of(document.data) is Figures
    system, more = (None, figure_faults(sections, folder)) if figures else check(sections, folder)
    if faults or more or (system is None and not figures):
        raise StudyError(document.source, located(faults + more, document.lines))
    if system is None:
        return FiguresPlan(Figures.model_validate(document.data), path, overrides)
    study = Study.model_validate(document.data)
    return Plan(study, system, Columns.of(study.design, system, measure_of(study.minimize).rows), path, overrides)


def load_study(path: str | Path, overrides: Sequence[str] = ()) -> Plan:
    """Load a file that optimizes or sweeps; InputError for one that draws figures."""
    plan = load(path, overrides)
    if isinstance(plan, FiguresPlan):
        raise StudyError(str(path), [Fault(("figures",), ": draws figures; allowed here: a study or a sweep")])
    return plan
