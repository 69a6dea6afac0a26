"""Parts make a body: zones add up, masses are those of the plates, consistent mass converges from above, links are rigid."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON, GENERAL, irregular, rotation, turned
from tests.refused import refused
from tests.validation.navier import Navier
from tests.validation.simply_supported import supports
from torchmbd.errors import InputError
from torchmbd.fem.elements import Assembly, Plates, PointMasses, RigidLink, merge_plates
from torchmbd.fem.materials import Laminate
from torchmbd.fem.reduction import eigenpairs
from torchmbd.math.angles import deg

MESH = turned(irregular(0.4, 0.3, (4, 3)), rotation(2))
HALVES = torch.arange(len(MESH.triangles)).split([9, len(MESH.triangles) - 9])


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_zones_of_one_laminate_are_the_whole(mass):
    direction = rotation(2)[:, 0]
    whole = Assembly(MESH, {"plate": Plates(MESH, GENERAL, direction, mass=mass)}, held=[3])
    zones = {f"zone{k}": Plates(MESH, GENERAL, direction, part, mass) for k, part in enumerate(HALVES)}
    parts = Assembly(MESH, zones, held=[3])
    K = whole.stiffness().dense().detach()
    assert_close(parts.stiffness().dense().detach(), K, rtol=1e-11, atol=1e-12 * float(K.max()))
    one, other = (x if isinstance(x, torch.Tensor) else x.dense() for x in (whole.mass(), parts.mass()))
    assert_close(one, other, rtol=1e-12, atol=1e-18)


def test_consistent_mass_is_that_of_linear_shape_functions():
    """Area / 12 (1 + delta_ij) of each triangle, in every freedom; a rigid translation sees the whole mass."""
    assembly = Assembly(MESH, {"plate": Plates(MESH, GENERAL, mass="consistent")})
    M = assembly.mass().dense().detach()
    n = len(MESH.nodes)
    expected = torch.zeros(n, n, dtype=torch.float64)
    for corners, area in zip(MESH.triangles.tolist(), MESH.areas.tolist(), strict=True):
        for i in corners:
            for j in corners:
                expected[i, j] += area / 12 * (2 if i == j else 1)
    m, mu = float(GENERAL.mass_per_area), float(GENERAL.rotary_inertia_per_area)
    six = torch.tensor([m, m, m, mu, mu, mu], dtype=torch.float64)
    assert_close(M, torch.kron(expected, torch.diag(six)), rtol=1e-12, atol=1e-18)


def test_invariants_of_a_consistent_mass_are_its_quadratic_forms():
    """S1, C1, P0 of the body against M times rigid and modal fields."""
    mesh = mbd.mesh.rectangle(0.3, 0.1, (4, 2))
    body = mbd.FlexibleBody.plate("rod", mesh, GENERAL, modes=3, mass="consistent")
    result = {key: x.detach() for key, x in body.structure().items()}
    n = len(mesh.nodes)
    M = Assembly(mesh, {"plate": Plates(mesh, GENERAL, mass="consistent")}).mass().dense().detach()
    psi = result["psi"].flatten(0, 1)
    for i in range(3):
        shift = torch.zeros(n, 6, dtype=torch.float64)
        shift[:, i] = 1.0
        assert_close(shift.flatten() @ M @ psi, result["S1"][i], rtol=1e-9, atol=1e-12)
    x = torch.zeros(n, 6, dtype=torch.float64)
    x[:, :3] = mesh.nodes - body.origin
    assert_close(x.flatten() @ M @ x.flatten(), result["P0"].trace(), rtol=1e-10, atol=0)
    assert_close(psi.T @ M @ psi, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-9)
    kinetic = result["C1"].diagonal(dim1=0, dim2=1).sum(-1) + result["R2"].diagonal(dim1=0, dim2=1).sum(-1)
    assert_close(kinetic, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "closer"), [("triangle", 0.1), ("quad", 0.25)])
def test_frequencies_of_both_masses_converge_to_the_series(kind, closer):
    """0/90/90/0, simply supported: consistent from above and of second order, lumped closer at every mesh."""
    laminate = Laminate(CARBON, deg([0, 90]), 5e-3, symmetric=True)
    exact = Navier(laminate, 0.5, 0.4).frequencies(2)

    def errors(n, mass):
        mesh = mbd.mesh.rectangle(0.5, 0.4, (n, n), kind)
        assembly = Assembly(mesh, {"plate": Plates(mesh, laminate, mass=mass)})
        free = np.setdiff1d(np.arange(6 * len(mesh.nodes)), supports(mesh, "SS-1"))
        M = assembly.mass()
        M = M[free] if isinstance(M, torch.Tensor) else M.restrict(free)
        values = eigenpairs(assembly.stiffness().restrict(free), M, 2).values.detach().numpy()
        return np.sqrt(values) / (2 * math.pi) / exact - 1

    coarse, fine = errors(12, "consistent"), errors(24, "consistent")
    assert (fine > 0).all()
    np.testing.assert_allclose(np.log2(coarse / fine), 2.0, atol=0.1)
    assert fine.max() < 0.02
    assert np.abs(errors(24, "lumped")).max() < closer * fine.max()


def test_a_rigid_patch_and_a_point_mass():
    """A cantilever with a rigid end that carries a mass: the end moves rigidly, and the first frequency is Rayleigh's."""
    mesh = mbd.mesh.rectangle(0.4, 0.05, (8, 2))
    laminate = Laminate(CARBON, deg([0, 90]), 2e-3, symmetric=True)
    tip = mesh.node("right")
    links = [RigidLink(k, tip) for k in mesh.node_set("right_edge") if k != tip]
    parts = {"plate": Plates(mesh, laminate), "mass": PointMasses(mesh, [tip], [0.7], [1e-4])}
    body = mbd.FlexibleBody("arm", mesh, parts, 2, reference="left_edge", links=links)
    result = {key: x.detach() for key, x in body.structure().items()}
    psi = result["psi"]
    for link in links:
        d = mesh.nodes[link.node] - mesh.nodes[tip]
        turn = torch.linalg.cross(psi[tip, 3:], d[:, None].expand(3, 2), dim=0)
        assert_close(psi[link.node, :3], psi[tip, :3] + turn, rtol=1e-10, atol=1e-10)
        assert_close(psi[link.node, 3:], psi[tip, 3:])
    EI = 1.0 / torch.linalg.inv(laminate.stiffness().D.detach())[0, 0] * 0.05
    m = float(laminate.mass_per_area.detach()) * 0.05 * 0.4
    first = math.sqrt(3 * float(EI) / ((0.7 + 33 / 140 * m) * 0.4**3))  # tip mass and Rayleigh's share of the beam
    assert math.sqrt(float(result["Kr"][0, 0])) == pytest.approx(first, rel=0.01)
    assert float(result["mass"]) == pytest.approx(0.7 + m, rel=1e-12)
    assert [name for name, _ in body.named_parameters()] == ["laminate.angles", "laminate.thickness"]


def test_names_of_several_laminates():
    one, two = (Laminate(CARBON, deg([a, -a]), 1e-3) for a in (20, 50))
    parts = {"skin": Plates(MESH, one, cells=HALVES[0]), "rib": Plates(MESH, two, cells=HALVES[1])}
    body = mbd.FlexibleBody("box", MESH, parts, 2)
    assert [name for name, x in body.named_parameters() if x.requires_grad] == ["skin.angles", "rib.angles"]
    with refused("box"):
        _ = body.matrices
    with refused("box.parts.mesh"):
        mbd.FlexibleBody("box", MESH, {"mesh": parts["skin"], "rib": parts["rib"]}, 2)
    with pytest.raises(InputError) as error:
        Plates(MESH, one, mass="lumpt")
    assert (error.value.path, error.value.value) == (("mass",), "lumpt")
    assert "lumped" in error.value.allowed


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_laminates_of_one_kind_are_one_part(mass):
    """Stiffness, mass and their slopes by all angles and thicknesses, of laminates along directions of their own."""
    plies = [CARBON, mbd.Ply.isotropic(70e9, 0.3, 2700.0)]
    laminates = [Laminate(plies, deg(angles), [2e-3, 1e-3]) for angles in ([10, 50], [-70, 30], [25, 0])]
    chosen = torch.arange(len(MESH.triangles)).split([5, 9, len(MESH.triangles) - 14])
    parts = {
        f"zone{k}": Plates(MESH, laminate, rotation(2)[:, 0] + 0.1 * k, cells, mass)
        for k, (laminate, cells) in enumerate(zip(laminates, chosen, strict=True))
    }
    parts["thick"] = Plates(MESH, GENERAL, cells=[2], mass=mass)
    joined = merge_plates(parts)
    assert list(joined) == ["zone0", "thick"]
    variables = [x for laminate in laminates for x in laminate.parameters()]
    for x in variables:
        x.requires_grad_()
    result = []
    for some in (parts, joined):
        assembly = Assembly(MESH, some, held=[3])
        K, M = assembly.stiffness().dense(), assembly.mass().dense()
        weight = torch.linspace(-1.0, 1.0, K.numel(), dtype=torch.float64).reshape(K.shape)
        slopes = [torch.autograd.grad((weight * X).sum() / X.max(), variables, allow_unused=True) for X in (K, M)]
        result.append((K, M, *(torch.zeros(1) if x is None else x for both in slopes for x in both)))
    for one, other in zip(*result, strict=True):
        assert_close(one, other, rtol=1e-11, atol=1e-12 * float(one.detach().abs().max()))


def test_laminates_on_one_cell_stay_apart():
    parts = {name: Plates(MESH, GENERAL, cells=cells) for name, cells in (("one", [0, 1]), ("other", [1, 2]))}
    assert merge_plates(parts) == parts


ISOTROPIC = mbd.Ply.isotropic(70e9, 0.3, 2700.0)
STACK = {"ply": [CARBON, ISOTROPIC], "thickness": [2e-3, 1e-3], "symmetric": True}
UNLIKE = {
    "offset": {"offset": 1e-3},
    "thickness": {"thickness": [1e-3, 2e-3]},
    "symmetry": {"symmetric": False},
    "plies": {"ply": [ISOTROPIC, CARBON]},
    "shear": {"shear_correction": 5.0 / 6.0},
    "mass": {"mass": "consistent"},
}


@pytest.mark.parametrize("unlike", UNLIKE)
def test_laminates_that_differ_in_more_than_angles_stay_apart(unlike):
    parts = {}
    for name, cells, other in (("one", HALVES[0], {}), ("other", HALVES[1], UNLIKE[unlike])):
        own = STACK | other
        mass = own.pop("mass", "lumped")
        parts[name] = Plates(MESH, Laminate(angles=deg([10, 50]), **own), cells=cells, mass=mass)
    assert merge_plates(parts) == parts
    alike = {name: Plates(MESH, Laminate(angles=deg([10, 50]), **STACK), cells=parts[name].cells) for name in parts}
    assert list(merge_plates(alike)) == ["one"]
