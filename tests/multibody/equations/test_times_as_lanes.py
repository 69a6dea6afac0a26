"""Prescribed quantities of many times are those of each time."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from torchmbd.examples.slider_crank import build
from torchmbd.math.pair import value
from torchmbd.multibody.equations.times_as_lanes import as_lanes
from torchmbd.multibody.equations.topology import Schedule

TIMES = torch.linspace(0.0, 0.03, 7, dtype=torch.float64)


def numbers(prescribed) -> list:
    """All numbers of one time."""
    laws = [value(x) for law in prescribed.laws if law is not None for x in law]
    return [prescribed.A, prescribed.r, value(prescribed.t).reshape(-1), *laws]


@pytest.mark.thorough
@pytest.mark.parametrize("condensed", [False, True])
def test_a_schedule_is_a_sequence_of_what_is_prescribed_at_each_time(condensed):
    system = build(2, cells=(4, 2), modes=2)
    dynamics = system.dynamics()
    T, data = (dynamics.condensed() if condensed else dynamics).topology, dynamics.data
    schedule = T.schedule(TIMES, data)
    assert len(schedule) == len(list(schedule)) == len(TIMES)
    for t, at in zip(TIMES, schedule, strict=True):
        for x, y in zip(numbers(at), numbers(T.prescribed(t, data)), strict=True):
            assert_close(x, y, rtol=0, atol=0)
    part = schedule[2:4]
    assert isinstance(part, Schedule)
    for x, y in zip(numbers(part[1]), numbers(schedule[3]), strict=True):
        assert_close(x, y, rtol=0, atol=0)
    for x, y in zip(numbers(Schedule.of(schedule[5])[0]), numbers(schedule[5]), strict=True):
        assert_close(x, y, rtol=0, atol=0)


@pytest.mark.parametrize("lanes_first", [False, True])
def test_times_become_lanes(lanes_first):
    dynamics = build(2, cells=(4, 2), modes=2).dynamics()
    schedule, lanes = dynamics.topology.schedule(TIMES, dynamics.data), 3
    wide = as_lanes(schedule, lanes, lanes_first)
    for number, law in enumerate(wide.laws):
        for k, x in enumerate(law or ()):
            for i, at in enumerate(schedule):
                here = slice(i, None, len(TIMES)) if lanes_first else slice(i * lanes, (i + 1) * lanes)
                assert_close(x[..., here], at.laws[number][k].expand(*x.shape[:-1], lanes), rtol=0, atol=0)
