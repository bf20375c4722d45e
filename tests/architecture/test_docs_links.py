"""Links of README.md and docs: every linked file and anchor exists, and every page is reachable.

`make check` runs this file too: it starts nothing and takes a second.
"""

import pkgutil
import re
from collections import Counter

import pytest

from tests.architecture.pages import PAGES, README, name_of
from tests.support.checkout import CHECKOUT

README_LINES_MAX = 250
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#{1,6} +(.*?)#* *$", re.MULTILINE)
FENCED = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)


def prose_of(text):
    """Return a page without its code blocks and code spans."""
    return re.sub(r"`[^`\n]*`", lambda code: "`" * len(code[0]), FENCED.sub("", text))


def anchors_of(text):
    """Return the anchors of a page's headings, as Git hosts and the site make them."""
    found = Counter()
    anchors = set()
    for heading in HEADING.findall(FENCED.sub("", text)):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        slug = re.sub(r"[^\w -]", "", plain).replace(" ", "-")
        anchors.add(f"{slug}-{found[slug]}" if found[slug] else slug)
        found[slug] += 1
    return anchors


def dead_links(page, text):
    """Return the links of a page that lead nowhere."""
    dead = []
    for link in LINK.findall(prose_of(text)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.is_file():
            dead.append(link)
        elif anchor:
            linked = text if target == page else target.read_text(encoding="utf-8")
            if anchor not in anchors_of(linked):
                dead.append(link)
    return dead


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_of_a_page_leads_somewhere(page):
    assert dead_links(page, page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_page_has_one_title(page):
    titles = re.findall(r"^# .+$", FENCED.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    assert len(titles) == 1


def test_every_page_is_linked_from_the_index_of_its_folder():
    for page in PAGES:
        if page.name == "index.md" or page == README:
            continue
        index = (page.parent / "index.md").read_text(encoding="utf-8")
        assert page.name in LINK.findall(index), name_of(page)


def test_pages_below_docs_link_to_nothing_outside_docs():
    """The site holds docs alone; files elsewhere are named, not linked."""
    docs = CHECKOUT / "docs"
    for page in PAGES:
        for link in LINK.findall(prose_of(page.read_text(encoding="utf-8"))):
            path = link.partition("#")[0]
            if page != README and path and not re.match(r"[a-z]+:", path):
                assert (page.parent / path).resolve().is_relative_to(docs), (name_of(page), link)


def test_readme_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= README_LINES_MAX


@pytest.mark.parametrize(
    ("link", "is_dead"),
    [
        ("LICENSE", False),
        ("#readme-title", False),
        ("#readme-title-1", False),
        ("#readme-title-2", True),
        ("docs/index.md#motorhil", False),
        ("docs/index.md#no-such-heading", True),
        ("docs/no-such-page.md", True),
    ],
)
def test_a_dead_link_is_found(link, is_dead):
    text = f"# `README`: title\n\n## README title\n\n[text]({link})\n"
    assert dead_links(README, text) == ([link] if is_dead else [])


def test_renamed_names_are_at_their_new_homes():
    page = (CHECKOUT / "docs/reference/renamed.md").read_text(encoding="utf-8")
    homes = re.findall(r"^\| `[^`]+`[^|]*\| `(motorhil[\w.]+)` \|$", page, re.MULTILINE)
    assert len(homes) > 30
    for home in homes:
        assert pkgutil.resolve_name(home) is not None
