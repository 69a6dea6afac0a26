"""Frequency responses as measurements: a twin's numbers, files in both forms, and what is refused."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import torchmbd as mbd
from tests.extensions.identification import pendulum
from tests.refused import ANY, refused

F = np.array([5.0, 8.0, 9.0, 14.0, 20.0])


def ports(model: mbd.System) -> tuple[mbd.signals.JointForce, dict[str, mbd.signals.JointTravel]]:
    first, second = model.joints
    return mbd.signals.JointForce(second), {"a": mbd.signals.JointTravel(first), "b": mbd.signals.JointTravel(second)}


def receptances(**numbers: float) -> dict[str, np.ndarray]:
    """Of two masses in a row, out of their matrices; keys as of pendulum.row."""
    x = {"k1": 8e3, "k2": 5e3, "c1": 6.0, "c2": 3.0} | numbers
    K, C = (np.array([[x[p + "1"] + x[p + "2"], -x[p + "2"]], [-x[p + "2"], x[p + "2"]]]) for p in "kc")
    s = 2j * np.pi * F
    G = np.array([np.linalg.solve(y * y * np.diag([2.0, 1.0]) + y * C + K, [0.0, 1.0]) for y in s])
    return {"frequency": F, "a": G[:, 0], "b": G[:, 1]}


@pytest.mark.thorough
@pytest.mark.parametrize("form", ["complex", "polar"])
def test_the_numbers_of_the_model(form):
    model = pendulum.row()
    push, outputs = ports(model)
    data = mbd.identification.FrequencyResponseData(receptances(), push, outputs, form=form)
    problem = mbd.identification.identify(
        mbd.identification.Experiment(model, data), ["first.damping"], max_evaluations=1
    )
    assert max(x.rms for x in problem.channels) < 1e-12


@pytest.mark.thorough
@pytest.mark.parametrize("form", ["complex", "polar"])
def test_stiffness_and_damping_are_found(form):
    """From 20 % off, with noise of 1 %; rows with small deviations count more."""
    model, rng = pendulum.row(k1=9.6e3, k2=4e3, c1=5.0, c2=3.6), np.random.default_rng(0)
    push, outputs = ports(model)
    numbers = receptances()
    for name in outputs:
        numbers[name] = numbers[name] * (1.0 + 0.01 * (rng.standard_normal(5) + 1j * rng.standard_normal(5)))
    deviation = {name: 0.01 if form == "polar" else 0.01 * np.abs(numbers[name]) for name in outputs}
    data = mbd.identification.FrequencyResponseData(numbers, push, outputs, form=form, deviation=deviation)
    fit = mbd.identification.identify(mbd.identification.Experiment(model, data), pendulum.ROW_UNKNOWNS)
    assert fit.converged
    for value, (low, high) in zip((8e3, 5e3, 6.0, 3.0), fit.interval, strict=True):
        assert low < value < high
        assert high - low < 0.5 * value
    assert 0.2 < np.mean([x.chi_square for x in fit.channels]) < 2.0


def test_files_of_both_forms(tmp_path):
    """Phases in degrees, a gap in one output."""
    model, numbers = pendulum.row(), receptances()
    push, outputs = ports(model)
    polar = {"frequency [Hz]": F}
    for name in outputs:
        polar |= {
            f"{name} magnitude": np.abs(numbers[name]),
            f"{name} phase [deg]": np.rad2deg(np.angle(numbers[name])),
        }
    polar["b magnitude"] = np.where(np.arange(5) == 2, np.nan, polar["b magnitude"])
    pd.DataFrame(polar).to_csv(tmp_path / "rig.csv", index=False)
    data = mbd.identification.FrequencyResponseData(tmp_path / "rig.csv", push, outputs, form="polar")
    assert [len(block.measured) for block in data.blocks] == [5, 5, 4, 4]
    np.testing.assert_allclose(data.measured["a"], numbers["a"])
    np.testing.assert_allclose(data.f, F)
    split = pd.DataFrame({"f": F} | {f"a {part}": getattr(numbers["a"], part[:4]) for part in ("real", "imaginary")})
    one = mbd.identification.FrequencyResponseData(split, push, {"a": outputs["a"]}, frequency="f")
    np.testing.assert_allclose(one.measured["a"], numbers["a"])


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"outputs": {}}, ("outputs", [])),
        ({"outputs": [1]}, ("outputs", [1])),
        ({"input": 3}, ("input", 3)),
        ({"form": "bode"}, ("form", "bode")),
        ({"frequency": "w"}, ("columns.w", "w")),
        ({"deviation": {"c": 1.0}}, ("deviation", "c")),
        ({"deviation": {"a": [1.0, 2.0]}}, ("a.deviation", {"a": [1.0, 2.0]})),
        (
            {"data": receptances() | {"frequency": F[::-1]}},
            ("frequency", 14.0),
        ),
        ({"data": receptances() | {"a": np.zeros(5, complex)}, "form": "polar"}, ("a", ANY, "zeros or gaps")),
        (
            {"data": receptances() | {"a": np.ones(5)}},
            ("a", ANY, "complex"),
        ),
        ({"deviation": 0.1}, ("deviation", 0.1)),
        ({"spinn": (0, 0, 1)}, ("options.spinn", "spinn")),
    ],
)
def test_bad_input_is_named(change, fault):
    push, outputs = ports(pendulum.row())
    arguments = {"data": receptances(), "input": push, "outputs": outputs} | change
    with refused(*fault):
        mbd.identification.FrequencyResponseData(**arguments)


def test_a_response_may_be_zero_but_in_a_logarithm():
    push, outputs = ports(pendulum.row())
    zero = receptances() | {"a": np.zeros(5, complex)}
    assert [len(block.measured) for block in mbd.identification.FrequencyResponseData(zero, push, outputs).blocks] == [
        5
    ] * 4


def test_signals_of_another_system_are_refused():
    push, outputs = ports(pendulum.row())
    with refused("forces.inputs and outputs"):
        mbd.identification.Experiment(
            pendulum.row(), mbd.identification.FrequencyResponseData(receptances(), push, outputs)
        )


@pytest.mark.parametrize(
    ("pick", "path"),
    [
        (lambda joint, point: point, "a"),
        (lambda joint, point: (joint, "x"), "a"),
        (lambda joint, point: (point, "w"), "a.direction"),
    ],
)
def test_outputs_of_several_numbers_need_a_direction(pick, path):
    model = pendulum.row()
    push, outputs = ports(model)
    point = mbd.signals.PointPosition(model.joints[0].b.body.at())
    with refused(path):
        mbd.identification.FrequencyResponseData(receptances(), push, outputs | {"a": pick(outputs["a"], point)})
