"""Bodies as models of other programs: a Nastran file read again is the body, an .inp has its mesh, stacks and frequencies."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused
from torchmbd.fem.elements import Plates

STRENGTH = mbd.Strength(1.5e9, 1.2e9, 4e7, 2.4e8, 6.8e7, interaction=-0.3)
PLY = mbd.Ply(128e9, 10.1e9, 5.36e9, 4.9e9, 3.6e9, 0.23, 1586.0, STRENGTH, alpha1=-0.3e-6, alpha2=28e-6)
STEEL = mbd.Ply.isotropic(210e9, 0.3, 7850.0)


def plate(cells=(6, 2), kind="quad", mesh: Any = None) -> Any:
    """Two zones: an unbalanced offset stack, and a symmetric one of two materials; the laminate's axis is oblique."""
    mesh = mesh or mbd.mesh.rectangle(0.3, 0.1, cells, kind)
    half = mesh.cell_count // 2
    first = mbd.Laminate(PLY, mbd.deg([20, -50, 75]), [1e-3, 2e-3, 1.5e-3], offset=0.4e-3)
    second = mbd.Laminate([PLY, STEEL], mbd.deg([30, 0]), [1e-3, 0.5e-3], symmetric=True)
    parts = {
        "first": Plates(mesh, first, (1.0, 0.3, 0.0), range(half)),
        "second": Plates(mesh, second, (1.0, 0.3, 0.0), range(half, mesh.cell_count)),
    }
    return mbd.FlexibleBody("plate", mesh, parts, 4, reference=mesh.node_sets.get("left_edge", [0, 1]))


def bent(kind: str) -> mbd.Mesh:
    """The rectangle rolled to a part of a tube, so that every cell lies otherwise."""
    flat = mbd.mesh.rectangle(0.3, 0.1, (4, 2), kind)
    x, y, _ = flat.nodes.unbind(1)
    nodes = torch.stack([0.2 * torch.sin(5.0 * x), y, 0.2 * torch.cos(5.0 * x)], 1)
    return mbd.Mesh(nodes, flat.triangles, {"left_edge": flat.node_set("left_edge")}, quads=flat.quads)


def squares(body: Any) -> torch.Tensor:
    return torch.linalg.eigvalsh(body.structure()["Kr"].detach())


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "units"), [("quad", "in"), ("triangle", "mm")])
def test_a_nastran_file_read_again_is_the_body(kind, units, tmp_path):
    """Mass, center and frequencies agree to 1e-9, flat and curved, in other units; strengths and angles are there."""
    for mesh in (None, bent(kind)):
        body = plate(kind=kind, mesh=mesh)
        again: Any = mbd.io.read_bdf(
            mbd.io.write_model(body, tmp_path / "plate.bdf", units=units), "plate", 4, units=units
        )
        first, second = body.structure(), again.structure()
        for name in ("mass", "S0"):
            assert_close(first[name], second[name], rtol=1e-9, atol=1e-12)
        assert_close(squares(body), squares(again), rtol=1e-9, atol=0)
        assert sorted(again.reference) == sorted(body.reference)
        assert_close(again.pcomp_1.angles, mbd.deg([20, -50, 75]), rtol=1e-12, atol=0)
        ply = again.pcomp_1.layer_plies[0]
        assert (ply.alpha1, ply.alpha2) == pytest.approx((PLY.alpha1, PLY.alpha2), rel=1e-12)
        strength = ply.strength
        assert (strength.Yc, strength.interaction) == pytest.approx((STRENGTH.Yc, STRENGTH.interaction), rel=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_an_input_file_of_linear_elements_is_read_by_read_mesh(kind, tmp_path):
    """Nodes, cells and zones are those of the body, which makes the same modes of them."""
    body = plate(kind=kind)
    path = mbd.io.write_model(body, tmp_path / "plate.inp", elements="linear", units="mm")
    laminates = {"FIRST_1": body.first, "SECOND_2": body.second}
    again = mbd.io.read_mesh(path, "plate", laminates, 4, scale="mm", direction=(1.0, 0.3, 0.0), reference="REFERENCE")
    assert_close(squares(body), squares(again), rtol=1e-9, atol=0)


def test_an_input_file_of_quadratic_elements(tmp_path):
    """A middle node for each side, sections with all layers from the bottom, and orientations along the fibers."""
    body = plate((2, 1))
    text = mbd.io.write_model(body, tmp_path / "plate.inp", modes=3).read_text()
    nodes = [
        line for line in text[text.index("*NODE, NSET") : text.index("*ELEMENT")].splitlines() if line[0].isdigit()
    ]
    assert len(nodes) == 6 + 7
    cells = re.findall(r"TYPE=S8R, ELSET=(\S+)\n(.*)", text)
    assert [name for name, _ in cells] == ["FIRST_1", "SECOND_2"]
    places = {int(line.split(",")[0]): np.array(line.split(",")[1:], float) for line in nodes}
    for _, line in cells:
        numbers = [int(x) for x in line.split(",")][1:]
        for k in range(4):
            middle = (places[numbers[k]] + places[numbers[(k + 1) % 4]]) / 2.0
            assert_close(places[numbers[4 + k]], middle)
    sections = re.findall(r"\*SHELL SECTION, COMPOSITE, ELSET=(\S+?)(?:, OFFSET=(\S+))?\n((?:\d.*\n)+)", text)
    assert [float(offset or 0.0) for _, offset, _ in sections] == pytest.approx([-0.4 / 4.5, 0.0])
    layers = [[row.split(", ") for row in rows.splitlines()] for _, _, rows in sections]
    assert [float(row[0]) for row in layers[0]] == [1e-3, 2e-3, 1.5e-3]
    assert [row[2] for row in layers[1]] == ["PLY_1", "PLY_2", "PLY_2", "PLY_1"]
    axes = dict(re.findall(r"\*ORIENTATION, NAME=(\S+), SYSTEM=RECTANGULAR\n(.*)", text))
    along = np.array(axes[layers[0][1][3]].split(", "), float)
    turn = np.arctan2(0.3, 1.0) + np.deg2rad(-50.0)
    assert_close(along, np.array([np.cos(turn), np.sin(turn), 0.0, -np.sin(turn), np.cos(turn), 0.0]))


def test_numbers_of_an_input_file_have_twenty_columns(tmp_path):
    """CalculiX and Abaqus read no more of them. The nodes of the plate are its top face: OFFSET = 0.5 of both."""
    thickness = [1e-3, 2e-3 / 3, 1e-3]
    laminate = mbd.Laminate(PLY, mbd.deg([0, 90, 180]), thickness, offset=-sum(thickness) / 2)
    mesh = mbd.mesh.rectangle(0.3, 0.1, (3, 1), "quad")
    body = mbd.FlexibleBody.plate("plate", mesh, laminate, 2, reference="left_edge")
    text = mbd.io.write_model(body, tmp_path / "plate.inp", units="in").read_text()
    assert max(map(len, re.findall(r"[-+.\deE]*\.[-+.\deE]*", text))) <= 20
    axes = re.findall(r"\*ORIENTATION, .*\n(.*)", text)[1].split(", ")
    assert_close(np.array([x[:20] for x in axes], float), np.array([0.0, 1, 0, -1, 0, 0]), rtol=0, atol=1e-15)
    assert float(re.findall(r"OFFSET=(\S+)", text)[0]) == pytest.approx(0.5)


@pytest.mark.thorough
@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX is not installed")
@pytest.mark.parametrize(("angles", "offset"), [([20, -50, 75], 0.0), ([20, -50, 75], 1e-3), ([0, 90, 0], 0.0)])
def test_calculix_has_the_frequencies(angles, offset, tmp_path):
    """A clamped plate: the first three within one percent."""
    laminate = mbd.Laminate(PLY, mbd.deg(angles), [1e-3, 2e-3, 1.5e-3], offset=offset)
    mesh = mbd.mesh.rectangle(0.3, 0.1, (40, 12), "quad")
    body = mbd.FlexibleBody.plate("plate", mesh, laminate, 3, reference="left_edge")
    mbd.io.write_model(body, tmp_path / "plate.inp", modes=3)
    subprocess.run(["ccx", "plate"], cwd=tmp_path, check=True, capture_output=True)
    rows = re.findall(r"^\s+\d+\s+\S+\s+\S+\s+(\S+)\s+\S+\s*$", Path(tmp_path / "plate.dat").read_text(), re.MULTILINE)
    frequencies = squares(body).sqrt() / (2 * torch.pi)
    assert_close(torch.tensor([float(x) for x in rows[:3]], dtype=torch.float64), frequencies, rtol=1e-2, atol=0)


def test_bad_input_is_refused(tmp_path):
    """Endings, units, elements, numbers, bodies of other parts, and a body that must be named."""
    body, path = plate((2, 1)), tmp_path / "plate.inp"
    for arguments, argument in (
        ({"path": tmp_path / "plate.stp"}, "path"),
        ({"units": "km"}, "units"),
        ({"elements": "cubic"}, "elements"),
        ({"modes": 0}, "modes"),
        ({"body": "plat"}, "body"),
    ):
        options: dict[str, Any] = {"design": body, "path": path} | arguments
        with refused(argument):
            mbd.io.write_model(**options)
    other = mbd.FlexibleBody.plate("other", body.mesh, body.first, 2)
    with refused("body"):
        mbd.io.write_model(mbd.System([body, other], free=["plate", "other"]), path)
    rigid = mbd.FlexibleBody.plate("rigid", body.mesh, body.first, 2, rigid=["right_edge"])
    with refused("rigid"):
        mbd.io.write_model(rigid, path)
    line = mbd.BeamLine.straight(1.0, 2)
    beam = mbd.FlexibleBody.beam("beam", line, mbd.sections.tube(0.02, PLY, [0.0], thickness=1e-3, cells=(8, 1)), 2)
    with refused("beam"):
        mbd.io.write_model(beam, path)
