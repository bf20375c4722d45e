"""The generated pages contain the promises of both kits."""

import pytest

from motorhil.harness.conformance import kit
from motorhil.harness.conformance.drives import kit as drive_kit
from tests.support.checkout import CHECKOUT

PAGES = CHECKOUT / "docs" / "reference"


@pytest.mark.parametrize(
    ("name", "page"), [("clauses.md", kit.page), ("drive-clauses.md", drive_kit.page)]
)
def test_clauses_page_is_up_to_date(name, page):
    assert (PAGES / name).read_text() == page(), "make clauses writes it anew"
