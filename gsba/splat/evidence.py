"""Evidence of paired differences for one of two alternatives, in standard errors."""

import numpy as np


def standard_error(differences: np.ndarray) -> float:
    """Standard error of the mean of differences (N,); infinite for a single one."""
    num = len(differences)
    return float(differences.std(ddof=1) / np.sqrt(num)) if num > 1 else np.inf


def score(differences: np.ndarray, chance: float = 0.0) -> float:
    """Significance of a positive sum of differences (N,), in standard errors.

    Few differences determine their spread poorly: their t is mapped to the normal score of equal
    probability (Wallace, Bounds on normal approximations, 1959).

    Args:
        chance: part of the sum that chance explains; only the excess counts.
    """
    total, num = float(differences.sum()), len(differences)
    beyond, spread = max(abs(total) - chance, 0.0), num * standard_error(differences)
    if beyond == 0 or not np.isfinite(spread):
        return 0.0
    squared, free = (beyond / max(spread, 1e-12)) ** 2, num - 1
    size = np.sqrt(free * np.log1p(squared / free)) * (8 * free + 1) / (8 * free + 3)
    return float(np.copysign(size, total))


def together(*scores: float) -> float:
    """Combined score of several kinds of evidence: log likelihoods, half the squares, add up."""
    total = sum(one * abs(one) for one in scores)
    return float(np.copysign(np.sqrt(abs(total)), total))
