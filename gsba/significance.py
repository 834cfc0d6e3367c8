"""How likely chance is to explain an agreement, and whether one explanation outweighs another."""

import numpy as np

# Models that one robust estimate compares at most: three thousand samples, each solved for up to
# ten poses.
_MODELS = 30_000


def log10_false_alarms(
    num: int, agreeing: np.ndarray | int, chance: float, sample: int
) -> np.ndarray:
    """Logarithm to base 10 of the number of models that chance alone lets agree as well.

    The a contrario test of Moisan and Stival (IJCV 57(3), 2004): under the hypothesis that data
    are independent of the model, each agrees with probability `chance`, and a model that was
    fitted to a minimal sample has the agreement of that sample for nothing.

    Args:
        num: independent data.
        agreeing: (...) those that agree with the best model.
        chance: probability that a datum agrees with a model that it has nothing to do with.
        sample: data that determine a model.
    """
    from scipy.special import gammaln
    from scipy.stats import binom

    samples = gammaln(num + 1) - gammaln(sample + 1) - gammaln(max(num - sample, 0) + 1)
    models = min(samples / np.log(10) + 1, np.log10(_MODELS))
    beyond = np.asarray(agreeing) - sample
    tail = binom.logsf(beyond - 1, max(num - sample, 0), chance) / np.log(10)
    return np.where(beyond > 0, models + tail, np.inf)


def least_agreeing(num: int, chance: float, sample: int, most_false_alarms: float) -> int:
    """How many of `num` data must agree with a model to rule chance out; `num` + 1 = none do."""
    numbers = np.arange(num + 1)
    alarms = log10_false_alarms(num, numbers, chance, sample)
    return int(np.count_nonzero(alarms > np.log10(most_false_alarms)))


def outweighs(support: int, rival: int, error_rate: float) -> bool:
    """Whether independent witnesses prefer one of two explanations (the sign test).

    Args:
        support, rival: witnesses of this explanation alone, and of the other alone.
        error_rate: probability of preferring one of two explanations that are equally true.
    """
    from scipy.stats import binom

    return bool(binom.sf(support - 1, support + rival, 0.5) <= error_rate)
