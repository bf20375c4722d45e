"""Fixtures of all tests of builds."""

from collections.abc import Generator

import pytest


@pytest.fixture(scope="module", autouse=True)
def no_path_to_the_sources() -> Generator[None]:
    """Let each environment find its own packages."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("PYTHONPATH")
        yield
