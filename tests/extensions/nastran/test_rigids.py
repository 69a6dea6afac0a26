"""RBE2 of single components, RBE3 and MPC: beams on joints in closed form; contradicting cards are named."""

from __future__ import annotations

import math

import pytest
import torch

import torchmbd as mbd
from tests.refused import ANY, refused
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.body import bulk_body

E, A, INERTIA, RHO, LENGTH, CELLS = 2e11, 1e-4, 1e-9, 8000.0, 1.0, 16
BEAM = ["MAT1,1,2.+11,,.25,8000.", "PBAR,5,1,1.-4,1.-9,2.-9,2.-9"]


def beam(first: int, y: float = 0.0) -> list[str]:
    """A bar of 1 m along x; its grids count from `first` on. Planes x-y (I1) and x-z (I2)."""
    lines = [f"GRID,{first + k},,{LENGTH * k / CELLS},{y},0." for k in range(CELLS + 1)]
    return lines + [f"CBAR,{first + k},5,{first + k},{first + k + 1},0.,1.,0." for k in range(CELLS)]


@pytest.fixture
def frequencies(tmp_path):
    """The lowest circular frequencies of a model [rad/s]."""

    def made(*lines: str, modes: int = 2) -> list[float]:
        path = tmp_path / "model.bdf"
        path.write_text("\n".join(["BEGIN BULK", *BEAM, *lines, "ENDDATA"]))
        body = mbd.io.read_bdf(path, "body", modes)
        return torch.linalg.eigvalsh(body.structure()["Kr"].detach()).sqrt().tolist()

    return made


def bending(root: float, inertia: float = INERTIA) -> float:
    return root**2 / LENGTH**2 * math.sqrt(E * inertia / (RHO * A))


@pytest.mark.parametrize("leader", ["0.,0.,0.", "-.2,.1,.3"])
def test_ball_joints_hold_a_beam(leader, frequencies):
    """CM 123 at one end, 1234 at the other: a beam on two supports, pi^2 sqrt(E I / rho A) / l^2, in both planes."""
    lines = [f"GRID,90,,{leader}", "GRID,91,,1.,.2,0.", "SPC1,1,123456,90,91"]
    result = frequencies(*beam(1), *lines, "RBE2,50,90,123,1", f"RBE2,51,91,1234,{CELLS + 1}")
    assert result == pytest.approx([bending(math.pi), bending(math.pi, 2 * INERTIA)], rel=2e-3)


def test_a_clamp_that_slides(frequencies):
    """CM 1456 at the far end of a clamped beam: both deflections are free, no end turns, (2.36502 / l)^2."""
    lines = ["GRID,91,,1.,.2,0.", "SPC1,1,123456,1,91", f"RBE2,51,91,1456,{CELLS + 1}"]
    result = frequencies(*beam(1), *lines)
    assert result == pytest.approx([bending(2.36502), bending(2.36502, 2 * INERTIA)], rel=2e-3)


def test_a_system_of_displacements_permutes_components(frequencies):
    """Axes 1 2 3 of the grid are z x y: its 1 and 2 hold z and x. In a system that is turned by 30 degrees they are refused."""
    lines = ["GRID,91,,1.,.2,0.", "SPC1,1,123456,1,91", f"RBE2,51,91,12,{CELLS + 1}", "CORD2R,4,0,0.,0.,0.,0.,1.,0."]
    own = [line + ",4" if line.startswith(f"GRID,{CELLS + 1},") else line for line in beam(1)]
    result = frequencies(*own, *lines, ",0.,0.,1.")[:2]  # bodies keep whole clusters
    assert result == pytest.approx([bending(1.87510), bending(3.92660, 2 * INERTIA)], rel=2e-3)
    with refused("RBE2 51 (model.bdf, line 39).CM", ANY, "12 of GRID 17"):
        frequencies(*own, *lines, ",.5,0.,.8")


@pytest.mark.parametrize(("first", "second"), [(1.0, -1.0), (-2.5, -5.0)])
def test_an_mpc_ties_two_tips_in_one_direction(first, second, tmp_path):
    """Equal cantilevers: in z, either both tips move in the ratio of the factors, free, or both stand still, supported."""
    path = tmp_path / "model.bdf"
    tie = f"MPC,9,17,3,{first},117,3,{second}"
    path.write_text("\n".join(["BEGIN BULK", *BEAM, *beam(1), *beam(101, 0.5), "SPC1,1,123456,1,101", tie, "ENDDATA"]))
    body = mbd.io.read_bdf(path, "body", 4)
    made = body.structure()
    result, modes = torch.linalg.eigh(made["Kr"].detach())
    free = bending(1.87510)  # in y, each for itself
    expected = [free, free, bending(1.87510, 2 * INERTIA), bending(3.92660, 2 * INERTIA)]
    assert result[:4].sqrt().tolist() == pytest.approx(expected, rel=3e-3)
    motion = made["psi"].detach() @ modes[:, 2]
    a, b = (float(motion[body.mesh.node(f"grid_{k}"), 2]) for k in (17, 117))
    assert abs(a) > 1e-3
    assert first * a + second * b == pytest.approx(0.0, abs=1e-9 * abs(a))


def read(tmp_path, *lines: str, units: str = "m"):
    path = tmp_path / "model.bdf"
    path.write_text("\n".join(["BEGIN BULK", *BEAM, *beam(1), *lines, "ENDDATA"]))
    return bulk_body(path, units)


@pytest.mark.parametrize(("units", "meters"), [("m", 1.0), ("mm", 1e-3)])
def test_an_mpc_of_many_terms_in_meters(units, meters, tmp_path):
    """u_z of 3 is 2 mm (per radian) of phi_y of 5, less half of u_x of 7 and u_y of 17, whose system is turned about z."""
    lines = ["MPC,9,3,3,-2.,5,5,4.", ",,7,1,-1.,17,2,5.", ",,9,1,0.", "CORD2R,4,0,0.,0.,0.,0.,0.,1.", ",.6,.8,0."]
    path = tmp_path / "model.bdf"
    own = [line + ",4" if line.startswith("GRID,17,") else line for line in beam(1)]
    path.write_text("\n".join(["BEGIN BULK", *BEAM, *own, *lines, "ENDDATA"]))
    (link,) = bulk_body(path, units).links
    assert (link.node, link.component) == (2, 2)
    assert [term[:2] for term in link.terms] == [(4, 4), (6, 0), (16, 0), (16, 1)]
    assert [term[2] for term in link.terms] == pytest.approx([2.0 * meters, -0.5, -0.8 * 2.5, 0.6 * 2.5])


def test_a_mean_of_some_components(tmp_path):
    """REFC 3 of an RBE3: only u_z follows, the others are the grid's own."""
    (link,) = read(tmp_path, "GRID,80,,.5,1.,0.", "RBE3,40,,80,3,1.,123,1,17", ",9").links
    assert link.components == (2,)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["RBE2,50,1,0,2"], ["RBE2 50", "line 37", "CM = '0'", "1 to 6"]),
        (["RBE2,50,1,113,2"], ["CM = '113'", "each once"]),
        (["RBE2,50,1,1.5,2"], ["CM = '1.5'"]),
        (["RBE3,50,,1,7,1.,123,3,4", ",5"], ["RBE3 50", "REFC = '7'"]),
        (["RBE2,50,1,123,9", "RBE2,51,2,34,9"], ["RBE2 51", "GRID 9", "RBE2 50", "component 3"]),
        (["RBE2,50,1,123,9", "MPC,4,9,2,1.,5,2,1."], ["MPC 4", "line 38", "GRID 9", "RBE2 50", "component 2"]),
        (
            ["MPC,4,9,2,1.,5,2,1.", "MPC,4,5,2,1.,9,2,1."],
            ["MPC 4", "line 37", "line 38", "closed chain", "chains that end"],
        ),
        (["MPC,4,9,7,1.,5,2,1."], ["MPC 4", "C1 = '7'", "1 to 6"]),
        (["MPC,4,9,1,1.,5,0,1."], ["C2 = '0'"]),
        (["MPC,4,9,1,1.,5,2,x"], ["A2 = 'x'"]),
        (["MPC,4,9,1,0.,5,2,1."], ["A1 = 0."]),
        (["MPC,4,9,1,1."], ["1 terms", "two"]),
        (["MPC,4,9,1,1.,9,1,2."], ["component 1 of GRID 9 appears twice"]),
        (["MPC,4,9,1,1.,99,1,2."], ["GRID 99 does not exist"]),
    ],
)
def test_what_is_wrong_is_named(lines, words, tmp_path):
    with pytest.raises(InputError) as error:
        read(tmp_path, *lines)
    assert all(word in str(error.value) for word in ["model.bdf, line", *words]), str(error.value)
