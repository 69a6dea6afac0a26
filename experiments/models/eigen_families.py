"""Families K(b), M(b) whose modes are known exactly, for every way in which eigenvalues can meet.

    K(b) = S Q Lambda Q' S',   M(b) = S S',   Q(b) = exp(sum b_k W_k) Q0,   Psi = S^-T Q_n,   Kr = Lambda_n

The W_k are skew, so Q is orthogonal; S(b) is the identity or a full matrix; Lambda(b) is diagonal, or for two variables
has a 2 x 2 block whose derivatives do not commute. Everything is a smooth closed form of b, and so are the gauge-free
quantities that the reduced equations of motion consist of: the projector Psi Psi', the response of the modes to a
load, and the energy. `python -m experiments.models.eigen_families` prints the relative errors of their derivatives by
torchmbd.reduction.modal_basis and by torch.linalg.eigh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchmbd.fem.reduction import modal_basis

SPRING = 0.7  # keeps the response of free bodies finite


@dataclass(frozen=True)
class Family:
    """One family, to be looked at near b = 0: `lowest(b)` is the block Lambda_n(b); the mass depends on b or not."""

    name: str
    lowest: Callable[[Tensor], Tensor]
    variables: int = 1
    with_mass: bool = False
    size: int = 24
    seed: int = 5

    @property
    def n(self) -> int:
        return self.lowest(torch.zeros(self.variables, dtype=torch.float64)).shape[-1]

    def _random(self) -> tuple[Tensor, ...]:
        draw = np.random.default_rng(self.seed).standard_normal((2 + 2 * self.variables, self.size, self.size))
        return tuple(torch.from_numpy(draw / np.sqrt(self.size)))

    def exact(self, b: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """K, M, and the exact retained Psi and Kr, all smooth in b."""
        first, second, *rest = self._random()
        W = sum(b[k] * (rest[k] - rest[k].T) for k in range(self.variables)) * 0.3
        Q = torch.linalg.matrix_exp(2 * W) @ torch.linalg.qr(first)[0]
        S = torch.eye(self.size, dtype=torch.float64)
        if self.with_mass:
            S = S + 0.5 * second.tril() + 0.5 * sum(b[k] * rest[self.variables + k] for k in range(self.variables))
        low = self.lowest(b)
        high = torch.arange(1.0, self.size - self.n + 1, dtype=torch.float64) * (1 + 0.2 * b.sum()) + 6.0
        Lambda = torch.block_diag(low, torch.diag(high))
        SQ = S @ Q
        K = SQ @ Lambda @ SQ.T
        return (K + K.T) / 2, S @ S.T, torch.linalg.solve(S.T, Q[:, : self.n]), low


def gauge_free(Psi: Tensor, Kr: Tensor) -> dict[str, Tensor]:
    """What does not change when retained modes are rotated among themselves."""
    load = torch.cos(torch.arange(Psi.shape[-2], dtype=torch.float64))
    w = torch.linalg.solve(Kr + SPRING * torch.eye(Kr.shape[-1], dtype=torch.float64), Psi.mT @ load[:, None])
    return {
        "projector": Psi @ Psi.mT,
        "response": (Psi @ w).squeeze(-1),
        "energy": (w.mT @ Kr @ w).squeeze(-1).squeeze(-1) / 2,
    }


def _diagonal(*entries: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda b: torch.diag(torch.stack([entry(b[0]) for entry in entries]))


def _near(gap: float) -> Callable[[Tensor], Tensor]:
    return _diagonal(lambda b: 1 + b, lambda b: 2 + b, lambda b: 2 + gap * 2 - b, lambda b: 4 + b)


def _two_variables(b: Tensor) -> Tensor:
    block = torch.stack([torch.stack([2 + b[0], b[1]]), torch.stack([b[1], 2 - b[0]])])
    return torch.block_diag((1 + b[:1])[:, None], block, (4 - b[1:])[:, None])


LOWEST: dict[str, Callable[[Tensor], Tensor]] = {
    "distinct": _diagonal(lambda b: 1 + b, lambda b: 2 - b, lambda b: 3 + b, lambda b: 4 - b),
    "crossing of two": _diagonal(lambda b: 1 + b, lambda b: 2 + b, lambda b: 2 - b, lambda b: 4 - b),
    "crossing of three": _diagonal(lambda b: 2 + b, lambda b: 2 - b, lambda b: 2 + 3 * b, lambda b: 4 - b),
    "equal slopes": _diagonal(lambda b: 1 + b, lambda b: 2 + b + b * b, lambda b: 2 + b - 3 * b * b, lambda b: 4 - b),
    "always repeated": _diagonal(lambda b: 1 + b, lambda b: 2 + b, lambda b: 2 + b, lambda b: 4 - b),
    "partly splitting triple": _diagonal(lambda b: 2 + b, lambda b: 2 + b, lambda b: 2 - b, lambda b: 4 - b),
    "free body": _diagonal(lambda b: 0 * b, lambda b: 0 * b, lambda b: 0 * b, lambda b: 2 + b, lambda b: 2 - b),
    "gap 1e-10": _near(1e-10),
    "gap 1e-8": _near(1e-8),
    "gap 1e-6": _near(1e-6),
    "gap 1e-4": _near(1e-4),
}
FAMILIES = [Family(name, lowest, with_mass=mass) for name, lowest in LOWEST.items() for mass in (False, True)]
FAMILIES += [Family("not commuting", _two_variables, variables=2, with_mass=mass) for mass in (False, True)]


def by_eigh(K: Tensor, M: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """The plain way, for comparison: Cholesky of M and the derivative of torch.linalg.eigh."""
    L = torch.linalg.cholesky(M)
    C = torch.linalg.solve_triangular(L, torch.linalg.solve_triangular(L, K, upper=False).mT, upper=False)
    values, U = torch.linalg.eigh(C)
    return torch.linalg.solve_triangular(L.mT, U[:, :n], upper=True), torch.diag(values[:n])


def derivative_errors(
    family: Family, route: Callable[[Tensor, Tensor, int], tuple[Tensor, Tensor]]
) -> dict[str, float]:
    """Relative errors of the derivatives of the gauge-free quantities, largest over the variables."""
    b = torch.zeros(family.variables, dtype=torch.float64)

    def exact(b: Tensor) -> dict[str, Tensor]:
        return gauge_free(*family.exact(b)[2:])

    def routed(b: Tensor) -> dict[str, Tensor]:
        K, M, _, _ = family.exact(b)
        return gauge_free(*route(K, M, family.n))

    truth, derivatives = torch.func.jacfwd(exact)(b), torch.func.jacfwd(routed)(b)
    return {
        name: max(
            (torch.linalg.norm(derivatives[name][..., k] - t) / torch.linalg.norm(t)).item()
            for k, t in enumerate(dt.unbind(-1))
        )
        for name, dt in truth.items()
    }


def main() -> None:
    print(
        f"{'relative error of the derivative of':38s}{'torchmbd.reduction.modal_basis':^30s}  {'torch.linalg.eigh':^30s}"
    )
    names = ("projector", "response", "energy")
    print(" " * 38 + "".join(f"{name:>10s}" for name in names) + "  " + "".join(f"{name:>10s}" for name in names))
    for family in FAMILIES:
        title = family.name + (", M(b)" if family.with_mass else "")
        ours, plain = derivative_errors(family, modal_basis), derivative_errors(family, by_eigh)
        print(f"{title:38s}" + "  ".join("".join(f"{row[name]:10.1e}" for name in names) for row in (ours, plain)))


if __name__ == "__main__":
    main()
