"""A body that does not fit into memory is refused before its matrices are made, with the number of freedoms that fits."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import torchmbd as mbd
from tests.extensions.nastran.bdf_models import model
from tests.refused import refused
from torchmbd.multibody.bodies import body_memory, flexible

LAMINATE = mbd.Laminate(mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3)
WORDS = (
    r"mesh of 'shell' has 492 degrees of freedom, whose modes take about \S+ MB of memory, of which 4 MB are "
    r"available: must have at most (\d+) degrees of freedom"
)


def shell(cells: int, curved: bool = True, modes: int = 2, **more: Any) -> mbd.FlexibleBody:
    flat = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(cells, 1))
    x = flat.nodes.clone()
    x[:, 2] = x[:, 0] ** 3 if curved else 0.0
    mesh = mbd.Mesh(x, quads=flat.quads, node_sets=flat.node_sets)
    return mbd.FlexibleBody.plate("shell", mesh, LAMINATE, modes=modes, reference="left_edge", **more)


@pytest.fixture(autouse=True)
def _four_megabytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_memory, "available_memory", lambda: 4e6)


def test_a_body_with_the_freedoms_that_fit_is_made() -> None:
    with refused("shell.mesh") as caught:
        shell(40)
    text = re.search(WORDS, str(caught.value))
    assert text
    cells = int(text[1]) // 12 - 1
    shell(cells)
    with refused("shell.mesh"):
        shell(cells + 8)


def test_cells_of_equal_shape_share_their_matrices() -> None:
    shell(40, curved=False)


def test_modes_that_are_too_many_are_refused_by_their_number() -> None:
    """Also where the mesh does not have them."""
    with refused("shell.modes", 100) as caught:
        shell(40, False, modes=100)
    text = re.search(r"must be at most (\d+)", str(caught.value))
    assert text
    shell(40, False, modes=int(text[1]))
    for modes in (10**9, 60):
        with refused("shell.modes", modes):
            shell(2, False, modes=modes)


def test_shapes_of_an_interface_count() -> None:
    options = {"reduction": "craig-bampton", "curved": False}
    with refused("shell.interface") as caught:
        shell(40, interface=list(range(2, 40)), **options)
    text = re.search(r"has 38 nodes, whose shapes take .*: must have at most (\d+)$", str(caught.value))
    assert text
    shell(40, interface=list(range(2, 2 + int(text[1]))), **options)
    with refused("shell.modes", 30):
        shell(40, modes=30, interface=[2], **options)


def test_nothing_is_made_of_a_body_that_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flexible, "Assembly", None)
    with refused("shell.mesh"):
        shell(40)


@pytest.mark.extensions
def test_a_deck_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    deck = tmp_path / "plate.bdf"
    deck.write_text(model(cells=(40, 2)))
    with refused("wing.mesh") as caught:
        mbd.io.read_bdf(deck, "wing", modes=4)
    assert "738 degrees of freedom" in str(caught.value)
