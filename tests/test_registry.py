"""What extensions add to the core: names at `mbd.`, entries of registries, and what is said where an extension is missing."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

import torchmbd as mbd
from tests.refused import ANY, refused
from torchmbd import registry
from torchmbd.design import COMBINATORS, OF_DESIGN, RESPONSES
from torchmbd.design.response_spec import measure_of
from torchmbd.integrate.backend import BACKENDS
from torchmbd.math.products import PRODUCTS
from torchmbd.study.file.kind import Kind
from torchmbd.study.file.load import KINDS

FOLDER = Path(mbd.__file__ or "").parent / "extensions"


@pytest.fixture
def tables(monkeypatch):
    """Function that puts other tables, or None for no folder, in the place of those of torchmbd/extensions."""
    registry._tables()
    return lambda result: monkeypatch.setattr(registry, "_tables", lambda: result)


@pytest.mark.extensions  # the folder is there, an extension is not
def test_a_name_of_a_missing_extension_tells_which(tables):
    tables(
        SimpleNamespace(
            NAMES={"robots_of_others": "read_robot"},
            NEEDS={},
            ENTRIES={"responses": {}, "combinators": {}, "of_design": {"wear": "robots_of_others:Wear"}},
        )
    )
    with pytest.raises(AttributeError, match=r"mbd\.read_robot: the extension robots_of_others is not installed"):
        mbd.read_robot  # noqa: B018
    assert "read_robot" not in mbd.__all__
    assert "wear" not in registry.Registry("of_design", {"mass": mbd.Mass})
    with refused("wear"):
        measure_of({"wear": {"body": "pin"}})


def test_without_the_folder_the_core_is_complete(tables):
    tables(None)
    assert "simulate" in mbd.__all__
    assert list(registry.Registry("of_design", {"mass": mbd.Mass})) == ["mass"]
    with pytest.raises(AttributeError, match=r"no attribute 'read_robot'; torchmbd\.extensions is not installed"):
        mbd.read_robot  # noqa: B018
    with refused("wear"):
        measure_of({"wear": {"body": "pin"}})


def test_frequencies_of_an_equilibrium_tell_what_is_not_installed(tables, monkeypatch):
    tables(None)
    # The module, whose function has the same name.
    equilibrium = importlib.import_module("torchmbd.simulation.equilibrium")
    monkeypatch.setattr(equilibrium, "OF_EQUILIBRIUM", registry.Registry("of_equilibrium", {}))
    rest = mbd.equilibrium(mbd.examples.pendulum(length=2.0))
    assert rest.stable
    with refused("eigenvalues", ANY, "torchmbd.extensions is not installed"):
        rest.frequencies  # noqa: B018


@pytest.mark.extensions
def test_extensions_need_those_that_they_import(tables):
    from torchmbd import extensions

    needs = {}
    for name in {name.partition(".")[0] for name in extensions.NAMES}:
        files = [FOLDER / f"{name}.py"] if (FOLDER / f"{name}.py").exists() else (FOLDER / name).rglob("*.py")
        text = "".join(file.read_text() for file in files)
        needs[name] = sorted({*re.findall(rf"from {registry.EXTENSIONS}\.(\w+)", text)} - {name})
    assert {name: tuple(x) for name, x in needs.items() if x} == extensions.NEEDS


@pytest.mark.extensions
def test_an_extension_is_not_there_without_those_that_it_needs(tables):
    absent = SimpleNamespace(
        NAMES={"lamination": "lamination.LaminationRegion"},
        NEEDS={"lamination": ("fibers_of_others",)},
        ENTRIES={"of_design": {"lamination_region": "lamination:LaminationRegion"}},
    )
    tables(absent)
    text = "the extension lamination needs the extension fibers_of_others, which is not installed"
    with pytest.raises(AttributeError, match=rf"mbd\.lamination: {text}"):
        mbd.lamination.LaminationRegion  # noqa: B018
    entries = registry.Registry("of_design", {})
    assert (*entries,) == ()
    assert entries.missing("lamination_region") == text


@pytest.mark.extensions
def test_what_is_only_asked_for_is_not_imported(tables):
    tables(SimpleNamespace(NEEDS={}, ENTRIES={"of_design": {"wear": "matrices:Wear"}}))  # a file that has no such class
    entries = registry.Registry("of_design", {"mass": mbd.Mass})
    assert "wear" in entries
    assert entries.name_of(mbd.Mass) == "mass"
    assert entries.name_of(mbd.Position) is None


def test_a_registry_is_a_mapping():
    result = registry.Registry("responses", {"energy": mbd.StrainEnergy})
    result["place"] = mbd.Position
    assert dict(result) == {
        "energy": mbd.StrainEnergy,
        "place": mbd.Position,
        **dict(registry.Registry("responses", {})),
    }
    del result["place"]
    assert "place" not in result
    with pytest.raises(KeyError):
        result["place"]


@pytest.mark.extensions
def test_every_entry_leads_to_a_class():
    for result in (RESPONSES, COMBINATORS, OF_DESIGN, BACKENDS):
        assert all(isinstance(kind, type) for kind in result.values())
    assert all(callable(products) for products in PRODUCTS.values())
    assert all(isinstance(kind, Kind) for kind in KINDS.values())


@pytest.mark.extensions
def test_the_tables_name_every_extension_and_type_checkers_know_the_names():
    from torchmbd import extensions

    present = {path.stem for path in FOLDER.iterdir() if path.stem[:2] != "__"}
    assert present == {name.partition(".")[0] for name in extensions.NAMES}
    modules = {name: importlib.import_module(f"{registry.EXTENSIONS}.{name}") for name in extensions.NAMES}
    listed = {name: [x.rpartition(".")[2] for x in names.split()] for name, names in extensions.NAMES.items()}
    assert {name: sorted(result.__all__) for name, result in modules.items()} == {
        k: sorted(x) for k, x in listed.items()
    }
    text = (FOLDER / "__init__.py").read_text()
    assert re.findall(rf"from {registry.EXTENSIONS} import (\w+) as \1", text) == registry.rooms()
    starred = re.findall(rf"from {registry.EXTENSIONS}\.(\w+) import \*", text)
    assert starred == [name for name, names in extensions.NAMES.items() if any("." not in x for x in names.split())]
    readers = re.findall(rf"from {registry.EXTENSIONS}\.\w+ import (\w+) as \1", (FOLDER.parent / "io.py").read_text())
    assert sorted(f"io.{name}" for name in readers) == sorted(x for x in registry.public_names() if x.startswith("io."))


@pytest.mark.extensions
def test_a_room_has_the_names_of_its_extension_and_tells_what_is_missing(tables):
    assert mbd.vibrations.campbell is importlib.import_module(f"{registry.EXTENSIONS}.vibrations").campbell
    assert {"read_bdf", "write_model"} <= set(dir(mbd.io))
    tables(
        SimpleNamespace(
            NAMES={"wear_of_others": "wear_of_others.Wear io.read_wear", "matrices": "io.read_matrix"},
            NEEDS={},
            ENTRIES={},
        )
    )
    assert registry.rooms() == []
    for name, call in {"wear_of_others": lambda: mbd.wear_of_others, "io.read_wear": lambda: mbd.io.read_wear}.items():  # pyright: ignore[reportAttributeAccessIssue]
        with pytest.raises(AttributeError, match=rf"mbd\.{name}: the extension wear_of_others is not installed"):
            call()
