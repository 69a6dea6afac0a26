"""Campbell diagrams and root loci: what the figures hold is what they were given."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from torchmbd.extensions.vibrations.pictures.spectra import crossings

SPEEDS = torch.linspace(0.0, 300.0, 31, dtype=torch.float64)
FREQUENCIES = torch.stack([20.0 - 0.02 * SPEEDS, 20.0 + 0.03 * SPEEDS], 1)


def test_crossings_of_straight_lines_are_exact():
    """20 + a w = n w / (2 pi)."""
    for order in (1, 2, 3):
        expected = sorted(w for a in (-0.02, 0.03) if (w := 20.0 / (order / (2 * math.pi) - a)) <= 300.0)
        result = crossings(SPEEDS.numpy(), FREQUENCIES.numpy(), order)
        assert sorted(result[:, 0]) == pytest.approx(expected, rel=1e-12)
        assert result[:, 1] == pytest.approx(order * result[:, 0] / (2 * math.pi))


def test_a_touch_counts_once_and_gaps_do_not():
    speeds = np.array([1.0, 2.0, 3.0])
    line = np.array([1.0, 2.0, 3.0]) / (2 * math.pi)
    on = line + np.array([0.1, 0.0, -0.1])
    assert crossings(speeds, on[:, None], 1.0)[:, 0].tolist() == [2.0]
    gap = line + np.array([0.1, np.nan, -0.1])
    assert not len(crossings(speeds, gap[:, None], 1.0))


def test_campbell_has_frequencies_orders_crossings_and_growth():
    damping = torch.stack([0.01 - 1e-4 * SPEEDS, 0.02 + 0.0 * SPEEDS], 1)
    figure = mbd.viz.campbell(SPEEDS, FREQUENCIES, damping, orders=(1, 2), title="a rotor")
    top, bottom = figure.axes[:2]
    assert [text.get_text() for text in top.texts][:2] == ["1/rev.", "2/rev."]
    np.testing.assert_allclose(np.asarray(top.lines[0].get_ydata()), FREQUENCIES[:, 0].numpy())
    [marks] = [line for line in top.lines if line.get_marker() == "o"]
    assert np.asarray(marks.get_xdata()).size == sum(
        len(crossings(SPEEDS.numpy(), FREQUENCIES.numpy(), n)) for n in (1, 2)
    )
    [grows] = [line for line in top.lines if line.get_label() == "grows"]
    assert float(np.asarray(grows.get_xdata()).min()) == 110.0
    np.testing.assert_allclose(np.asarray(bottom.lines[0].get_ydata()), 100.0 * damping[:, 0].numpy())
    assert figure.get_suptitle() == "a rotor"


def test_rounding_is_no_growth_and_no_label_lies_on_another():
    """An undamped rotor whose damping ratios are rounding; two whirls that nearly coincide, and two that do."""
    frequencies = torch.stack(
        [10.0 - 0.002 * SPEEDS, 10.0 + 0.002 * SPEEDS, 24.5 + 0.0 * SPEEDS, 24.5 + 0.0 * SPEEDS], 1
    )
    figure = mbd.viz.campbell(SPEEDS, frequencies, -1e-11 + 0.0 * frequencies, orders=(1, 2))
    top, bottom = figure.axes[:2]
    assert not [line for axes in (top, bottom) for line in axes.lines if line.get_marker() == "x"]
    assert bottom.get_ylim() == (-1.0, 1.0)
    figure.canvas.draw()
    texts = [text for text in top.texts if text.get_text()]
    assert [text.get_text() for text in texts].count("153.9") == 1
    boxes = [text.get_window_extent() for text in texts]
    assert len(boxes) == 8  # two orders, three crossings of each
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_the_dashes_of_a_line_tell_its_whirl():
    """A line has a piece for each sense, and the pieces are the line."""
    whirl = torch.ones(31, 2, dtype=torch.long)
    whirl[0], whirl[:, 0], whirl[20:, 0] = 0, -1, 0
    top = mbd.viz.campbell(SPEEDS, FREQUENCIES, orders=(), whirl=whirl).axes[0]
    lines = [line for line in top.lines if len(line.get_xdata()) > 2]
    ends = [(line.get_linestyle(), float(line.get_xdata()[0]), float(line.get_xdata()[-1])) for line in lines]
    assert ends == [("--", 0.0, 190.0), (":", 190.0, 300.0), ("-", 0.0, 300.0)]
    assert [x.get_text() for x in top.get_legend().get_texts()] == [
        "forward whirl",
        "backward whirl",
        "neither, or several",
    ]


def test_root_locus_draws_upper_poles_and_leaves_room_for_those_that_swing(tmp_path):
    c = torch.linspace(0.0, 6.0, 7, dtype=torch.float64)
    swinging = torch.complex(0.3 - 0.3 * c, 4.0 + 0.0 * c)
    fast = torch.complex(-1e6 + 0.0 * c, 0.0 * c)
    figure = mbd.viz.root_locus(c, torch.stack([swinging, swinging.conj(), fast], 1), "damper [N s/m]")
    axes = figure.axes[0]
    dots = np.asarray(axes.collections[0].get_offsets())
    assert len(dots) == 14  # not the conjugate ones
    low, high = axes.get_xlim()
    assert -2.0 < low < -1.5
    assert 0.3 < high < 1.0
    assert "1 more on the left" in [text.get_text() for text in axes.texts]
    assert mbd.viz.save(figure, tmp_path / "locus.svg").stat().st_size > 1000


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"speeds": SPEEDS.flip(0)}, "speeds"),
        ({"speeds": SPEEDS[:1]}, "speeds"),
        ({"speeds": "fast"}, "speeds"),
        ({"frequencies": FREQUENCIES[:3]}, "frequencies"),
        ({"frequencies": torch.nan * FREQUENCIES}, "frequencies"),
        ({"damping": FREQUENCIES[:, :1]}, "damping"),
        ({"orders": (1, 0)}, "orders"),
    ],
)
def test_wrong_arguments_are_named(change, path):
    with refused(path):
        mbd.viz.campbell(**{"speeds": SPEEDS, "frequencies": FREQUENCIES} | change)


def test_poles_of_another_number_are_refused():
    with refused("poles"):
        mbd.viz.root_locus([1.0, 2.0, 3.0], [[1j], [2j]], "k [N/m]")
