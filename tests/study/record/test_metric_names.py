"""Names of metrics: constraints by their words, in groups."""

from __future__ import annotations

import torchmbd as mbd
from torchmbd.study.record.metric_names import constraint_names, is_design, legal_key, metric_heading, without_group

ENERGY = mbd.StrainEnergy("arm")


def problem(*limits, minimize=None):
    minimize = mbd.Integral(ENERGY) if minimize is None else minimize
    return mbd.Problem(mbd.examples.arm(), 0.05, minimize, limits, steps=20)


def test_constraints_have_the_names_of_their_responses():
    asked = problem(
        mbd.Max(ENERGY) <= 1.0, mbd.Max(ENERGY) >= 0.1, mbd.AtPeaks(ENERGY, count=2) <= 2.0, mbd.Mass() <= 1.0
    )
    assert constraint_names(asked, 5) == [
        "constraint/max of strain energy of arm",
        "constraint/max of strain energy of arm no 2",
        "constraint/at peaks of strain energy of arm 1",
        "constraint/at peaks of strain energy of arm 2",
        "constraint/mass of all bodies",
    ]


def test_rows_of_a_min_max_problem_come_first():
    asked = problem(mbd.Mass() <= 1.0, minimize=mbd.AtPeaks(ENERGY, count=2))
    assert constraint_names(asked, 3) == ["constraint/peak 1", "constraint/peak 2", "constraint/mass of all bodies"]


def test_long_names_differ_and_keep_their_ends():
    peaks = [mbd.Max(mbd.Displacement("arm", axis, node="right")) for axis in "xyz" * 4]
    sums = [sum(peaks[1:], start=peaks[0]), sum(peaks[2:], start=peaks[0]) + peaks[1]]
    names = constraint_names(problem(*(x <= 1.0 for x in sums)), 2)
    assert len({*names, *(legal_key(f"{'x' * 300}{end}_kg") for end in "ab")}) == 4
    assert all(len(name) <= 240 for name in names)
    assert legal_key(f"{'x' * 300}_kg").endswith("x_kg")


def test_what_is_not_known_is_numbered():
    assert constraint_names(None, 2) == ["constraint/1", "constraint/2"]


def test_groups():
    assert is_design("design/angle_1_deg")
    assert not is_design("constraint/mass")
    assert without_group("design/angle_1_deg") == "angle_1_deg"
    assert metric_heading("design/boom_height_cm") == "boom height [cm]"
    assert metric_heading("design/stiffness_N/mm") == "stiffness [N/mm]"
    assert metric_heading("reduction_percent") == "reduction [%]"


def test_constraints_of_scenarios_name_the_scenario():
    cases = {"thin": {"arm.laminate.thickness": 1e-3}, "thick": {"arm.laminate.thickness": 2e-3}}

    def criterion_metrics(minimize, *limits, **options):
        given = {"variables": ["arm.laminate.angles"], "scenarios": cases, "steps": 20}
        return mbd.Scenarios(mbd.examples.arm(), 0.05, minimize, limits, **given | options)

    worst = criterion_metrics(mbd.Max(ENERGY), mbd.Mass() <= 1.0, mbd.AtPeaks(ENERGY, count=2) <= 2.0)
    assert [without_group(name) for name in constraint_names(worst, 8)] == [
        "max of strain energy of arm in thin",
        "max of strain energy of arm in thick",
        "mass of all bodies in thin",
        "mass of all bodies in thick",
        "at peaks of strain energy of arm in thin 1",
        "at peaks of strain energy of arm in thin 2",
        "at peaks of strain energy of arm in thick 1",
        "at peaks of strain energy of arm in thick 2",
    ]
    mean = criterion_metrics(mbd.Max(ENERGY), mbd.Mass() <= 1.0, objective="mean", constraints="worst")
    assert [without_group(name) for name in constraint_names(mean, 1)] == ["mass of all bodies"]
