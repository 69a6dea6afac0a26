"""Laws as scalar operations: the same numbers and slopes as the law, for whatever users write."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused
from torchmbd.extensions.native.codegen.scalars import Untraceable
from torchmbd.extensions.native.user_laws import trace_law
from torchmbd.math.elementwise import partial_derivatives
from torchmbd.multibody.forces import Gap, OfTime, Pieces, Spring, Table

LAWS = {
    "spring": lambda s, rate, t: -3.0 * (s - 0.2) - 0.1 * rate,
    "cubic": lambda s, rate, t: -2.0 * s**3 + 0.5 * s**2 - rate * torch.abs(rate),
    "tanh": lambda s, rate, t: -torch.tanh(5.0 * s) * torch.exp(-rate * rate) + torch.log(2.0 + t),
    "ratio": lambda s, rate, t: s / (1.0 + s * s) - torch.sqrt(1.0 + rate**2) / (t + 1.0),
    "branches": lambda s, rate, t: torch.where((s > 0.1) & (rate <= 0.3), -4.0 * s, torch.sin(s) * rate),
    "either": lambda s, rate, t: torch.where((s < -0.5) | ~(s < 0.7), 1.0 * s, torch.cos(rate)),
    "clamped": lambda s, rate, t: -torch.clamp(s, -0.3, 0.4) - torch.maximum(rate, s) + torch.minimum(rate, 0.5 * s),
    "signs": lambda s, rate, t: -torch.sign(rate) * torch.clamp_min(s, 0.0) + torch.atan2(s, 2.0 + rate),
    "time": lambda s, rate, t: torch.sin(20.0 * t) + 0.0 * s,
    "constant": lambda s, rate, t: torch.full_like(s, 2.5),
    "undefined": lambda s, rate, t: (
        s * (torch.log(s + 0.3) >= -5.0) + torch.where(torch.sqrt(0.2 - s) <= 0.9, 1.0, 2.0) * rate
    ),
    "endless": lambda s, rate, t: -s * torch.clamp(rate, -float("inf"), 0.2),
    "power": lambda s, rate, t: s**5 - (1.0 + rate * rate) ** 0.5,
}
STATED = {
    "Spring": Spring(3.0, 0.2, 0.1),
    "Table": Table(((-1.0, 2.0), (0.0, 0.5), (1.0, -1.0)), 0.1),
    "Pieces": Pieces((0.0, 1.0), (1.0, 2.0, -1.0), (0.5, 0.0, -2.0), 0.1, 0.2),
    "Gap": Gap(100.0, 0.1, 1.0, 2.0, 0.05),
    "OfTime": OfTime(lambda t: torch.cos(3.0 * t) * t, 2.0),
}


@pytest.fixture(scope="module")
def points() -> tuple[Tensor, Tensor, Tensor]:
    make = torch.Generator().manual_seed(5)
    s, rate = (2.0 * torch.rand(1, 1, 200, generator=make, dtype=torch.float64) - 1.0 for _ in range(2))
    return s, rate, torch.tensor(0.37, dtype=torch.float64)


@pytest.mark.parametrize("name", LAWS)
def test_what_users_write(name, points):
    law = trace_law(LAWS[name])
    assert_close(law(*points), LAWS[name](*points), rtol=1e-14, atol=1e-14)
    s, rate, t = points
    by_s, by_rate = partial_derivatives(lambda s, rate: LAWS[name](s, rate, t), s, rate)
    result = law.slopes(*points)
    assert_close(result[0], by_s, rtol=1e-12, atol=1e-13)
    assert_close(result[1], by_rate, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", STATED)
def test_slopes_that_a_law_states_are_kept(name, points):
    law = trace_law(STATED[name])
    assert_close(law(*points), STATED[name](*points), rtol=1e-14, atol=1e-14)
    for result, expected in zip(law.slopes(*points), STATED[name].slopes(*points), strict=True):
        assert_close(result, expected.expand_as(result), rtol=1e-14, atol=1e-14)
    assert law.center == getattr(STATED[name], "center", 0.0)


def test_a_law_is_what_it_is_made_of_at_the_time():
    """Closures and attributes are read anew."""
    held = {"k": 2.0}

    def law(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return -held["k"] * s

    first = trace_law(law)
    assert first == trace_law(law)
    held["k"] = 3.0
    assert trace_law(law) != first


@pytest.mark.parametrize(
    "law",
    [
        lambda s, rate, t: s if float(s.sum()) > 0.0 else -s,
        lambda s, rate, t: torch.special.bessel_j0(s),
        lambda s, rate, t: torch.tensor(s.numpy() * 2.0),
        lambda s, rate, t: s**-3.5,
        lambda s, rate, t: s * ((s > 2.0) + (rate > 2.0)),
        lambda s, rate, t: torch.where(s > 0.1, 100.0, 0.0),
        lambda s, rate, t: -s * torch.tensor([1.0, 2.0], dtype=torch.float64)[(s > 0).long()],
        type("Wrong", (), {"__call__": lambda _, s, rate, t: -s, "slopes": lambda _, s, rate, t: (s**rate, 0 * s)})(),
    ],
    ids=["branch in Python", "unknown operator", "numpy", "odd power", "sum of bools", "float32", "table", "slopes"],
)
def test_what_cannot_be_written_out_is_left(law):
    with pytest.raises(Untraceable):
        trace_law(law)


@pytest.mark.parametrize(
    "law",
    [
        lambda s, rate, t: torch.from_numpy(np.tanh(s.detach().numpy())),
        lambda s, rate, t: torch.full_like(s, float(np.tanh(s.detach().mean()))),
        lambda s, rate, t: torch.sin(s.detach()),
    ],
    ids=["numpy", "float", "detach"],
)
def test_a_law_that_leaves_torch_is_refused_by_name(law):
    block = mbd.RigidBody("block", 1.0, (0.01,) * 3)
    with refused("spring.law"):
        mbd.SpringDamper(mbd.Ground().at(), block.at(0.1, 0, 0), law=law, name="spring")


@pytest.mark.parametrize("transform", ["jvp", "grad", "vmap"])
def test_transforms_of_torch_leave_laws_as_they_are(transform):
    """A simulation inside of torch.func traces its laws there."""
    law = lambda s, rate, t: torch.sin(30.0 * t) * s + 0.1 * rate  # noqa: E731
    traced = []

    def inside(x: Tensor) -> Tensor:
        traced.append(trace_law(law))
        return x * x

    x = torch.tensor(0.3, dtype=torch.float64)
    if transform == "jvp":
        torch.func.jvp(inside, (x,), (x,))
    elif transform == "grad":
        torch.func.grad(inside)(x)
    else:
        torch.vmap(inside)(x.expand(2))
    assert traced == [trace_law(law)]
