"""docs/reference/clauses.md is the page of this conformance kit."""

from harness.conformance.clauses_page import page
from tests.architecture.checkout import CHECKOUT

PAGE = CHECKOUT / "docs" / "reference" / "clauses.md"


def test_the_page_is_of_this_kit():
    assert PAGE.read_text() == page(), "make clauses writes it anew"
