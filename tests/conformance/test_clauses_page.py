"""docs/CLAUSES.md says what the kit promises."""

from pathlib import Path

from harness.conformance.clauses_page import page

PAGE = Path(__file__).parents[2] / "docs" / "CLAUSES.md"


def test_the_page_is_of_this_kit():
    assert PAGE.read_text() == page(), "make clauses writes it anew"
