"""docs/CLAUSES.md says what the kit promises."""

from harness.conformance.clauses_page import page
from tests.architecture.checkout import CHECKOUT

PAGE = CHECKOUT / "docs" / "CLAUSES.md"


def test_the_page_is_of_this_kit():
    assert PAGE.read_text() == page(), "make clauses writes it anew"
