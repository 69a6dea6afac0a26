"""Kinds of experiment files: what the contract asks for is enough, and a kind whose extension is missing is said."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from torchmbd import registry
from torchmbd.cli import main
from torchmbd.study.file import load as load_module
from torchmbd.study.file.faults import Fault, StudyError
from torchmbd.study.file.kind import Kind
from torchmbd.study.file.load import kind_of, load, load_study
from torchmbd.study.file.section import Section


class Tally(Section):
    """A file that counts.

    count  how far
    names  what is counted
    """

    count: int
    names: dict[str, dict[str, float]] = {}  # noqa: RUF012


@pytest.fixture
def counted(monkeypatch):
    """What a kind of files with the section `count` has done; `torchmbd` knows it by one entry of the registry."""
    done = []

    def read(source, sections, faults):
        if sections.get("count", 0) > 9:
            faults = [*faults, Fault(("count",), "= 10: must be at most 9")]
        return faults or SimpleNamespace(name=source.path.stem, uri=None, **sections)

    def run(x, console: Console, uri=None, workers=1, scheduler=None, fresh=False) -> int:
        done.append((x.name, x.count, workers, fresh))
        return 0

    def check(x, console: Console) -> int:
        console.print(f"counts to {x.count}")
        return 0

    kind = Kind(
        "counts; allowed here: a study",
        Tally,
        read,
        run,
        check,
        named_by_parameters=("names",),
    )
    monkeypatch.setitem(load_module.KINDS, "count", kind)
    return done


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TORCHMBD_STORE", str(tmp_path / "state"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'runs.db'}")
    path = Path("tally.yaml")
    path.write_text("count: 3\n", encoding="utf-8")
    return path


def test_a_kind_is_checked_and_run(counted, file, capsys):
    assert main(["check", str(file)]) == 0
    assert "counts to 3" in capsys.readouterr().out
    assert main(["run", str(file), "count=4,5", "--workers", "2", "--fresh"]) == 0
    assert main(["run", str(file)]) == 0
    assert counted == [("tally", 4, 2, True), ("tally", 5, 2, True), ("tally", 3, 1, False)]


def test_its_faults_have_lines_and_its_keys_dots(counted, file):
    for overrides, text in (
        (["count=10"], "count = 10: must be at most 9"),
        (["model=x.py:f"], "model = 'x.py:f' is an unknown key"),
    ):
        with pytest.raises(StudyError, match=text):
            load(file, overrides)
    file.write_text("count: 3\nnames: {c: {weight: 1.0}}\n", encoding="utf-8")
    _, experiment = load(file, ["names.a.b.weight=2.0"])
    assert experiment.names == {"c": {"weight": 1.0}, "a.b": {"weight": 2.0}}


def test_another_kind_is_no_study(counted, file):
    with pytest.raises(StudyError, match=r"line 1: count: counts; allowed here: a study"):
        load_study(file)
    assert kind_of({"model": "x"}) is load_module.STUDY


@pytest.mark.parametrize(
    ("tables", "text"),
    [
        (None, r"line 2: weigh = .* is an unknown key: must be .*; torchmbd\.extensions is not installed"),
        pytest.param(
            SimpleNamespace(NEEDS={}, ENTRIES={"experiments": {"weigh": "scales_of_others:WEIGH"}}),
            r"1 error\n +line 2: weigh: the extension scales_of_others is not installed$",
            marks=pytest.mark.extensions,  # the folder is there, an extension is not
        ),
        (
            SimpleNamespace(NEEDS={}, ENTRIES={"experiments": {}}),
            r"line 2: weigh = .*scales.* is an unknown key: must be one of [a-z_, ]*$",
        ),
    ],
)
def test_a_section_of_a_missing_extension_is_said(file, monkeypatch, tables, text):
    registry._tables()
    monkeypatch.setattr(registry, "_tables", lambda: tables)
    file.write_text("model: model.py:build\nweigh: {on: scales}\n", encoding="utf-8")
    with pytest.raises(StudyError, match=text):
        load(file)


@pytest.mark.extensions
@pytest.mark.parametrize(
    ("section", "fault"),
    [
        ({"minimize": {"wear": {"body": "rod"}}}, "minimize.wear: the extension scales_of_others is not installed"),
        (
            {"minimize": {"sum": [{"mass": "rod"}, {"wear": {"body": "rod"}}]}},
            "minimize.sum.1.wear: the extension scales_of_others is not installed",
        ),
        (
            {"subject_to": [{"max": {"dust": "rod"}, "at_most": 1.0}]},
            "subject_to.0.max.dust: the extension scales_of_others is not installed",
        ),
        (
            {"simulate": {"duration": 0.01, "backend": "gpu"}},
            "simulate.backend = 'gpu' cannot be used, because the extension scales_of_others is not installed. "
            "Try: 'auto' or 'eager' or 'native'",
        ),
    ],
)
def test_every_name_of_a_missing_extension_is_said(write, monkeypatch, section, fault):
    """With the extension alone: no name that resembles it, no other fault."""
    place = "scales_of_others:Scale"
    entries = {"of_design": {"wear": place}, "responses": {"dust": place}, "backends": {"gpu": place}}
    tables = SimpleNamespace(NEEDS={}, ENTRIES={"experiments": {}, "combinators": {}, **entries})
    monkeypatch.setattr(registry, "_tables", lambda: tables)
    with pytest.raises(StudyError) as refusal:
        load(write(**section))
    assert [line.partition(": ")[2] for line in str(refusal.value).splitlines()[1:]] == [fault]


def test_a_misspelt_section_is_told_beside_other_faults_without_extensions(file, monkeypatch):
    monkeypatch.setattr(registry, "_tables", lambda: None)
    file.write_text("model: model.py:build\nminimise: {mass: rod}\n", encoding="utf-8")
    with pytest.raises(StudyError) as refusal:
        load(file)
    text = str(refusal.value)
    assert "is an unknown key" in text
    assert "Try: 'minimize'" in text
    assert "design is missing" in text
