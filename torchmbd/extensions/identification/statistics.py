"""What residuals and their Jacobian say of unknowns: covariance, intervals, whiteness.

    cov = kappa (J'J)^-1           J: derivatives of the residuals, in deviations, priors included      [n, n]
    kappa = 1                                 the plain square; deviations that are estimated count freedoms, N - n
    kappa = mean psi^2 / (mean psi')^2        robust losses, psi = rho' r                   (M-estimators)
    b +- t(0.975, N - n) sigma     interval of 95 %, sigma^2 the diagonal of cov

Directions that the data cannot see (unseen.py) have no variance: unknowns with a part in one have an infinite deviation.
Ljung-Box: Q = N (N + 2) sum_k r_k^2 / (N - k) of the autocorrelations r_k of the residuals of a channel, chi-squared where they
are white; runs: how often the sign changes, normal where signs are independent. Small probabilities say that the model, not
the noise, is in the residuals.
Sources: Seber and Wild, Nonlinear Regression (1989); Huber, Robust Statistics (1981), section 7.6; Ljung and Box, Biometrika 65
(1978) 297-303; Wald and Wolfowitz, Ann. Math. Stat. 11 (1940) 147-162.
Checked in tests/extensions/identification/test_statistics.py.
"""

from __future__ import annotations

import numpy as np

from torchmbd.extensions.identification.losses import Loss

LEVEL = 0.95
LAGS = 10  # of Ljung and Box's test, and at most a fifth of the samples
_PART = 1e-3  # of an unseen direction that makes an unknown one without an interval


def covariance(jacobian: np.ndarray, unseen: np.ndarray, scale: np.ndarray, kappa: float) -> np.ndarray:
    """Covariance [n, n] of the unknowns; infinite variance of those with a part in an unseen direction.

    jacobian  [rows, n];  scale: units of the unknowns [n];  unseen: directions in these units [n, k], orthonormal
    """
    n = jacobian.shape[1]
    if not n:
        return np.zeros((0, 0))
    seen = _complement(unseen)
    R = np.linalg.qr(jacobian * scale @ seen, mode="r")
    half = seen @ np.linalg.inv(R) * 1.0
    result = kappa * (half @ half.T) * scale[:, None] * scale
    lost = np.abs(unseen).max(1, initial=0.0) > _PART
    result[lost, :] = np.nan
    result[:, lost] = np.nan
    result[lost, lost] = np.inf
    return result


def _complement(directions: np.ndarray) -> np.ndarray:
    """Orthonormal directions [n, n - k] across others [n, k]."""
    n, k = directions.shape
    if not k:
        return np.eye(n)
    return np.linalg.svd(directions, full_matrices=True)[0][:, k:]


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


def quantile(free: int, level: float = LEVEL) -> float:
    """Half the width of an interval in deviations: Student's t with `free` degrees of freedom."""
    from scipy.stats import t

    return float(t.ppf(0.5 + 0.5 * level, max(free, 1)))


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
