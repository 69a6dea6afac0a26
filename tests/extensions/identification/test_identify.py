"""`identify`: truth is found with intervals, by any start, despite outliers; what the result says."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.extensions.identification import pendulum
from tests.refused import refused

pytestmark = pytest.mark.thorough


def channels(noise: float = 0.01) -> dict[str, mbd.identification.Channel]:
    numbers = pendulum.data()
    return {
        name: mbd.identification.Channel(response, deviation=noise * numbers[name].std())
        for name, response in (("angle", pendulum.ANGLE), ("force", pendulum.FORCE))
    }


@cache
def fit_of_noise() -> mbd.identification.Identification:
    return mbd.identification.identify(pendulum.experiment(pendulum.data(0.01), **channels()), pendulum.UNKNOWNS)


@pytest.fixture
def fit(compiled):
    return fit_of_noise()


def test_truth_from_thirty_percent_off(fit):
    assert fit.status == "converged"
    assert fit.evaluations <= 15
    for name, value in pendulum.TRUTH.items():
        low, high = fit.interval[fit.names.index(f"{name}[0]")]
        assert low - 0.5 * (high - low) < value < high + 0.5 * (high - low)
    assert [0.6 < x.chi_square < 1.4 for x in fit.channels] == [True, True]
    assert min(x.ljung_box for x in fit.channels) > 1e-3
    assert fit.unseen == []
    assert fit["bob.mass"] == fit["bob.mass[0]"] == fit.x[0]


def test_tables_and_the_summary(fit):
    frame = fit.to_frame()
    assert list(frame.index) == fit.names
    assert frame.loc["bob.mass[0]", "low"] < fit.x[0] < frame.loc["bob.mass[0]", "high"]
    assert list(fit.channels_frame().index) == ["angle", "force"]
    text = repr(fit)
    for word in ("converged", "bob.mass[0]", "+-", "angle", "chi-square"):
        assert word in text
    assert len(fit.plot().axes) == 4
    with refused("name", "bob.mas", meant="bob.mass[0]"):
        fit["bob.mas"]


def test_a_channel_that_contradicts_the_other_is_seen_when_left_out():
    """The force is shown 5 % too large."""
    numbers = pendulum.data(0.01)
    numbers["force"] = 1.05 * numbers["force"]
    wrong = mbd.identification.identify(pendulum.experiment(numbers, **channels()), pendulum.UNKNOWNS)
    assert wrong.leave_one_out().loc["force"].abs().max() > 10.0


def test_leaving_one_out_is_linear_in_a_linear_problem(fit):
    """Against a fit without the channel."""
    numbers, kept = pendulum.data(0.01), channels()
    del kept["angle"]
    alone = mbd.identification.identify(pendulum.experiment(numbers, **kept), pendulum.UNKNOWNS)
    moves = fit.leave_one_out().loc["angle"].to_numpy() * fit.deviation
    np.testing.assert_allclose(moves, alone.x - fit.x, rtol=0.2, atol=0.1 * np.abs(alone.x - fit.x).max())


def test_what_only_the_channel_left_out_sees_stays(fit):
    """The angle alone hardly sees the mass: noise, and rounding, would move it by thousands of deviations."""
    assert fit.leave_one_out().loc["force"].abs().max() < 100.0


def test_a_fit_that_has_not_ended_claims_no_intervals():
    shown = {"angle": mbd.identification.Channel(pendulum.ANGLE)}
    fit = mbd.identification.identify(
        pendulum.experiment(pendulum.data(0.01), **shown), pendulum.UNKNOWNS, max_evaluations=2
    )
    assert fit.status == "max_evaluations"
    assert "cannot see" not in str(fit)
    assert "+-" not in str(fit)
    assert "angle" in str(fit)


def test_delay_gain_and_offset_are_recovered(compiled):
    late = {
        "angle": mbd.identification.Channel(
            pendulum.ANGLE, deviation=1e-4, delay=mbd.variable(0.0), gain=mbd.variable(1.0), offset=mbd.variable(0.0)
        ),
        "force": mbd.identification.Channel(pendulum.FORCE, deviation=1e-3),
    }
    t = pendulum.TIMES[5:]
    numbers = {"t": t, "angle": 1.3 * pendulum.shown(pendulum.ANGLE, t - 0.023) + 0.04}
    numbers["force"] = pendulum.shown(pendulum.FORCE, t)
    fit = mbd.identification.identify(
        pendulum.experiment(numbers, start=1.1, **late), pendulum.UNKNOWNS, bounds={"angle.delay": (-0.05, 0.05)}
    )
    result = [fit["angle.delay"], fit["angle.gain"], fit["angle.offset"], *(fit[name] for name in pendulum.UNKNOWNS)]
    np.testing.assert_allclose(result, [0.023, 1.3, 0.04, *pendulum.TRUTH.values()], rtol=1e-4)


def test_a_combination_that_is_not_seen_is_named(compiled):
    """The angle alone, of a bob without inertia of its own: mass, stiffness and damping have a common factor."""
    model = pendulum.system(1.3, 1.8, 0.16)
    model.bodies[0].inertia.data *= 1e-9
    truth = pendulum.system()
    truth.bodies[0].inertia.data *= 1e-9
    y = pendulum.shown(pendulum.ANGLE, pendulum.TIMES, truth)
    series = mbd.identification.TimeSeries(
        {"t": pendulum.TIMES, "angle": y}, {"angle": mbd.identification.Channel(pendulum.ANGLE, deviation=1e-4)}
    )
    fit = mbd.identification.identify(
        mbd.identification.Experiment(model, series, steps=pendulum.STEPS, duration=1.0), pendulum.UNKNOWNS
    )
    assert [x.words for x in fit.unseen] == ["bob.mass, spring.stiffness and spring.damping only up to a common factor"]
    assert np.isinf(fit.deviation).all()
    assert "the data cannot see it alone" in repr(fit)
    assert fit.remarks == ["the data cannot see it alone"] * 3
    low, high = fit.profile("bob.mass")
    assert (low < 0.1, high) == (True, np.inf)


@pytest.mark.parametrize("loss", ["soft_l1", "cauchy"])
def test_outliers(compiled, loss):
    numbers = pendulum.data(0.01)
    numbers["angle"][::9] += 1.0
    experiment = pendulum.experiment(numbers, start=1.1, **channels())
    plain = mbd.identification.identify(experiment, pendulum.UNKNOWNS)
    robust = mbd.identification.identify(experiment, pendulum.UNKNOWNS, loss=loss)
    error = [np.abs(fit.x / np.array([*pendulum.TRUTH.values()]) - 1.0).max() for fit in (plain, robust)]
    assert error[0] > 0.2
    assert error[1] < 0.05
    assert (np.abs(robust.x - [*pendulum.TRUTH.values()]) < 3.0 * robust.deviation).all()


def test_deviations_that_are_not_given_are_estimated(compiled):
    """Channels of other units and noise; the deviations of their residuals weigh them."""
    numbers = pendulum.data()
    rng = np.random.default_rng(2)
    numbers["angle"] = numbers["angle"] + 2e-3 * rng.standard_normal(60)
    numbers["force"] = numbers["force"] + 0.3 * rng.standard_normal(60)
    fit = mbd.identification.identify(
        pendulum.experiment(numbers, 1.1, angle=pendulum.ANGLE, force=pendulum.FORCE), pendulum.UNKNOWNS
    )
    assert [x.deviation for x in fit.channels] == pytest.approx([2e-3, 0.3], rel=0.25)
    given = {
        "angle": mbd.identification.Channel(pendulum.ANGLE, deviation=2e-3),
        "force": mbd.identification.Channel(pendulum.FORCE, deviation=0.3),
    }
    known = mbd.identification.identify(pendulum.experiment(numbers, 1.1, **given), pendulum.UNKNOWNS)
    np.testing.assert_allclose(fit.deviation, known.deviation, rtol=0.25)
    assert (np.abs(fit.x - known.x) < 0.3 * known.deviation).all()


def test_held_out_data(compiled):
    """The model that the first mass fits agrees with the second; a wrong model does not."""
    experiments = []
    for mass in (1.2, 2.0):
        rng = np.random.default_rng(int(10 * mass))
        y = pendulum.shown(pendulum.ANGLE, pendulum.TIMES, pendulum.system(mass)) + 1e-3 * rng.standard_normal(60)
        series = mbd.identification.TimeSeries(
            {"t": pendulum.TIMES, "angle": y}, {"angle": mbd.identification.Channel(pendulum.ANGLE, deviation=1e-3)}
        )
        experiments.append(
            mbd.identification.Experiment(
                pendulum.system(1.2, 1.6, 0.12), series, {"bob.mass": mass}, steps=40, duration=1.0
            )
        )
    unknowns = ["spring.stiffness", "spring.damping"]
    fit = mbd.identification.identify(experiments[:1], unknowns, validation=experiments[1:])
    [held_out] = fit.validation
    assert held_out.chi_square < 3.0
    wrong = mbd.identification.identify(experiments[:1], unknowns[1:], validation=experiments[1:])
    assert wrong.validation[0].chi_square > 5.0
    assert "held out: angle" in repr(fit)


def test_priors_hold_what_the_data_do_not_see(compiled):
    numbers = pendulum.data(0.01)
    kept = {"angle": channels()["angle"]}
    free = mbd.identification.identify(pendulum.experiment(numbers, 1.1, **kept), pendulum.UNKNOWNS)
    prior = mbd.identification.identify(
        pendulum.experiment(numbers, 1.1, **kept), pendulum.UNKNOWNS, priors={"bob.mass": (1.2, 0.01)}
    )
    assert prior.deviation[0] <= 0.01 < free.deviation[0]
    assert abs(prior["bob.mass"] - 1.2) < 0.03


def test_many_starts_are_batches(compiled):
    """Damped and driven far: starts end in several minima; the best is that of the truth."""
    experiment = pendulum.experiment(pendulum.data(), start=1.0)
    bounds = {"bob.mass": (0.3, 5.0), "spring.stiffness": (0.1, 30.0), "spring.damping": (0.0, 2.0)}
    batches = []
    from torchmbd.extensions.identification.fit_problem import FitProblem

    evaluate = FitProblem.evaluate

    def counted(self, X, gradients):
        batches.append(len(X))
        return evaluate(self, X, gradients)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FitProblem, "evaluate", counted)
        fit = mbd.identification.identify(
            experiment, pendulum.UNKNOWNS, bounds=bounds, starts=mbd.optimization.sobol(4, seed=1)
        )
    assert len(fit.starts) == 4
    assert [x.cost for x in fit.starts] == sorted(x.cost for x in fit.starts)
    assert batches[0] == 4
    assert sum(x.evaluations for x in fit.starts) == fit.evaluations == sum(batches)
    np.testing.assert_allclose(fit.x, [*pendulum.TRUTH.values()], rtol=1e-5)


def test_failed_simulations_are_statuses(compiled):
    """The angle is no number for a mass above 3 kg."""

    @mbd.history
    def angle(motion):
        y = pendulum.ANGLE.values(motion)
        return torch.where(motion.designs["bob.mass"][:, None] > 3.0, torch.nan, y)

    channel = mbd.identification.Channel(angle, deviation=1e-3)
    experiment = pendulum.experiment(pendulum.data(0.01), 1.0, angle=channel, force=channels()["force"])
    failed = mbd.identification.identify(experiment, pendulum.UNKNOWNS, start={"bob.mass": 4.0})
    assert failed.status == "failed"
    assert failed.message.startswith("the start: failed: ")
    assert "failed" in repr(failed)
    with refused("result", "failed"):
        failed.to_frame()
    far = mbd.identification.identify(
        experiment,
        pendulum.UNKNOWNS,
        starts=[[1.3, 1.5, 0.2], [4.0, 1.0, 0.1]],
    )
    assert (far.status, far.failures >= 1, far.starts[-1].status) == ("converged", True, "failed")


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ({"loss": "l1"}, "loss"),
        ({"f_scale": 0.0}, "f_scale"),
        ({"scales": {"bob.mass": 0.0}}, "scale.bob.mass[0]"),
        ({"starts": [[1.0]]}, "start"),
        ({"max_evaluations": 0}, "max_evaluations"),
        ({"tolerance": 1.0}, "tolerance"),
        ({"validation": [3]}, "validation"),
    ],
)
def test_bad_input_is_named(arguments, path):
    with refused(path):
        mbd.identification.identify(pendulum.experiment(pendulum.data()), pendulum.UNKNOWNS, **arguments)


def test_experiments_of_another_kind():
    for wrong in (3, [], {}, "x", [3]):
        with refused("experiments"):
            mbd.identification.identify(wrong, ["x"])


def test_an_unknown_with_equal_bounds_is_a_constant():
    """Deviations of the others are those of a fit in which it is none, and no combination with it is unseen."""
    numbers = pendulum.data(0.01)
    held = mbd.identification.identify(
        pendulum.experiment(numbers, 1.0), pendulum.UNKNOWNS, bounds={"bob.mass": (1.2, 1.2)}, tolerance=1e-9
    )
    without = mbd.identification.identify(pendulum.experiment(numbers, 1.0), pendulum.UNKNOWNS[1:], tolerance=1e-9)
    np.testing.assert_allclose(held.deviation[1:], without.deviation, rtol=1e-6)
    assert held.deviation[0] == 0.0
    assert held.freedoms == without.freedoms
    np.testing.assert_allclose(held.singular_values, without.singular_values, rtol=1e-6)
    assert "1.2, its bounds" in str(held)
