"""Fixtures: the report of the demo."""

from tests.unit.harness.conftest import demo  # noqa: F401
from tests.unit.harness.report.conftest import demo_page, report_of  # noqa: F401
