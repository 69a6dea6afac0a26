"""Motions on a device: the numbers of the CPU, on a stand-in (tests/stand_in.py) and, where there is one, on CUDA."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from experiments.slider_crank import build
from tests.mechanisms import box, pendulum, soft_slider_crank, spoilt, sprung
from tests.sensitivity.test_law_variables import arm
from tests.stand_in import Elsewhere, StandIn, stand_in
from tests.system.test_initial import four_bar
from tests.system.test_least_norm import doors
from torchmbd.errors import InputError
from torchmbd.integrators import captured, march
from torchmbd.integrators.march import March
from torchmbd.numerics import rotation
from torchmbd.system import equations

ANGLES = "rod.laminate.angles"
LANES = mbd.deg([[0.0, 0.0, 0.0], [10.0, 40.0, -70.0], [-15.0, 80.0, 5.0]])  # beside the system's own


CHECK = 10  # steps between looks: a few steps show what many would


@pytest.fixture(autouse=True)
def looks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(march, "CHECK", CHECK)


def chain(links: int = 10) -> mbd.System:
    """So many rigid bodies that the CPU eliminates their blocks."""
    bodies = [box(f"link{i}", position=(0.2 * i, 0.0, 0.0)) for i in range(links)]
    ends = [mbd.Ground().at(), *(body.at(0.2, 0.0, 0.0) for body in bodies)]
    joints = [mbd.Spherical(end, body.at()) for end, body in zip(ends, bodies, strict=False)]
    return mbd.System(bodies, joints, gravity=(0.0, -9.81, 0.0))


def stop() -> mbd.System:
    """A plate that hits a stop."""
    return sprung(mbd.forces.Gap(40.0, limit=-0.01, damping=0.1, smooth=0.02))


def softening(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    """A law of the user's own."""
    return -2.0 * torch.sin(s) * (1.0 + 0.5 * torch.cos(40.0 * t)) - 0.02 * rate


CASES: dict[str, tuple[Callable[[], mbd.System], dict[str, Any]]] = {
    "slider-crank, three angles": (partial(build, 3, (30.0, -20.0, 50.0), cells=(6, 2), modes=3), {"duration": 0.002}),
    "condensed": (soft_slider_crank, {"iterations": (2, 2)}),
    "values alone": (pendulum, {"sensitivities": False}),
    "factors kept": (pendulum, {"refresh": 3}),
    "redundant constraints": (partial(doors, mbd.Sine(0.4, 1.5)), {"sensitivities": False}),
    "factors always": (four_bar, {"sensitivities": False, "refresh": 0}),
    "contact and springs": (stop, {}),
    "a law of the user's own": (partial(sprung, softening), {}),
    "drives with variables": (arm, {}),
    "many bodies": (chain, {"sensitivities": False}),
}


def motion(system: mbd.System, **options: Any) -> mbd.Trajectory:
    """Of several designs, where the angles of the rod are variables."""
    own, designs = dict(system.named_parameters()).get(ANGLES), {}
    if own is not None:
        designs = {"designs": {ANGLES: own.detach() + LANES[:, : len(own)]}}
    return mbd.simulate(system, **({"duration": 0.016, "steps": 32, "sensitivities": True} | designs | options))


# Relative to the largest. Rounding of coordinates comes into accelerations as 1 / h^2.
CLOSE = {"q": 1e-9, "v": 1e-9, "dq_db": 1e-9, "dv_db": 1e-9, "a": 1e-6, "lam": 1e-6, "da_db": 1e-6, "dlam_db": 1e-6}


def same(found: mbd.Trajectory, expected: mbd.Trajectory) -> None:
    """All that a motion has, on the CPU."""
    assert found.status == expected.status
    for name, close in CLOSE.items():
        x, y = getattr(found, name), getattr(expected, name)
        assert (x is None) == (y is None)
        if y is not None and y.numel():
            assert_close(x, y, rtol=0, atol=close * float(y.nan_to_num().abs().max()), equal_nan=True, msg=name)
    for name, x in expected.stats.items():
        if isinstance(x, Tensor):
            assert_close(found.stats[name], x, rtol=0.1, atol=1e-9, equal_nan=True)


cuda = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"))
Place = Callable[[str], AbstractContextManager[Any]]


@pytest.fixture
def there(monkeypatch: pytest.MonkeyPatch) -> Place:
    """Where a device is: a stand-in has to be made."""
    return lambda name: stand_in(monkeypatch) if name == "meta" else nullcontext()


@pytest.mark.parametrize("device", ["meta", cuda])
@pytest.mark.parametrize("name", CASES)
def test_the_numbers_of_the_cpu(name: str, device: str, there: Place) -> None:
    make, options = CASES[name]
    expected = motion(make(), **options).require_ok()
    with there(device) as place:
        found = motion(make(), device=device, **options)
        same(found, expected)
        if isinstance(place, StandIn):
            assert place.launched > 20  # of 32 steps


@pytest.mark.parametrize("device", ["meta", cuda])
def test_a_lane_that_fails_leaves_the_others_alone(device: str, there: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    system = pendulum()
    spoilt(system, monkeypatch)
    expected = motion(system)
    with there(device):
        found = motion(system, device=device)
        assert [status == "ok" for status in found.status] == [True, False, True]
        same(found, expected)


@pytest.mark.parametrize("device", ["meta", cuda])
def test_an_optimization_takes_the_same_path(device: str, there: Place) -> None:
    energy = mbd.StrainEnergy("rod")

    def best(**options: Any) -> Any:
        system = soft_slider_crank((30.0, -20.0))
        bounds = mbd.deg([-90.0, 90.0]).tolist()
        problem = mbd.Problem(
            system, 0.02, mbd.Integral(energy), mbd.Max(energy) <= "initial", bounds, steps=40, **options
        )
        return mbd.optimize(problem, method="slsqp", max_iterations=2)

    expected = best()
    with there(device):
        found = best(device=device)
    assert found.value == pytest.approx(expected.value, rel=1e-8)
    assert_close(torch.as_tensor(found.x), torch.as_tensor(expected.x), rtol=1e-6, atol=1e-6)


def counted(monkeypatch: pytest.MonkeyPatch, steps: int, graphs: bool) -> StandIn:
    with stand_in(monkeypatch, graphs) as device:
        motion(pendulum(), duration=1e-3 * steps, steps=steps, device="meta").require_ok()
    return device


@pytest.mark.parametrize("graphs", [True, False])
def test_the_host_waits_at_looks_only(graphs: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A look more costs a question more, and no copy."""
    looks = 3 if graphs else 2
    short, long = (counted(monkeypatch, steps, graphs) for steps in (2 * CHECK, (2 + looks) * CHECK))
    assert (long.asked - short.asked).total() == looks
    assert long.crossings == short.crossings
    if graphs:
        assert long.launched - short.launched == looks * CHECK
        assert (long.done - short.done) / (looks * CHECK) < 75  # copies to and from a graph, and what a look does


def test_what_is_asked_for_leaves_the_device_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    with stand_in(monkeypatch) as device:
        found = motion(pendulum(), device="meta")
        before = device.crossings["to host"]
        found.body("rod").strain_energy  # noqa: B018
        assert device.crossings["to host"] == before + 1
        assert type(found.q) is Tensor


def test_a_constant_of_the_cpu_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    own = rotation.skew
    monkeypatch.setattr(equations, "skew", lambda x: own(x) * torch.ones(3, 3, 1, 1, 1, dtype=torch.float64))
    motion(pendulum())
    with stand_in(monkeypatch), pytest.raises(Elsewhere, match="of the CPU among those of the device"):
        motion(pendulum(), device="meta")


def test_steps_that_cannot_be_captured_are_done_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step that asks for a number."""
    expected, own = motion(pendulum()), March._values

    def asking(self: March, step: Any, z: Tensor, renew: bool) -> Any:
        assert bool((z == z).any())
        return own(self, step, z, renew)

    monkeypatch.setattr(March, "_values", asking)
    with stand_in(monkeypatch) as device:
        with pytest.warns(UserWarning, match="cannot be captured, which makes them slow: .* cannot ask for a number"):
            found = motion(pendulum(), device="meta")
        same(found, expected)
        assert device.launched == 0


def test_a_graph_sees_what_is_copied_to_it_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prescribed motions that are not, stand still."""
    own, kept = captured._numbers, []

    def stale(x: Any, given: Any, *rest: Any) -> list[Tensor]:
        kept.append(given)
        return own(x, kept[0], *rest)

    monkeypatch.setattr(captured, "_numbers", stale)
    system = arm()
    expected = motion(system)
    with stand_in(monkeypatch):
        found = motion(system, device="meta", halvings=0)
        assert not torch.allclose(found.q, expected.q, rtol=0, atol=1e-3)


def test_names_of_devices() -> None:
    system = pendulum()

    def refused(words: str, **options: Any) -> None:
        with pytest.raises(InputError, match=words):
            mbd.simulate(system, 0.01, **options)

    assert_close(
        mbd.simulate(system, 0.01, steps=5, device="cpu").q, mbd.simulate(system, 0.01, steps=5, device=None).q
    )
    refused("device is 'gpu'; allowed: 'cpu'", device="gpu")
    refused("device is 3; allowed: 'cpu'", device=3)
    refused("device is 'cpu:x'; allowed: 'cpu'", device="cpu:x")
    if not torch.cuda.is_available():
        refused("device is 'cuda'; allowed: 'cpu'; torch finds no CUDA device on this machine", device="cuda")
        with pytest.raises(InputError, match="device is 'cuda'"):
            mbd.Problem(system, 0.01, mbd.Max(mbd.StrainEnergy("rod")), device="cuda")


def test_what_a_device_does_not_do(monkeypatch: pytest.MonkeyPatch) -> None:
    with stand_in(monkeypatch):
        with pytest.raises(
            InputError, match=r"device is 'meta' for method 'dopri5'; allowed: method 'generalized_alpha'"
        ):
            mbd.simulate(pendulum(), 0.01, "dopri5", device="meta")
        with pytest.raises(InputError, match="device is 'meta' with phases"):
            mbd.simulate(pendulum(), 0.01, device="meta", phases=[mbd.Phase()])
        with pytest.raises(InputError, match=r"adjoint is True, but device is 'meta'; allowed: .* on the CPU"):
            motion(pendulum(), device="meta", adjoint=True)
        assert motion(pendulum(), device="meta", adjoint=None, steps=3).adjoint is None
        branching = sprung(lambda s, rate, t: -2.0 * s if float(s) > 0.0 else -s)
        with pytest.raises(InputError, match="law of a force cannot be written out for it"):
            mbd.simulate(branching, 0.01, steps=5, device="meta")
