"""Errors of GPS fixes that last: a first-order Gauss-Markov process with white noise beside it."""

import numpy as np

from gsba.bundle.gps_factors import WHITE_SHARE, FrameFixes

SIGMAS_M = np.array([3.0, 3.0, 5.0])  # east, north, up
TAU_S = 60.0


def lasting_errors(times: np.ndarray, rng: np.random.Generator, tau: float = TAU_S) -> np.ndarray:
    """Errors (G, 3) at times (G,), metres."""
    state, states = rng.normal(size=3), np.empty((len(times), 3))
    for g, gap in enumerate(np.diff(times, prepend=times[0])):
        memory = np.exp(-gap / tau)
        state = memory * state + np.sqrt(1 - memory**2) * rng.normal(size=3)
        states[g] = state
    white = rng.normal(size=states.shape)
    return SIGMAS_M * (np.sqrt(1 - WHITE_SHARE) * states + np.sqrt(WHITE_SHARE) * white)


def fixes_at(positions: np.ndarray, times: np.ndarray | None) -> FrameFixes:
    """Fixes of frames 0, 1, ... at positions (G, 3) metres that claim this noise."""
    num = len(positions)
    sigmas, origin = np.tile(SIGMAS_M, (num, 1)), np.zeros(3)
    return FrameFixes(np.arange(num), positions, sigmas, times, origin, TAU_S)


def covariance(times: np.ndarray) -> np.ndarray:
    """Correlations (G, G) of the errors of one axis."""
    apart = np.abs(times[:, None] - times)
    return (1 - WHITE_SHARE) * np.exp(-apart / TAU_S) + WHITE_SHARE * np.eye(len(times))
