"""Likelihood ratio tests of GPS fixes: of another clock offset, and of a mirrored run.

Both are fitted by similarities under Student's distribution of whitened errors, whose scale is
fitted, too: files claim more or less noise than fixes have.
"""

import dataclasses

import numpy as np

from gsba.bundle.gps_factors import FrameFixes

_MAX_LAG_S = 60.0  # largest lag that is tried
_MAX_GAP_S = 5.0  # between frames: a position further from both is not interpolated
_MIN_FIXES, _MAX_FIXES = 10, 300  # that paths are compared by
_MIN_GAIN = 15.0  # of the log-likelihood; right files reach 7 in simulations
_MIN_NOISE_RATIO = 0.5  # smallest noise of fixes, part of the claimed one: the map drifts besides
_STUDENT_DOF = 4.0  # degrees of freedom of the distribution of errors


def lag_of(fixes: FrameFixes, times: np.ndarray, positions: np.ndarray, level: bool) -> float:
    """Seconds by which fixes are behind their frames, negative = ahead; 0 = no other lag is
    significantly more likely, or fixes are too few.

    Args:
        times, positions: (F,) seconds, ascending, and (F, 3) map units, of the run's frames.
        level: +z of the map is known to be up.
    """
    fixes = fixes.taken(_spread_out(fixes))
    if fixes.times is None or len(fixes) < _MIN_FIXES:
        return 0.0
    own, inside = positions_at(fixes.times, times, positions)
    most = int(min(_MAX_LAG_S, np.ptp(fixes.times) / 2))
    lag = gain = 0.0
    for step, num in ((1.0, most), (0.25, 4), (0.05, 5)):  # seconds, and steps to either side
        lags = lag + step * np.arange(-num, num + 1)
        moved, known = positions_at(fixes.times - lags[:, None], times, positions)
        gains = _gains(fixes, own, moved, known & inside, level)
        best = int(np.argmax(gains))
        lag, gain = float(lags[best]), float(gains[best])
    return lag if gain > _MIN_GAIN else 0.0


def are_mirrored(fixes: FrameFixes, positions: np.ndarray) -> bool:
    """True if fixes fit the mirror image of positions (G, 3) of a map with +z up significantly
    better."""
    rows = _spread_out(fixes)
    fixes, own = fixes.taken(rows), positions[rows]
    if len(fixes) < _MIN_FIXES:
        return False
    known = np.ones((1, len(own)), bool)
    return bool(_gains(fixes, own, (own * [-1.0, 1, 1])[None], known, True)[0] > _MIN_GAIN)


def positions_at(
    at: np.ndarray, times: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (..., 3) of a path at times (...), and whether (...) they are known."""
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    known = (at >= times[0]) & (at <= times[-1]) & (times[after] - times[after - 1] <= _MAX_GAP_S)
    return np.stack([np.interp(at, times, column) for column in positions.T], axis=-1), known


def _spread_out(fixes: FrameFixes) -> np.ndarray:
    """Rows of at most `_MAX_FIXES` fixes, a second or more apart if they have times."""
    if fixes.times is None:
        return np.unique(np.linspace(0, len(fixes) - 1, _MAX_FIXES).astype(int))
    steps = (fixes.times - fixes.times[0]) / max(float(np.ptp(fixes.times)) / _MAX_FIXES, 1.0)
    return np.flatnonzero(np.diff(np.floor(steps), prepend=-1))


def _gains(
    fixes: FrameFixes, own: np.ndarray, others: np.ndarray, rows: np.ndarray, level: bool
) -> np.ndarray:
    """Gains (L,) of the log-likelihood of fixes by other positions (L, G, 3) than `own` (G, 3), by
    rows (L, G) bool of which both are known; -inf = of too few."""
    dims, equal = 2 if level else 3, np.repeat(fixes.sigmas[:, :1], 3, axis=1)
    columns = np.stack([np.ones_like(own), fixes.positions, own, *others], axis=2)
    columns = dataclasses.replace(fixes, sigmas=equal).whitened(columns)
    one, target, own, others = (
        np.moveaxis(part, 2, 0)[..., :dims] for part in np.split(columns, [1, 2, 3], axis=2)
    )
    found, lasting = _log_likelihoods(others, target[0], one[0, :, :1], rows)
    before, _ = _log_likelihoods(np.repeat(own, len(rows), 0), target[0], one[0, :, :1], rows)
    enough = rows.sum(axis=1) >= max(_MIN_FIXES, len(fixes) // 2)
    return np.where(enough, (found - before) / lasting, -np.inf)


def _log_likelihoods(
    sources: np.ndarray, target: np.ndarray, one: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihoods (L,) of whitened targets (G, d) under the best similarity of sources
    (L, G, d), and the number (L,) of rows over which residuals are alike, at least 1.

    Args:
        one: (G, 1), by which a translation adds to targets.
        rows: (L, G) bool, rows that count.
    """
    dims, num = target.shape[1], np.maximum(rows.sum(axis=1), 1)
    weights, variance = rows.astype(np.float64)[..., None], np.ones(len(rows))
    off = np.zeros_like(sources)
    for n in range(10):  # passes of reweighting
        total = np.maximum(np.sum(weights * one**2, axis=1, keepdims=True), 1e-300)
        s, t = (
            part - one * np.sum(weights * one * part, axis=1, keepdims=True) / total
            for part in (sources, target)
        )
        u, sizes, vt = np.linalg.svd(np.swapaxes(weights * t, 1, 2) @ s)
        sign = np.sign(np.linalg.det(u @ vt))
        u[:, :, -1] *= sign[:, None]
        sizes[:, -1] *= sign
        scales = sizes.sum(axis=1) / np.maximum(np.sum(weights * s**2, axis=(1, 2)), 1e-300)
        off = t - scales[:, None, None] * s @ np.swapaxes(u @ vt, 1, 2)
        squares = np.sum(off**2, axis=2)
        if n == 0:
            variance = np.maximum(np.sum(squares * rows, axis=1) / (dims * num), 1e-12)
        weights = rows * (_STUDENT_DOF + dims) / (_STUDENT_DOF + squares / variance[:, None])
        variance = np.sum(weights * squares, axis=1) / (dims * num)
        variance = np.maximum(variance, _MIN_NOISE_RATIO**2)
        weights = weights[..., None]
    logs = (_STUDENT_DOF + dims) * np.log1p(squares / (_STUDENT_DOF * variance[:, None]))
    found = -0.5 * np.sum(rows * (logs + dims * np.log(variance)[:, None]), axis=1)
    # Errors that a receiver smooths stay alike beyond the whitening (Geyer, Statistical Science 7,
    # 1992): the sum of correlations until these end.
    kept = off * np.sqrt(weights)
    spread, lasting, alike = np.sum(kept**2, axis=(1, 2)), np.ones(len(rows)), np.ones(len(rows))
    for step in range(1, rows.shape[1] // 2):
        part = np.sum(kept[:, step:] * kept[:, :-step], axis=(1, 2)) / np.maximum(spread, 1e-300)
        alike *= part > 0
        if not alike.any():
            break
        lasting += 2 * alike * part
    return found, lasting
