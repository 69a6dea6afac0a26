"""Angles that are counted while a motion is recorded, in pieces, with lanes that begin at different times."""

from __future__ import annotations

import math

import pytest
import torch

from torchmbd.results.turns import _Known


@pytest.mark.parametrize("pieces", [[60], [1] * 60, [7, 1, 30, 22]])
def test_pieces_give_the_angles_of_the_whole(pieces):
    """Lanes turn back and forth by many turns; the second begins later, the third ends early, the last has no record."""
    t = torch.linspace(0.0, 1.0, 60, dtype=torch.float64)
    sizes = torch.tensor([40.0, -25.0, 60.0, 10.0], dtype=torch.float64)
    whole, rates = sizes * (t[:, None] * (1.5 - t[:, None])), sizes * (1.5 - 2.0 * t[:, None])
    wrapped = torch.atan2(whole.sin(), whole.cos())
    recorded = torch.ones(60, 4, dtype=torch.bool)
    recorded[:20, 1] = recorded[45:, 2] = recorded[:, 3] = False
    known, first = _Known.nothing(60, 4), 0
    for length in pieces:
        rows = torch.arange(first, first + length)
        known.add(rows, recorded[rows], t, wrapped[rows], rates[rows])
        first += length
    whole[:, 1] += (
        2.0 * math.pi * ((wrapped[20, 1] - whole[20, 1]) / (2.0 * math.pi)).round()
    )  # it begins within a turn
    expected = torch.where(recorded, whole, torch.nan)
    torch.testing.assert_close(known.angles, expected, rtol=0.0, atol=1e-12, equal_nan=True)
    assert known.last.tolist() == [59, 59, 44, -1]
    lanes, most = torch.arange(4), torch.tensor([10, 10, 50, 50])
    assert known.rows(lanes, most).tolist() == [10, -1, 44, -1]
