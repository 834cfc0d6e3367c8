"""Significance tests: false alarms of a fitted model, and the sign test of two models."""

import numpy as np

MEDIAN_ABS_NORMAL = 0.6745  # median of |x|, x unit normal
MEDIAN_NORMAL_LENGTH = 1.538  # median length of a 3-vector of independent unit normals
OUTLIER_LENGTH = 4.6  # 99.99 % of such vectors are shorter
SIGMAS_OF_1E_3 = 3.09  # standard deviations of a one-sided error rate of 1e-3
MAX_FALSE_POSES = 1e-6  # expected number of poses that chance explains as well as an accepted one


def log10_false_alarms(
    num: int, agreeing: np.ndarray | int, chance: float, sample: int
) -> np.ndarray:
    """Logarithm to base 10 of the expected number of models that fit random data as well (...).

    The a contrario test of Moisan and Stival (IJCV 57(3), 2004): under the hypothesis that data
    are independent of the model, each is an inlier with probability `chance`. A model that was
    fitted to a minimal sample fits that sample by construction.

    Args:
        num: number of independent data.
        agreeing: (...) number of inliers of the best model.
        chance: probability that a datum is an inlier of an unrelated model.
        sample: number of data that determine a model.
    """
    from scipy.special import gammaln

    samples = gammaln(num + 1) - gammaln(sample + 1) - gammaln(max(num - sample, 0) + 1)
    # A robust estimate compares three thousand samples at most, with up to ten poses each.
    models = min(samples / np.log(10) + 1, np.log10(30_000))
    beyond = np.asarray(agreeing) - sample
    with np.errstate(divide="ignore"):  # chance brings no more than all of them
        tail = np.log(_binomial_tail(beyond, max(num - sample, 0), chance)) / np.log(10)
    return np.where(beyond > 0, models + tail, np.inf)


def least_agreeing(num: int, chance: float, sample: int, most_false_alarms: float) -> int:
    """Smallest number of inliers among `num` data that is significant; `num` + 1 = none is."""
    numbers = np.arange(num + 1)
    alarms = log10_false_alarms(num, numbers, chance, sample)
    return int(np.count_nonzero(alarms > np.log10(most_false_alarms)))


def outweighs(support: int, rival: int, error_rate: float) -> bool:
    """True if independent data significantly prefer one of two models (the sign test).

    Args:
        support, rival: numbers of data that fit this model alone, and the other alone.
        error_rate: probability of preferring one of two models that fit equally well.
    """
    return bool(_binomial_tail(support, support + rival, 0.5) <= error_rate)


def _binomial_tail(least: np.ndarray | int, num: int, chance: float) -> np.ndarray:
    """Probability (...) of at least `least` (...) successes in `num` independent trials.

    The incomplete beta function, as in scipy.stats.binom, which takes a quarter of a second to
    import.
    """
    from scipy.special import betainc

    least = np.asarray(least)
    inner = np.clip(least, 1, max(num, 1))
    tail = betainc(inner, np.maximum(num - inner + 1, 1), chance)
    return np.where(least <= 0, 1.0, np.where(least > num, 0.0, tail))
