"""Lamination rules on stacks whose properties are known, and their meaning in the stiffness of the laminate."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import CARBON
from torchmbd.errors import InputError
from torchmbd.extensions.lamination.rules import LaminationRules, angle_between

PLY: dict = CARBON
ALL = LaminationRules(symmetric=True, balanced=True, max_step=45.0, min_share=0.1)


@pytest.mark.parametrize(
    ("a", "b", "expected"), [(0, 0, 0), (90, -90, 0), (60, -60, 60), (80, -80, 20), (45, -45, 90), (-30, 100, 50)]
)
def test_fibers_have_no_head(a, b, expected):
    assert angle_between(a, b) == angle_between(b, a) == expected


@pytest.mark.parametrize(
    ("rules", "angles", "sentence"),
    [
        ({"symmetric": True}, [30, 0, 30], None),
        ({"symmetric": True}, [90, 20, 20, -90], None),
        ({"symmetric": True}, [30, 0, -30], "ply 1 lies at 30, its mirror image at -30"),
        ({"symmetric": True}, [10, 20, 25, 10], "ply 2 lies at 20, its mirror image at 25"),
        ({"balanced": True}, [0, 90, -90, 0], None),
        ({"balanced": True}, [30, -30, 150, 30], None),
        ({"balanced": True}, [30, 0, -30, 30], "50 % at 30, 25 % at -30"),
        ({"balanced": True}, [45, -40], "50 % at 45, 0 % at -45"),
        ({"max_step": 45.0}, [0, 45, 90, -45, 0], None),
        ({"max_step": 45.0}, [0, 60], "60 degrees between plies 1 and 2"),
        ({"max_step": 45.0}, [80, -70, 70, 20], "50 degrees between plies 3 and 4"),
        ({"max_step": 30.0}, [80, -80, 60], "40 degrees between plies 2 and 3"),
        ({"min_share": 0.1}, [0, 45, -45, 90], None),
        ({"min_share": 0.1}, [0, 0, 45, -45], "0 % lie at 90 degrees: must be at least 10 %"),
        ({"min_share": 0.1}, [0] * 7 + [45, -45, 90], None),
        ({"min_share": 0.1}, [0] * 8 + [45, -45, 90], "9.091 % lie at 90 degrees"),
    ],
)
def test_each_rule(rules, angles, sentence):
    broken = LaminationRules(**rules).broken(angles)
    if sentence is None:
        assert broken == []
    else:
        assert any(sentence in result for result in broken)
    assert LaminationRules(**rules).admits(angles) == (sentence is None)


def test_thickness_counts_not_the_number_of_plies():
    rules = LaminationRules(balanced=True, symmetric=True)
    assert rules.admits([30, -30, -30, 30], [1.0, 1.0, 1.0, 1.0])
    assert "not balanced" in rules.broken([30, -30, -30, 30], [2.0, 1.0, 1.0, 2.0])[0]
    assert "differ in thickness" in rules.broken([30, -30, -30, 30], [2.0, 1.0, 1.0, 1.0])[0]


def test_all_rules_together():
    """The quasi-isotropic stack that they were made for, and everything that the paper's optimum of L3 breaks."""
    assert ALL.admits([45, 0, -45, 90, 90, -45, 0, 45])
    assert len(ALL.broken([0, -18.6, 0])) == 4  # not balanced, nothing at 90, 45 and -45
    assert LaminationRules().admits([0, -18.6, 0])


def test_the_rules_mean_what_they_say_in_the_stiffness():
    """Symmetric: B = 0. Balanced: A16 = A26 = 0."""
    symmetric, balanced = [30.0, -50.0, -50.0, 30.0], [30.0, -50.0, 50.0, -30.0]
    assert LaminationRules(symmetric=True).admits(symmetric)
    assert LaminationRules(balanced=True).admits(balanced)
    C = mbd.Laminate(mbd.Ply(**PLY), angles=mbd.deg(symmetric), thickness=1e-3).stiffness()
    assert_close(
        C.B, torch.zeros(3, 3, dtype=torch.float64), rtol=0, atol=1e-9 * float(C.A.detach().abs().max()) * 1e-3
    )
    assert float(C.A[0, 2].detach().abs()) > 1e6
    C = mbd.Laminate(mbd.Ply(**PLY), angles=mbd.deg(balanced), thickness=1e-3).stiffness()
    assert_close(C.A[:2, 2], torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-12 * float(C.A.detach().abs().max()))
    assert float(C.B.detach().abs().max()) > 1e3


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LaminationRules(max_step=100.0), "max_step = 100.0: must be 0 to 90"),
        (lambda: LaminationRules(min_share=0.3), "min_share = 0.3: must be 0 to 0.25"),
        (lambda: LaminationRules(tolerance=-1.0), "tolerance = -1.0"),
        (lambda: ALL.broken([]), "angles = []: must be at least one finite"),
        (lambda: ALL.broken([float("nan")]), "angles = [nan]"),
        (lambda: ALL.broken([0, 1], [1.0]), "thickness = [1.0]: must be a positive number, or one for each ply"),
        (lambda: ALL.broken([0, 1], 0.0), "thickness = 0.0"),
    ],
)
def test_bad_input(make, words):
    with pytest.raises(InputError) as error:
        make()
    assert words in str(error.value)
