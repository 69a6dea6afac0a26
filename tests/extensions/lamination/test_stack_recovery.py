"""Stacks of given lamination parameters: found again where they exist, rules, refusals."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from tests.extensions.lamination.test_parameters import CARBON, parameters_of

ANGLES = mbd.deg([-75, -60, -45, -30, -15, 0, 15, 30, 45, 60, 75, 90])


def asked(degrees: list[float], **given) -> mbd.lamination.LaminationParameters:
    angles = torch.tensor(degrees).double().deg2rad()
    known = parameters_of(angles, torch.full((len(degrees),), 1.25e-4, dtype=torch.float64))
    if degrees == degrees[::-1]:
        del known["coupling"]
    return mbd.lamination.LaminationParameters(CARBON, 1.25e-4 * len(degrees), **known, **given)


@pytest.mark.parametrize("degrees", [[45, -45, 0, 90, 90, 0, -45, 45], [30, 0, -60, 0, 30], [0, 45, 90, -15, 60]])
def test_a_stack_that_exists_is_found(degrees):
    laminate = asked(degrees)
    result = mbd.lamination.recover_stacks(laminate, len(degrees), ANGLES)[0]
    assert result.distance < 1e-9
    assert torch.tensor(result.angles).rad2deg().tolist() == pytest.approx(degrees)
    one, two = laminate.stiffness(), result.laminate.stiffness()
    torch.testing.assert_close(two.D, one.D, rtol=1e-9, atol=1e-9 * float(one.D.abs().max()))


@pytest.mark.thorough
def test_rules_come_first_and_several_are_sorted():
    laminate = asked([30, 0, 0, 60, 60, 0, 0, 30])
    rules = mbd.lamination.LaminationRules(symmetric=True, balanced=True)
    free, ruled = (
        mbd.lamination.recover_stacks(laminate, 8, ANGLES, number=4),
        mbd.lamination.recover_stacks(laminate, 8, ANGLES, rules, 4),
    )
    assert free[0].distance < 1e-9
    assert [x.distance for x in free] == sorted(x.distance for x in free)
    assert len({tuple(x.angles) for x in free}) == 4
    assert all(not x.broken for x in ruled)
    assert ruled[0].distance > 0.1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"plies": 0}, "plies = 0"),
        ({"number": 1.5}, "number = 1.5"),
        ({"angles": []}, "angles = "),
        ({"rules": "balanced"}, "rules = "),
        ({"weights": (1.0, 1.0)}, "weights = "),
        ({"weights": (0.0, 0.0, 0.0)}, "weights = "),
        ({"laminate": mbd.Laminate(CARBON, [0.0], 1e-3)}, "LaminationParameters"),
    ],
)
def test_bad_input(options, words):
    given = {"laminate": asked([0, 90, 0]), "plies": 3, "angles": ANGLES} | options
    with pytest.raises(mbd.InputError) as result:
        mbd.lamination.recover_stacks(**given)
    assert words in str(result.value)
