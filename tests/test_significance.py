"""Whether chance explains an agreement: against simulations of chance."""

import numpy as np
import pytest

from gsba.significance import least_agreeing, log10_false_alarms, outweighs


@pytest.mark.parametrize(("num", "chance"), [(30, 0.02), (200, 0.005), (200, 0.3), (1000, 0.05)])
def test_chance_brings_fewer_than_what_rules_it_out(num: int, chance: float) -> None:
    """The best of as many models as an estimate compares, each with a sample that fits anyway."""
    rng = np.random.default_rng(0)
    best = 5 + rng.binomial(num - 5, chance, 30_000).max()
    least = least_agreeing(num, chance, 5, 1e-3)
    assert best < least <= num
    assert least < 5 + num * chance + 8 * np.sqrt(num * chance) + 12  # and not by much


def test_more_agreement_makes_chance_less_likely() -> None:
    alarms = log10_false_alarms(100, np.arange(101), 0.1, 5)
    assert np.isinf(alarms[:6]).all() and (np.diff(alarms[6:]) < 0).all()
    least = least_agreeing(100, 0.1, 5, 1e-3)
    assert alarms[least] <= -3 < alarms[least - 1]


def test_some_agreement_is_always_chance() -> None:
    assert least_agreeing(5, 0.01, 5, 1e-3) == 6
    assert least_agreeing(50, 1.0, 5, 1e-3) == 51


@pytest.mark.parametrize(("support", "rival"), [(10, 10), (100, 90), (3, 1)])
def test_equal_witnesses_prefer_neither(support: int, rival: int) -> None:
    assert not outweighs(support, rival, 0.05)


@pytest.mark.parametrize(("support", "rival"), [(10, 0), (60, 40), (16, 5)])
def test_many_more_witnesses_do(support: int, rival: int) -> None:
    assert outweighs(support, rival, 0.05) and not outweighs(rival, support, 0.05)


def test_of_two_equal_explanations_one_is_preferred_as_rarely_as_stated() -> None:
    rng = np.random.default_rng(0)
    supports = rng.binomial(80, 0.5, 2000)
    preferred = np.mean([outweighs(int(s), 80 - int(s), 0.05) for s in supports])
    assert 0.02 < preferred < 0.06
