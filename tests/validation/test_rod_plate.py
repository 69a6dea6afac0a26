"""The connecting rod of the paper: a carbon plate 304 x 40 x 7.5 mm, clamped at an end or at its center node.

References: the Euler-Bernoulli beam with the modulus of the free strip (Jones, section 2.8); central differences; an
independent triangle (linear displacements, smoothed discrete shear gaps, penalty drilling) on 96 x 16 cells, whose
cantilever frequencies are given below to 4 digits.
A plate held at one *point* has no limit under refinement: in plane stress a point support is no support, so the spin of
the plate in its plane about the center node falls in proportion to the element size, and the rocking of the plate falls
with the logarithm of it. Modes that leave the center at rest converge. This is the reference condition of the paper
(one node fixed to the body frame): the whole set of modes spans the same motions on any mesh, a truncated set differs.
"""

import math

import numpy as np
import pytest
import torch
from torch.func import functional_call, jvp

from tests.fem.elements.plate_cases import CARBON, freedoms, frequencies
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate
from torchmbd.fem.mesh import rectangle
from torchmbd.math.angles import deg

LENGTH, WIDTH, HEIGHT = 0.304, 0.04, 0.0075


def rod(degrees, cells, held, count, kind="quad"):
    laminate = Laminate(CARBON, deg(degrees), HEIGHT / len(degrees))
    mesh = rectangle(LENGTH, WIDTH, cells, kind)
    return frequencies(PlateMatrices(mesh, laminate), laminate, freedoms(mesh.node_set(held)), count)


@pytest.mark.thorough
@pytest.mark.parametrize("degrees", [0, 90])
def test_cantilever_is_the_beam_of_the_free_strip(degrees):
    """Along or across the fibres nothing twists; shear takes 0.3 % at 0 degrees (E1 / G13 = 24), next to none at 90."""
    E = CARBON.E1 if degrees == 0 else CARBON.E2
    beam = 1.8751**2 / (2 * math.pi) * math.sqrt(E * HEIGHT**2 / 12 / CARBON.density) / LENGTH**2
    assert rod([degrees], (24, 4), "left_edge", 1)[0][0] == pytest.approx(beam, rel=0.01)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("degrees", "reference"),
    [
        (0, [117.39, 575.31, 576.82, 720.40, 1813.98, 1953.88]),
        (45, [40.26, None, 250.94, 698.32, 789.48, None]),
        (30, [52.69, None, 326.32, 886.26, 921.03, None]),
    ],
)
def test_cantilever_agrees_with_an_independent_triangle(degrees, reference):
    """None: the reference's in-plane modes (constant-strain triangles) are 3 % from their own limit. On its own mesh."""
    result = rod([degrees], (96, 16), "left_edge", 6)[0]
    for f, other in zip(result, reference, strict=True):
        assert other is None or f == pytest.approx(other, rel=0.007)


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "most"), [("triangle", 0.03), ("quad", 0.045)])
@pytest.mark.parametrize("degrees", [[0], [45], [30], [45, -45, 45]])
def test_cantilever_frequencies_on_the_mesh_in_use(degrees, kind, most):
    """24 x 4 against 48 x 8 cells: six modes, the first within 1 %.

    n lumped masses across overrate the inertia of torsion by 1 + 2 / n^2, its frequency by -4.3 % from 4 to 8; triangles
    hide that behind their stiffness.
    """
    coarse, fine = (rod(degrees, cells, "left_edge", 6, kind)[0] for cells in ((24, 4), (48, 8)))
    np.testing.assert_allclose(coarse, fine, rtol=most)
    assert coarse[0] == pytest.approx(fine[0], rel=0.01)


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "times"), [("triangle", 3), ("quad", 2)])
def test_center_clamp_has_no_spurious_soft_mode(kind, times):
    """A penalty drilling spring would leave an in-plane spin at 15 Hz; here bending comes first, as it must.

    The spin about a point is that of a disk of the size of the cells around it: eight triangles or four quadrilaterals.
    """
    for degrees in ([45], [45, -45], [45, -45, 45]):
        f, modes = rod(degrees, (24, 4), "center", 8, kind)
        in_plane = (modes.reshape(-1, 6, 8)[:, :2] ** 2).sum((0, 1)) / (modes.reshape(-1, 6, 8)[:, :3] ** 2).sum((0, 1))
        assert in_plane[0] < 0.1
        assert f[in_plane > 0.5].min() > times * f[0]


@pytest.mark.thorough
def test_point_clamp_spin_falls_with_the_element_size():
    """The law of a point support in plane stress: frequency ~ size, because its spring is a ring of elements."""
    spin = []
    for cells in ((24, 4), (48, 8), (96, 16)):
        f, modes = rod([0], cells, "center", 4)
        u = modes.reshape(-1, 6, 4)
        spin.append(f[np.argmax((u[:, 1] ** 2).sum(0))])
    assert spin[1] / spin[0] == pytest.approx(0.5, abs=0.03)
    assert spin[2] / spin[1] == pytest.approx(0.5, abs=0.03)


@pytest.mark.thorough
def test_modes_with_a_center_at_rest_converge():
    """45 degrees: the symmetric bending of both halves, 155.3 Hz on every mesh."""
    coarse, fine = (rod([45], cells, "center", 3)[0] for cells in ((24, 4), (48, 8)))
    assert coarse[1] == pytest.approx(fine[1], rel=2e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("held", ["left_edge", "center"])
def test_derivatives_of_frequencies_by_every_angle(held):
    """Squared frequencies of an unsymmetric rod: psi' dK psi with the tangent of K, against differences."""
    degrees = [40, -30, 65]
    laminate = Laminate(CARBON, deg(degrees), HEIGHT / 3)
    plate = PlateMatrices(rectangle(LENGTH, WIDTH, (12, 2)), laminate)
    fixed = freedoms(plate.mesh.node_set(held))
    _, modes = frequencies(plate, laminate, fixed, 6)
    theta = laminate.angles.detach()

    def stiffness(angles):
        return plate.values(functional_call(laminate, {"angles": angles}, ()))

    for k, e in enumerate(torch.eye(3, dtype=torch.float64)):
        dK = plate.pattern.to_scipy(jvp(stiffness, (theta,), (e,))[1])
        exact = np.einsum("in,in->n", modes, dK @ modes)
        ends = [frequencies(plate, Laminate(CARBON, theta + s * e, HEIGHT / 3), fixed, 6)[0] for s in (1e-4, -1e-4)]
        difference = (2 * math.pi) ** 2 * (ends[0] ** 2 - ends[1] ** 2) / 2e-4
        np.testing.assert_allclose(
            exact, difference, rtol=1e-5, atol=1e-5 * abs(difference).max(), err_msg=f"angle {k}"
        )
