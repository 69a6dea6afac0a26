"""Thicknesses and moduli as design variables: exact derivatives, and the elements of the present design, not of the first."""

import pytest
import torch
from torch.func import functional_call, jacfwd, jacrev, vmap
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON, irregular
from torchmbd.fem.elements import Plates
from torchmbd.fem.elements.plate import ply_basis

ANGLES, HEIGHT = mbd.deg([20, -50, 75]), 2.5e-3
PARTS = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
FOAM = mbd.Ply(E1=70e6, E2=70e6, G12=26e6, G13=26e6, G23=26e6, nu12=0.3, density=60.0)


def arched(kind: str) -> mbd.Mesh:
    """A part of a cylinder, as drilling freedoms are softened there by the thickness; slanted cells."""
    flat = mbd.mesh.rectangle(length=0.3, width=0.1, cells=(6, 2), kind=kind)
    x, y, _ = flat.nodes.unbind(1)
    nodes = torch.stack([x + 0.2 * y, 0.2 * torch.sin(y / 0.2), 0.2 * torch.cos(y / 0.2)], 1)
    return mbd.Mesh(nodes, triangles=flat.triangles, quads=flat.quads, node_sets=flat.node_sets)


MESHES = {
    "quads": lambda: irregular(0.304, 0.08, (12, 4)),
    "arched quads": lambda: arched("quad"),
    "arched triangles": lambda: arched("triangle"),
}


class Frequencies(torch.nn.Module):
    """Eigenvalues of the reduced stiffness [1/s2] of a cantilever, unbalanced, on an irregular mesh."""

    body: mbd.FlexibleBody

    def __init__(self, thickness: torch.Tensor, mesh: str = "quads", core: mbd.Ply = CARBON, **options):
        super().__init__()
        laminate = mbd.Laminate([CARBON, core, CARBON], ANGLES, thickness, **options)
        self.body = mbd.FlexibleBody.plate("plate", MESHES[mesh](), laminate, modes=5, reference="left_edge")

    def forward(self):
        return torch.linalg.eigvalsh(self.body.structure()["Kr"])

    def at(self, thickness):
        return functional_call(self, {"body.laminate.thickness": thickness})


@pytest.mark.thorough
@pytest.mark.parametrize("mesh", MESHES)
def test_derivative_by_every_thickness_against_differences(mesh):
    """Through stiffness, mass, modes and the constants of the elements; in every mode and of lanes."""
    given = Frequencies(PARTS * HEIGHT, mesh)
    h = PARTS * HEIGHT
    exact = jacfwd(given.at)(h)
    for k, e in enumerate(torch.eye(3, dtype=torch.float64) * 1e-4 * HEIGHT):
        near, far = given.at(h + e) - given.at(h - e), given.at(h + 2 * e) - given.at(h - 2 * e)
        rough = ((8 * near - far) / (12e-4 * HEIGHT)).detach()
        assert_close(exact[:, k], rough, rtol=1e-6, atol=0)
    assert_close(jacrev(given.at)(h), exact, rtol=1e-8, atol=0)
    both = torch.stack([h, 1.3 * h])
    assert_close(vmap(jacfwd(given.at))(both)[0, -len(exact) :], exact, rtol=1e-8, atol=0)
    for lane, x in zip(given.at(both), both, strict=True):
        alone = given.at(x)
        assert_close(lane[-len(alone) :], alone, rtol=1e-9, atol=0)  # those of padding are 0 and come first


@pytest.mark.parametrize("mesh", MESHES)
@pytest.mark.parametrize("options", [{}, {"symmetric": True}, {"shear_correction": 5.0 / 6.0, "offset": 1e-3}])
@pytest.mark.parametrize("core", [CARBON, FOAM])
def test_a_design_is_a_body_made_anew(mesh, options, core):
    """Frequencies, ply stresses and geometric stiffness."""
    if mesh != "quads" and options:
        pytest.skip("laminates of one mesh are enough")
    start, end = (torch.tensor(x, dtype=torch.float64) for x in ([5e-4, 1e-3, 4e-4], [3e-4, 1.5e-2, 6e-4]))
    given, anew = (Frequencies(x, mesh, core, **options) for x in (start, end))
    assert_close(given.at(end), anew(), rtol=1e-9, atol=0)
    given.load_state_dict(anew.state_dict())
    psi = anew.body.structure()["psi"].detach()
    for f in (
        lambda body: ply_basis(body.matrices, body.plates["plate"].laminate, psi).stress,
        lambda body: body.plates["plate"].stressed(psi)[0].law,
    ):
        assert_close(f(given.body), f(anew.body), rtol=1e-9, atol=1e-9 * float(f(anew.body).detach().abs().max()))


@pytest.mark.thorough
def test_moduli_that_move():
    """A core whose shear moduli fall to a tenth."""

    def body(G: float) -> mbd.FlexibleBody:
        G13, G23 = mbd.variable(G), mbd.variable(G)
        core = mbd.Ply(E1=70e6, E2=70e6, G12=26e6, G13=G13, G23=G23, nu12=0.3, density=60.0)
        laminate = mbd.Laminate([CARBON, core, CARBON], ANGLES, [5e-4, 1e-2, 5e-4])
        return mbd.FlexibleBody.plate("plate", MESHES["quads"](), laminate, modes=3, reference="left_edge")

    given, anew = body(26e6), body(2.6e6)
    given.load_state_dict(anew.state_dict())
    result, expected = (torch.linalg.eigvalsh(b.structure()["Kr"]).detach() for b in (given, anew))
    assert_close(result, expected, rtol=1e-9, atol=0)


@pytest.mark.thorough
def test_zones_that_were_equal_at_the_start_move_apart():
    """Parts of one body are joined where their plies are equal; each keeps the elements of its own thickness."""
    mesh = MESHES["quads"]()
    cells = torch.arange(mesh.cell_count)

    def body(*core: float) -> mbd.FlexibleBody:
        parts = {
            name: Plates(mesh, mbd.Laminate([CARBON, FOAM, CARBON], ANGLES, [5e-4, t, 5e-4]), cells=own)
            for name, t, own in zip(("root", "tip"), core, cells.chunk(2), strict=True)
        }
        return mbd.FlexibleBody("plate", mesh, parts, modes=3, reference="left_edge")

    given, anew = body(1e-3, 1e-3), body(1.5e-2, 4e-3)
    given.load_state_dict(anew.state_dict())
    result, expected = (torch.linalg.eigvalsh(b.structure()["Kr"]).detach() for b in (given, anew))
    assert_close(result, expected, rtol=1e-9, atol=0)


@pytest.mark.extensions
@pytest.mark.parametrize("varies", [False, True])
@pytest.mark.parametrize("kind", ["steered", "lamination parameters"])
def test_fields_and_lamination_parameters(kind, varies):
    """Thick ones out of thin ones; the thickness is one for all cells, or that of each control."""
    mesh = mbd.mesh.rectangle(0.3, 0.1, cells=(6, 2))
    field = mbd.fibers.FiberField(mesh, controls=(3, 1))
    shape = torch.tensor([1.0, 1.5, 2.0] if varies else [1.0], dtype=torch.float64)

    def body(h: float) -> mbd.FlexibleBody:
        t = h * shape if varies else h * shape[0]
        if kind == "steered":
            layers = torch.stack([t, t], -1) if varies else t.expand(2)
            laminate = mbd.fibers.SteeredLaminate(CARBON, mbd.deg([30.0, -40.0]), layers, field)
        else:
            laminate = mbd.lamination.LaminationParameters(CARBON, t, [0.2, 0.1, -0.1, 0.0], field=field)
        return mbd.FlexibleBody.plate("plate", mesh, laminate, modes=3, reference="left_edge")

    given, anew = body(5e-4), body(8e-3)
    given.load_state_dict(anew.state_dict())
    result, expected = (torch.linalg.eigvalsh(b.structure()["Kr"]).detach() for b in (given, anew))
    assert_close(result, expected, rtol=1e-9, atol=0)
