"""Fixtures: the demo's recording, and a file that grows into a copy of it."""

import pytest

from tests.support.view.growing import Growing
from tests.unit.harness.conftest import demo  # noqa: F401


@pytest.fixture
def growing(demo, tmp_path):  # noqa: F811
    return Growing(tmp_path / "growing.mcap", demo)
