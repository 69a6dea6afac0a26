"""Rods, springs, bushings and solids of a model, in closed form; cards of no structure are listed once."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import ANY, refused
from torchmbd.extensions.nastran.body import bulk_body
from torchmbd.extensions.nastran.cards import read_cards
from torchmbd.fem.elements import Assembly

GRIDS = ["GRID,1,,0.,0.,0.", "GRID,2,,3.,4.,0.", "GRID,3,,0.,0.,0."]
STEEL = "MAT1,1,2.+11,,.25,8000."


@pytest.fixture
def stiffness(tmp_path):
    """K of all freedoms and masses of a model."""

    def made(*lines: str, units: str = "m"):
        path = tmp_path / "model.bdf"
        path.write_text("\n".join(["BEGIN BULK", *lines, "ENDDATA"]))
        result = bulk_body(path, units)
        full = sum(part.pattern.to_scipy(part.values()).toarray() for part in result.parts.values())
        return np.asarray(full), float(Assembly(result.mesh, result.parts).masses().mass.sum())

    return made


@pytest.mark.parametrize("card", [["CROD,7,5,1,2", "PROD,5,1,2.-4,3.-8"], ["CONROD,7,1,2,1,2.-4,3.-8"]])
def test_a_rod(stiffness, card):
    K, mass = stiffness(*GRIDS[:2], *card, STEEL)
    e = np.array([0.6, 0.8, 0.0])
    stretch, twist = np.zeros(12), np.zeros(12)
    stretch[6:9], twist[9:12] = e, e
    assert stretch @ K @ stretch == pytest.approx(2e11 * 2e-4 / 5.0)
    assert twist @ K @ twist == pytest.approx(8e10 * 3e-8 / 5.0)
    assert np.linalg.matrix_rank(K) == 2
    assert mass == pytest.approx(8000.0 * 2e-4 * 5.0)
    mm, _ = stiffness(
        "GRID,1,,0.,0.,0.",
        "GRID,2,,3000.,4000.,0.",
        "CROD,7,5,1,2",
        "PROD,5,1,200.,3.+4",
        "MAT1,1,2.+5,,.25,8.-9",
        units="mm",
    )
    np.testing.assert_allclose(mm, K, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("card", [["CELAS2,7,500.,1,1,2,5"], ["CELAS1,7,5,1,1,2,5", "PELAS,5,500.,,,9,1."]])
def test_a_spring_between_two_components(stiffness, card):
    """Component 1 of grid 1 in its own system, turned by 90 degrees about z, and component 5 of grid 2."""
    turned = ["CORD2R,4,0,0.,0.,0.,0.,0.,1.", ",0.,1.,0.", "GRID,1,,0.,0.,0.,4", GRIDS[1]]
    K, _ = stiffness(*turned, *card)
    g = np.zeros(12)
    g[1], g[10] = 1.0, -1.0
    np.testing.assert_allclose(K, 500.0 * np.outer(g, g), atol=1e-12)


def test_a_bushing_in_its_system_and_between_two_grids(stiffness):
    bush = "PBUSH,5,K,1.,2.,3.,4.,5.,6."
    K, _ = stiffness(*GRIDS[::2], "CBUSH,7,5,1,3,,,,0", bush)
    want = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    np.testing.assert_allclose(K, np.block([[want, -want], [-want, want]]), atol=1e-12)
    K, _ = stiffness(*GRIDS[:2], "CBUSH,7,5,1,2,0.,0.,1.", bush)
    assert np.linalg.matrix_rank(K) == 6
    along = np.r_[np.zeros(6), 0.6, 0.8, 0.0, np.zeros(3)]
    assert along @ K @ along == pytest.approx(1.0)
    assert np.r_[np.zeros(8), 1.0, np.zeros(3)] @ K @ np.r_[np.zeros(8), 1.0, np.zeros(3)] == pytest.approx(2.0)
    x = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    spin = np.array([0.3, -0.2, 0.5])
    rigid = np.concatenate([np.r_[np.cross(spin, p), spin] for p in x])
    np.testing.assert_allclose(K @ rigid, 0.0, atol=1e-12)


def brick_model(card: str, material: str = "MAT1,1,70.+9,,.3,2700.") -> list[str]:
    """A bar of 1 x 0.1 x 0.1 m, 10 x 1 x 1 cells, its left end held by SPC1 123."""
    lines, number = [f"PSOLID,5,1{',0' if card else ''}", material], 1

    def grid(i, j, k):
        return 1 + 4 * i + 2 * j + k

    for i in range(11):
        lines += [f"GRID,{grid(i, j, k)},,{0.1 * i!r},{0.1 * j!r},{0.1 * k!r}" for j in (0, 1) for k in (0, 1)]
    cuts = {
        "CHEXA": [(0, 1, 2, 3, 4, 5, 6, 7)],
        "CPENTA": [(0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)],
        "CTETRA": [(0, 1, 3, 4), (1, 2, 3, 6), (1, 3, 4, 6), (1, 4, 5, 6), (3, 4, 6, 7)],
    }
    for i in range(10):
        corner = [grid(i, 0, 0), grid(i + 1, 0, 0), grid(i + 1, 1, 0), grid(i, 1, 0)]
        corner += [grid(i, 0, 1), grid(i + 1, 0, 1), grid(i + 1, 1, 1), grid(i, 1, 1)]
        for own in cuts[card]:
            named = [str(corner[k]) for k in own]
            lines.append(
                f"{card},{number},5,{','.join(named[:6])}" + (f"\n,{','.join(named[6:])}" if named[6:] else "")
            )
            number += 1
    return [*lines, "SPC1,1,123,1,2,3,4"]


@pytest.mark.parametrize(("card", "stiff"), [("CHEXA", 1.02), ("CPENTA", 2.5), ("CTETRA", 3.0)])
def test_a_bar_of_solids(card, stiff, tmp_path):
    """First bending frequency of a clamped bar: bricks near Euler-Bernoulli, linear wedges and tetrahedra stiffer."""
    path = tmp_path / "model.bdf"
    path.write_text("\n".join(["BEGIN BULK", *brick_model(card), "ENDDATA"]))
    body = mbd.io.read_bdf(path, "bar", modes=4)
    result = body.structure()
    assert float(result["mass"]) == pytest.approx(27.0)
    first = math.sqrt(float(torch.linalg.eigvalsh(result["Kr"])[0]))
    beam = 1.8751**2 * math.sqrt(70e9 * 0.1**4 / 12 / (2700.0 * 0.01))
    assert 0.96 < first / beam < stiff
    bend = result["psi"][-1]
    axis = bend[1:3, 0].abs().argmax() + 1
    slope = bend[5, 0] if axis == 1 else -bend[4, 0]
    assert float(slope / bend[axis, 0]) == pytest.approx(1.3765, rel=0.1)  # rotation of the end of a clamped beam


def test_an_anisotropic_solid_is_the_isotropic_one(stiffness):
    """MAT9 of an isotropic material, in a system that is turned: the same stiffness."""
    lame, G = 70e9 * 0.3 / (1.3 * 0.4), 70e9 / 2.6
    D = np.zeros((6, 6))
    D[:3, :3] = lame
    D[range(6), range(6)] += [2 * G] * 3 + [G] * 3
    fields = [f"{x:.16E}".replace("E", "D") for x in D[np.triu_indices(6)]] + ["2700."]
    rows = [["MAT9", "1", *fields[:7]], *[["", *fields[k : k + 8]] for k in range(7, 22, 8)]]
    text = "\n".join(",".join(row) for row in rows)
    one, mass = stiffness(*brick_model("CHEXA"))
    lines = [x.replace("PSOLID,5,1,0", "PSOLID,5,1,3") for x in brick_model("CHEXA", text)]
    two, other = stiffness("CORD2R,3,0,0.,0.,0.,1.,2.,3.", ",1.,0.,0.", *lines)
    np.testing.assert_allclose(two, one, rtol=1e-9, atol=1e-5 * abs(one).max())
    assert other == pytest.approx(mass)


@pytest.mark.parametrize(
    ("lines", "fault"),
    [
        (["CROD,7,9,1,2", STEEL], ("CROD 7 (model.bdf, line 6).PID", ANY, "PROD 9")),
        (["CROD,7,5,1,3", "PROD,5,1,1.-4", STEEL], ("CROD 7 (model.bdf, line 6).A",)),
        (["CELAS2,7,5.,1,9,2,1"], ("CELAS2 7 (model.bdf, line 6).C",)),
        (["CBUSH,7,5,1,3", "PBUSH,5,K,1."], ("CBUSH 7 (model.bdf, line 6).CID",)),
        (["CBUSH,7,5,1,2", "PBUSH,5,K,1.,2."], ("CBUSH 7 (model.bdf, line 6).X",)),
        (["CTETRA,7,5,1,2,3,1"], ("CTETRA 7 (model.bdf, line 6).G", ANY, "4 different")),
        (["CTETRA,7,5,1,2,3,4,1,2"], ("CTETRA 7 (model.bdf, line 6).G", ANY, "4 corners", "6 nodes")),
        (["RBAR,7,1,2,123,456"], ("RBAR 7 (model.bdf, line 6).CNA",)),
        (["CROD,7,5,1,2", "PROD,5,1,1.-4", "MAT8,1,1.,1.,.3,1."], ("MAT8 1 (model.bdf, line 8)",)),
    ],
)
def test_what_is_wrong_is_named(stiffness, lines, fault):
    with refused(*fault):
        stiffness(*GRIDS, "GRID,4,,0.,0.,7.", *lines)


def test_masses_on_arms_and_defaults_of_grids(stiffness, tmp_path):
    """A CONM2 with an offset in a turned system; GRDSET gives the system of the grids."""
    system = ["CORD2R,4,0,1.,0.,0.,1.,0.,1.", ",1.,1.,0."]  # origin at x = 1, x axis along y
    lines = [
        "GRDSET,,4",
        *system,
        "GRID,1,,0.,0.,0.",
        "GRID,2,,2.,0.,0.",
        "CONROD,7,1,2,1,1.-4,1.-8",
        STEEL,
        "CONM2,9,1,4,5.,.5",
    ]
    (tmp_path / "model.bdf").write_text("\n".join(["BEGIN BULK", *lines, "ENDDATA"]))
    result = bulk_body(tmp_path / "model.bdf")
    np.testing.assert_allclose(result.mesh.nodes.numpy(), [[1.0, 0.0, 0.0], [1.0, 2.0, 0.0]], atol=1e-15)
    points = result.parts["conm2"].masses()
    assert points.arm is not None
    np.testing.assert_allclose(points.arm.numpy(), [[0.0, 0.5, 0.0]], atol=1e-15)


def test_cards_of_no_structure_are_listed_once(stiffness):
    aero = ["CAERO1,1,1,,4", "SPLINE1,1,1", "AELIST,5,1", "GRID,99,,9.,9.,9.", "PAERO1,1", "CAERO1,2,1,,4"]
    words = r"left out: AELIST \(1\), CAERO1 \(2\), GRID of no element \(1\), PAERO1 \(1\), SPLINE1 \(1\)"
    with pytest.warns(UserWarning, match=words) as caught:
        stiffness(*GRIDS[:2], "CELAS2,7,500.,1,1,2,1", *aero)
    assert len(caught) == 1


def test_includes_stay_in_their_folder(tmp_path):
    inner = tmp_path / "model" / "parts"
    inner.mkdir(parents=True)
    (tmp_path / "outside.bdf").write_text("GRID,1,,0.,0.,0.\n")
    (inner / "grids.bdf").write_text("INCLUDE 'more.bdf'\nGRID,1,,0.,0.,0.\n")
    (inner / "more.bdf").write_text("GRID,2,,0.,0.,0.\n")
    main = tmp_path / "model" / "main.bdf"
    main.write_text("BEGIN BULK\nINCLUDE 'parts/\n  grids.bdf'\nINCLUDE parts\\more.bdf\nENDDATA\n")
    assert [card.text(1) for card in read_cards(main)] == ["2", "1", "2"]
    main.write_text("INCLUDE '../outside.bdf'\n")
    with refused("main.bdf, line 1.INCLUDE", ANY, "outside"):
        read_cards(main)
    (inner / "link.bdf").symlink_to(tmp_path / "outside.bdf")
    main.write_text("INCLUDE 'parts/link.bdf'\n")
    with refused("main.bdf, line 1.INCLUDE", ANY, "outside"):
        read_cards(main)
    main.write_text("INCLUDE 'parts/grids.bdf\n")
    with refused("main.bdf, line 1.INCLUDE", ANY, "quote"):
        read_cards(main)


def test_a_tube_is_a_rod_of_its_area(stiffness):
    """A CTUBE of OD 20 mm and T 2 mm against a CROD with its numbers."""
    A, J = math.pi * (0.01**2 - 0.008**2), math.pi / 2 * (0.01**4 - 0.008**4)
    material = "MAT1,1,7.+10,,.3,2700."
    tube, mass = stiffness(*GRIDS[:2], material, "CTUBE,7,9,1,2", "PTUBE,9,1,.02,.002")
    rod, same = stiffness(*GRIDS[:2], material, "CROD,7,9,1,2", f"PROD,9,1,{A!r},{J!r}")
    assert tube == pytest.approx(rod, rel=1e-12)
    assert mass == pytest.approx(same)
    with refused("PTUBE 9 (model.bdf, line 6).OD", ANY, ".02"):
        stiffness(*GRIDS[:2], material, "CTUBE,7,9,1,2", "PTUBE,9,1,.02,.02")


@pytest.mark.thorough
def test_hostile_files_are_refused(tmp_path):
    """Trees of includes and lines without end: an InputError, not memory."""
    for k in range(40):
        (tmp_path / f"f{k}.bdf").write_text(f"INCLUDE 'f{k + 1}.bdf'\n" * 2)
    (tmp_path / "f40.bdf").write_text("")
    with refused("f40.bdf.INCLUDE", ANY, "1000"):
        read_cards(tmp_path / "f0.bdf")
    path = tmp_path / "long.bdf"
    path.write_text("GRID" + " " * 20_000)
    with refused("long.bdf, line 1", ANY, "10000"):
        read_cards(path)
    path.write_text("GRID,1,,1e999,0.,0.\n")
    with refused("GRID 1 (long.bdf, line 1).X1", "1e999"):
        bulk_body(path)
