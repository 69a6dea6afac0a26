"""The start of motions by compiled code: the same numbers and cotangents as by operators of torch."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box
from tests.sensitivity.adjoint_cases import CASES, held
from torchmbd.extensions.native import start
from torchmbd.integrate.backend import with_backend
from torchmbd.integrate.generalized_alpha import GeneralizedAlpha
from torchmbd.integrate.prepared import Prepared, prepare_whole, with_leaves
from torchmbd.multibody.system.dynamics import Dynamics

pytestmark = [pytest.mark.thorough, pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")]


def turning_beam() -> mbd.System:
    """An elastic beam that swings from a hinge and turns about its axis at the start."""
    section = mbd.GivenSection.isotropic(70e9, 0.3, 2700.0, 2e-4, Iyy=2e-9, Izz=7e-9, J=5e-9)
    blade = mbd.FlexibleBeam("blade", mbd.BeamLine.straight(0.5, 4), section, angular_velocity=(1.0, 3.0, 0.5))
    return mbd.System([blade], [mbd.Spherical(mbd.Ground().at(), blade.at("start"))], gravity=(0.0, -9.81, 0.0))


def turned() -> mbd.System:
    """Two rigid bodies with rates in all directions, joined by a ball."""
    inner = box("inner", angular_velocity=(1.0, -2.0, 3.0), position=(0.1, 0.0, 0.0))
    outer = box("outer", angular_velocity=(0.5, 4.0, -1.0), position=(0.3, 0.0, 0.0))
    joints = [mbd.Spherical(mbd.Ground().at(), inner.at()), mbd.Spherical(inner.at(0.2, 0.0, 0.0), outer.at())]
    return mbd.System([inner, outer], joints, gravity=(0.0, 0.0, -9.81))


SYSTEMS: dict[str, Callable[[], mbd.System]] = {name: make for name, (make, _, _) in CASES.items()}
SYSTEMS |= {"turned": turned, "exact beam": turning_beam}
del SYSTEMS["forces"]  # it starts at a kink of a table, where the slope of either side is a derivative
BY_TORCH = ("laws of drives", "all held")  # drives with design variables


def dynamics_of(system: mbd.System, lanes: int) -> Dynamics:
    """The dynamics of a batch: each number of a design is up to a tenth greater than in the system."""
    generator = torch.Generator().manual_seed(3)
    batch = {
        name: x.detach() * (1.0 + 0.1 * torch.rand(lanes, *x.shape, generator=generator, dtype=x.dtype))
        for name, x in system.named_parameters()
    }
    with torch.no_grad():
        stages, _ = system.stages(batch)
    return stages


def begun(dynamics: Dynamics, backend: str) -> Prepared:
    """The start of a motion, as a function of all data."""
    leaves = with_leaves(with_backend(dynamics, backend), list(dynamics.data))
    t = torch.zeros(1, dynamics.lanes, dtype=torch.float64)
    with torch.enable_grad():
        return prepare_whole(leaves).with_begin(GeneralizedAlpha(), t, t + 1e-3)


def cotangents(made: Prepared) -> list[Tensor]:
    """By the data, of two rows of the accelerations, multipliers that are determined, and the state from which steps go on."""
    generator = torch.Generator().manual_seed(5)
    assert made.begin is not None
    outputs = [made.state.vd, made.begin.v, made.begin.a, *([] if made.whole.redundant else [made.state.lam])]
    weights = [torch.randn(2, *x.shape, generator=generator, dtype=x.dtype) for x in outputs]
    leaves = [made.whole.data[name] for name in made.leaves]

    def pulled(*rows: Tensor) -> tuple[Tensor, ...]:
        return torch.autograd.grad(outputs, leaves, rows, retain_graph=True, materialize_grads=True, allow_unused=True)

    return list(torch.vmap(pulled)(*weights))


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("lanes", [1, 5])
@pytest.mark.parametrize("name", SYSTEMS)
def test_it_is_that_of_torch(name, lanes, monkeypatch):
    dynamics = dynamics_of(SYSTEMS[name](), lanes)
    plain = begun(dynamics, "eager")
    compiled, calls = start._Start.run, []
    monkeypatch.setattr(start._Start, "run", lambda *x: calls.append(1) or compiled(*x))
    fast = begun(dynamics, "native")
    assert len(calls) == (0 if name in BY_TORCH else 2)
    for x, y in ((plain.state, fast.state), (plain.begin, fast.begin)):
        assert x is not None
        assert y is not None
        for part, other in zip(x.map(Tensor.detach), y.map(Tensor.detach), strict=True):
            assert_close(other, part, rtol=0, atol=1e-9 * float(part.abs().max()) + 1e-14)
    for datum, by, other in zip(plain.leaves, cotangents(plain), cotangents(fast), strict=True):
        if name == "redundant" and datum == "x":
            continue  # a loop with redundant rows does not close where one vector moves
        assert_close(other, by, rtol=0, atol=1e-8 * float(by.abs().max()) + 1e-12)


@pytest.mark.usefixtures("compiled")
def test_drives_with_design_variables_are_left_to_torch():
    dynamics = with_backend(dynamics_of(held(), 1), "native")
    assert start.accelerations(dynamics, *dynamics.start) is None
