"""Shape of a beam's elements: straight, or arcs of circles through start, middle and end.

    tan(alpha / 4) = 2 |b| / c,    theta = alpha (t - 1/2),    r = c / (2 sin(alpha / 2))
    x = middle of the chord + r sin(theta) e + r (cos(theta) - cos(alpha / 2)) n,    tangent = cos(theta) e - sin(theta) n

c, e     length and direction of the chord;  b = |b| n: from its middle to the arc's     [m]
alpha    angle of the arc   [rad];  t: part of the length from the start
A straight element is the limit b = 0.
Checked in tests/fem/elements/test_beam_curve.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

#: Arcs flatter than this part of the chord are straight.
FLAT = 1e-9


class Curves(NamedTuple):
    """Elements: ends of the chords [m, 3], arrows b [m, 3], angles [m] and lengths along the arcs [m], m."""

    start: Float[Tensor, "m 3"]
    end: Float[Tensor, "m 3"]
    arrow: Float[Tensor, "m 3"]
    angle: Float[Tensor, " m"]
    length: Float[Tensor, " m"]

    @classmethod
    def through(cls, start: Tensor, end: Tensor, middle: Tensor | None) -> Curves:
        """Arcs through three points each; no middles: straight."""
        chord = (end - start).norm(dim=-1)
        arrow = torch.zeros_like(start) if middle is None else middle - 0.5 * (start + end)
        rise = arrow.norm(dim=-1)
        flat = rise <= FLAT * chord
        arrow, rise = torch.where(flat[..., None], 0.0, arrow), torch.where(flat, 0.0, rise)
        angle = 4.0 * torch.atan2(2.0 * rise, chord)
        length = torch.where(flat, chord, chord * angle / 2.0 / torch.sin(torch.where(flat, 1.0, angle / 2.0)))
        return cls(start, end, arrow, angle, length)

    def at(self, t: Float[Tensor, " g"]) -> tuple[Float[Tensor, "m g 3"], Float[Tensor, "m g 3"]]:
        """Places [m] and unit tangents at parts t of the lengths."""
        span = (self.end - self.start)[..., None, :]
        flat = (self.angle == 0.0)[..., None]
        half = torch.where(flat, 1.0, self.angle[..., None] / 2.0)
        theta = half * (2.0 * t - 1.0)
        along = torch.where(flat, 2.0 * t - 1.0, torch.sin(theta) / torch.sin(half))
        over = torch.where(flat, 0.0, (torch.cos(theta) - torch.cos(half)) / (1.0 - torch.cos(half)))
        middle = 0.5 * (self.start + self.end)[..., None, :]
        place = middle + 0.5 * along[..., None] * span + over[..., None] * self.arrow[..., None, :]
        e, rise = span / span.norm(dim=-1, keepdim=True), self.arrow.norm(dim=-1, keepdim=True)[..., None, :]
        n = self.arrow[..., None, :] / torch.where(rise > 0.0, rise, 1.0)
        cosine, sine = (
            torch.where(flat, limit, f(theta))[..., None] for f, limit in ((torch.cos, 1.0), (torch.sin, 0.0))
        )
        return place, cosine * e - sine * n
