"""Interfaces of several nodes in a Craig-Bampton reduction: averaged (RBE3) and rigid (RBE2)."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor
from tests.refused import ANY, refused

STEEL = mbd.Ply.isotropic(E=2.1e11, nu=0.3, density=7800.0)
LENGTH, WIDTH, THICKNESS = 0.5, 0.05, 2e-3
ROOT_AND_TIP = {"root": "left_edge", "tip": "right_edge"}


def plate(cells=(6, 4), modes=0, interface=None, laminate=None, **options) -> mbd.FlexibleBody:
    mesh = mbd.mesh.rectangle(length=LENGTH, width=WIDTH, cells=cells)
    laminate = mbd.Laminate(STEEL, [0.0], thickness=THICKNESS) if laminate is None else laminate
    options = {"reduction": "craig-bampton", "reference": "center"} | options
    if options["reduction"] == "craig-bampton":
        options["interface"] = ROOT_AND_TIP if interface is None else interface
    return mbd.FlexibleBody.plate("plate", mesh, laminate, modes=modes, **options)


def sag(body: mbd.FlexibleBody, root="left_edge", tip="right_edge") -> torch.Tensor:
    """Deflection under a unit force at the tip, the root clamped: twice the strain energy."""
    frames = mbd.Ground().at(-LENGTH / 2, 0, 0), body.at(root)
    system = mbd.System([body], [mbd.Fixed(*frames)], [mbd.Force(body.at(tip), (0.0, 0.0, 1.0))])
    return 2.0 * mbd.StrainEnergy("plate")(mbd.equilibrium(system)).squeeze()


@pytest.mark.thorough
def test_six_freedoms_for_each_interface():
    assert plate(modes=5).modes == 2 * 6 + 5
    assert plate(modes=5, interface=[mbd.Interface("left_edge"), mbd.Interface("right_edge", rigid=True)]).modes == 17
    assert plate(modes=0, interface="left_edge").modes == 5 * 6  # each node by itself, as ever


def left_out(body: mbd.FlexibleBody) -> float:
    """The share of the static flexibility at both edges that the modes leave out (diagnosis/truncation.py)."""
    frames = mbd.Ground().at(-LENGTH / 2, 0, 0), body.at("left_edge")
    tool = mbd.RigidBody("tool", 0.5, (1e-3, 1e-3, 1e-3))
    joints = [mbd.Fixed(*frames), mbd.Fixed(body.at("right_edge"), tool.at())]
    system = mbd.System([body, tool], joints, [mbd.Force(body.at("right_edge"), (0.0, 0.0, 1.0))])
    result = mbd.static_truncation(system)
    assert result is not None
    return result.share


@pytest.mark.thorough
@pytest.mark.parametrize("modes", [0, 2])
def test_statics_under_loads_on_averaged_interfaces_are_exact(modes):
    """Against K^-1 of the mesh without the interfaces' freedoms."""
    assert abs(left_out(plate(modes=modes))) < 1e-7
    assert left_out(plate(modes=2, reduction="vibration")) > 0.1


@pytest.mark.thorough
def test_a_cantilever_in_closed_form():
    """F l^3 / 3 E I of a narrow plate, nu = 0: the root turns as its mean."""
    ply = mbd.Ply.isotropic(E=2.1e11, nu=0.0, density=7800.0)
    laminate = mbd.Laminate(ply, [0.0], thickness=THICKNESS)
    exact = LENGTH**3 / (3.0 * 2.1e11 * WIDTH * THICKNESS**3 / 12.0)
    weights = [1.0, 2.0, 1.0]  # lengths of the edge
    ends = {name: mbd.Interface(edge, weights=weights) for name, edge in ROOT_AND_TIP.items()}
    body = plate(cells=(24, 2), laminate=laminate, interface=ends)
    assert float(sag(body, "root", "tip")) == pytest.approx(exact, rel=1e-3)


@pytest.mark.thorough
def test_rigid_is_stiffer_than_averaged():
    """Poisson's contraction is held at a rigid edge. A set that the body has as rigid says the same by its first node."""
    rigid = {name: mbd.Interface(edge, rigid=True) for name, edge in ROOT_AND_TIP.items()}
    soft, stiff = (float(sag(plate(interface=x))) for x in (ROOT_AND_TIP, rigid))
    assert 0.9 * soft < stiff < 0.9999 * soft
    body = plate(interface=rigid)
    leaders = [min(body.mesh.node_set(edge)) for edge in ROOT_AND_TIP.values()]
    same = plate(interface=leaders, rigid=list(ROOT_AND_TIP.values()))
    assert float(sag(same)) == pytest.approx(stiff, rel=1e-9)
    assert abs(left_out(body)) < 1e-7


def test_names_are_frames():
    body = plate(interface={"hinge": mbd.Interface("left_edge", weights=[1, 2, 3, 2, 1]), "tip": "right_edge"})
    assert body.at("hinge").interpolation == body.at("left_edge", weights=[1, 2, 3, 2, 1]).interpolation
    assert body.at("tip").interpolation == body.at("right_edge").interpolation
    psi = body.structure()["psi"]
    y = body.at("hinge").interpolation.motion(body.places(), psi.detach())
    assert torch.linalg.matrix_rank(y) == 6  # a freedom of the reduced body each


@pytest.mark.thorough
def test_fixed_interface_modes_hold_the_mean_motion():
    """More of them bring frequencies to those of the mesh from above; the interface keeps six shapes."""

    def squares(**options) -> torch.Tensor:
        return torch.linalg.eigvalsh(plate(cells=(8, 2), **options).structure()["Kr"].detach())[:6]

    exact = squares(reduction="vibration", modes=6)
    off = [squares(modes=n) / exact - 1.0 for n in (0, 4, 8, 12)]
    assert all(float(x.min()) > -1e-6 for x in off)
    assert float(off[0].max()) > float(off[1].max()) > float(off[2].max()) > float(off[3].max())
    assert float(off[3].max()) < 1e-3


@pytest.mark.thorough
def test_gradients_are_those_of_differences():
    thickness = tensor(1e-3, 1.5e-3)

    def deflection(x: torch.Tensor) -> torch.Tensor:
        laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([30.0, -50.0]), thickness=1e-3)
        body = plate(cells=(4, 2), modes=2, laminate=laminate)
        frames = mbd.Ground().at(-LENGTH / 2, 0, 0), body.at("root")
        system = mbd.System([body], [mbd.Fixed(*frames)], [mbd.Force(body.at("tip"), (0.0, 0.0, 1.0))])
        rest = mbd.equilibrium(system, designs={"plate.laminate.thickness": x[None]})
        return mbd.StrainEnergy("plate")(rest).squeeze()

    x = thickness.clone().requires_grad_()
    [slope] = torch.autograd.grad(deflection(x), x)
    for i in range(2):
        h = torch.zeros(2, dtype=torch.float64)
        h[i] = 1e-4 * thickness[i]
        with torch.no_grad():
            d = [
                float((deflection(thickness + k * h) - deflection(thickness - k * h)) / (2 * k * h[i])) for k in (1, 2)
            ]
        assert_close(float(slope[i]), (4.0 * d[0] - d[1]) / 3.0, rtol=1e-6, atol=0.0)


def test_edges_of_a_mesh():
    mesh = mbd.mesh.rectangle(length=LENGTH, width=WIDTH, cells=(4, 2))
    left = float(mesh.nodes[:, 0].min())
    assert mesh.edge(x=left) == tuple(sorted(mesh.node_set("left_edge")))
    assert len(mesh.edge()) == 2 * (4 + 2)
    with refused("edge"):
        mesh.edge(x=9.0)


@pytest.mark.parametrize(
    ("interface", "path"),
    [
        ({"a": ["left", "center"]}, "means.17"),
        ({"a": "left_edge", "b": ["left", "right"]}, "means.2"),
        ({"a": mbd.Interface(["left", "left"])}, "plate.interface"),
        ({"left_edge": "right_edge"}, "plate.interface"),
        ({3: "left_edge"}, "plate.interface"),
        ({"a": "nowhere"}, "node"),
    ],
)
def test_wrong_interfaces_are_refused(interface, path):
    with refused(path):
        plate(interface=interface)


def test_wrong_options_are_refused():
    with refused("rigid", 1):
        mbd.Interface("left_edge", rigid=1)
    with refused("weights"):
        mbd.Interface("left_edge", rigid=True, weights=[1.0])
    body = plate()
    with refused("plate.interface", ANY, "'vibration'"):
        mbd.FlexibleBody.plate("plate", body.mesh, body.laminate, modes=2, interface=ROOT_AND_TIP)
