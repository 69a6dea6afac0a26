"""Responses as plain data: what experiment files can say, and where a wrong word is found."""

from __future__ import annotations

import pytest

import torchmbd as mbd
from torchmbd.design import (
    AtPeaks,
    AtTime,
    AtTimes,
    Frequency,
    Mass,
    Max,
    MeanFrequency,
    RelativeDisplacement,
    SmoothMax,
    Velocity,
    WeightedSum,
)
from torchmbd.design.aggregate import Aggregate
from torchmbd.design.response_spec import (
    HISTORIES,
    MEASURES,
    OPERATIONS,
    SpecError,
    leaf,
    measure_of,
    terms,
)
from torchmbd.design.responses import COMBINATORS, OF_DESIGN, RESPONSES
from torchmbd.design.words import UNITS
from torchmbd.design.words import heading as heading_of
from torchmbd.design.words import unit as unit_of
from torchmbd.design.words import words as words_of

ENERGY = mbd.StrainEnergy("rod")
TWIST = RelativeDisplacement("rod", "left", "right", "z")
TWIST_SPEC = {"relative_displacement": {"body": "rod", "a": "left", "b": "right", "axis": "z"}}


def heading(spec) -> str:
    return heading_of(measure_of(spec))


def unit(spec) -> str:
    return unit_of(measure_of(spec))


def words(spec, bodies: bool = True) -> str:
    return words_of(measure_of({key: x for key, x in spec.items() if key != "weight"}), bodies)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ({"integral": {"strain_energy": "rod"}}, mbd.Integral(ENERGY)),
        ({"max": {"strain_energy": {"body": "rod"}}, "window": [0.01, 0.03]}, mbd.Max(ENERGY, window=(0.01, 0.03))),
        ({"at_peaks": {"strain_energy": "rod"}, "count": 5}, AtPeaks(ENERGY, count=5)),
        (
            {"aggregate": [{"max": {"strain_energy": "rod"}}, {"mass": "rod"}], "kind": "p_norm", "sharpness": 9.0},
            Aggregate([Max(ENERGY), Mass("rod")], "p_norm", 9.0),
        ),
        (
            {"aggregate": {"at_times": {"strain_energy": "rod"}, "count": 7}, "scale": 0.1},
            Aggregate(AtTimes(ENERGY, None, 7), scale=0.1),
        ),
        ({"smooth_max": {"strain_energy": "rod"}, "sharpness": 9.0, "scale": 2.0}, SmoothMax(ENERGY, None, 9.0, 2.0)),
        ({"time": 0.02, "at_time": TWIST_SPEC}, AtTime(TWIST, 0.02)),
        ({"integral": {"squared": TWIST_SPEC}}, mbd.Integral(TWIST**2)),
        (
            {"max": {"velocity": {"body": "rod", "node": "right", "axis": [0, 1, 1], "seen_from": "rod"}}},
            mbd.Max(Velocity("rod", [0, 1, 1], node="right", seen_from="rod")),
        ),
        ({"frequency": {"body": "rod", "number": 2}}, Frequency("rod", 2)),
        ({"mean_frequency": {"body": "rod", "cluster": [2, 3], "power": -4}}, MeanFrequency("rod", (2, 3), -4)),
        ({"mass": "rod"}, Mass("rod")),
        (
            {"weighted_sum": [{"weight": 0.6, "max": {"strain_energy": "rod"}}, {"weight": 2, "mass": "rod"}]},
            WeightedSum([(0.6, mbd.Max(ENERGY)), (2.0, Mass("rod"))]),
        ),
        (
            {"weighted_sum": [{"weight": 0.6, "mass": "rod"}], "normalize": [0.3]},
            WeightedSum([(0.6, Mass("rod"))], normalize=[0.3]),
        ),
    ],
    ids=lambda x: str(x) if isinstance(x, dict) else "",  # the text of a function is not the same in every process
)
def test_what_a_file_can_say(spec, expected):
    assert measure_of(spec) == expected


def test_the_name_is_told_from_its_options():
    """Whatever stands first: `integrl` is the unknown name, not the window."""
    for spec in ({"integrl": {"strain_energy": "rod"}, "window": [0, 1]}, {"window": [0, 1], "integrl": "rod"}):
        with pytest.raises(SpecError, match="Try: 'integral'") as error:
            measure_of(spec)
        assert error.value.path[-1] == "integrl"


def test_responses_have_units():
    assert {name for name, kind in {**RESPONSES, **OF_DESIGN}.items() if not hasattr(kind, "unit")} == set(UNITS)
    assert heading({"integral": {"strain_energy": "rod"}}) == "integral of strain energy of rod [J s]"
    assert unit({"rms": {"squared": {"displacement": {"body": "rod", "node": "right", "axis": "y"}}}}) == "m²"
    assert unit({"integral": {"squared": {"velocity": {"body": "rod", "node": "right", "axis": "y"}}}}) == "(m/s)² s"
    assert unit({"max": {"reaction": {"joint": "hinge", "axis": "z", "kind": "torque"}}}) == "N m"
    assert heading({"max": {"ply_failure": "rod"}}) == "max of ply failure of rod"
    assert unit({"weighted_sum": [{"weight": 1.0, "mass": "rod"}]}) == ""


def test_responses_in_words():
    both = {"weighted_sum": [{"weight": 1, "integral": {"squared": TWIST_SPEC}}, {"weight": 2, "mass": "rod"}]}
    assert words(both) == "weighted sum"
    assert words(both["weighted_sum"][0]) == "integral of squared z relative displacement of rod"
    assert terms(both, ("minimize",))[1] == ({"mass": "rod"}, ("minimize", "weighted_sum", 1))
    assert terms({"mass": "rod"}) == [({"mass": "rod"}, ())]
    assert words({"window": [0, 1], "max": {"strain_energy": "rod"}}, bodies=False) == "max of strain energy"
    assert leaf({"integral": {"squared": TWIST_SPEC}}, ("minimize",))[1:] == (
        "integral",
        "squared",
        "relative_displacement",
    )


def test_every_registered_name_can_be_said():
    assert set(MEASURES) == {*COMBINATORS, *OF_DESIGN, "weighted_sum", "aggregate", *OPERATIONS, "function"}
    assert set(HISTORIES) == {*RESPONSES, *OPERATIONS, "function"}


@pytest.mark.parametrize(
    ("spec", "path", "words"),
    [
        ("integral", (), ["'integral'", "must be a mapping"]),
        ({}, (), ["has 0 keys: must have exactly one", "integral"]),
        ({"integrl": {"strain_energy": "rod"}}, ("integrl",), ["unknown name", "Try: 'integral'"]),
        ({"max": {"strain_energie": "rod"}}, ("max", "strain_energie"), ["Try: 'strain_energy'"]),
        ({"max": {"strain_energy": "rod"}, "min": {"strain_energy": "rod"}}, (), ["has 2 keys"]),
        ({"max": {"strain_energy": 3}}, ("max", "strain_energy"), ["= 3: must be a name", "body"]),
        ({"max": {"strain_energy": "rod"}, "windw": [0, 1]}, ("windw",), ["unknown key", "Try: 'window'"]),
        ({"max": {"strain_energy": "rod"}, "window": [1, 0]}, ("window",), ["window = [1, 0]", "t0 < t1"]),
        (
            {"max": {"strain_energy": "rod", "window": [0, 1]}},
            ("max", "window"),
            ["an argument of 'max' stands beside it"],
        ),
        ({"max": {"velocity": "rod"}}, ("max", "velocity"), ["lacks 'axis'"]),
        ({"max": {"velocity": {"body": "rod", "axs": "x"}}}, ("max", "velocity", "axs"), ["Try: 'axis'"]),
        ({"at_time": {"strain_energy": "rod"}}, (), ["lacks 'time'"]),
        ({"at_time": {"strain_energy": "rod"}, "time": -1}, ("time",), ["time = -1: must be zero or positive"]),
        ({"mass": "rod", "number": 1}, ("number",), ["unknown key"]),
        ({"weighted_sum": {}}, ("weighted_sum",), ["must be a list of measures"]),
        ({"weighted_sum": [{"mass": "rod"}]}, ("weighted_sum", 0), ["must be a measure with a weight"]),
        ({"weighted_sum": [{"mass": "rod", "weight": "1"}]}, ("weighted_sum", 0, "weight"), ["must be a number"]),
        ({"weighted_sum": [{"maas": "rod", "weight": 1}]}, ("weighted_sum", 0, "maas"), ["Try: 'mass'"]),
    ],
    ids=str,
)
def test_a_wrong_word_is_found_where_it_stands(spec, path, words):
    with pytest.raises(SpecError) as error:
        measure_of(spec)
    assert error.value.path == path
    for word in words:
        assert word in str(error.value)
