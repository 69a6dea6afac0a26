"""Random families: any number of modes that meet in any pattern, near or exactly, with one or two variables.

Retained eigenvalues are drawn as clusters: a value, then members at gaps from zero to 1e-3 with slopes that agree or not.
Everything must be exact as in the families that were made by hand.
"""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import jacfwd, jacrev

from experiments.models.eigen_families import Family, derivative_errors, gauge_free
from torchmbd.fem.reduction import craig_bampton, eigenpairs, modal_basis

GAPS = (0.0, 0.0, 1e-12, 1e-10, 1e-8, 1e-7, 1e-5, 1e-3)
RATES = (-1.0, 0.0, 0.5, 1.0)
Mode = tuple[float, list[float], float]  # eigenvalue at b = 0, slopes, curvature


@st.composite
def spectra(draw: st.DrawFn) -> tuple[list[Mode], int]:
    """Modes of one to four clusters of one to three members, and the number of variables."""
    variables = draw(st.integers(1, 2))
    start = draw(st.sampled_from([0.0, 0.7]))  # 0: rigid modes among them
    modes = []
    for k in range(draw(st.integers(1, 4))):
        value = start + 1.2 * k
        for member in range(draw(st.integers(1, 3))):
            value += draw(st.sampled_from(GAPS)) if member else 0.0
            rigid = value == 0.0
            slopes = [0.0 if rigid else draw(st.sampled_from(RATES)) for _ in range(variables)]
            modes.append((value, slopes, 0.0 if rigid else draw(st.sampled_from(RATES))))
    modes.append((5.2, [1.0] * variables, 0.0))  # so that energies of free bodies change at all
    return modes, variables


def family(modes: list[Mode], variables: int, with_mass: bool, size: int, seed: int) -> Family:
    values = torch.tensor([value for value, _, _ in modes], dtype=torch.float64)
    slopes = torch.tensor([slope for _, slope, _ in modes], dtype=torch.float64)
    curvatures = torch.tensor([curvature for _, _, curvature in modes], dtype=torch.float64)

    def lowest(b: Tensor) -> Tensor:
        return torch.diag(values + slopes @ b + curvatures * (b @ b))

    return Family("random", lowest, variables, with_mass, size, seed)


@pytest.mark.thorough
@settings(max_examples=24, deadline=None, derandomize=True)
@given(spectra(), st.booleans(), st.sampled_from([16, 23, 151]), st.integers(0, 1000))
def test_gauge_free_derivatives_are_exact(spectrum, with_mass, size, seed):
    errors = derivative_errors(family(*spectrum, with_mass, size, seed), modal_basis)
    assert max(errors.values()) < 1e-9, errors


@pytest.mark.parametrize("size", [23, 151], ids=["dense", "krylov"])
@pytest.mark.parametrize("soft", [1e-10, 1e-8, 1e-7, 1e-6, 1e-5])
def test_a_soft_mode_beside_rigid_ones(soft, size):
    """K passes for definite there: each pivot is rounding divided by the one before."""
    modes = [(0.0, [0.0], 0.0), (0.0, [0.0], 0.0), (soft, [1.0], 0.0), (5.2, [1.0], 0.0)]
    errors = derivative_errors(family(modes, 1, False, size, 100), modal_basis)
    assert max(errors.values()) < 1e-9, errors


@pytest.mark.parametrize("gap", [1e-13, 1e-12, 1e-10])
def test_slopes_next_to_rounding_add_up(gap):
    """Vectors that rounding mixes by per cent are turned apart, not stretched."""
    result = family([(0.0, [0.0], 0.0), (gap, [-1.0], 0.0), (5.2, [1.0], 0.0)], 1, True, 18, 0)
    slopes = jacfwd(lambda b: eigenpairs(*result.exact(b)[:2], result.n).values)(torch.zeros(1, dtype=torch.float64))
    assert float(slopes[:2].sum()) == pytest.approx(-1.0, abs=1e-10)


@pytest.mark.thorough
@settings(max_examples=12, deadline=None, derandomize=True)
@given(spectra(), st.booleans(), st.integers(0, 1000))
def test_reverse_mode_is_forward_mode(spectrum, with_mass, seed):
    made = family(*spectrum, with_mass, 18, seed)

    def response(b: Tensor) -> Tensor:
        K, M, _, _ = made.exact(b)
        result = gauge_free(*modal_basis(K, M, made.n))
        held = (
            gauge_free(*craig_bampton(K + 0.1 * M, M, made.n, [0, 5])) if _separated(K + 0.1 * M, M, made.n) else result
        )
        return torch.cat([x.flatten()[::7] for x in (*result.values(), *held.values())])

    b = torch.zeros(made.variables, dtype=torch.float64)
    forward, reverse = jacfwd(response)(b), jacrev(response)(b)
    assert torch.linalg.norm(forward - reverse) < 1e-9 * torch.linalg.norm(forward)


def _separated(K: Tensor, M: Tensor, n: int) -> bool:
    """Whether the fixed-interface modes n and n + 1 are apart, which the families do not know."""
    keep = [i for i in range(len(K)) if i not in (0, 5)]
    with torch.no_grad():
        values = eigenpairs(K[keep][:, keep].detach(), M[keep][:, keep].detach(), len(keep)).values
    return bool(values[n] - values[n - 1] > 1e-2)


@pytest.mark.thorough
@settings(max_examples=30, deadline=None, derandomize=True)
@given(spectra(), st.booleans(), st.integers(0, 1000))
def test_slopes_of_eigenvalues_are_exact_or_those_of_their_cluster(spectrum, with_mass, seed):
    """Distinct or repeated: each its own; nearer than rounding tells: in rising order along every direction."""
    made = family(*spectrum, with_mass, 18, seed)
    b = torch.zeros(made.variables, dtype=torch.float64)

    def values(b: Tensor) -> Tensor:
        return eigenpairs(*made.exact(b)[:2], made.n).values

    result = jacfwd(values)(b)
    exact = jacfwd(lambda b: made.lowest(b).diagonal())(b)
    at = made.lowest(b).diagonal()
    ends = [0, *(i + 1 for i, (x, y) in enumerate(pairwise(at.tolist())) if y - x > 1e-9), made.n]
    for start, end in pairwise(ends):
        group = slice(start, end)
        # within a group that rounding may or may not tell apart, the sum is exact and each slope is one of the group's
        torch.testing.assert_close(result[group].sum(0), exact[group].sum(0), rtol=1e-8, atol=1e-8)
        for k in range(made.variables):
            a, e = result[group, k].sort().values, exact[group, k].sort().values
            if bool((at[group].diff() == 0.0).all()):
                torch.testing.assert_close(a, e, rtol=1e-8, atol=1e-8)
