"""Exact first-order (Mindlin-Reissner) solutions of simply supported laminated rectangles, by Navier's double series.

Two families, whose stiffness couples no other terms (checked here):
    cross-ply            SS-1: on x = const w = v = beta_y = 0, on y = const w = u = beta_x = 0
    antisymmetric angle-ply   SS-2: on x = const w = u = beta_y = 0, on y = const w = v = beta_x = 0
Term (m, n), alpha = m pi / a, beta = n pi / b, w = W sin(alpha x) sin(beta y), beta_x = X cos sin, beta_y = Y sin cos;
SS-1: u = U cos sin, v = V sin cos;  SS-2: u = U sin cos, v = V cos sin. Its strains are amplitudes times one product of
sines and cosines each, so the equations of one term are S' C S with the 8 x 8 law C. The first moment of the density
couples U with X and V with Y.
Source: J. N. Reddy, Mechanics of Laminated Composite Plates and Shells, 2nd ed., sections 6.2-6.4 and 7.2-7.4.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg

from torchmbd.fem.materials import Laminate


class Navier:
    """Series solution of one laminate on the rectangle a x b."""

    def __init__(self, laminate: Laminate, a: float = 1.0, b: float = 1.0) -> None:
        A, B, D, As = (x.detach().numpy() for x in laminate.stiffness())
        self.C = scipy.linalg.block_diag(np.block([[A, B], [B, D]]), As)
        self.a, self.b = a, b
        m, mu = float(laminate.mass_per_area), float(laminate.rotary_inertia_per_area)
        self.M = np.diag([m, m, m, mu, mu])
        first = float(laminate.first_moment_per_area)
        self.M[[0, 1, 3, 4], [3, 4, 0, 1]] = first
        self.spin = mu - first**2 / m  # about the normal
        straight = max(abs(A[:2, 2]).max() / A[0, 0], abs(D[:2, 2]).max() / D[0, 0], abs(As[0, 1]) / As[0, 0])
        assert straight < 1e-9, "the laminate is neither cross-ply nor antisymmetric angle-ply"
        skew, even = abs(B[:2, 2]).max(), max(abs(B[:2, :2]).max(), abs(B[2, 2]))
        assert min(skew, even) < 1e-9 * max(A[0, 0] * math.sqrt(D[0, 0] / A[0, 0]), 1e-300)
        self.support = "SS-2" if skew > even else "SS-1"
        assert self.support == "SS-1" or abs(first) < 1e-12 * m, "the first moment couples other terms than SS-2's"

    def term(self, m: int, n: int) -> np.ndarray:
        """Stiffness of the amplitudes U, V, W, X, Y per quarter area."""
        x, y = m * math.pi / self.a, n * math.pi / self.b
        s = 1.0 if self.support == "SS-1" else -1.0
        S = np.zeros((8, 5))
        S[0, 0], S[1, 1], S[2, 0], S[2, 1] = -s * x, -s * y, s * y, s * x
        S[3, 3], S[4, 4], S[5, 3], S[5, 4] = -x, -y, y, x
        S[6, 2], S[6, 3], S[7, 2], S[7, 4] = x, 1.0, y, 1.0
        return S.T @ self.C @ S

    def sine_deflection(self) -> float:
        """Deflection of the center under the pressure sin(pi x / a) sin(pi y / b) [Pa]."""
        return float(np.linalg.solve(self.term(1, 1), [0, 0, 1, 0, 0])[2])

    def uniform_deflection(self, terms: int = 199) -> float:
        """Deflection of the center under a pressure of 1 Pa."""
        total = 0.0
        for m in range(1, terms, 2):
            for n in range(1, terms, 2):
                load = 16 / (math.pi**2 * m * n) * math.sin(m * math.pi / 2) * math.sin(n * math.pi / 2)
                total += load * np.linalg.solve(self.term(m, n), [0, 0, 1, 0, 0])[2]
        return float(total)

    def frequencies(self, count: int) -> np.ndarray:
        """Lowest natural frequencies [Hz]; the terms with m = 0 or n = 0 hold the in-plane shear modes."""
        squares = []
        for m in range(8):
            for n in range(8):
                alive = [k for k in range(5) if not self._vanishes(k, m, n)]
                pencil = self.term(m, n)[np.ix_(alive, alive)], self._mass(m, n)[np.ix_(alive, alive)]
                squares += scipy.linalg.eigh(*pencil, eigvals_only=True).tolist() if alive else []
        return np.sqrt(np.sort(squares)[:count]) / (2 * math.pi)

    def _mass(self, m: int, n: int) -> np.ndarray:
        """Mass of the amplitudes; eq. (2) of the paper gives the rotation (v,x - u,y) / 2 an inertia, too."""
        spin = np.zeros(5)
        spin[0], spin[1] = -n * math.pi / (2 * self.b), m * math.pi / (2 * self.a)
        return self.M + self.spin * np.outer(spin, spin)

    def _vanishes(self, amplitude: int, m: int, n: int) -> bool:
        """Whether the term of U, V, W, X or Y has a sine of zero."""
        sine_x, sine_y = (m == 0), (n == 0)
        in_plane = (sine_y, sine_x) if self.support == "SS-1" else (sine_x, sine_y)
        return (*in_plane, sine_x or sine_y, sine_y, sine_x)[amplitude]
