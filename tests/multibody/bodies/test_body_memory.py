"""A body that does not fit into memory is refused before its matrices are made, with the number of freedoms that fits."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import torchmbd as mbd
from tests.extensions.nastran.bdf_models import model
from tests.refused import refused
from torchmbd.multibody.bodies import body_memory, flexible

LAMINATE = mbd.Laminate(mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3)
WORDS = r"mesh of 'shell' has 492 freedoms: their modes take about \S+ MB of memory, 4 MB are available; allowed: up to (\d+)"


def shell(cells: int, curved: bool = True) -> mbd.FlexibleBody:
    flat = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(cells, 1))
    x = flat.nodes.clone()
    x[:, 2] = x[:, 0] ** 3 if curved else 0.0
    mesh = mbd.Mesh(x, quads=flat.quads, node_sets=flat.node_sets)
    return mbd.FlexibleBody.plate("shell", mesh, LAMINATE, modes=2, reference="left_edge")


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


def test_nothing_is_made_of_a_body_that_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flexible, "Assembly", None)
    with refused("shell.mesh"):
        shell(40)


@pytest.mark.extensions
def test_a_deck_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    deck = tmp_path / "plate.bdf"
    deck.write_text(model(cells=(40, 2)))
    with refused("wing.mesh") as caught:
        mbd.read_bdf(deck, "wing", modes=4)
    assert "738 freedoms" in str(caught.value)
