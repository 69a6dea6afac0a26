"""Laminates whose mass lies off their middle surface: center of mass, inertia, mass matrix, hanging, derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.func import functional_call, jacfwd, jacrev
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON, KINDS, grid, irregular, moved, rotation, turned
from tests.validation.navier import Navier
from tests.validation.simply_supported import supports
from torchmbd.fem.elements import Assembly, Plates
from torchmbd.fem.reduction import eigenpairs
from torchmbd.math.rotation import rotation_matrix

pytestmark = pytest.mark.usefixtures("compiled")

STEEL, FOAM = mbd.Ply.isotropic(2.1e11, 0.3, 7800.0), mbd.Ply.isotropic(7e7, 0.3, 60.0)
DENSITY, THICKNESS = (7800.0, 60.0, 1586.0, 1586.0), (1e-3, 10e-3, 1e-3, 0.7e-3)
LENGTH, WIDTH, CORNER = 0.3, 0.1, "corner_left_bottom"


def sandwich() -> mbd.Laminate:
    """A steel face, foam, and a face of two unbalanced carbon layers: unsymmetric in all."""
    return mbd.Laminate([STEEL, FOAM, CARBON, CARBON], mbd.deg([0, 10, 25, -60]), THICKNESS)


def moments() -> tuple[float, float, float]:
    """Mass, first and second moment about the middle surface per area, layer by layer [kg/m2, kg/m, kg]."""
    z, mass, first, second = -sum(THICKNESS) / 2, 0.0, 0.0, 0.0
    for rho, t in zip(DENSITY, THICKNESS, strict=True):
        mass += rho * t
        first += rho * ((z + t) ** 2 - z**2) / 2
        second += rho * ((z + t) ** 3 - z**3) / 3
        z += t
    return mass, first, second


def rigid_motions(x: torch.Tensor) -> torch.Tensor:
    """Three translations and three rotations about the origin, of nodes at x: [n, 6, 6]."""
    fields = torch.zeros(len(x), 6, 6, dtype=torch.float64)
    for i, e in enumerate(torch.eye(3, dtype=torch.float64)):
        fields[:, i, i] = 1.0
        fields[:, :3, 3 + i] = torch.linalg.cross(e.expand_as(x), x)
        fields[:, 3 + i, 3 + i] = 1.0
    return fields


def inertia_of_layers(c: torch.Tensor, R: torch.Tensor) -> torch.Tensor:
    """6 x 6 inertia about the origin of four boxes in line with the columns of R, middle of the stack at c.

    Eq. (2) gives a node the rotary inertia about the layers' own center about all axes, the normal among them.
    """
    M, z = torch.zeros(6, 6, dtype=torch.float64), -sum(THICKNESS) / 2
    mass, first, second = moments()
    for rho, t in zip(DENSITY, THICKNESS, strict=True):
        m, at = rho * t * LENGTH * WIDTH, c + R[:, 2] * (z + t / 2)
        J = R @ torch.diag(c.new_tensor([WIDTH**2 + t**2, LENGTH**2 + t**2, LENGTH**2 + WIDTH**2])) @ R.T
        lever = torch.linalg.cross(torch.eye(3, dtype=torch.float64), -at.expand(3, 3))  # columns: e_i x at, transposed
        M[:3, :3] += m * torch.eye(3, dtype=torch.float64)
        M[:3, 3:] += m * -lever.T
        M[3:, :3] += m * -lever
        M[3:, 3:] += m / 12 * J + m * lever @ lever.T
        z += t
    spin = (second - first**2 / mass) * LENGTH * WIDTH
    M[3:, 3:] += spin * torch.outer(R[:, 2], R[:, 2])
    return M


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_center_of_mass(mass, kind):
    """Of a plate that is turned in its mesh and fixed at a corner: the layers' own center over the middle of the plate."""
    R = rotation(4)
    mesh = turned(irregular(LENGTH, WIDTH, (4, 3), kind=kind), R)
    parts = {"plate": Plates(mesh, sandwich(), R[:, 0], mass=mass)}
    result = mbd.FlexibleBody("plate", mesh, parts, 2, reference=CORNER).structure()
    per_area, first, _ = moments()
    middle = R @ torch.tensor([LENGTH / 2, WIDTH / 2, first / per_area], dtype=torch.float64)
    assert abs(first / per_area) > 2e-3
    assert_close(result["mass"].detach(), torch.tensor(per_area * LENGTH * WIDTH), check_dtype=False)
    assert_close((result["S0"] / result["mass"]).detach(), middle, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("kind", KINDS)
def test_rigid_inertia_is_that_of_the_offset_layers(kind):
    """Mass matrix on rigid motions, and invariants; consistent mass integrates squares of lengths exactly."""
    R = rotation(5)
    mesh = turned(grid(LENGTH, WIDTH, (4, 3), kind), R)
    parts = {"plate": Plates(mesh, sandwich(), R[:, 0], mass="consistent")}
    x = mesh.nodes - mesh.nodes[mesh.node(CORNER)]
    exact = inertia_of_layers(x.mean(0), R)
    M = Assembly(mesh, parts).mass().dense().detach()
    fields = rigid_motions(x).flatten(0, 1)
    assert_close(fields.T @ M @ fields, exact, rtol=1e-11, atol=1e-16)
    result = {
        key: value.detach()
        for key, value in mbd.FlexibleBody("plate", mesh, parts, 2, reference=CORNER).structure().items()
    }
    J = (result["P0"].trace() + result["mu"]) * torch.eye(3, dtype=torch.float64) - result["P0"]
    assert_close(J, exact[3:, 3:], rtol=1e-11, atol=1e-16)


def test_lumped_mass_couples_translations_with_rotations():
    """By the first moment at every node, beside which rotations have the second moment about the middle surface."""
    mesh, laminate = mbd.mesh.rectangle(LENGTH, WIDTH, (4, 2)), sandwich()
    part = Plates(mesh, laminate)
    M = Assembly(mesh, {"plate": part}).mass().dense().detach()
    mass, first, second = moments()
    node = torch.diag(torch.tensor([mass] * 3 + [second, second, second - first**2 / mass], dtype=torch.float64))
    node[0, 4] = node[4, 0] = first  # phi_y moves the center of mass by z phi_y along x
    node[1, 3] = node[3, 1] = -first
    assert_close(M, torch.kron(torch.diag(part.matrices.area), node), rtol=1e-11, atol=1e-16)


def test_a_symmetric_stack_listed_whole_is_the_half_mirrored():
    """Arms of length zero, which grow with one face alone, beside none at all: the same body."""
    mesh = irregular(LENGTH, WIDTH, (4, 2), kind="quad")
    half = mbd.Laminate([STEEL, FOAM], [0.0, 0.0], [1e-3, 5e-3], symmetric=True)
    whole = mbd.Laminate([STEEL, FOAM, FOAM, STEEL], [0.0] * 4, [1e-3, 5e-3, 5e-3, 1e-3])
    one, other = (mbd.FlexibleBody.plate("plate", mesh, own, modes=3) for own in (half, whole))
    assert [body.assembly.diagonal for body in (one, other)] == [True, False]
    a, b = one.structure(), other.structure()
    for key in ("mass", "S0", "P0", "mu", "Kr"):
        x, y = (torch.linalg.eigvalsh(result[key]) if key == "Kr" else result[key] for result in (a, b))
        assert_close(x, y, rtol=1e-9, atol=1e-15)


@pytest.mark.thorough
def test_a_shell_has_its_center_off_each_facet():
    """Half a tube: a facet's middle lies at r cos(a), its mass at the height z on it; 2 a is the angle of a facet."""
    count, radius = 48, 0.2
    flat = mbd.mesh.rectangle(math.pi, WIDTH, (count, 2))
    s, y = flat.nodes[:, 0], flat.nodes[:, 1]
    mesh = moved(flat, radius * torch.stack([s.sin(), y / radius, s.cos()], dim=1))
    body = mbd.FlexibleBody.plate("tube", mesh, sandwich(), modes=2, reference="left_edge")
    result = body.structure()
    center = (result["S0"] / result["mass"]).detach() + body.origin
    mass, first, _ = moments()
    a = math.pi / count / 2
    expected = (radius * math.cos(a) + first / mass) / (count * math.sin(a))  # mean of the cosines of all facets
    assert float(center[2]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.thorough
def test_frequencies_are_those_of_the_series():
    """A thick plate, simply supported: the first moment couples u with beta_x, v with beta_y; extrapolated meshes."""
    light, heavy = (mbd.Ply.isotropic(7e10, 0.3, rho) for rho in (300.0, 8000.0))
    laminate = mbd.Laminate([light, CARBON, heavy], mbd.deg([0, 90, 0]), [8e-3, 2e-3, 4e-3])
    series = Navier(laminate, 0.1, 0.08)
    exact = series.frequencies(5)
    series.M[[0, 1, 3, 4], [3, 4, 0, 1]] = 0.0
    assert np.abs(series.frequencies(5) / exact - 1).max() > 0.02  # what it costs to drop the first moment

    def found(n):
        mesh = mbd.mesh.rectangle(0.1, 0.08, (n, n), "quad")
        assembly = Assembly(mesh, {"plate": Plates(mesh, laminate)})
        free = np.setdiff1d(np.arange(6 * len(mesh.nodes)), supports(mesh, "SS-1"))
        M = assembly.mass().restrict(free)
        values = eigenpairs(assembly.stiffness().restrict(free), M, 5).values.detach().numpy()
        return np.sqrt(values) / (2 * math.pi)

    np.testing.assert_allclose((4 * found(24) - found(12)) / 3, exact, rtol=1e-4)


def hung(laminate: mbd.Laminate, **given) -> mbd.System:
    """A plate that hangs from a hinge along its left edge, its normal horizontal; the hinge is turned about the vertical."""
    turn = rotation(6)
    e_y, down = turn[:, 0], turn[:, 1]  # hinge and gravity: any two directions at right angles
    axes = torch.stack([down, e_y, torch.linalg.cross(down, e_y)], dim=1)
    mesh = mbd.mesh.rectangle(LENGTH, WIDTH, (6, 2))
    body = mbd.FlexibleBody.plate(
        "plate", mesh, laminate, modes=4, reference="left_edge", position=(0, 0, 0), axes=axes, **given
    )
    hinge = mbd.Revolute(mbd.Ground().at(axes=axes), body.at("left"), "y", name="hinge")
    return mbd.System([body], [hinge], gravity=(9.81 * down).tolist())


@pytest.mark.thorough
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_a_plate_hangs_with_its_center_below_the_hinge(mass):
    """At atan(z / (L / 2)) to the vertical; the clamped plate of 1 g droops by less than 1e-6 of that."""
    system = hung(sandwich(), mass=mass)
    result = mbd.equilibrium(system)
    body = system.body("plate")
    q = result.q[0, 0]
    A = rotation_matrix(q[3:7, None])[..., 0]
    angle = torch.linalg.cross(body.axes[:, 0], A[:, 0]) @ body.axes[:, 1]
    per_area, first, _ = moments()
    assert result.stable
    assert float(angle.asin()) == pytest.approx(math.atan(first / per_area / (LENGTH / 2)), rel=1e-3)
    assert abs(math.degrees(float(angle.asin()))) > 0.8


class Invariants(torch.nn.Module):
    """Everything that the motion gets, as one vector; modes by what does not depend on their signs."""

    def __init__(self, mass: str):
        super().__init__()
        mesh = irregular(LENGTH, WIDTH, (6, 2), kind="quad")
        self.body = mbd.FlexibleBody.plate("plate", mesh, sandwich(), modes=3, reference="left_edge", mass=mass)

    def forward(self):
        result = self.body.structure()
        even = [torch.linalg.eigvalsh(result["Kr"]), (result["S1"] @ result["S1"].mT).flatten(-2)]
        even += [
            (result["C0"].flatten(-3, -2).mT @ result["C0"].flatten(-3, -2))
            .diagonal(dim1=-2, dim2=-1)
            .sum(-1)[..., None]
        ]
        return torch.cat([result["S0"], result["P0"].flatten(-2), result["mu"][..., None], *even], dim=-1)

    def at(self, thickness):
        return functional_call(self, {"body.laminate.thickness": thickness})


@pytest.mark.thorough
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_derivatives_by_thickness_and_lanes(mass):
    """Forward and reverse, against differences of fourth order; a batch of designs is its designs one by one."""
    model = Invariants(mass)
    h = torch.tensor(THICKNESS, dtype=torch.float64)
    exact = jacfwd(model.at)(h)
    scale = exact.detach().norm(dim=1) + 1e-4
    assert_close(jacrev(model.at)(h) / scale[:, None], exact / scale[:, None], rtol=0, atol=1e-8)
    for k, e in enumerate(torch.diag(1e-4 * h)):
        near, far = model.at(h + e) - model.at(h - e), model.at(h + 2 * e) - model.at(h - 2 * e)
        rough = ((8 * near - far) / (12 * e[k])).detach()
        assert_close(exact[:, k] / scale, rough / scale, rtol=1e-6, atol=1e-7)
    lanes = torch.stack([h, 1.1 * h, h.flip(0)])
    one_by_one = torch.stack([model.at(own) for own in lanes])
    assert_close(model.at(lanes), one_by_one, rtol=1e-8, atol=1e-12)


@pytest.mark.thorough
def test_gradient_of_the_motion_by_thickness():
    """How far the hung plate swings out when it is let go with its middle surface vertical."""
    system = hung(sandwich())
    history = mbd.Displacement("plate", "z", node="corner_right_top")
    problem = mbd.Problem(
        system,
        0.05,
        minimize=mbd.Integral(history**2),
        steps=300,
        iterations=(6, 6),
        refresh=1,
        variables=["plate.laminate.thickness"],
        bounds=(1e-4, 2e-2),
    )
    h = np.array(THICKNESS)
    exact = problem.evaluate(h[None], gradients=True)[0].objective_gradient
    steps = 5e-4 * np.diag(h)
    designs = np.concatenate([h + s * steps for s in (1, -1, 2, -2)])
    a, b, c, d = np.reshape([e.objective for e in problem.evaluate(designs, gradients=False)], (4, 4))
    rough = (8 * (a - b) - (c - d)) / (12 * steps.max(1))  # of fourth order
    np.testing.assert_allclose(exact, rough, rtol=1e-5, atol=1e-5 * np.abs(rough).max())
