"""Cross-validation over parts of a sequence: a model is taken if it predicts held-out parts.

Everything that is estimated of the camera is judged here: each part of the sequence is predicted by
the parameters that the other parts give.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

_MIN_GAIN_SIGMAS = 3.0  # least significant gain, in its standard deviations


class SequencePart(Protocol):
    """A part of the sequence, whose robust cost is a function of parameters."""

    @property
    def cost(self) -> float:
        """The cost where all parameters are zero."""
        ...

    def gain(self, step: np.ndarray, /) -> float:
        """Decrease of the cost from there by parameters."""
        ...


P = TypeVar("P", bound=SequencePart)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Gains of parts by parameters that were found from the other parts."""

    gains: np.ndarray  # (PARTS,) float64, decrease of each part's robust cost by the
    # parameters of the other parts, beyond the baseline
    shares: np.ndarray  # (PARTS,) float64, gains as shares of the cost that the baseline leaves

    @property
    def predicts(self) -> bool:
        """True if the parameters surely predict parts that they were not found from."""
        return predicts(self.gains)


def cross_validate(
    parts: Sequence[P],
    candidate: Callable[[list[P]], np.ndarray],
    baseline: Callable[[list[P]], np.ndarray] | None = None,
) -> Verdict:
    """Predict each part of a sequence by the others.

    Args:
        candidate: parameters that some parts give.
        baseline: the same by the simpler model that the candidate is compared with; None = all
            parameters are zero.
    """
    gains, costs = np.zeros(len(parts)), np.array([part.cost for part in parts])
    for p, part in enumerate(parts):
        others = [*parts[:p], *parts[p + 1 :]]
        before = 0.0 if baseline is None else part.gain(baseline(others))
        gains[p] = part.gain(candidate(others)) - before
        costs[p] -= before
    return Verdict(gains, gains / costs)


def predicts(gains: np.ndarray) -> bool:
    """True if gains (PARTS,) in log-likelihood are surely more than chance.

    A gain of G by parameters that are true has a standard deviation of sqrt(2 G): the residuals'
    noise along their change. The sum of all parts must exceed none by several of these, and no part
    may surely lose.
    """
    total = float(gains.sum())
    sigma = np.sqrt(2 * max(total, 0.0))
    least = -_MIN_GAIN_SIGMAS * sigma / np.sqrt(len(gains))
    return bool(total > _MIN_GAIN_SIGMAS * sigma and np.all(gains > least))
