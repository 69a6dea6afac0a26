"""Conditions on lamination parameters: all stacks keep them, and little else does."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchmbd.extensions.lamination.conditions import CONDITIONS, conditions, directions, infeasibility_reasons


def parameters(angles: torch.Tensor, shares: torch.Tensor) -> torch.Tensor:
    """a, b, d of a stack; shares of its thickness."""
    top = 2 * shares.cumsum(0) - 1
    low = top - 2 * shares
    weights = torch.stack([(top - low) / 2, (top**2 - low**2) / 2, (top**3 - low**3) / 2])
    return weights @ directions(angles)


@pytest.mark.thorough
@given(st.lists(st.tuples(st.floats(-2, 2), st.floats(0.01, 1)), min_size=1, max_size=8))
def test_all_stacks_keep_the_conditions(plies):
    angles, t = torch.tensor(plies, dtype=torch.float64).T
    result = conditions(*parameters(angles, t / t.sum()))
    assert result.shape == (CONDITIONS,)
    assert float(result.max()) <= 1 + 1e-12
    assert infeasibility_reasons(*parameters(angles, t / t.sum())) == [""]


def reach(direction: np.ndarray, layers: int = 40, count: int = 36) -> float:
    """How far lamination parameters go in a direction [3, 4] from the origin, by linear programming over stacks."""
    edges = np.linspace(-1, 1, layers + 1)
    V = directions(torch.arange(count, dtype=torch.float64) * torch.pi / count).numpy()
    w = np.stack([np.diff(edges) / 2, np.diff(edges**2) / 2, np.diff(edges**3) / 2])
    rows = np.einsum("xl,kv->xvlk", w, V).reshape(12, -1)
    sums = np.kron(np.eye(layers), np.ones(count))
    A = np.block([[rows, -direction.reshape(12, 1)], [sums, np.zeros((layers, 1))]])
    cost = np.zeros(A.shape[1])
    cost[-1] = -1.0
    result = scipy.optimize.linprog(cost, A_eq=A, b_eq=np.r_[np.zeros(12), np.ones(layers)], bounds=(0, None))
    assert result.status == 0
    return float(result.x[-1])


@pytest.mark.thorough
def test_the_region_is_hardly_larger_than_that_of_stacks():
    """In directions of symmetric laminates it is at most 15 % too large, in the plane or in bending alone 2 %."""
    random = np.random.default_rng(3)
    excess = []
    for k in range(24):
        direction = random.normal(size=(3, 4))
        direction[1] = 0.0
        if k % 3 == 0:
            direction[2] = direction[0]
        if k % 3 == 1:
            direction[:, 1::2] = 0.0
        a, b, d = torch.as_tensor(direction)
        low, high = 0.0, 10.0
        for _ in range(50):
            s = 0.5 * (low + high)
            low, high = (s, high) if float(conditions(s * a, s * b, s * d).max()) <= 1.0 else (low, s)
        excess.append(low / reach(direction) - 1.0)
    assert min(excess) > -1e-3
    assert max(excess[0::3]) < 0.02
    assert max(excess) < 0.15
