"""Combinations of unknowns that the data cannot see, in words.

    J diag(s) = U S V'         Jacobian of the residuals in deviations, by unknowns in units of their sizes s

A direction v_k with a singular value S_k below one moves no residual by its noise while the unknowns change by their own size;
one far below the largest singular value moves none at all. A combination of unknowns that leaves the data as they are has a
simple form more often than not: with two unknowns a and b, the data see them only as

    product  a b      quotient  a / b      sum  a + b      difference  a - b

and more than two up to a common factor, or a common summand.
Which of them it is, linear derivatives at one point cannot tell: they are tried, by moving both unknowns a finite way along
each form and looking whether the residuals stay. A form that none of these is remains a linear combination.
Checked in tests/extensions/identification/test_unseen.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

NOISE = 1.0  # singular value at which a change by the whole size of the unknowns is as large as the noise
ROUNDING = 1e-7  # of the largest singular value: the accuracy of derivatives of motions
_PART = 0.05  # of a direction that makes an unknown a part of it
_MOVE = 0.05  # of its size, by which the first unknown of a form is moved
_STAYS = 0.02  # of the change of the residuals by the first unknown alone: a form along which they stay
_EQUAL = 0.2  # of the ratio that a form asks of a direction

Evaluate = Callable[[np.ndarray], np.ndarray]  # unknowns [n] -> residuals [rows]; nan where there are none


@dataclass(frozen=True)
class Unseen:
    """A direction that the data cannot see.

    direction    in units of the sizes of the unknowns [n], of length one
    value        its singular value: change of the residuals, in deviations
    names        unknowns with a part in it
    words        what the data see of them
    """

    direction: np.ndarray
    value: float
    names: tuple[str, ...]
    words: str


def decomposition(jacobian: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """U [rows, n], singular values [n], descending, and V [n, n] of the scaled Jacobian.

    Columns of U without a value are zero.
    """
    n = jacobian.shape[1]
    if not n:
        return np.zeros((len(jacobian), 0)), np.zeros(0), np.zeros((0, 0))
    Q, R = np.linalg.qr(jacobian * size)
    U, values, rows = np.linalg.svd(R, full_matrices=True)
    short = n - len(values)
    U = np.pad(Q @ U[:, : len(values)], ((0, 0), (0, short)))
    return U, np.concatenate([values, np.zeros(short)]), rows.T


def singular_values(jacobian: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Singular values [n] of the scaled Jacobian, descending, and right singular vectors, columns [n, n]."""
    return decomposition(jacobian, size)[1:]


def unseen_count(values: np.ndarray) -> int:
    """How many of the singular values [n] are those of unseen directions."""
    return int((values < max(NOISE, ROUNDING * values.max(initial=0.0))).sum())


def unseen_combinations(
    jacobian: np.ndarray, size: np.ndarray, names: list[str], x: np.ndarray, evaluate: Evaluate
) -> list[Unseen]:
    """Directions without a trace in the data, each with as few unknowns as possible.

    jacobian   [rows, n];  size: of the unknowns [n];  x: their values [n]
    """
    values, vectors = singular_values(jacobian, size)
    count = unseen_count(values)
    if not count:
        return []
    short = [_short(name, names) for name in names]
    result = []
    for direction in _sparse(vectors[:, len(values) - count :]).T:
        parts = np.flatnonzero(np.abs(direction) > _PART * np.abs(direction).max())
        order = parts[np.argsort(parts)]
        strength = float(np.linalg.norm(jacobian @ (size * direction)))
        words = _words(direction, order, short, size, x, evaluate)
        result.append(Unseen(direction, strength, tuple(names[i] for i in order), words))
    return result


def _sparse(basis: np.ndarray) -> np.ndarray:
    """Directions [n, k] that span the same as an orthonormal basis, with many zeros: reduced echelon form by large pivots."""
    rows, done = basis.T.copy(), []
    for k in range(len(rows)):
        left = [j for j in range(rows.shape[1]) if j not in done]
        best = np.abs(rows[k:][:, left])
        i, j = np.unravel_index(int(best.argmax()), best.shape)
        pivot = left[int(j)]
        rows[[k, k + int(i)]] = rows[[k + int(i), k]]
        rows[k] /= rows[k, pivot]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, pivot] * rows[k]
        done.append(pivot)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).T


def _words(
    v: np.ndarray, parts: np.ndarray, names: list[str], size: np.ndarray, x: np.ndarray, evaluate: Evaluate
) -> str:
    """What the data see of the unknowns with a part in a direction v [n], in units of their sizes."""
    if len(parts) == 1:
        return f"{names[parts[0]]} not at all"
    listed = f"{', '.join(names[k] for k in parts[:-1])} and {names[parts[-1]]}"
    for power, signs, move in _forms(v, parts, size, x):
        if not _stays(parts, x, move, size, evaluate):
            continue
        same = bool((signs == signs[0]).all())
        if len(parts) == 2:
            return f"{listed} only as a {('product', 'quotient')[same] if power else ('sum', 'difference')[same]}"
        what = "factor" if power else "summand"
        opposite = ", ".join(names[k] for k, sign in zip(parts, signs, strict=True) if sign != signs[0])
        return f"{listed} only up to a common {what}" + (f", opposite for {opposite}" if opposite else "")
    unit = np.abs(v[parts]).max()
    terms = " ".join(f"{'-' if v[k] < 0.0 else '+'} {abs(v[k]) / unit:.2g} {names[k]}" for k in parts)
    return f"{listed} not along {terms.removeprefix('+ ')} (in units of their sizes)"


def _forms(
    v: np.ndarray, parts: np.ndarray, size: np.ndarray, x: np.ndarray
) -> list[tuple[bool, np.ndarray, np.ndarray]]:
    """Simple forms in the direction v: whether by factors, the sign of each part, and where the parts are after a move."""
    forms, step = [], v[parts] * size[parts]
    for power in (True, False):
        if power and not x[parts].all():
            continue
        rates = step / x[parts] if power else step
        signs = np.sign(rates)
        if np.abs(rates).min() < (1.0 - _EQUAL) * np.abs(rates).max():
            continue
        first = np.abs(size[parts]).min() * _MOVE
        moved = x[parts] * (1.0 + _MOVE) ** signs if power else x[parts] + signs * first
        forms.append((power, signs, moved))
    return forms


def _stays(parts: np.ndarray, x: np.ndarray, moved: np.ndarray, size: np.ndarray, evaluate: Evaluate) -> bool:
    """True if the residuals stay where the parts are moved together, beside those where the first is moved alone."""
    before = evaluate(x)

    def change(indices: np.ndarray) -> float:
        y = x.copy()
        y[indices] = moved[np.isin(parts, indices)]
        difference = evaluate(y) - before
        return float(np.linalg.norm(difference)) if np.isfinite(difference).all() else np.inf

    alone = min(change(parts[k : k + 1]) for k in range(len(parts)))
    return change(parts) < max(_STAYS * alone, NOISE)


def _short(name: str, names: list[str]) -> str:
    """The name of an unknown for a sentence: without the index of a parameter of one entry."""
    parameter = name.rpartition("[")[0]
    return parameter if sum(x.rpartition("[")[0] == parameter for x in names) == 1 and name.endswith("[0]") else name
