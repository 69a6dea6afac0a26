"""The composite plate of TACS's tests (comp_plate.bdf, test_shell_comp_unbalanced.py): 0.5 x 2 m, [0, 45, 30]s along y.

Clamped at x = 0, 1 MN along x and 0.1 N along z at the other side. TACS prints mass 1.1625, compliance 15637.9208 and
2.09617e-4, on two of its elements. Two of ours bend under the forces at their corners, as they have drilling freedoms: they
are twice as soft in tension, and right along z. Compared are finer meshes.
"""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from torchmbd.fem.elements import Assembly, Plates
from torchmbd.fem.reduction.static import StaticLoads

PLY = mbd.Ply(E1=54e9, E2=18e9, G12=9e9, G13=9e9, G23=9e9, nu12=0.25, density=1550.0)


def compliance(nx: int, ny: int) -> tuple[float, float, float]:
    """Mass [kg], and the work of the forces along x and along z [J]."""
    mesh = mbd.mesh.rectangle(0.5, 2.0, cells=(nx, ny))
    laminate = mbd.Laminate(PLY, mbd.deg([0.0, 45.0, 30.0]), 1.25e-4, symmetric=True)
    plate = Plates(mesh, laminate, (0.0, 1.0, 0.0))
    assembly = Assembly(mesh, {"plate": plate}, mesh.node_set("left_edge"), [])
    force = torch.zeros(len(mesh.nodes), 6, 2, dtype=torch.float64)
    for node in mesh.node_set("right_edge"):
        inside = abs(float(mesh.nodes[node, 1] - mesh.nodes[:, 1].mean())) < 0.999
        share = (1.0 if inside else 0.5) / ny
        force[node, 0, 0], force[node, 2, 1] = 1e6 * share, 0.1 * share
    load = assembly.freedoms.gathered(force)
    moved = StaticLoads(assembly.pattern)(assembly.stiffness(), load)
    tension, shear = (moved * load).sum(0).tolist()
    return float(assembly.masses().mass.sum()), tension, shear


@pytest.mark.thorough
def test_mass_and_compliance():
    mass, tension, shear = compliance(8, 32)
    assert mass == pytest.approx(1.1625, rel=1e-12)
    assert tension == pytest.approx(15637.9208, rel=1e-2)
    _, finer, _ = compliance(16, 64)
    assert finer == pytest.approx(tension, rel=2e-3)
    _, _, coarse = compliance(1, 2)
    assert coarse == pytest.approx(shear, rel=5e-3)
    assert 0.74 < 2.0961674e-4 / shear < 0.76  # two elements of TACS are a quarter too stiff
