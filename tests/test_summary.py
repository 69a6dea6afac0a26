"""What objects say of themselves in a terminal and in a notebook: short, whatever they hold; and data frames."""

from __future__ import annotations

import pytest

import torchmbd as mbd
from tests.mechanisms import pendulum
from torchmbd.summary import few, plural, table


@pytest.fixture(scope="module")
def motion():
    return mbd.simulate(pendulum(), 0.02, steps=100)


def test_no_description_is_longer_than_a_screen(motion):
    name = motion.dynamics.topology.names[0]
    joint = motion.system.joints[0].name
    for result in (motion, motion.body(name), motion.energies, motion.reaction(joint), motion.system):
        assert 20 < len(repr(result)) < 1500
        assert len(repr(result).splitlines()) < 20
        assert result._repr_html_().startswith(("<b>", "<svg"))
    assert "0 to 0.02 s, 101 times" in repr(motion)


@pytest.mark.extensions
def test_results_with_large_tensors_show_their_numbers_and_shapes():
    body = mbd.examples.arm().body("arm")
    modes = mbd.natural_frequencies(body, number=2)
    loaded = mbd.buckling.linear_buckling(body, {"right": (-1.0, 0.0, 0.0)})
    drawn = mbd.vibrations.campbell(mbd.examples.pendulum(), [0.0], modes=1)
    phases = [mbd.Phase(lasting=0.1), mbd.Phase(name="second")]
    [switch] = mbd.simulate(mbd.examples.pendulum(), 0.2, phases=phases, steps=20).switches
    for result in (modes, loaded, drawn, switch, switch.before):
        assert "tensor(" not in repr(result)
        assert len(repr(result).splitlines()) < 20
    assert repr(switch) == "Switch('second' begins at t = 0.1 s)"
    assert f"{modes.frequencies[1].item():.4g} Hz" in repr(modes)
    assert "vibration 1" in repr(drawn)


def test_a_failed_lane_is_shown(motion):
    from dataclasses import replace

    assert "1 of 1 lanes: failed: so" in repr(replace(motion, status=["failed: so"]))


def test_the_diagram_has_every_body_and_joint(motion):
    drawn = motion.system._repr_html_()
    for named in (*motion.system.bodies, *motion.system.joints):
        assert f">{named.name}</text>" in drawn


def test_text_in_tables_is_text():
    assert "<script>" not in table([("<script>", 1)])
    assert few(list("abcdefgh")) == "a, b, c, d, e, f, ... (8 in all)"
    assert few([]) == "none"


def test_a_problem_is_shown_without_memory_addresses():
    """Operations as Python writes them, functions of users by their names."""

    @mbd.measure
    def reach(motion):
        return motion.t.new_ones(motion.lanes)

    arm, energy = mbd.examples.arm(), mbd.StrainEnergy("arm")
    asked = 2.0 * mbd.Max(abs(energy) ** 2 - 3.0 * energy) / mbd.Mass("arm")
    text = str(mbd.Problem(arm, 0.1, asked, [reach <= 1.0, mbd.Max(energy / 2.0) <= 1.0], steps=4))
    assert "built-in" not in text
    assert " at 0x" not in text
    assert "(abs(StrainEnergy(body='arm')) ** 2)" in text
    assert "measure(reach)" in text


def test_one_thing_is_not_several():
    assert [plural(n, "start") for n in (0, 1, 2)] == ["no starts", "1 start", "2 starts"]
