"""The contract of a kind of experiment files: what the program must know to check, run, continue and send one.

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

    @property
    def question(self) -> str:
        """The question that the file opens with, "" if there is none."""
        return question(self.path)

    @property
    def name(self) -> str:
        return self.path.stem


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of experiment files. What `read` makes of one is its experiment, an object with `name` and `uri` of its store.

    purpose   what such a file does, where another is asked for: "draws figures; ..."
    sections  of a file, a class of section.py
    read      (source, valid sections, faults of the others) -> the experiment, or all faults
    key       (experiment, URI of the store) -> hash of all that the results depend on: an experiment is continued by it
    run       (experiment, console, *, uri, workers, scheduler, fresh, offline) -> exit code; the arguments of run.run_study
    check     (experiment, console) -> exit code; prints what it will cost, or what it is
    constructors         section -> what is constructed of it, whose docstrings explain its keys (json_schema.py)
    named_by_parameters  keys of sections whose entries have dotted names, such as those of parameters
    """

    purpose: str
    sections: type[Section]
    read: Callable[[Source, dict[str, Any], list[Fault]], Any]
    key: Callable[..., str]
    run: Callable[..., int]
    check: Callable[..., int]
    constructors: Mapping[type[Section], Sequence[Any]] = field(default_factory=dict)
    named_by_parameters: tuple[str, ...] = ()
