"""Geometric stiffness of all shells and beams: rigid motions, patches, projections, columns and strips."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.fem.elements.beam_cases import coupled_section
from tests.fem.elements.plate_cases import CARBON, GENERAL, KINDS, grid, irregular, mapped, rotation
from torchmbd.fem.elements import Assembly, BeamLine, Beams, GivenSection, Plates
from torchmbd.fem.elements.geometric import projected_geometric_stiffness
from torchmbd.fem.materials import Laminate
from torchmbd.fem.mesh import Mesh

TWIST = [[0.1 * i, 0.1 * i + 0.1] for i in range(4)]


def parts() -> dict:
    result = {kind: irregular(1.0, 0.7, (3, 3), kind=kind) for kind in KINDS}
    result["warped"] = mapped((2, 3), lambda s, t: (s, t, 0.3 * s * t - 0.1 * s * s), "quad")
    cases: dict[str, tuple] = {name: (mesh, Plates(mesh, GENERAL)) for name, mesh in result.items()}
    line, arc = BeamLine.straight(1.0, 4), BeamLine.arc(1.0, 2.0, 3)
    cases["beam"] = (line, Beams(line, coupled_section()))
    cases["twisted beam"] = (line, Beams(line, coupled_section(), twist=TWIST, offset=(0.02, -0.01)))
    cases["arc"] = (arc, Beams(arc, coupled_section(), orientation=(0.0, 0.0, 1.0)))
    return cases


@pytest.mark.parametrize("name", [*KINDS, "beam", "twisted beam", "arc"])
@torch.no_grad()
def test_a_rigid_rotation_does_the_work_of_the_loads(name):
    """Of all loads of beams; of shells that of loads in their plane, for their shear forces and moments are not in Kg."""
    mesh, part = parts()[name]
    if name in KINDS:
        part = Plates(mesh, Laminate(CARBON, [0.4, -0.9, 0.4], [1e-3, 1e-3, 1e-3]))
    assembly = Assembly(mesh, {"part": part})
    n, x = len(mesh.nodes), mesh.nodes
    u = torch.randn(n, 6, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    if name in KINDS:
        u[:, 2:5] = 0.0
    force = (assembly.stiffness() @ u.reshape(-1, 1)).reshape(n, 6)[:, :3]
    Kg = assembly.geometric(u).dense()[0]
    eye = torch.eye(3, dtype=torch.float64)

    def rotate(e: Tensor, d: Tensor) -> Tensor:
        return torch.linalg.cross(e.expand(n, 3), d)

    rigid = torch.stack([torch.cat([rotate(e, x), e.expand(n, 3)], 1).flatten() for e in eye], 1)
    work = torch.stack([torch.stack([(force * rotate(a, rotate(b, x))).sum() for a in eye]) for b in eye])
    assert_close(rigid.T @ Kg @ rigid, -0.5 * (work + work.T), rtol=1e-10, atol=1e-10 * float(work.abs().max()))
    shift = torch.cat([eye, 0.0 * eye], 1).repeat(n, 1).reshape(n, 3, 6)[:, :, :]
    moved = torch.stack([shift[:, i].flatten() for i in range(3)], 1)
    assert float((Kg @ moved).abs().max()) < 1e-12 * float(Kg.abs().max())


@pytest.mark.parametrize("name", [*KINDS, "warped", "beam", "twisted beam", "arc"])
@torch.no_grad()
def test_the_projection_is_that_of_the_matrix(name):
    mesh, part = parts()[name]
    assembly = Assembly(mesh, {"part": part})
    generator = torch.Generator().manual_seed(4)
    u, psi = (torch.randn(len(mesh.nodes), 6, k, dtype=torch.float64, generator=generator) for k in (2, 3))
    flat = psi.reshape(-1, 3)
    expected = flat.T @ assembly.geometric(u).dense() @ flat
    assert_close(
        projected_geometric_stiffness(assembly.stressed(u), psi),
        expected,
        rtol=1e-9,
        atol=1e-9 * float(expected.abs().max()),
    )


@pytest.mark.parametrize(("kind", "slant"), [("triangle", None), ("quad", 0.3), ("quad", None)])
@torch.no_grad()
def test_patch_of_uniform_forces_and_quadratic_deflection(kind, slant):
    """N : grad w grad w of any quadratic w, with N of a uniform strain, in any position: exact on triangles and
    parallelograms; other quadrilaterals, whose sides alone are parabolas, are near."""
    flat = irregular(1.0, 0.7, (3, 3), kind=kind) if slant is None else grid(1.0, 0.7, (3, 3), kind)
    nodes = flat.nodes + (slant or 0.0) * flat.nodes[:, [1, 2, 2]] * torch.tensor([1.0, 0.0, 0.0])
    turn = rotation(2)
    mesh = Mesh(nodes @ turn.T, flat.triangles, flat.node_sets, quads=flat.quads)
    laminate = Laminate(CARBON, [0.4, -0.9, 0.4], [1e-3, 1e-3, 1e-3])
    assembly = Assembly(mesh, {"part": Plates(mesh, laminate, turn[:, 0].contiguous())})
    x, y = nodes[:, 0], nodes[:, 1]
    eps = torch.tensor([1e-3, -2e-3, 0.7e-3], dtype=torch.float64)
    zero = torch.zeros_like(x)

    def field(u: Tensor, v: Tensor, w: Tensor, a: Tensor, b: Tensor) -> Tensor:
        return torch.cat([torch.stack([u, v, w], 1) @ turn.T, torch.stack([a, b, zero], 1) @ turn.T], 1)[..., None]

    stretched = field(eps[0] * x + 0.5 * eps[2] * y, eps[1] * y + 0.5 * eps[2] * x, zero, zero, zero)
    c = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    H = torch.tensor([[2 * c[0], c[2]], [c[2], 2 * c[1]]], dtype=torch.float64)  # grad w = H x
    bent = field(
        zero, zero, c[0] * x**2 + c[1] * y**2 + c[2] * x * y, H[1, 0] * x + H[1, 1] * y, -(H[0, 0] * x + H[0, 1] * y)
    )
    result = projected_geometric_stiffness(assembly.stressed(stretched), bent)[0, 0, 0]
    N = (laminate.stiffness().A @ eps)[[0, 2, 2, 1]].reshape(2, 2)
    xx, yy = 0.7 / 12.0, 0.7**3 / 12.0  # second moments of the rectangle
    s = slant or 0.0
    second = torch.tensor([[xx + s**2 * yy, s * yy], [s * yy, yy]], dtype=torch.float64)
    expected = (H @ N @ H * second).sum()
    assert_close(result, expected, rtol=1e-2 if (kind, slant) == ("quad", None) else 1e-10, atol=0.0)


def column(elements: int) -> tuple[Assembly, GivenSection]:
    stiffness = torch.diag(torch.tensor([1e7, 1e7, 1e7, 1e3, 100.0, 200.0], dtype=torch.float64))
    section = GivenSection(stiffness, torch.diag(torch.tensor([1.0, 1.0, 1.0, 2.0, 1.0, 1.0], dtype=torch.float64)))
    line = BeamLine.straight(1.0, elements)
    return Assembly(line, {"beam": Beams(line, section)}, [0]), section


def factor(assembly: Assembly, freedom: int, force: float) -> float:
    K = assembly.stiffness().dense()
    f = K.new_zeros(len(K), 1)
    f[freedom - 6] = force
    Kg = assembly.geometric(assembly.freedoms.expand(torch.linalg.solve(K, f))).dense()[0]
    return 1.0 / float(torch.linalg.eigvals(torch.linalg.solve(K, -Kg)).real.max())


def test_columns_and_lateral_buckling_of_a_beam():
    """Euler with shear (Engesser); end moment (semitangential): pi (EI GJ)^1/2 / L; tip force 4.0126 (EI GJ)^1/2 / L^2."""
    euler = math.pi**2 * 100.0 / 4.0
    assert factor(column(4)[0], 0, -1.0) == pytest.approx(euler / (1.0 + euler / 1e7), rel=1e-4)
    both = [factor(column(n)[0], 5, 1.0) / (math.pi * math.sqrt(1e5)) - 1.0 for n in (8, 16)]
    assert abs(both[1]) < 2e-3
    assert both[0] / both[1] == pytest.approx(4.0, rel=0.05)
    tip = [factor(column(n)[0], 1, 1.0) / (4.0126 * math.sqrt(1e5)) - 1.0 for n in (8, 16)]
    assert abs(tip[1]) < 1.5e-3
