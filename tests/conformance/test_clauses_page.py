"""docs/reference/clauses.md contains the kit's promises."""

from motorhil.harness.conformance.kit import page
from tests.support.checkout import CHECKOUT

PAGE = CHECKOUT / "docs" / "reference" / "clauses.md"


def test_clauses_page_is_up_to_date():
    assert PAGE.read_text() == page(), "make clauses writes it anew"
