"""What residuals and their Jacobian say of unknowns: covariance, intervals, whiteness.

    cov = kappa (J'J)^-1           J: derivatives of the residuals, in deviations, priors included      [n, n]
    kappa = 1                                 the plain square
    kappa = mean psi^2 / (mean psi')^2        robust losses, psi = rho' r                   (M-estimators)
    b_i +- (sum_c t(0.975, nu_c)^2 v_ic)^1/2          interval of 95 %; v_ic: what the noise of channel c adds to the
                                              variance of b_i, the diagonal of cov; nu_c: degrees of freedom of its deviation

Deviations that are given are known, with infinitely many degrees of freedom: their t is that of the normal distribution. The
interval holds the truth with at least 95 % (Banerjee), whatever the shares of the channels.
Directions that the data cannot see (unseen.py) leave the unknowns with a part in them without a deviation; all others have
what these directions add to theirs.
Ljung-Box: Q = N (N + 2) sum_k r_k^2 / (N - k) of the autocorrelations r_k of the residuals of a channel, chi-squared where they
are white; runs: how often the sign changes, normal where signs are independent. Small probabilities say that the model, not
the noise, is in the residuals.
Sources: Seber and Wild, Nonlinear Regression (1989); Banerjee, Sankhya 22 (1960) 357-358; Huber, Robust Statistics (1981),
section 7.6; Ljung and Box, Biometrika 65 (1978) 297-303; Wald and Wolfowitz, Ann. Math. Stat. 11 (1940) 147-162.
Checked in tests/extensions/identification/test_statistics.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchmbd.extensions.identification.losses import Loss
from torchmbd.extensions.identification.unseen import NOISE, ROUNDING, decomposition

LEVEL = 0.95
LAGS = 10  # of Ljung and Box's test, and at most a fifth of the samples
_PART = 0.05  # of a direction below the noise that makes an unknown one without an interval
_TRACE = 1e-3  # the same, of a direction without a trace in the data


def influence(jacobian: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How the noise of each residual moves the unknowns [n, rows], and which unknowns the data cannot see [n].

    jacobian  [rows, n];  size: of the unknowns [n]
    """
    n = jacobian.shape[1]
    if not n:
        return np.zeros((0, len(jacobian))), np.zeros(0, dtype=bool)
    U, values, vectors = decomposition(jacobian, size)
    blank = values <= ROUNDING * values.max(initial=0.0)
    faint = (values < NOISE) & ~blank
    lost = np.linalg.norm(vectors[:, blank], axis=1) > _TRACE
    lost |= np.linalg.norm(vectors[:, faint], axis=1) > _PART
    seen = np.flatnonzero(~blank)
    return size[:, None] * ((vectors[:, seen] / values[seen]) @ U[:, seen].T), lost


def covariance(jacobian: np.ndarray, size: np.ndarray, kappa: float) -> np.ndarray:
    """Covariance [n, n] of the unknowns; infinite variance of those that the data cannot see. Arguments as in `influence`."""
    moves, lost = influence(jacobian, size)
    result = kappa * (moves @ moves.T)
    result[lost, :] = np.nan
    result[:, lost] = np.nan
    result[lost, lost] = np.inf
    return result


def half_widths(moves: np.ndarray, channels: Sequence[tuple[slice, float]], level: float) -> np.ndarray:
    """Half the widths [n] of intervals of a level (Banerjee), without the factor of the covariance.

    moves     as in `influence`;  channels: rows of each whose deviation is estimated, and its degrees of freedom
    """
    quantiles = np.full(moves.shape[1], quantile(np.inf, level))
    for rows, free in channels:
        quantiles[rows] = quantile(free, level)
    return np.linalg.norm(moves * quantiles, axis=1)


def correlations(cov: np.ndarray) -> np.ndarray:
    """Correlations [n, n] of a covariance; nan where a variance is infinite or zero."""
    deviation = np.sqrt(np.diag(cov))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.isfinite(cov), cov / (deviation[:, None] * deviation), np.nan)


def variance_factor(values: np.ndarray, data: int, unknowns: int, loss: Loss, f_scale: float) -> float:
    """kappa of the module header, of residuals [rows], the first `data` of them measured."""
    rows = len(values)
    free = max(rows - unknowns, 1)
    rho = loss((values[:data] / f_scale) ** 2)
    if np.all(rho[1] == 1.0):
        return 1.0
    psi = rho[1] * values[:data]
    slope = rho[1] + 2.0 * rho[2] * (values[:data] / f_scale) ** 2
    mean = float(slope.mean())
    return float((psi**2).mean()) / mean**2 * rows / free if mean > 0.0 else np.inf


def quantile(free: float, level: float = LEVEL) -> float:
    """Half the width of an interval in deviations: Student's t with `free` degrees of freedom; infinite without any.

    Infinitely many degrees are those of a deviation that is known: the normal distribution.
    """
    from scipy.stats import norm, t

    if free <= 0.0:
        return np.inf
    return float(norm.ppf(0.5 + 0.5 * level) if np.isinf(free) else t.ppf(0.5 + 0.5 * level, free))


def ljung_box(residuals: np.ndarray) -> float:
    """Probability of autocorrelations as large as these, of white noise [samples]; nan of fewer than ten."""
    from scipy.stats import chi2

    count = len(residuals)
    lags = min(LAGS, count // 5)
    x = residuals - residuals.mean() if count else residuals
    power = float(x @ x)
    if lags < 2 or power == 0.0:
        return float("nan")
    r = np.array([float(x[k:] @ x[:-k]) for k in range(1, lags + 1)]) / power
    return float(chi2.sf(count * (count + 2.0) * float((r**2 / (count - np.arange(1, lags + 1))).sum()), lags))


def runs_test(residuals: np.ndarray) -> float:
    """Probability of a number of runs of equal sign so far from that of independent signs; nan where signs are all equal."""
    from scipy.stats import norm

    signs = residuals[residuals != 0.0] > 0.0
    above, below = int(signs.sum()), int((~signs).sum())
    count = above + below
    if not above or not below or count < 10:
        return float("nan")
    runs = 1 + int((signs[1:] != signs[:-1]).sum())
    mean = 2.0 * above * below / count + 1.0
    variance = (mean - 1.0) * (mean - 2.0) / (count - 1.0)
    return float(2.0 * norm.sf(abs(runs - mean) / np.sqrt(variance))) if variance > 0.0 else float("nan")
