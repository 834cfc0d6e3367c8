"""A reach that suits the small worlds of these tests."""

import pytest


@pytest.fixture(autouse=True)
def _short_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    for user in ("matching.pairs", "loop_closure.loops"):
        monkeypatch.setattr(f"gsba.{user}.MAX_BASELINE_DEPTHS", 0.8)
