"""Slopes of a sampled function: the derivative at each sample of the polynomial through it and its neighbors (Lagrange).

    y'_i = sum_j w_j y_j,    w_j = 1/(t_j - t_i) prod_k (t_i - t_k)/(t_j - t_k),    w_i = sum_k 1/(t_i - t_k)      j, k != i

Through five samples inside a piece (error of fourth order), through three at its ends and next to them (second order); never
across a switch. At equal times the weights are (1, -8, 0, 8, -1)/12h, (-1, 0, 1)/2h and (-3, 4, -1)/2h.

Across a kink neither: a cubic through it goes beyond the samples by up to 0.081 of the change of slope times the step. In the
interval of a kink the cubic has the slopes m0, m1 of both sides, but no farther apart than without a point of inflection:

    (m0 + 2 m1)/3  <=  (y1 - y0)/h  <=  (2 m0 + m1)/3      for m1 <= m0, of m0 and m1 the farther one is drawn in

Such a cubic lies between the chord and the tangents, as does a history of two straight pieces. Where the chord is not between
both slopes, it is the cubic. All of this is continuous where a kink passes a sample.
Differentiable in values and times.
Checked in tests/design/test_spline.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

WIDTH = 5


def slopes(t: Tensor, y: Tensor, begins: Tensor | None = None) -> Tensor:
    """Slopes [..., n] at samples y [..., n] at times t [n], or [..., n] with `begins`: where a piece begins [..., n].

    Samples at the time of the one before are left out: the last one may be repeated.
    """
    index, member = _stencils(t.detach(), begins)
    at = index if index.dim() == 2 else index.flatten(-2)
    times = t[at] if index.dim() == 2 else t.gather(-1, at).unflatten(-1, (-1, WIDTH))
    values = y[..., at] if index.dim() == 2 else y.gather(-1, at).unflatten(-1, (-1, WIDTH))
    center = member & (index == torch.arange(t.shape[-1])[:, None])
    here = t[..., None]
    others = member & ~center & (times != here).detach()
    member = others | center
    ahead = torch.where(others, here - times, 1.0)  # t_i - t_k
    between = times[..., :, None] - times[..., None, :]  # t_j - t_k
    apart = member[..., :, None] & member[..., None, :] & ~torch.eye(WIDTH, dtype=torch.bool)
    divisors = torch.where(apart, between, 1.0).prod(-1)
    weights = torch.where(others, ahead.prod(-1, keepdim=True) / (ahead * divisors), 0.0)
    of_center = torch.where(others, 1.0 / ahead, 0.0).sum(-1, keepdim=True)
    return (torch.where(center, of_center, weights) * torch.where(member, values, 0.0)).sum(-1)


def slopes_beside_kinks(t: Tensor, y: Tensor, begins: Tensor | None, kinks: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes after and before the samples [..., n]; kinks: intervals in which the samples have a kink [..., n - 1]."""
    t, kinks = t.expand(y.shape), (kinks & (t.detach().diff() > 0.0)).expand(*y.shape[:-1], -1)
    pieces = torch.nn.functional.pad(kinks, (1, 0))
    if begins is not None:
        pieces = pieces | begins
    m = slopes(t, y, pieces)
    edge = torch.ones_like(pieces[..., :1])
    alone = torch.cat([edge, pieces[..., 1:]], -1) & torch.cat([pieces[..., 1:], edge], -1)
    h = t.diff()
    chord = y.diff() / torch.where(h.detach() > 0.0, h, 1.0)
    m0, m1 = torch.where(alone[..., :-1], chord, m[..., :-1]), torch.where(alone[..., 1:], chord, m[..., 1:])
    between = (chord - m0) * (m1 - chord) > 0.0
    apart = (m1 - m0).abs()
    after = torch.where(3.0 * (chord - m1).abs() < apart, 3.0 * chord - 2.0 * m1, m0)
    before = torch.where(3.0 * (chord - m0).abs() < apart, 3.0 * chord - 2.0 * m0, m1)
    after, before = (torch.where(between, x, chord) for x in (after, before))
    after, before = torch.where(kinks, after, m[..., :-1]), torch.where(kinks, before, m[..., 1:])
    return torch.cat([after, m[..., -1:]], -1), torch.cat([m[..., :1], before], -1)


def _stencils(t: Tensor, begins: Tensor | None) -> tuple[Tensor, Tensor]:
    """Numbers of the samples through which the polynomials go [..., n, WIDTH], and which of them count."""
    n = t.shape[-1]
    i = torch.arange(n)
    first, last = (torch.zeros(n, dtype=torch.long), torch.full((n,), n - 1))
    if begins is not None:
        first, last = ends_of_pieces(t, begins)
    near = torch.minimum(i - first, last - i)
    start = torch.where(near >= 2, i - 2, torch.where(near == 1, i - 1, torch.where(i == first, first, last - 2)))
    index = start.maximum(first)[..., None] + torch.arange(WIDTH)
    wide = torch.where(near >= 2, WIDTH, 3)
    member = (torch.arange(WIDTH) < wide[..., None]) & (index <= last[..., None])
    return index.clamp(0, n - 1), member


def ends_of_pieces(t: Tensor, begins: Tensor) -> tuple[Tensor, Tensor]:
    """Numbers of the first and the last sample of the piece of each [..., n]; a last one that is repeated counts once."""
    n = t.shape[-1]
    i = torch.arange(n)
    first = torch.where(begins, i, 0).cummax(-1).values
    ends = torch.cat([begins[..., 1:], torch.ones_like(begins[..., :1])], -1)
    last = torch.where(ends, i, n - 1).flip(-1).cummin(-1).values.flip(-1)
    count = torch.cat([torch.ones_like(begins[..., :1]), (t.diff() > 0.0) | begins[..., 1:]], -1)
    final = torch.where(count, i, 0).amax(-1, keepdim=True)
    return first, last.minimum(final)
