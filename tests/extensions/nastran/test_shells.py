"""Shells and shear panels of a model: offsets, membranes and bending of different materials, and derivatives by property."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.extensions.nastran.bdf_models import model
from tests.refused import refused, warned
from torchmbd.extensions.nastran.body import bulk_body
from torchmbd.fem.elements import Plates

SQUARE = ["GRID,1,,0.,0.,0.", "GRID,2,,2.,0.,0.", "GRID,3,,2.,1.,0.", "GRID,4,,0.,1.,0."]
STEEL = "MAT1,1,2.+11,,.25,8000."
SOFT = "MAT1,2,7.+10,,.3,2700."
MAT8 = "MAT8,3,1.28+11,1.01+10,.23,5.36+9,5.36+9,3.6+9,1586."


@pytest.fixture
def parts(tmp_path):
    """Parts of a model of one cell."""

    def made(*lines: str, units: str = "m"):
        path = tmp_path / "model.bdf"
        path.write_text("\n".join(["BEGIN BULK", *SQUARE, *lines, "ENDDATA"]))
        return bulk_body(path, units).parts

    return made


def laminate(part) -> mbd.Laminate:
    assert isinstance(part, Plates)
    return part.laminate


@pytest.mark.parametrize(
    ("lines", "offset"),
    [
        (["CQUAD4,1,7,1,2,3,4,0.,.05", "PSHELL,7,1,.01,1"], 0.05),
        (["CQUAD4,1,7,1,2,3,4", "PCOMP,7,0.\n,1,.01,0."], 0.005),
        (["CQUAD4,1,7,1,2,3,4,0.,-.02", "PCOMP,7,.01\n,1,.01,0."], -0.005),
    ],
)
def test_offsets(parts, lines, offset):
    """A, B, D and the place of the mass about the plane of the grids, by Steiner's theorem."""
    (part,) = parts(*lines, STEEL).values()
    h, Q = 0.01, mbd.Ply.isotropic(E=2e11, nu=0.25, density=8000.0).plane_stiffness()
    result = laminate(part).stiffness()
    assert_close(result.A, h * Q)
    assert_close(result.B, offset * h * Q)
    assert_close(result.D, (h**3 / 12 + offset**2 * h) * Q)
    assert_close(result.As, 5 / 6 * h * 8e10 * torch.eye(2, dtype=torch.float64))
    points = part.masses()
    assert float(points.mass.sum()) == pytest.approx(8000.0 * h * 2.0)
    assert points.arm is not None
    assert_close(points.arm[:, 2], torch.full((4,), offset, dtype=torch.float64))


def test_elements_of_several_offsets(parts):
    more = ["GRID,5,,4.,0.,0.", "GRID,6,,4.,1.,0.", "CQUAD4,2,7,2,5,6,3,0.,.05"]
    result = parts("CQUAD4,1,7,1,2,3,4", *more, "PSHELL,7,1,.01,1", STEEL)
    assert {name: laminate(part).offset for name, part in result.items()} == {
        "pshell_7": 0.0,
        "pshell_7_offset_1": 0.05,
    }


def test_angles_of_isotropic_properties_are_no_design_variables(parts):
    """They had no effect; those of a property with an anisotropic material have one."""
    lines = {
        ("PSHELL,7,1,.01,1", STEEL): ["thickness"],
        ("PSHELL,7,1,.01,2,3.,1,.5", STEEL, SOFT): ["thickness"],
        ("PCOMP,7,,,,TSAI", ",1,.002,10.,,2,.002,20.", STEEL, SOFT): ["thickness"],
        ("PSHELL,7,3,.01,3", MAT8): ["angles", "thickness"],
        ("PCOMP,7,,,,TSAI", ",1,.002,10.,,3,.002,20.", STEEL, MAT8): ["angles", "thickness"],
    }
    for cards, names in lines.items():
        (part,) = parts("CQUAD4,1,7,1,2,3,4", *cards).values()
        assert [name for name, _ in laminate(part).named_parameters()] == names


def test_membrane_bending_and_shear_of_other_materials(parts):
    (part,) = parts("CQUAD4,1,7,1,2,3,4", "PSHELL,7,1,.01,2,3.,1,.5", STEEL, SOFT).values()
    result, plies = laminate(part).stiffness(), [(2e11, 0.25), (7e10, 0.3)]
    steel, soft = (mbd.Ply.isotropic(E=E, nu=nu, density=1.0).plane_stiffness() for E, nu in plies)
    assert_close(result.A, 0.01 * steel)
    assert_close(result.D, 3.0 * 0.01**3 / 12 * soft)
    assert_close(result.As, 0.5 * 0.01 * 8e10 * torch.eye(2, dtype=torch.float64))
    assert float(part.masses().mass.sum()) == pytest.approx(8000.0 * 0.02)
    with refused("laminate"):
        laminate(part).shear_shape()


def test_a_membrane_keeps_a_little_bending(parts):
    with warned("PSHELL 7", "MID2", "1e-06"):
        (part,) = parts("CQUAD4,1,7,1,2,3,4", "PSHELL,7,1,.01", STEEL).values()
    result = laminate(part).stiffness()
    assert float(result.D[0, 0] / result.A[0, 0]) == pytest.approx(1e-6 * 0.01**2 / 12)


def test_an_anisotropic_material_is_the_isotropic_one(parts):
    Q = mbd.Ply.isotropic(E=2e11, nu=0.25, density=1.0).plane_stiffness()
    numbers = [f"{float(Q[i, j]):.15E}" for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    shell = ["CQUAD4,1,7,1,2,3,4,30.", "PSHELL,7,1,.01,1,,1"]
    (one,) = parts(*shell, STEEL).values()
    (two,) = parts(*shell, ",".join(["MAT2", "1", *numbers, "8000."])).values()
    assert_close(laminate(two).entries(), laminate(one).entries(), rtol=1e-12, atol=1e-3)
    with refused("MAT2 1 (model.bdf, line 8).G"):
        parts(*shell, "MAT2,1,1.+9,2.+9,0.,1.+9,0.,1.+9,8000.")


def test_a_shear_panel(parts):
    """G A gamma^2 t of a shear, nothing of stretch, rotation or what leaves the plane; rods along two sides."""
    (part,) = parts("CSHEAR,1,7,1,2,3,4", "PSHEAR,7,1,.01", STEEL).values()
    K = part.pattern.to_scipy(part.values()).toarray()
    x = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
    fields = {"shear": x[:, ::-1], "turn": np.stack([-x[:, 1], x[:, 0]], 1), "stretch": x * [1.0, -0.3]}
    result = {}
    for name, own in fields.items():
        u = np.zeros((4, 6))
        u[:, :2] = own
        result[name] = u.ravel() @ K @ u.ravel()
    assert result["shear"] == pytest.approx(8e10 * 0.01 * 2.0 * 2.0**2)
    assert abs(result["turn"]) + abs(result["stretch"]) < 1e-3
    assert np.linalg.matrix_rank(K) == 1
    assert float(part.masses().mass.sum()) == pytest.approx(8000.0 * 0.02)
    (part,) = parts("CSHEAR,1,7,1,2,3,4", "PSHEAR,7,1,.01,,1.,30.", STEEL).values()
    K = part.pattern.to_scipy(part.values()).toarray()
    assert K[0, 0] - 8e10 * 0.01 * 2.0 * 0.5**2 == pytest.approx(2e11 * 0.5 * 0.01 * 1.0 / 2.0)  # half of the panel
    assert K[1, 1] - 8e10 * 0.01 * 2.0 * 0.25**2 == pytest.approx(2e11 * 0.5 * 30.0 * 0.01**2 / 1.0)


def test_scalar_points_and_springs_to_the_ground_are_left_out(parts):
    scalar = ["SPOINT,90,THRU,95", "CELAS2,5,1.+5,90,,91", "CMASS4,6,1.,92", "CELAS4,7,1.,93", "SPC1,3,,90,94"]
    shell = ["CQUAD4,1,7,1,2,3,4", "PSHELL,7,1,.01,1", STEEL]
    with warned("scalar points") as caught:
        result = parts(*shell, *scalar, "CELAS2,8,1.+5,1,3")
    words = " ".join(str(w.message) for w in caught)
    assert list(result) == ["pshell_7"]
    assert "CELAS2 of scalar points (1)" in words
    assert "CMASS4 of scalar points (1)" in words
    assert "CELAS2 8 (model.bdf, line 14): one of its ends is the ground" in words
    with refused("RBE2 8 (model.bdf, line 14).91"):
        parts(*shell, *scalar, "RBE2,8,91,123,1")


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["angles", "thickness"])
def test_derivatives_by_property(name, tmp_path):
    """Mass and frequency by the angles and thicknesses of two properties, against differences."""
    path = tmp_path / "model.bdf"
    more = "PCOMP,8,,,,TSAI\n,1,.002,10.\nCQUAD4,900,8,601,602,912,911,0.\nGRID,911,,.2,-.05,.01\nGRID,912,,.2,0.,.01"
    path.write_text(model(cells=(6, 2), extra=[more]))
    body = mbd.io.read_bdf(path, "wing", modes=3)
    names = [f"pcomp_{number}.{name}" for number in (7, 8)]
    given = [dict(body.named_parameters())[own] for own in names]

    def numbers(*values: torch.Tensor) -> torch.Tensor:
        class Made(torch.nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.body = body

            def forward(self) -> torch.Tensor:
                result = self.body.structure()
                return torch.stack([result["mass"], torch.linalg.eigvalsh(result["Kr"])[0].sqrt()])

        state = {f"body.{own}": x for own, x in zip(names, values, strict=True)}
        return torch.func.functional_call(Made(), state)

    values = [x.detach().clone() for x in given]
    exact = torch.func.jacrev(numbers, argnums=(0, 1))(*values)
    for k, x in enumerate(values):
        step = 1e-4 * (1.0 if name == "angles" else float(x[0]))
        for i in range(len(x)):
            moved = [torch.zeros_like(y) for y in values]
            moved[k][i] = step
            with torch.no_grad():
                up, down = (numbers(*(y + s * d for y, d in zip(values, moved, strict=True))) for s in (1.0, -1.0))
            assert_close(exact[k][:, i], (up - down) / (2 * step), rtol=2e-6, atol=1e-6)
    assert bool((exact[0][0] > 0.0).all()) == (name == "thickness")
