"""A motion as a component of OpenMDAO: values, partial derivatives in both directions, an optimization, bad input."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

import torchmbd as mbd
from tests.refused import refused

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "openmdao.md"
ENERGY = mbd.Integral(mbd.StrainEnergy("arm"))
RESPONSES = {
    "energy": ENERGY,
    "mass": mbd.Mass("arm"),
    "places": mbd.AtTimes(mbd.Position("arm", axis="x"), times=[0.01, 0.02]),
}


@pytest.mark.thorough
def test_values_and_partials():
    om = pytest.importorskip("openmdao.api")
    arm = mbd.examples.arm()
    for mode, way in (("fwd", "reverse"), ("rev", "forward")):
        problem = om.Problem(reports=False)
        problem.model.add_subsystem(
            "arm", mbd.openmdao_component(arm, 0.02, RESPONSES, steps=20, gradients=way), promotes=["*"]
        )
        problem.setup(mode=mode)
        problem.set_val("arm:laminate:angles", mbd.deg([35.0, -20.0]))
        problem.run_model()
        design = {"arm.laminate.angles": mbd.deg([[35.0, -20.0]])}
        motion = mbd.simulate(arm, 0.02, designs=design, steps=20)
        for name, measure in RESPONSES.items():
            np.testing.assert_allclose(problem.get_val(name), measure(motion).reshape(-1).detach().numpy(), rtol=1e-12)
        own = [_name(name) for name, x in arm.named_parameters() if x.requires_grad]
        totals = problem.compute_totals(of=list(RESPONSES), wrt=own)
        assert {shape.shape[0] for (output, _), shape in totals.items() if output == "places"} == {2}
        checked = problem.check_totals(of=["energy", "mass"], wrt=own, out_stream=None, step=1e-5, form="central")
        for key, result in checked.items():
            size = max(np.abs(result["J_fd"]).max(), 1e-9)
            assert np.abs(result["J_fwd" if "J_fwd" in result else "J_rev"] - result["J_fd"]).max() < 1e-5 * size, key


def test_parameters_of_one_number():
    """A block on a spring that rests at 0.01: x = 0.01 (1 - cos sqrt(k / m) t)."""
    om = pytest.importorskip("openmdao.api")
    k, m, t = 2e3, 1.0, 0.02
    ground, block = mbd.Ground(), mbd.RigidBody("block", mbd.variable(m), (1e-3, 1e-3, 1e-3))
    slide = mbd.Prismatic(ground.at(), block.at(), axis="x")
    spring = mbd.AxialSpringDamper(ground.at(), block.at(), "x", stiffness=mbd.variable(k), rest=0.01, name="spring")
    system = mbd.System([block], [slide], [spring])
    problem = om.Problem(reports=False)
    component = mbd.openmdao_component(system, t, {"x": mbd.Final(mbd.Displacement("block", "x"))}, steps=200)
    problem.model.add_subsystem("block", component, promotes=["*"])
    problem.setup()
    problem.run_model()
    w = np.sqrt(k / m)
    assert problem.get_val("x") == pytest.approx(0.01 * (1 - np.cos(w * t)), rel=1e-5)
    totals = problem.compute_totals(of=["x"], wrt=["spring:stiffness", "block:mass"])
    slope = 0.01 * t * np.sin(w * t) * w / 2
    assert totals["x", "spring:stiffness"].item() == pytest.approx(slope / k, rel=1e-4)
    assert totals["x", "block:mass"].item() == pytest.approx(-slope / m, rel=1e-4)


def test_a_complex_step_is_refused():
    """Its derivatives would be zero."""
    om = pytest.importorskip("openmdao.api")
    component = mbd.openmdao_component(mbd.examples.arm(), 0.002, {"energy": ENERGY}, steps=2)
    problem = om.Problem(reports=False)
    problem.model.add_subsystem("arm", component, promotes=["*"])
    problem.model.add_design_var("arm:laminate:angles")
    problem.model.add_objective("energy")
    problem.model.approx_totals(method="cs")
    problem.setup(force_alloc_complex=True)
    problem.run_model()
    with pytest.raises(RuntimeError, match="a motion has no complex step"):
        problem.compute_totals()


@pytest.mark.thorough
def test_an_optimization_ends_where_ours_does():
    om = pytest.importorskip("openmdao.api")
    arm = mbd.examples.arm()
    problem = om.Problem(reports=False)
    component = mbd.openmdao_component(arm, 0.02, {"energy": ENERGY}, variables=["arm.laminate.angles"], steps=20)
    problem.model.add_subsystem("arm", component, promotes=["*"])
    problem.model.add_design_var("arm:laminate:angles", lower=-1.5, upper=1.5)
    problem.model.add_objective("energy", scaler=1e4)
    problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", disp=False, tol=1e-10)
    problem.setup()
    problem.run_driver()
    ours = mbd.Problem(arm, 0.02, ENERGY, variables=["arm.laminate.angles"], bounds=(-1.5, 1.5), steps=20)
    expected = mbd.optimize(ours, method="slsqp", ftol=1e-10, progress=False).value
    assert float(problem.get_val("energy")[0]) == pytest.approx(expected, rel=1e-4)


@pytest.mark.thorough
def test_the_page_runs():
    pytest.importorskip("openmdao.api")
    [code] = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    names: dict = {}
    exec(compile(code, str(PAGE), "exec"), names)
    angles = dict(names["arm"].named_parameters())["arm.laminate.angles"].detach()
    assert not np.allclose(names["problem"].get_val("arm:laminate:angles"), angles)


def test_bad_input(monkeypatch):
    arm = mbd.examples.arm()
    if "openmdao" in sys.modules or _installed():
        with refused("responses"):
            mbd.openmdao_component(arm, 0.02, {})
        with refused("energy"):
            mbd.openmdao_component(arm, 0.02, {"energy": mbd.StrainEnergy("arm")})  # pyright: ignore[reportArgumentType]
        with refused("parameter", "arm.laminat.angles"):
            mbd.openmdao_component(arm, 0.02, {"energy": ENERGY}, variables=["arm.laminat.angles"])
    monkeypatch.setitem(sys.modules, "openmdao.api", None)
    with refused("package", "openmdao", "pip install 'torchmbd[openmdao]'"):
        mbd.openmdao_component(arm, 0.02, {"energy": ENERGY})


def _name(parameter: str) -> str:
    return parameter.replace(".", ":")


def _installed() -> bool:
    try:
        import openmdao.api  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:
        return False
    return True
