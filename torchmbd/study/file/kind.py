"""The contract of a kind of experiment files: what the program must know to check and run one.

A kind is a `Kind` in a file of its own and an entry of the registry `KINDS` in load.py, under the section by which a file shows
that it is of this kind. A file without such a section optimizes, or sweeps a variable.
Checked in tests/study/file/test_kinds.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchmbd.study.file.config_index import question
from torchmbd.study.file.faults import Fault
from torchmbd.study.file.section import Section
from torchmbd.study.file.yaml_file import Document
from torchmbd.tracking.uri import StoreURI


@dataclass(frozen=True)
class Source:
    """An experiment file with its overrides."""

    document: Document
    path: Path
    overrides: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """The folder of the file (absolute): names of other files in it are relative to it."""
        return self.path.absolute().parent


@dataclass(frozen=True, eq=False)
class FilePlan:
    """What a file asks for: an experiment of record/unfinished.py, without its kind and key."""

    data: Any  # the valid file, a Section with `tracking`
    source: Source

    @property
    def name(self) -> str:
        return self.source.path.stem

    @property
    def experiment(self) -> str:
        return self.data.tracking.experiment

    @property
    def uri(self) -> StoreURI | None:
        return self.data.tracking.uri

    @property
    def file(self) -> Path:
        return self.source.path

    @property
    def overrides(self) -> tuple[str, ...]:
        return self.source.overrides

    @property
    def question(self) -> str:
        """The question that the file opens with, "" if there is none."""
        return question(self.source.path)

    def resolved(self) -> dict[str, Any]:
        """Return the file with every default filled in."""
        return self.data.resolved()


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of experiment files. What `read` makes of one is its experiment (record/unfinished.py).

    purpose   what such a file does, where another is asked for: "draws figures; ..."
    sections  of a file, a class of section.py
    read      (source, valid sections, faults of the others) -> the experiment, or all faults
    run       (experiment, console, *, uri, workers, scheduler, fresh) -> exit code; the arguments of run.run_study
    check     (experiment, console) -> exit code; prints what it will cost, or what it is
    constructors         section -> what is constructed of it, whose docstrings explain its keys (json_schema.py)
    named_by_parameters  keys of sections whose entries have dotted names, such as those of parameters
    """

    purpose: str
    sections: type[Section]
    read: Callable[[Source, dict[str, Any], list[Fault]], Any]
    run: Callable[..., int]
    check: Callable[..., int]
    constructors: Mapping[type[Section], Sequence[Any]] = field(default_factory=dict)
    named_by_parameters: tuple[str, ...] = ()
