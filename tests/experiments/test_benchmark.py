"""The benchmark measures what it says: same mechanisms in both codes, exact gradients, honest gaps. Tiny sizes."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchmbd as mbd
from experiments.benchmark import __main__ as benchmark
from experiments.benchmark import chosen_steps as benchmark_chosen_steps
from experiments.benchmark import costs as benchmark_costs
from experiments.benchmark import evaluate as benchmark_evaluate
from experiments.benchmark import motion as benchmark_motion
from experiments.benchmark import multistart as benchmark_multistart
from experiments.benchmark import processes, stages
from experiments.benchmark import segments as benchmark_segments
from experiments.benchmark import study as benchmark_study
from experiments.benchmark import tube as benchmark_tube
from experiments.benchmark.cases import Case, compilation, compiled_ready, crank3, interleaved, loops, motion, pendulum
from experiments.benchmark.report import Result, Settings
from experiments.peers import exudyn_peer
from torchmbd.examples import slider_crank


@pytest.fixture(autouse=True)
def eager(monkeypatch):
    monkeypatch.setenv("TORCHMBD_COMPILE", "0")


def small() -> Case:
    return pendulum(2, modes=3, cells=(6, 2), duration=0.01)


def spherical_crank(angles) -> Case:
    """The slider-crank with the joint that the peer has at the slider."""
    system = slider_crank.build(len(angles), angles, cells=(8, 2), modes=4, joint="spherical")
    return Case("", system, 0.01, {"rod.laminate.angles": 0.3}, exudyn_peer.slider_crank)


CASES = {
    "pendulum": small,
    "slider-crank": lambda: spherical_crank([45.0, -45.0, 45.0]),
    "closed loops": lambda: loops(modes=3, cells=(6, 2), duration=0.01),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", CASES)
def test_both_codes_simulate_the_same_mechanism(name):
    case = CASES[name]()
    pytest.importorskip("exudyn")
    steps, lanes = 200, 2
    ours = mbd.simulate(case.system, case.duration, steps=steps, designs=case.designs(lanes)).require_ok()
    U = sum(ours.body(body.name).strain_energy for body in case.system.bodies if hasattr(body, "mesh"))
    runs = case.peer(case.system, case.designs(lanes))
    for lane, run in enumerate(runs):
        result = run(case.duration, steps)
        np.testing.assert_allclose(result.t, ours.t.numpy(), atol=1e-9)
        # Rotary inertia of the nodes is a part in a thousand of what matters here.
        assert np.abs(result.U - U[lane].numpy()).max() < 2e-3 * float(U[lane].max())
        assert result.seconds > 0.0


def test_a_peer_that_fails_says_so_in_its_numbers():
    pytest.importorskip("exudyn")
    case = spherical_crank([45.0, -45.0, 45.0])
    [run] = exudyn_peer.slider_crank(case.system, case.designs(1))
    assert np.isnan(run(0.06, 5).U).all()


@pytest.mark.thorough
def test_responses_are_those_of_the_measures_and_their_gradients():
    case, lanes, steps = small(), 2, 60
    values, gradients = motion(case.dynamics(lanes, True), case.duration, steps)
    names = list(case.variables)
    reference = mbd.simulate(
        case.system, case.duration, steps=steps, designs=case.designs(lanes), gradients="forward", variables=names
    )
    total = mbd.StrainEnergy("link0") + mbd.StrainEnergy("link1")
    for row, measure in enumerate((mbd.Max(total), mbd.Integral(total))):
        value, gradient = measure.value_and_gradient(reference)
        torch.testing.assert_close(values[row], value)
        torch.testing.assert_close(gradients[row], gradient)
    alone, nothing = motion(case.dynamics(lanes, False), case.duration, steps)
    torch.testing.assert_close(alone, values, rtol=1e-9, atol=0.0)
    assert nothing.numel() == 0


def test_fewer_tangents_are_the_first_ones():
    case = crank3(modes=3, cells=(6, 2))
    whole = case.dynamics(2, True)
    _, every = motion(whole, 0.002, 20)
    _, two = motion(benchmark_costs._first_tangents(whole, 2), 0.002, 20)
    assert two.shape[-1] == 2
    torch.testing.assert_close(two, every[..., :2], rtol=1e-6, atol=1e-9 * float(every.abs().max()))


def test_the_ladder_ends_at_the_first_rung_that_is_accurate_enough():
    def run(steps):
        error = torch.tensor([[40.0, 10.0], [20.0, -30.0]]) / steps**2
        return (1.0 + error) * torch.tensor([[2.0, 3.0], [4.0, 5.0]]) if steps != 300 else torch.full((2, 2), torch.nan)

    result = benchmark_motion.accuracy(run, ladder=(100, 200, 300, 400), converged=10**6)
    assert result.steps == 400  # 40/200^2 is too much, 300 failed
    assert result.peak == pytest.approx(40 / 400**2, rel=1e-4)
    assert result.integral == pytest.approx(30 / 400**2, rel=1e-4)


def test_runs_are_interleaved_and_the_fastest_counts():
    order, own = [], iter([3.0, 1.0, 2.0])

    def peer():
        order.append("peer")
        return next(own)

    seconds = interleaved({"ours": lambda: order.append("ours"), "peer": peer}, 3)
    assert order == ["ours", "peer"] * 3
    assert seconds["peer"] == 1.0
    assert seconds["ours"] < 1.0


def test_differences_of_the_peer_become_gradients(monkeypatch):
    def fake(X, steps):
        peak, integral = 1.0 + (X**2).sum(1), 2.0 + X @ np.array([1.0, 2.0, 3.0])
        return np.stack([peak, integral], 1), 0.5

    monkeypatch.setattr(benchmark_multistart, "_peer_measures", fake)
    pool = SimpleNamespace(starmap=lambda f, arguments: [benchmark_multistart._peer_measures(*a) for a in arguments])
    start = np.array([0.5, 0.0, 0.0])
    own = SimpleNamespace(start=start, lower=-start, upper=start, names=["a", "b", "c"], period=None, equalities=[])
    problem = benchmark_multistart.PeerProblem(own, pool, steps=10)
    x = np.array([[0.1, 0.2, 0.3], [0.0, 0.0, 1.0]])
    first, second = problem.evaluate(x, gradients=True)
    assert first.objective == pytest.approx(3.4)
    np.testing.assert_allclose(first.objective_gradient, [1.0, 2.0, 3.0], rtol=1e-6)
    np.testing.assert_allclose(second.constraints, [2.0 / 1.25 - 1.0])
    np.testing.assert_allclose(second.constraint_gradients, [[0.0, 0.0, 2.0 / 1.25]], atol=1e-3)
    assert problem.evaluate(x, gradients=False)[0].objective_gradient is None


def test_nothing_is_built_when_not_asked_for(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHMBD_CACHE", str(tmp_path / "empty"))
    dynamics = crank3(modes=2, cells=(4, 2)).dynamics(2, True)
    assert not compiled_ready(dynamics, build=False)
    assert not (tmp_path / "empty").exists()
    result = benchmark_motion.measured(crank3(modes=2, cells=(4, 2)), benchmark_motion.ROWS, Settings(quick=True))
    assert set(result.figures.values()) == {None}


def test_compilation_is_switched_within_a_block_only(monkeypatch):
    import os

    with compilation(True):
        assert os.environ["TORCHMBD_COMPILE"] == "1"
    assert os.environ["TORCHMBD_COMPILE"] == "0"
    monkeypatch.delenv("TORCHMBD_COMPILE")
    with compilation(False):
        assert os.environ["TORCHMBD_COMPILE"] == "0"
    assert "TORCHMBD_COMPILE" not in os.environ


@pytest.mark.thorough
def test_json_is_one_object_with_every_figure(capsys):
    benchmark.main(["--json", "--quick", "structure", "multistart"])
    out, err = capsys.readouterr()
    [line] = out.splitlines()
    report = json.loads(line)
    assert set(report) == {*benchmark.FIGURES, "machine", "versions"}
    assert all(report[name] is None for name in benchmark.FIGURES)  # too small to be the figures they are named after
    assert report["versions"]["torch"] == torch.__version__
    assert "freedoms" in err


def test_a_part_whose_process_fails_is_printed_with_its_error_and_the_others_go_on(monkeypatch, capsys):
    done = []

    def child(settings):
        raise processes.ChildFailure("the reason of the child")

    def other(settings):
        done.append("other")
        return Result({"structure_ms": 2.5})

    monkeypatch.setattr(benchmark, "PARTS", {"child": child, "other": other})
    assert benchmark.main(["--json", "--quick"]) == 1
    out, err = capsys.readouterr()
    assert json.loads(out)["structure_ms"] == 2.5
    assert done == ["other"]
    assert "the reason of the child" in err
    assert "failed: child" in err


def test_the_error_of_a_process_is_in_the_message(monkeypatch, tmp_path):
    (tmp_path / "fails.py").write_text("import sys\nprint('some lines')\nsys.exit('the reason of the child')")
    monkeypatch.setattr(processes, "ROOT", tmp_path)
    with pytest.raises(processes.ChildFailure, match="ended with 1\nthe reason of the child"):
        processes.fresh("fails", folder=tmp_path)
    (tmp_path / "works.py").write_text("print('a word')\nprint('{\"seconds\": 2.5}')")
    assert processes.fresh("works", folder=tmp_path) == {"seconds": 2.5}


def test_stages_are_those_of_the_innermost_function_that_has_one():
    def at(*places):  # the innermost first
        frame = None
        for place in reversed(places):
            file, _, name = place.partition(":")
            frame = SimpleNamespace(f_code=SimpleNamespace(co_filename=file, co_name=name), f_back=frame)
        return stages.stage_of(frame)

    library = "/x/torchmbd"
    assert at(f"{library}/fem/shift.py:solve", f"{library}/multibody/system/system.py:stages") == "structure"
    assert at("/x/torch/_ops.py:call", f"{library}/extensions/native/steps.py:run", "scipy/a.py:b") == "steps"
    assert at(f"{library}/integrate/simulate.py:f", f"{library}/study/report/terminal.py:save_pictures") == "pictures"
    assert at("<frozen importlib._bootstrap>:_load", f"{library}/integrate/registry.py:f") == "imports"
    assert at("/x/torch/autograd/__init__.py:grad", f"{library}/design/differentiate.py:f") == stages.BACKWARD
    assert at("/x/rich/console.py:print") == "other"


@pytest.mark.thorough
def test_the_main_job_is_measured_by_stages():
    [table] = benchmark_study.study(Settings(quick=True)).tables
    seconds = {name: (cold, warm) for name, cold, warm in table.rows}
    assert 0.0 < seconds["first line"][1] <= seconds["first iteration"][1] < seconds["table"][1]
    assert min(*seconds["imports"], *seconds["steps"], *seconds["structure"], *seconds["pictures"]) > 0.0
    own = sum(seconds[name][1] for name in (*benchmark_study.STAGES, "idle"))
    assert own == pytest.approx(seconds["last line"][1], rel=0.2)


@pytest.mark.thorough
def test_evaluations_are_measured_beside_the_sum_of_their_parts():
    [table] = benchmark_evaluate.evaluate(Settings(quick=True)).tables
    for _, whole, *parts, ratio in table.rows:
        assert ratio == pytest.approx(whole / sum(parts))


@pytest.mark.thorough
def test_phases_are_measured_beside_none():
    trivial, switches, antenna = benchmark_segments.segments(Settings(quick=True)).tables
    assert [row[:2] for row in trivial.rows] == [[1, "values"], [1, "gradient"]]
    assert [row[:2] for row in switches.rows] == [["switch", "values"], ["switch", "gradient"]]
    assert not antenna.rows


@pytest.mark.thorough
def test_an_optimization_by_chosen_steps_is_measured_beside_one_by_given_steps():
    result = benchmark_chosen_steps.chosen_steps(Settings(quick=True))
    [[_, steps, *motions, chosen, given, ratio, value, other]] = result.tables[0].rows
    assert steps == benchmark_chosen_steps.QUICK
    assert motions[0] == motions[1] > 0
    assert ratio == pytest.approx(chosen / given)
    assert value == other
    assert result.figures == {"chosen_steps_ratio": None}


@pytest.mark.thorough
def test_no_design_of_a_round_tube_fails_by_its_number_of_modes():
    table, _ = benchmark_tube.round_tube(Settings(quick=True)).tables
    assert [row[:3] for row in table.rows] == [["first tube", 6, 0], ["second tube", 5, 0]]


def test_an_unknown_part_is_refused_with_the_names_of_all(capsys):
    with pytest.raises(SystemExit):
        benchmark.main(["gradiants"])
    message = capsys.readouterr().err
    assert "gradiants" in message
    assert "work-precision" in message
