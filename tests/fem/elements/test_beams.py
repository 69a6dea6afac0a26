"""Beams as parts of a body: mass of the assembly, several sections, offset and twist, section forces."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.beam_cases import coupled_section, twisted_flexibility
from torchmbd.errors import InputError
from torchmbd.fem import sections
from torchmbd.fem.elements import Assembly, BeamLine, Beams, GivenSection, PointMasses, RigidLink
from torchmbd.fem.sections import Orthotropic

LINE = BeamLine([[0, 0, 0], [0.2, 0.05, 0], [0.4, 0.2, 0.1], [0.5, 0.4, 0.3]])
ACROSS = (0.1, 0.2, 1.0)


def dense(x):
    return (torch.diag(x) if isinstance(x, torch.Tensor) else x.dense()).detach()


def test_mass_of_the_assembly_is_that_of_the_elements():
    section = coupled_section()
    beams = Beams(LINE, section, ACROSS)
    M = dense(Assembly(LINE, {"beam": beams}).mass())
    exact = torch.zeros(24, 24, dtype=torch.float64)
    matrices = beams.matrices
    for k, (axes, length) in enumerate(zip(matrices.axes, matrices.length, strict=True)):
        turn = torch.block_diag(axes, axes)
        for node in (k, k + 1):
            own = slice(6 * node, 6 * node + 6)
            exact[own, own] += turn.T @ section.mass() @ turn * length / 2
    d = exact.diagonal().rsqrt()
    assert float(((M - exact) * d[:, None] * d).abs().max()) < 1e-12


def test_consistent_mass_moves_rigidly_like_the_solid():
    """A rigid motion sees the same inertia by both masses, and that of a straight beam exactly (Simpson's rule)."""
    line, section = BeamLine.straight(0.9, 3), coupled_section()
    motion = torch.zeros(4, 6, 6, dtype=torch.float64)
    motion[:, :, :] = torch.eye(6, dtype=torch.float64)
    for k, x in enumerate(line.nodes[:, 0].tolist()):  # rotations about y and z move along z and y
        motion[k, 2, 4], motion[k, 1, 5] = -x, x
    M = dense(Assembly(line, {"b": Beams(line, section, mass="consistent")}).mass())
    flat = motion.flatten(0, 1)
    result, m, c = flat.T @ M @ flat, section.mass() * 0.9, section.mass()[0, 0]
    exact = m.clone()
    exact[4, 4] += c * 0.9**3 / 3
    exact[5, 5] += c * 0.9**3 / 3
    assert_close(result[[0, 4, 5], [0, 4, 5]], exact[[0, 4, 5], [0, 4, 5]], rtol=1e-12, atol=0)
    assert_close(result[3, 3], exact[3, 3], rtol=1e-12, atol=0)


def test_two_sections_on_halves_are_two_parts():
    one, two = coupled_section(), GivenSection.isotropic(70e9, 0.3, 2700.0, 1e-3, 1e-7, 2e-7, 2e-7)
    parts = {"a": Beams(LINE, one, ACROSS, elements=[0, 2]), "b": Beams(LINE, two, ACROSS, elements=[1])}
    both = dense(Assembly(LINE, parts).stiffness())
    mixed = torch.stack([one.stiffness(), two.stiffness(), one.stiffness()]).detach()
    assert_close(both, Beams(LINE, one, ACROSS).matrices.stiffness(mixed[:, None]).dense(), rtol=1e-12, atol=1e-6)


def test_offset_and_twist_are_a_rigid_arm():
    """A beam off the line equals one on a line of its own whose nodes are linked rigidly."""
    section, offset, twist = coupled_section(), (0.03, -0.02), 0.5
    off = Assembly(
        LINE.__class__.straight(0.8, 4), {"b": Beams(BeamLine.straight(0.8, 4), section, (0, 1, 0), offset, twist)}
    )
    nodes = BeamLine.straight(0.8, 4).nodes
    moved = nodes + torch.tensor([0.0, *offset], dtype=torch.float64)
    own = BeamLine(torch.cat([moved, nodes]), [*([k, k + 1] for k in range(9) if k != 4), [4, 9]])
    turned = Beams(own, section, (0.0, math.cos(twist), math.sin(twist)), elements=range(4))
    links = [RigidLink(k, k + 5) for k in range(5)]
    linked = Assembly(own, {"b": turned}, links=links)
    for here, there in ((off.stiffness(), linked.stiffness()), (off.mass(), linked.mass())):
        d = dense(here).diagonal().rsqrt()
        assert float(((dense(here) - dense(there)) * d[:, None] * d).abs().max()) < 1e-10


@pytest.mark.parametrize("twist", [0.0, 0.4, [0.1, -0.3, 0.5], [[0.0, 0.2], [0.2, 0.1], [0.1, 0.4]]])
@pytest.mark.parametrize("offset", [(0.01, 0.02), [[0.03, -0.02], [0.0, 0.01], [-0.02, 0.0]]])
def test_offsets_and_twists_of_single_elements(offset, twist):
    """All elements at once are the elements one by one."""
    section, line = coupled_section(), BeamLine.straight(0.6, 3)
    result = dense(Assembly(line, {"b": Beams(line, section, (0, 1, 0), offset, twist)}).stiffness())
    of_each = torch.as_tensor(offset).double().expand(3, 2), torch.as_tensor(twist).double()
    ways = of_each[1] if of_each[1].ndim else of_each[1].expand(3)
    parts = {
        f"b{k}": Beams(line, section, (0, 1, 0), of_each[0][k], ways if ways.ndim == 2 else ways[k], [k])
        for k in range(3)
    }
    assert_close(result, dense(Assembly(line, parts).stiffness()), rtol=1e-12, atol=1e-9 * float(result.abs().max()))


def test_section_forces_are_about_the_sections_axes():
    """A cantilever with offset and twist under a force at its tip."""
    section, offset, twist = coupled_section(), (0.03, -0.02), 0.5
    line = BeamLine.straight(0.8, 2)
    beams = Beams(line, section, (0, 1, 0), offset, twist)
    K = dense(Assembly(line, {"b": beams}, held=[0]).stiffness())
    load = torch.tensor([10.0, -20.0, 30.0, 1.0, 2.0, -3.0], dtype=torch.float64)
    u = torch.linalg.solve(K, torch.cat([torch.zeros(6, dtype=torch.float64), load]))
    motion = torch.cat([torch.zeros(6, dtype=torch.float64), u]).reshape(3, 6, 1)
    result = beams.section_forces(motion)[..., 0].detach()
    assert_close(result[1, 0], result[0, 1], rtol=0, atol=1e-6)
    c, s = math.cos(twist), math.sin(twist)
    R = torch.tensor([[1, 0, 0], [0, c, s], [0, -s, c]], dtype=torch.float64)
    for k, x in enumerate((0.4, 0.8)):
        arm = torch.tensor([0.8 - x, -offset[0], -offset[1]], dtype=torch.float64)
        moment = load[3:] + torch.linalg.cross(arm, load[:3])
        assert_close(result[k, 1], torch.cat([R @ load[:3], R @ moment]), rtol=0, atol=1e-6)


@pytest.mark.parametrize(("elements", "error"), [(1, 1e-9), (3, 1e-12)])
def test_a_twisted_coupled_cantilever_is_exact(elements, error):
    """Full 6 x 6, the section turned by 70 degrees along the beam: tip flexibility beside the integrated equations."""
    section, length, root, tip = coupled_section(), 1.3, -0.2, 1.0
    line = BeamLine.straight(length, elements)
    ends = torch.linspace(root, tip, elements + 1, dtype=torch.float64)
    beams = Beams(line, section, (0, 1, 0), twist=torch.stack([ends[:-1], ends[1:]], dim=1))
    K = dense(Assembly(line, {"b": beams}, held=[0]).stiffness())
    exact = torch.from_numpy(twisted_flexibility(section.stiffness().detach(), length, root, tip))
    d = exact.diagonal().rsqrt()
    result = torch.linalg.inv(K)[-6:, -6:]
    assert float(((result - exact) * d[:, None] * d).abs().max()) < error
    steps = Beams(line, section, (0, 1, 0), twist=(ends[:-1] + ends[1:]) / 2)
    coarse = torch.linalg.inv(dense(Assembly(line, {"b": steps}, held=[0]).stiffness()))[-6:, -6:]
    assert float(((coarse - exact) * d[:, None] * d).abs().max()) > 1e-3  # a polygon of prismatic elements is not


def test_a_twisted_beam_has_its_own_axes_at_both_ends():
    """Section forces at start and end in the axes there; its inertia turned likewise, an even twist that of one angle."""
    section, line = coupled_section(), BeamLine.straight(0.8, 1)
    beams = Beams(line, section, (0, 1, 0), twist=[[0.3, 1.1]])
    K = dense(Assembly(line, {"b": beams}, held=[0]).stiffness())
    load = torch.tensor([10.0, -20.0, 30.0, 1.0, 2.0, -3.0], dtype=torch.float64)
    u = torch.cat([torch.zeros(6, dtype=torch.float64), torch.linalg.solve(K, load)]).reshape(2, 6, 1)
    M = dense(Assembly(line, {"b": beams}).mass())
    for k, (x, angle) in enumerate(((0.0, 0.3), (0.8, 1.1))):
        c, s = math.cos(angle), math.sin(angle)
        R = torch.tensor([[1, 0, 0], [0, c, s], [0, -s, c]], dtype=torch.float64)
        moment = load[3:] + torch.linalg.cross(torch.tensor([0.8 - x, 0.0, 0.0], dtype=torch.float64), load[:3])
        result = beams.section_forces(u)[0, k, :, 0].detach()
        assert_close(result, torch.cat([R @ load[:3], R @ moment]), rtol=0, atol=1e-6)
        both, own = torch.block_diag(R, R), slice(6 * k, 6 * k + 6)
        assert_close(M[own, own], both.T @ section.mass() @ both * 0.4, rtol=0, atol=1e-12)
    even = dense(Assembly(line, {"b": Beams(line, section, twist=[[0.4, 0.4]])}).stiffness())
    one = dense(Assembly(line, {"b": Beams(line, section, twist=0.4)}).stiffness())
    assert_close(even, one, rtol=1e-9, atol=1e-9 * float(one.abs().max()))


def test_stresses_of_a_bent_beam():
    """From the motion of the nodes to the stress in the material: M z / I at the place of the moment."""
    line, b, h = BeamLine.straight(0.8, 4), 0.02, 0.03
    section = sections.rectangle(b, h, Orthotropic.isotropic(210e9, 0.3, 7850.0), cells=(4, 6))
    beams = Beams(line, section)
    K = dense(Assembly(line, {"b": beams}, held=[0]).stiffness())
    load = torch.zeros(24, dtype=torch.float64)
    load[-4] = 50.0
    u = torch.cat([torch.zeros(6, dtype=torch.float64), torch.linalg.solve(K, load)]).reshape(5, 6, 1)
    forces = beams.section_forces(u)[:, 1, :, 0]
    result = section.stress(forces)  # of the four elements' ends
    for k, x in enumerate((0.2, 0.4, 0.6, 0.8)):
        expected = -50.0 * (0.8 - x) * result.points[..., 1] / (b * h**3 / 12)
        assert_close(
            result.stress[k, ..., 0].detach(), expected, rtol=0, atol=1e-5 * 50 * 0.8 * h / 2 / (b * h**3 / 12)
        )


def test_a_mass_at_the_tip_joins_the_beam():
    line = BeamLine.straight(0.5, 6)
    section = GivenSection.isotropic(70e9, 0.3, 2700.0, 1e-4, 1e-9, 1e-9, 2e-9)
    parts = {"beam": Beams(line, section), "tip": PointMasses(line, [6], [0.4], [1e-5])}  # pyright: ignore[reportArgumentType]
    body = mbd.FlexibleBody("arm", line, parts, 2, reference="start")
    result = body.structure()
    assert float(result["mass"]) == pytest.approx(0.4 + 2700.0 * 1e-4 * 0.5, rel=1e-12)
    first = math.sqrt(3 * 70e9 * 1e-9 / (0.5**3 * (0.4 + 33 / 140 * 0.135)))
    assert math.sqrt(float(result["Kr"][0, 0])) == pytest.approx(first, rel=2e-3)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"section": "steel"}, ["section = 'steel'", "a Section or a GivenSection"]),
        ({"offset": [[0.0, 0.1]] * 2}, ["offset has shape (2, 2)", "[3, 2]"]),
        ({"twist": [0.1, 0.2]}, ["twist has shape (2,)", "[3]", "[3, 2]"]),
        ({"twist": 45.0}, ["twist = ", "2 pi"]),
        ({"mass": "lumpd"}, ["mass = 'lumpd'", "Try: 'lumped'"]),
        ({"orientation": [[0.0, 1.0, 0.0]] * 2}, ["orientation has shape (2, 3)"]),
    ],
)
def test_bad_beams_are_named(given, words):
    with pytest.raises(InputError) as error:
        Beams(LINE, **({"section": coupled_section()} | given))
    for word in words:
        assert word in str(error.value)
