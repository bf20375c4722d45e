"""The page of names for extensions: every name, each with a text."""

import re
from importlib import import_module

import pytest

from motorhil.harness import api_names
from tests.support.checkout import CHECKOUT

PAGE = CHECKOUT / "docs" / "reference" / "api-names.md"


@pytest.mark.pure("compiled modules have no text of their own")
def test_page_is_up_to_date():
    assert PAGE.read_text() == api_names.page(), "make clauses writes it anew"


@pytest.mark.parametrize("module", ["motorapi", "emulators", "traces"])
def test_every_name_is_on_the_page_with_its_meaning(module):
    section = PAGE.read_text().split(f"## motorhil.{module}.api\n")[1].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| \w+ \| .*\S.* \|$", section, re.MULTILINE)
    assert rows == sorted(import_module(f"motorhil.{module}.api").__all__)
