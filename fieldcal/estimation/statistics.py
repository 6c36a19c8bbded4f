"""Standard errors of least squares when residuals are correlated in time (after Morelli and Klein, 1997): every fit of
fieldcal states its covariance through this page."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from fieldcal.geometry.rotation import Array

MAD_TO_SIGMA = 1.4826
HUBER = 1.345
# Blocks taken for independent: at least so long, which is longer than a hand's motion remembers, and so few that their
# spread can still be estimated.
BLOCK_S, BLOCKS, FEWEST_BLOCKS = 2.0, 20, 6
LEAST_LOCAL_SHARE = 0.05  # of a residual's rms: what is locally less is taken for so much


def robust_sigma(residual: ArrayLike) -> float:
    """Standard deviation from the median absolute value (the residual is centred already)."""
    return MAD_TO_SIGMA * float(np.median(np.abs(residual)))


def huber_weights(residual: ArrayLike, sigma: float) -> Array:
    """Weights min(1, 1.345 σ/|r|), same shape as the residual; all ones when σ is 0."""
    magnitude = np.abs(np.asarray(residual, dtype=float))
    limit = HUBER * sigma
    if limit == 0.0:
        return np.ones_like(magnitude)
    return np.where(magnitude > limit, limit / np.maximum(magnitude, limit), 1.0)


def huber_inflation(weights: ArrayLike) -> float:
    """What Huber weights take from the information that they seem to leave: (mean w / share of weights at 1)².

    A clipped residual says nothing of small parameter changes (ψ′ = 0) although its weight is not 0; the covariance
    of an M-estimator has ψ′, not w, in its outer factors."""
    w = np.asarray(weights, dtype=float)
    return float(w.mean() / max(float(np.mean(w >= 1.0)), 0.1)) ** 2


def power_density(x: ArrayLike, interval_s: float, length: int) -> tuple[Array, Array]:
    """One-sided power spectral density of each column of x (n, m) by Welch's method: frequencies (f,), Hz, densities
    (f, m).

    Means over parts of `length` ≤ n samples that overlap by half, their mean taken out, under a Hann window. Equals
    `scipy.signal.welch(x, 1/interval_s, nperseg=length, axis=0)`, whose module takes as long to import as all others of
    the pipeline together."""
    x = np.asarray(x, dtype=float)
    window = np.hanning(length + 1)[:-1] if length > 1 else np.ones(1)
    starts = range(0, len(x) - length + 1, length - length // 2)
    power: Array = np.zeros((length // 2 + 1, x.shape[1]))
    for start in starts:
        part = x[start : start + length]
        power += np.abs(fft.rfft((part - part.mean(axis=0)) * window[:, None], axis=0)) ** 2
    power *= interval_s / (len(starts) * float(np.sum(window**2)))
    power[1 : (length + 1) // 2] *= 2.0  # every bin but the first, and an even length's last, stands for two
    return fft.rfftfreq(length, interval_s), power


def white_noise_sigma(x: ArrayLike) -> Array:
    """Sample-to-sample noise of each column of x (n, m), in time order, (m,): robust, from second differences, so that
    motion slower than the sampling does not count."""
    second = np.diff(np.asarray(x, dtype=float), n=2, axis=0)
    return MAD_TO_SIGMA * np.median(np.abs(second), axis=0) / np.sqrt(6.0)


def coloured_information(sensitivity: ArrayLike, residual: ArrayLike) -> Array:
    """Σ_i Σ_j S_iᵀ 𝓡(i−j) S_j, the middle of the coloured-residual covariance.

    𝓡 is the biased autocorrelation of each residual channel under a triangular taper of N/10 lags: its spectrum
    cannot be negative, unlike the unbiased one's. By FFT.

    Parameters
    ----------
    sensitivity : (n, c, p) array
        Derivative of the model of each of c channels with respect to p parameters (weights already in).
    residual : (n, c) array
        Residuals in the same weighting.

    Returns
    -------
    (p, p) array
    """
    return _coloured(np.asarray(sensitivity, dtype=float), np.asarray(residual, dtype=float))[0]


def _coloured(s: Array, r: Array) -> tuple[Array, float]:
    """`coloured_information`, and how many of the n samples are independent: n over the sum of the tapered
    autocorrelation, channels pooled."""
    n = len(r)
    lags = max(1, n // 10)
    size = fft.next_fast_len(n + lags + 1, real=True)  # no wrap-around within the lags that the taper keeps
    correlation = fft.irfft(np.abs(fft.rfft(r, size, axis=0)) ** 2, size, axis=0) / n
    taper = np.zeros(size)
    taper[: lags + 1] = 1.0 - np.arange(lags + 1) / (lags + 1)
    taper[-lags:] = taper[lags:0:-1]
    spectrum = np.maximum(fft.rfft(correlation * taper[:, None], size, axis=0).real, 0.0)
    # Parseval over the half spectrum: every bin but the first (and an even size's last) stands for two.
    twice = np.full(len(spectrum), 2.0)
    twice[0] = 1.0
    if size % 2 == 0:
        twice[-1] = 1.0
    middle = np.zeros((s.shape[2], s.shape[2]))
    for channel in range(s.shape[1]):
        transform = fft.rfft(s[:, channel, :], size, axis=0)
        weighted = transform * (spectrum[:, channel] * twice / size)[:, None]
        middle += (transform.conj().T @ weighted).real
    variance = float(correlation[0].sum())
    independent = n / max(1.0, float(spectrum[0].sum()) / variance) if variance > 0.0 else float(n)
    return middle, independent


def independent_samples(residual: ArrayLike) -> float:
    """How many independent samples the residual (n,), in order of time, is worth: n over the sum of its tapered
    autocorrelation, n at most."""
    r = np.asarray(residual, dtype=float)
    return _coloured(np.zeros((len(r), 1, 0)), r[:, None])[1]


def colour(residual: ArrayLike) -> float:
    """How many times the density of white noise of the same variance the residuals (n, c), in order of time, have at
    low frequency; mean of the channels, 1 at least."""
    r = np.asarray(residual, dtype=float)
    return float(np.mean([len(r) / max(independent_samples(column), 1e-9) for column in r.T]))


def low_frequency_density(x: ArrayLike, lags: int, *, together: int, largest: float) -> Array:
    """Density at low frequency over that of white noise of the same variance, from the tapered autocorrelation.

    Parameters
    ----------
    x : (n, r) array
        Residuals in order of time.
    lags : int
        The longest correlation that is looked at, samples.
    together : int
        So many columns, one beside the other, share a density.
    largest : float
        1 at least, this at most.

    Returns
    -------
    (r / together,) array
    """
    x = np.asarray(x, dtype=float)
    size = fft.next_fast_len(len(x) + lags + 1, real=True)
    correlation = fft.irfft(np.abs(fft.rfft(x, size, axis=0)) ** 2, size, axis=0)[: lags + 1]
    of_lag = correlation.reshape(lags + 1, x.shape[1] // together, together).sum(axis=2)
    taper = 1.0 - np.arange(1, lags + 1) / (lags + 1)
    density = 1.0 + 2.0 * (taper @ of_lag[1:]) / np.maximum(of_lag[0], 1e-300)
    return np.asarray(np.clip(density, 1.0, largest))


def least_squares_covariance(
    sensitivity: ArrayLike, residual: ArrayLike, *, nuisance: int = 0, steady_over: int | None = None
) -> tuple[Array, Array]:
    """Covariances of a least-squares fit: (Cramér–Rao σ²M⁻¹, coloured M⁻¹[ΣΣ Sᵀ𝓡S]M⁻¹), each (p, p).

    `sensitivity` (n, c, p) and `residual` (n, c) as in `coloured_information`; `nuisance` counts parameters that were
    eliminated beforehand. `steady_over`: samples over which the residual's size is the same, None for all: where both
    it and the sensitivity are larger in motion than at rest, the rest says nothing of the errors. Publish the second.
    """
    s, r = np.asarray(sensitivity, dtype=float), np.asarray(residual, dtype=float)
    n, channels, p = s.shape
    flat = s.reshape(n * channels, p)
    scale = np.linalg.norm(flat, axis=0)
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv((flat / scale).T @ (flat / scale), hermitian=True) / np.outer(scale, scale)
    sigma_squared = float(np.sum(r * r)) / max(1, n * channels - p)
    # p parameters a channel took from the variance of n_e independent samples: n_e/(n_e − p), at most 4.
    size = np.ones(n) if steady_over is None else _local_size(r, steady_over)
    middle, independent = _coloured(s * size[:, None, None], r / size[:, None])
    freedom = min(independent / max(independent - (p + nuisance) / channels, 1e-9), 4.0)
    return sigma_squared * inverse, inverse @ (freedom * middle) @ inverse


def _local_size(r: Array, window: int) -> Array:
    """Rms of residuals r (n, c) over `window` samples about each, (n,), as a share of the rms of all."""
    square, ones = np.mean(r * r, axis=1), np.ones(min(window, len(r)))
    local = np.convolve(square, ones, mode="same") / np.convolve(np.ones(len(r)), ones, mode="same")
    return np.sqrt(np.maximum(local / max(float(square.mean()), 1e-300), LEAST_LOCAL_SHARE**2))


def variance_by_blocks(pull: ArrayLike, t: ArrayLike) -> Array:
    """Variance of a sum whose terms are uncorrelated over long times only: BLOCKS sums of neighbours take its place
    (cluster-robust; Liang and Zeger, 1986).

    Parameters
    ----------
    pull : (n, p) array
        Terms of each of p sums: what every residual does to every parameter. A sum is 0 at a fit's minimum, so their
        mean counts for nothing.
    t : (n,) array
        Their times, s, ascending, gaps taken out; blocks are no shorter than BLOCK_S.

    Returns
    -------
    (p,) array
        Variances; 0 where there are fewer than FEWEST_BLOCKS blocks to judge by.
    """
    pull, t = np.asarray(pull, dtype=float), np.asarray(t, dtype=float)
    length = max(BLOCK_S, float(t[-1] - t[0]) / BLOCKS)
    block = np.unique(np.floor((t - t[0]) / length), return_inverse=True)[1]
    blocks = int(block[-1]) + 1
    if blocks < FEWEST_BLOCKS:
        return np.zeros(pull.shape[1])
    total = np.zeros((blocks, pull.shape[1]))
    np.add.at(total, block, pull)
    return np.asarray(blocks * np.var(total, axis=0, ddof=1))
