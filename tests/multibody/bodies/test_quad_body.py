"""Plates of quadrilaterals as bodies: near those of triangles, exact derivatives, ply stresses, files, mixed meshes."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from torch.func import functional_call, jvp
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON, GENERAL, KINDS, grid, irregular, mapped, rotation, turned
from tests.mechanisms import SOFT
from torchmbd.fem.elements import Plates, ply_basis
from torchmbd.fem.materials import Strength


def values(body):
    return torch.linalg.eigvalsh(body.structure()["Kr"])


def plate(kind="quad", cells=(9, 3), laminate=GENERAL, **given):
    return mbd.FlexibleBody.plate("plate", grid(0.3, 0.1, cells, kind), laminate, 4, reference="left_edge", **given)


@pytest.mark.thorough
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_both_elements_have_one_limit(mass):
    """Eigenvalues of an unbalanced stack, clamped at one edge: 1.2 % apart with 48 x 16 cells."""
    triangles, quads, mixed = (
        values(plate(kind, (48, 16), mass=mass)).detach() for kind in ("triangle", "quad", "mixed")
    )
    assert_close(quads, triangles, rtol=0.012, atol=0)
    assert_close(mixed, triangles, rtol=0.012, atol=0)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_derivative_of_every_frequency_by_every_angle(kind):
    """General laminate, irregular mesh turned in space: forward mode against central differences."""
    mesh = turned(irregular(0.3, 0.1, (6, 2), kind=kind), rotation(8))
    body = mbd.FlexibleBody.plate("plate", mesh, GENERAL, 4, reference="left_edge")
    angles = body.laminate.angles.detach().clone()

    class Frequencies(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.body = body

        def forward(self):
            return values(self.body).sqrt()

    def of(theta):
        return functional_call(Frequencies(), {"body.laminate.angles": theta}, ())

    for k in range(3):
        way = torch.eye(3, dtype=torch.float64)[k]
        exact = jvp(of, (angles,), (way,))[1]
        step = 1e-4
        difference = (of(angles + step * way) - of(angles - step * way)).detach() / (2 * step)
        assert_close(exact.detach(), difference, rtol=1e-6, atol=1e-7 * float(of(angles).max()))


@pytest.mark.extensions
@pytest.mark.thorough
def test_a_motion_its_plies_and_its_files(tmp_path):
    """A pendulum of quadrilaterals: failure of plies, frames for ParaView, triangles for the animation."""
    ply = mbd.Ply(**SOFT, strength=Strength(1.5e6, 1.2e6, 4e4, 2.5e5, 7e4))
    rod = plate(laminate=mbd.Laminate(ply, mbd.deg([20, -50]), 5e-3), cells=(6, 2))
    ground = mbd.Ground()
    system = mbd.System([rod], [mbd.Revolute(ground.at(-0.15, 0, 0), rod.at("left"), axis="y")], gravity=(0, 0, -9.81))
    motion = mbd.simulate(system, 2e-3, steps=20).require_ok()
    plies = mbd.PlyHistory(motion, "plate")
    assert len(plies.points) == 12 * 2 * 2
    assert float(mbd.PlyFailure("plate", "max_stress").values(motion).detach().max()) > 0
    file = mbd.viz.save_motion(motion, tmp_path / "rod.pvd", criterion="max_stress")
    frame = next((tmp_path / "rod").glob("*.vtu"))
    assert file.is_file()
    piece = ET.parse(frame).find(".//Piece")
    assert piece is not None
    assert piece.get("NumberOfCells") == "12"
    mbd.viz.animate(motion, tmp_path / "rod.html")


@pytest.mark.thorough
def test_uniform_states_have_their_stresses_in_every_ply():
    """Tension of a bar of quadrilaterals, slanted and turned: sigma = F / (b h) in a single layer of isotropic material."""
    lean = mapped((6, 2), lambda s, t: (0.3 * s + 0.02 * (1 - 2 * t) * np.sin(np.pi * s), 0.1 * t, 0.0), "quad")
    laminate = mbd.Laminate(mbd.Ply.isotropic(70e9, 0.3, 2700.0), [0.0], 2e-3)
    R = rotation(9)
    matrices = mbd.FlexibleBody.plate("bar", turned(lean, R), laminate, 2, direction=R[:, 0]).matrices
    x = lean.nodes
    strain = 1e6 / 70e9
    local = torch.stack([strain * x[:, 0], -0.3 * strain * x[:, 1], 0 * x[:, 0]], dim=1)
    u = torch.cat([local @ R.T, torch.zeros_like(local)], dim=1)[..., None]
    stress = ply_basis(matrices, laminate, u).stress.detach()[..., 0]
    assert_close(stress, torch.tensor([1e6, 0, 0, 0, 0], dtype=torch.float64).expand(24, 5), rtol=1e-10, atol=1e-3)


@pytest.mark.thorough
def test_zones_of_a_mixed_mesh():
    """Two stacks on the cells of a mesh that mixes kinds: masses add up, every cell has its plies."""
    mesh = grid(0.3, 0.1, (6, 2), "mixed")
    cells = torch.arange(mesh.cell_count)
    other = mbd.Laminate(CARBON, mbd.deg([0, 90]), 1e-3)
    zones = {"even": cells[cells % 2 == 0], "odd": cells[cells % 2 == 1]}
    body = mbd.FlexibleBody(
        "plate",
        mesh,
        {k: Plates(mesh, m, cells=zones[k]) for k, m in (("even", GENERAL), ("odd", other))},
        3,
    )
    areas = [float(mesh.areas[zones[k]].sum()) for k in ("even", "odd")]
    mass = sum(a * float(m.mass_per_area.detach()) for a, m in zip(areas, (GENERAL, other), strict=True))
    assert float(body.structure()["mass"]) == pytest.approx(mass, rel=1e-12)
    result = torch.cat([part.matrices.members for part in body.plates.values()])
    assert_array_equal(result.sort().values, cells)
