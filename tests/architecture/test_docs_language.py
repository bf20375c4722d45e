"""Language of README.md and docs: short sentences in the usual order of words.

Checked is running text. Tables, code and generated pages are left out. Of docstrings, those of
attributes included, only the first word is checked.
"""

import ast
import re

import pytest

from tests.architecture.pages import PAGES, name_of
from tests.support.checkout import CHECKOUT, PACKAGES

WORDS_MAX = 20
GENERATED = tuple(f"docs/reference/{n}.md" for n in ("api-names", "clauses", "drive-clauses"))
OPENINGS = ("What", "Who", "Whose", "Whether", "That", "It", "Of")
UNWANTED = ("somebody", "nobody", "is told", "are told", "goes on", "go on", "aloud")


def paragraphs(text):
    """Yield paragraphs and list items as single lines, code spans replaced by one word."""
    text = re.sub(r"^```.*?^```$", "\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^(<!-- .* -->|#.*|\|.*)$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"^ *(?:- |\d+\. )", "\n", text, flags=re.MULTILINE)
    for paragraph in re.split(r"\n\s*\n", text):
        plain = re.sub(r"`[^`]*`", "CODE", " ".join(paragraph.split()))
        yield re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", plain)


def complaints(text):
    """Return a line for each sentence that breaks a rule."""
    found = []
    for paragraph in paragraphs(text):
        for sentence in re.split(r"(?<=[.!?:;])\s+", paragraph):
            words = sentence.split()
            if len(words) > WORDS_MAX:
                found.append(f"{len(words)} words: {sentence}")
            if words and words[0] in OPENINGS:
                found.append(f"opens with {words[0]}: {sentence}")
            found += [
                f"{bad}: {sentence}" for bad in UNWANTED if re.search(rf"\b{bad}\b", sentence)
            ]
    return found


@pytest.mark.parametrize(
    "page", [page for page in PAGES if name_of(page) not in GENERATED], ids=name_of
)
def test_sentences_of_a_page_are_short_and_plain(page):
    assert complaints(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "text",
    [
        "word " * 21,
        "Fine. It is not.",
        "- What is this.",
        "The value is told.",
    ],
)
def test_a_sentence_that_breaks_a_rule_is_found(text):
    assert len(complaints(text)) == 1


def test_tables_code_and_links_are_not_sentences():
    text = "| It | is told |\n\n```text\nIt is told\n```\n\n`It`: [a b](c.md#it-is) fine.\n"
    assert complaints(text) == []


def odd_docstrings(name, text):
    """Return the docstrings that open with a word of OPENINGS."""
    strings = [
        node.value
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    ]
    return [
        f"{name}:{one.lineno}: {one.value.splitlines()[0]}"
        for one in strings
        if isinstance(one.value, str) and one.value.split(maxsplit=1)[:1] in ([w] for w in OPENINGS)
    ]


def test_docstrings_open_plainly():
    found = []
    for package in (*PACKAGES, "tests"):
        for path in sorted((CHECKOUT / package).rglob("*.py")):
            found += odd_docstrings(path.relative_to(CHECKOUT).as_posix(), path.read_text())
    assert found == []


@pytest.mark.parametrize(
    "text",
    [
        '"""What it is."""',
        'def f():\n    """It does."""',
        'class A:\n    b = 1\n    """Of it.\n\n    More.\n    """',
    ],
)
def test_docstring_that_opens_oddly_is_found(text):
    assert len(odd_docstrings("m.py", text)) == 1
    assert odd_docstrings("m.py", 'x = "It is data"\ndef f():\n    """Item of a list."""') == []
