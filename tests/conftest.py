"""Fixtures that several files share."""

import pytest
from tiny_run import Case, make_case


@pytest.fixture(scope="session")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """A tiny rendered walk and its finished run; copy it before going on from it."""
    return make_case(tmp_path_factory.mktemp("pipeline"))
