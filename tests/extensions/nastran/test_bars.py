"""Offsets, pins and axes of bars: cantilevers and beams on supports in closed form."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from torchmbd.extensions.nastran.body import bulk_body

E, A, INERTIA, RHO, LENGTH, CELLS = 2e11, 1e-4, 1e-9, 8000.0, 1.0, 12
HEAD = ["MAT1,1,2.+11,,.25,8000.", "PBAR,5,1,1.-4,1.-9,2.-9,2.-9"]


def bending(root: float, inertia: float = INERTIA, length: float = LENGTH) -> float:
    return root**2 / length**2 * math.sqrt(E * inertia / (RHO * A))


def beam(first: str = "", last: str = "", middle: str = "", vector: str = "0.,1.,0.") -> list[str]:
    """A bar of 1 m along x, clamped at grid 1; more fields of the first bar, the last and the others."""
    lines = [f"GRID,{k + 1},,{LENGTH * k / CELLS!r},0.,0." for k in range(CELLS + 1)]
    for k in range(CELLS):
        more = first if k == 0 else last if k == CELLS - 1 else middle
        lines.append(f"CBAR,{k + 1},5,{k + 1},{k + 2},{vector}{more}")
    return [*lines, "SPC1,1,123456,1"]


@pytest.fixture
def frequencies(tmp_path):
    """The lowest circular frequencies of a model [rad/s]."""

    def made(*lines: str, modes: int = 2) -> list[float]:
        path = tmp_path / "model.bdf"
        path.write_text("\n".join(["BEGIN BULK", *HEAD, *lines, "ENDDATA"]))
        body = mbd.io.read_bdf(path, "body", modes)
        return torch.linalg.eigvalsh(body.structure()["Kr"].detach()).sqrt().tolist()

    return made


def test_a_hinge_at_the_root(frequencies):
    """Pin 6 at the clamp: hinged in plane 1; pins 5 and 6 in both."""
    clamped = frequencies(*beam())
    assert clamped == pytest.approx([bending(1.87510), bending(1.87510, 2 * INERTIA)], rel=5e-3)
    end = [f"RBE2,50,1,123,{CELLS + 1}"]  # the far end is supported
    one, both = bending(math.pi), bending(math.pi, 2 * INERTIA)
    assert frequencies(*beam("\n,6"), *end) == pytest.approx([one, bending(3.92660, 2 * INERTIA)], rel=1e-2)
    assert frequencies(*beam("\n,56"), *end) == pytest.approx([one, both], rel=5e-3)


@pytest.mark.parametrize("pins", ["6", "56", "456", "5"])
@pytest.mark.parametrize("angle", [0.0, 35.0])
def test_pins_in_turned_axes(pins, angle, frequencies):
    """At the far end, held by a rigid clamp: hinges in one plane or both, whatever the axes of the bar."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    lines = beam("", f"\n,,{pins}", vector=f"0.,{c},{s}")
    lines[-1] = f"SPC1,1,123456,1,{CELLS + 1}"
    both = [bending(3.92660 if "6" in pins else 4.73004), bending(3.92660 if "5" in pins else 4.73004, 2 * INERTIA)]
    assert sorted(frequencies(*lines)) == pytest.approx(sorted(both), rel=1e-2)


def test_offsets_along_and_different_at_the_ends(tmp_path):
    """The last bar is longer by an offset along it: a tip beyond its grid. The strain energy of a pull says where it ends."""
    path = tmp_path / "model.bdf"
    more = "\n,,,,,,.05,0.02,0."
    path.write_text("\n".join(["BEGIN BULK", *HEAD, *beam("", more), "ENDDATA"]))
    result = bulk_body(path)
    assert len(result.mesh.nodes) == CELLS + 2
    assert_close(result.mesh.nodes[-1], torch.tensor([1.05, 0.02, 0.0], dtype=torch.float64))
    mass = float(mbd.io.read_bdf(path, "body", 2).structure()["mass"])
    length = 11 / 12 + math.hypot(1 / 12 + 0.05, 0.02)
    assert mass == pytest.approx(RHO * A * length)


@pytest.mark.parametrize(
    "more",
    [
        ",GGG\n,,,.0,.1,.0,.0,.1,.0",
        ",BGG\n,,,.0,.1,.0,.0,.1,.0",
        ",GOO\n,,,.0,.1,.0,.0,.1,.0",
        ",GGO\n,,,.0,.1,.0,.0,.1,.0",
    ],
)
def test_axes_of_offsets(more, frequencies):
    """Along the basic axes all words say the same: a beam beside its grids is as stiff as on them in plane 2."""
    result = frequencies(*beam(more, more, more))
    assert result[0] == pytest.approx(bending(1.87510), rel=5e-3)


def test_a_cylindrical_system_turns_the_vector(tmp_path):
    """CD of the first grid: its y is around the axis, here the basic -x."""
    path = tmp_path / "model.bdf"
    text = [
        "CORD2C,4,0,0.,0.,0.,0.,0.,1.",
        ",1.,0.,0.",
        "GRID,1,,0.,1.,0.,4",
        "GRID,2,,0.,2.,0.",
        "CBAR,1,5,1,2,0.,1.,0.",
    ]
    path.write_text("\n".join(["BEGIN BULK", *HEAD, *text, "ENDDATA"]))
    result = bulk_body(path)
    axes = result.parts["pbar_5"].matrices.axes[0]
    assert_close(axes, torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], dtype=torch.float64), atol=1e-12, rtol=0)
