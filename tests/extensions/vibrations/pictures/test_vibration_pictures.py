"""Pictures of a study that asks for vibrations: which are drawn, of which numbers, and that pages have the shapes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from torchmbd.study.report.terminal import draw_measures
from torchmbd.viz import campbell, root_locus

LABELS = ["start design", "best design"]
GROUND = mbd.Ground()


def bar(speed: float) -> mbd.System:
    """A bar that flaps on a hub against a spring: w^2 = speed^2 (1 + m e s / I) + k / I."""
    hub = mbd.RigidBody("hub", 1.0, (1e-3, 1e-3, 1e-3))
    blade = mbd.RigidBody("bar", 2.0, (1e-9, 0.1, 0.1), position=(0.7, 0.0, 0.0))
    joints: list[Any] = [mbd.Revolute(hub.at(0.2, 0, 0), blade.at(-0.5, 0, 0), axis="y", name="root")]
    if speed:
        joints += [mbd.Revolute(GROUND.at(), hub.at(), axis="z"), mbd.Drive(GROUND, hub, axis="z", speed=speed)]
    else:
        joints.append(mbd.Fixed(GROUND.at(), hub.at()))
    spring = mbd.RotationalSpringDamper(
        hub.at(), blade.at(), axis="y", stiffness=mbd.variable(60.0), damping=0.2, name="spring"
    )
    return mbd.System([hub, blade], joints, [spring])


def pictures(
    speed: float, minimize: Any, subject_to: Any, folder: Any
) -> tuple[dict[str, tuple[Any, dict]], list[str]]:
    """Files -> figure function and arguments; names of pages."""
    system = bar(speed)
    [name] = [name for name, _ in system.named_parameters()]
    problem = mbd.Problem(
        system, duration=1e-3, steps=2, variables=[name], bounds=(10.0, 100.0), minimize=minimize, subject_to=subject_to
    )
    motion = mbd.simulate(system, 1e-3, steps=2, designs={name: torch.tensor([60.0, 90.0], dtype=torch.float64)})
    drawn: dict[str, tuple[Any, dict]] = {}

    def draw(figure: Any, files: list[str], **arguments: Any) -> None:
        figure(**arguments)
        drawn.update(dict.fromkeys(files, (figure, arguments)))

    pages = draw_measures(problem, motion, LABELS, "a bar", draw, folder)
    return drawn, [page.name for page in pages]


@pytest.mark.thorough
def test_a_campbell_diagram_and_a_locus_over_the_speeds_that_are_asked_for(tmp_path):
    clear = mbd.vibrations.CampbellClearance(orders=(1, 3), band=(3.0, 6.0), modes=(1,))
    damped = mbd.vibrations.DampingRatio(1, speed=4.0) >= 0.001
    drawn, pages = pictures(4.0, mbd.Mass(), [clear >= -1.0, damped], tmp_path)
    assert set(drawn) == {
        f"{name}.{kind}" for name in ("campbell_start", "campbell_best", "root_locus_best") for kind in ("png", "pdf")
    }
    assert pages == ["mode_best_1.html"]
    figure, arguments = drawn["campbell_best.png"]
    assert figure is campbell
    assert arguments["orders"] == [1, 3]
    assert arguments["title"] == "best design: a bar"
    speeds = arguments["speeds"]
    assert (float(speeds[0]), float(speeds[-1])) == pytest.approx((0.0, 6.6))
    inertia = 0.1 + 2.0 * 0.5**2
    expected = (speeds**2 * (1.0 + 2.0 * 0.2 * 0.5 / inertia) + 90.0 / inertia).sqrt() / (2.0 * torch.pi)
    assert_close(arguments["frequencies"][:, 0], expected, rtol=1e-4, atol=0.0)
    assert_close(arguments["damping"][:, 0], 0.2 / inertia / (4.0 * torch.pi * expected), rtol=1e-4, atol=0.0)
    figure, arguments = drawn["root_locus_best.pdf"]
    assert figure is root_locus
    assert "best design, vibration 1 at 6 rad/s: " in (tmp_path / "mode_best_1.html").read_text()


def test_a_machine_at_rest_has_shapes_alone(tmp_path):
    total = mbd.WeightedSum([(1.0, mbd.Mass()), (1.0, mbd.vibrations.SystemFrequency(1))])
    drawn, pages = pictures(0.0, total, [], tmp_path)
    assert not drawn
    assert pages == ["mode_best_1.html"]


def test_other_problems_have_none(tmp_path):
    assert pictures(0.0, mbd.Mass(), [], tmp_path) == ({}, [])


@pytest.mark.parametrize("widths", [(0.03, 0.02), (0.02, 0.03)])
def test_the_best_design_may_retain_another_number_of_modes(widths, tmp_path):
    """The square beam has pairs of equal frequencies, and retains four modes, not three; the page has its lowest frequency."""
    steel, width = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0), mbd.variable(widths[0])
    section = mbd.sections.rectangle(width, 0.02, steel, cells=(2, 2))
    beam = mbd.FlexibleBody.beam("beam", mbd.BeamLine.straight(1.0, 4), section, modes=3, reference="start")
    system = mbd.System([beam], [mbd.Fixed(GROUND.at(), beam.at("start"))])
    first = mbd.vibrations.SystemFrequency(1)
    problem = mbd.Problem(
        system, 1e-3, mbd.Mass(), [first >= 1.0], (0.01, 0.1), ["beam.section.width"], steps=2, start=[widths[0]]
    )
    designs = {"beam.section.width": torch.tensor(widths, dtype=torch.float64)}
    motion = mbd.simulate(system, 1e-3, steps=2, designs=designs)
    alone = (
        mbd.simulate(system, 1e-3, steps=2, designs={"beam.section.width": x[None]})
        for x in designs["beam.section.width"]
    )
    assert {one.body("beam").w.shape[-1] for one in alone} == {3, 4}
    [page] = draw_measures(problem, motion, LABELS, "a beam", lambda *_, **__: None, tmp_path)
    assert f"vibration 1: {first(motion)[1].item():.4g} Hz" in page.read_text()
