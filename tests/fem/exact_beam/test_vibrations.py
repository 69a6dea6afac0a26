"""Frequencies of exact beams: closed forms, rotors, loaded beams, derivatives, and the rotating beams of Epps and Chandra.

J. Epps, R. Chandra, Smart Mater. Struct. 5 (1996): measured, as D. H. Hodges, X. Shang, C. E. S. Cesnik (1996) and GXBeam's
documentation have them.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.fem.exact_beam.cases import coupled, given, matrix
from tests.refused import refused
from torchmbd.fem.exact_beam import vibrations

INCH, E, NU, RHO = 0.0254, 73.1e9, 0.325, 2682.3  # E = 1.06e7 psi, 2.51e-4 lb s2 / in4
SLIM = matrix(1.0, 1.0, 1.0, 2e-6, 1e-6, 1e-6)


def blade(sweep: float, elements: int = 1) -> tuple[mbd.ExactBeam, tuple[float, float, float]]:
    """31.5 and 6 inches of a strip of 1 x 0.063 inches, 2.5 inches from the axis; the tip is swept back."""
    b, h = INCH, 0.063 * INCH
    section = mbd.GivenSection.isotropic(
        E, NU, RHO, b * h, b * h**3 / 12, h * b**3 / 12, b * h**3 / 3 * (1 - 0.63 * h / b), 1 / 1.2, 1 / 14.6
    )
    inner = torch.linspace(0.0, 31.5 * INCH, 11 * elements + 1, dtype=torch.float64)[:, None] * torch.tensor(
        [1.0, 0.0, 0.0]
    )
    way = torch.tensor([math.cos(sweep), -math.sin(sweep), 0.0], dtype=torch.float64)
    outer = inner[-1] + torch.linspace(0.0, 6.0 * INCH, 3 * elements + 1, dtype=torch.float64)[1:, None] * way
    line = mbd.BeamLine(torch.cat([inner, outer]))
    return mbd.ExactBeam("blade", line, section), (-2.5 * INCH, 0.0, 0.0)


@pytest.mark.parametrize(
    ("rpm", "wanted"), [(0.0, [1.4, 10.3, 27.7]), (500.0, [10.2, 25.2, 47.0]), (750.0, [14.8, 36.1, 62.9])]
)
def test_rotating_straight_beam_of_epps_and_chandra(rpm, wanted):
    """Flapping modes against measurements, which are up to 10 % from the beam of these data: at rest, 1.487, 9.32, 26.1 Hz in
    closed form."""
    beam, center = blade(0.0)
    result, state = beam.frequencies(6, spin=(0.0, 0.0, rpm * math.pi / 30.0), center=center)
    assert state.status == "ok"
    for frequency in wanted:
        assert float(((result - frequency) / frequency).abs().min()) < 0.1, result.tolist()


@pytest.mark.parametrize(("rpm", "wanted"), [(0.0, [1.6, 10.4, 24.8]), (750.0, [14.7, 26.1, 44.8])])
def test_rotating_swept_beam_of_epps_and_chandra(rpm, wanted):
    beam, center = blade(math.pi / 4.0)
    result, state = beam.frequencies(6, spin=(0.0, 0.0, rpm * math.pi / 30.0), center=center)
    assert state.status == "ok"
    for frequency in wanted:
        assert float(((result - frequency) / frequency).abs().min()) < 0.09, result.tolist()


def rod(elements: int = 16, K: Tensor | None = None) -> mbd.ExactBeam:
    section = given(1e4, 1e4, 1e4, 1.0, 1.0, 2.0, mass=SLIM) if K is None else mbd.GivenSection(K, SLIM)
    return mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, elements), section)


@pytest.mark.thorough
def test_cantilever_at_rest():
    """3.516 sqrt(E I / (m L^4)) in two planes, of second order in the elements' length."""
    result = [2.0 * math.pi * rod(n).frequencies(2)[0] for n in (10, 20, 40)]
    assert result[2].tolist() == pytest.approx([3.5160, 3.5160 * 2.0**0.5], rel=1e-3)
    first = [w[0].item() for w in result]
    assert (first[1] - first[0]) / (first[2] - first[1]) == pytest.approx(4.0, rel=0.1)


@pytest.mark.thorough
@pytest.mark.parametrize(("spin", "wanted"), [(4.0, [5.5850, 24.2734]), (12.0, [13.1702, 37.6031])])
def test_flapping_of_a_rotating_cantilever(spin, wanted):
    """A. D. Wright et al., J. Appl. Mech. 49 (1982), spin and frequencies in sqrt(E I / (m L^4)); lagging: w^2 - spin^2."""
    section = given(1e6, 1e6, 1e6, 1e3, 1.0, 1.0, mass=1e-3 * SLIM + 0.999 * matrix(1.0, 1.0, 1.0, 2e-8, 1e-8, 1e-8))
    beam = mbd.ExactBeam("rotor", mbd.BeamLine.straight(1.0, 40), section)
    result = 2.0 * math.pi * beam.frequencies(4, spin=(0.0, 0.0, spin))[0]
    for w in (*wanted, math.sqrt(wanted[0] ** 2 - spin**2)):
        assert float((result / w - 1.0).abs().min()) < 3e-3, result.tolist()


@pytest.mark.thorough
def test_tension_and_compression():
    """A hinged beam: w^2 = (pi / L)^4 E I / m (1 + N / N_cr)."""
    hinged = {"start": "u1 u2 u3 phi1 phi3", "end": "u2 u3 phi1 phi3"}
    euler = math.pi**2
    for load in (-0.6, 0.0, 2.0):
        result, _ = rod(24).frequencies(1, {"end": (load * euler, 0.0, 0.0)}, supports=hinged)
        assert (2.0 * math.pi * result[0]).item() == pytest.approx(math.pi**2 * math.sqrt(1.0 + load), rel=5e-3)


@pytest.mark.thorough
def test_a_buckled_beam_has_no_frequencies():
    result, state = rod().frequencies(2, {"end": (-10.0, 0.0, 0.0)})
    assert bool(result.isnan().all())
    assert "buckles" in state.status


def test_a_rotor_with_coriolis_forces():
    """A mass on a soft shaft along its axis of rotation: the turning observer sees w + spin and |w - spin|."""
    section = given(1e4, 1e4, 1e4, 1e3, 2.0, 2.0, mass=SLIM)
    beam = mbd.ExactBeam("shaft", mbd.BeamLine.straight(1.0, 12), section)
    rest = 2.0 * math.pi * beam.frequencies(2)[0]
    spun = 2.0 * math.pi * beam.frequencies(2, spin=(2.0, 0.0, 0.0))[0]
    assert spun.tolist() == pytest.approx([rest[0].item() - 2.0, rest[0].item() + 2.0], rel=1e-3)


@pytest.mark.thorough
def test_sparse_and_dense_methods_agree(monkeypatch):
    loads = {"loads": {"end": (0.5, 1.0, 0.3)}, "spin": (0.3, 0.2, 1.0)}
    dense, _ = rod(30, coupled()).frequencies(4, **loads)
    monkeypatch.setattr(vibrations, "SMALL", 10)
    sparse, _ = rod(30, coupled()).frequencies(4, **loads)
    torch.testing.assert_close(dense, sparse, rtol=1e-8, atol=1e-9)


@pytest.mark.thorough
def test_derivatives():
    """By section, load and spin, of a bent and turning coupled beam: differences, forward and reverse."""
    beam = rod(6, coupled())

    def response(K: Tensor, load: Tensor, spin: Tensor) -> Tensor:
        class Call(torch.nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.beam = beam

            def forward(self) -> Tensor:
                result, state = self.beam.frequencies(3, {"end": load}, spin=spin)
                assert state.status == "ok"
                return result.sum()

        return torch.func.functional_call(Call(), {"beam.section.matrix": K}, ())

    point = (coupled(), *(torch.tensor(x, dtype=torch.float64) for x in ((0.5, 1.0, 0.3), (0.3, 0.2, 1.0))))
    leaves = [x.clone().requires_grad_() for x in point]
    gradients = torch.autograd.grad(response(*leaves), leaves)
    ways = [torch.randn(x.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(4)) for x in point]
    ways[0] = ways[0] + ways[0].T
    forward = torch.func.jvp(response, point, tuple(ways))[1]
    reverse = sum(float((g * d).sum()) for g, d in zip(gradients, ways, strict=True))
    assert forward.item() == pytest.approx(reverse, rel=1e-8)

    def moved(s: float) -> Tensor:
        return response(*(x + s * d for x, d in zip(point, ways, strict=True)))

    one, two = ((moved(h) - moved(-h)) / (2.0 * h) for h in (1e-3, 2e-3))
    assert reverse == pytest.approx(((4.0 * one - two) / 3.0).item(), rel=1e-6)


def test_coinciding_frequencies_have_the_mean_of_their_derivatives():
    stiffness = torch.tensor([1e4, 1e4, 1e4, 1.0, 1.0, 1.0], dtype=torch.float64)
    section = mbd.GivenSection(torch.diag(stiffness), SLIM)
    section.matrix.requires_grad_(True)
    result, _ = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 8), section).frequencies(1)
    result[0].backward()
    gradient = section.matrix.grad
    assert gradient is not None
    half = 0.25 * result[0].item()  # w ~ sqrt(E I), half of it in each plane
    assert [gradient[4, 4].item(), gradient[5, 5].item()] == pytest.approx([half, half], rel=1e-3)


def test_what_is_refused():
    with refused("number"):
        rod().frequencies(0)
    with refused("number", 10):
        rod(2).frequencies(10, supports={"start": "all", "end": "u1 u2 u3"})
    with refused("loads"):
        rod().frequencies(2, {"end": (0.0, 0.0, 0.0, 1.0, 0.0, 0.0)})
