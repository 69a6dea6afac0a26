"""Flexible bodies: what the structure stage hands over, references, frames on nodes, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import laminate, plate
from tests.refused import ANY, refused


@pytest.mark.parametrize("reference", [None, "corner_left_top", "left_edge", 7, [3, 8]])
def test_modes_are_fixed_at_the_reference_and_normalized_to_the_mass(reference):
    body = plate("plate", modes=4, reference=reference)
    result = {name: x.detach() for name, x in body.structure().items()}
    psi, diagonal = (
        result["psi"],
        body.matrices.lumped_mass(body.laminate.mass_per_area, body.laminate.rotary_inertia_per_area),
    )
    assert not psi[body.reference].any()
    others = [i for i in range(len(body.mesh.nodes)) if i not in body.reference]
    assert psi[others].abs().amax((1, 2)).min() > 0
    flat, K = psi.flatten(0, 1), body.matrices.stiffness(body.laminate.entries().detach()).dense()
    assert_close(flat.T @ (diagonal[:, None] * flat), torch.eye(4, dtype=torch.float64), rtol=0, atol=1e-12)
    assert_close(flat.T @ K @ flat, result["Kr"], rtol=1e-10, atol=1e-10 * float(result["Kr"].max()))


def test_the_default_reference_is_the_node_nearest_to_the_center_of_mass():
    body = plate("plate")
    assert body.reference == [body.mesh.node("center")]
    assert_close(body.origin, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-15)


def test_the_mean_of_several_reference_nodes_is_the_origin():
    body = plate("plate", reference="left_edge")
    assert_close(body.origin, torch.tensor([-0.15, 0.0, 0.0], dtype=torch.float64))
    assert_close(body.at("right").point, torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64))


def test_mass_and_first_moment_are_those_of_the_plate():
    body = plate("plate", reference="corner_left_bottom")
    result = body.structure()
    mass = 1586.0 * 7.5e-3 * 0.3 * 0.1
    assert float(result["mass"]) == pytest.approx(mass, rel=1e-12)
    assert result["S0"].tolist() == pytest.approx([mass * 0.15, mass * 0.05, 0.0], rel=1e-12)


@pytest.mark.thorough
def test_the_structure_stage_runs_on_lanes():
    """A batch of designs is the loop over the designs: invariants and stiffness, up to rotations among the modes."""
    body = plate("plate", modes=3)
    angles = mbd.deg([[20.0, -50.0, 75.0], [0.0, 35.0, -80.0]])
    system = mbd.System([body])
    data = system.dynamics({"plate.laminate.angles": angles}).data
    for lane, own in enumerate(angles):
        single = mbd.System([plate("plate", modes=3, made_of=laminate(own * 180 / math.pi))]).dynamics().data
        for name in ("mass", "S0", "P0", "mu"):
            assert_close(data[name].expand(*data[name].shape[:-1], 2)[..., lane], single[name][..., 0].detach())
        values = [
            torch.linalg.eigvalsh(K) for K in (data["Kr"][:, :, 0, 0, lane], single["Kr"][:, :, 0, 0, 0].detach())
        ]
        assert_close(*values, rtol=1e-10, atol=0)


def test_bodies_that_share_a_laminate_share_its_angles():
    shared = laminate()
    system = mbd.System([plate("one", made_of=shared), plate("two", made_of=shared)])
    names = [name for name, x in system.named_parameters() if x.requires_grad]
    assert names == ["one.laminate.angles"]
    Kr = system.dynamics({"one.laminate.angles": mbd.deg([[1.0, 2.0, 3.0]])}).data["Kr"]
    assert_close(Kr[:, :, 0], Kr[:, :, 1])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"name": ""}, ("name", "", "name of the flexible body")),
        ({"modes": 0}, ("rod.modes", 0, "1 to 84")),
        ({"modes": 2.0}, ("rod.modes", 2.0, "1 to 84")),
        ({"modes": 85}, ("rod.modes", 85, "1 to 84")),
        ({"damping": -1.0}, ("rod.damping", -1.0)),
        ({"damping": math.nan}, ("rod.damping", math.nan)),
        ({"position": (0, 0, math.nan)}, ("rod.position", ANY, "nan")),
        ({"axes": [[1, 0, 0], [0, 2, 0], [0, 0, 1]]}, ("rod.axes", ANY, "orthonormal")),
        ({"reference": "lft"}, ("reference.node", "lft", "left", "Try: 'left'")),
        ({"reference": 15}, ("reference.node", 15, "0 to 14")),
        ({"reference": [1.5]}, ("reference.node", 1.5, "0 to 14")),
        ({"reference": []}, ("reference", [])),
        ({"rigid": 3}, ("rigid", 3)),
        ({"rigid": "left_edge"}, ("rigid", "left_edge")),
        ({"updated": "no"}, ("rod.updated", "no")),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_bad_input_is_named_with_its_value_and_what_is_allowed(given, said):
    with refused(*said):
        plate(**({"name": "rod"} | given))


def test_a_node_that_does_not_exist_is_named():
    body = plate("rod")
    with refused("node", "rigth", meant="right"):
        body.at("rigth")
    with refused("reference.node", "rigth", meant="right"):
        plate("rod", reference="rigth")
    for index in (-1, 15):
        with refused("node"):
            body.at(index)


@pytest.mark.parametrize("reduction", [{}, {"reduction": "craig-bampton", "interface": ["right"]}])
def test_as_many_designs_as_freedoms_are_no_dense_mass(reduction):
    """Masses [84, 84] of 84 designs with 84 freedoms were taken for one matrix, which is not symmetric."""
    body = plate("rod", **reduction)
    freedoms = 6 * (5 * 3 - 1)
    angles = body.laminate.angles.detach() + torch.linspace(0.0, 0.1, freedoms, dtype=torch.float64)[:, None]
    thickness = body.laminate.thickness.detach() * torch.linspace(1.0, 1.1, freedoms, dtype=torch.float64)[:, None]
    system = mbd.System([body], truncation=None)
    designs = {"rod.laminate.angles": angles, "rod.laminate.thickness": thickness}
    every = system.stages(designs)[0].data["Kr"]
    some = system.stages({name: x[5:7] for name, x in designs.items()})[0].data["Kr"]
    assert every.shape[-1] == freedoms
    assert_close(every[..., 5:7], some, rtol=1e-8, atol=1e-9 * float(some.abs().max()))
