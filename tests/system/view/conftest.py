"""Fixtures: the demo's recording, a file that grows into a copy of it, and a browser."""

import pytest

from motorhil.harness.cli.main import main
from tests.support.browser import started
from tests.support.view.growing import Growing
from tests.unit.harness.conftest import demo  # noqa: F401


@pytest.fixture
def growing(demo, tmp_path):  # noqa: F811
    return Growing(tmp_path / "growing.mcap", demo)


@pytest.fixture
def wheels(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "wheels"]) == 0
    return tmp_path


@pytest.fixture(scope="package")
def browser(tmp_path_factory):
    yield from started(tmp_path_factory)


@pytest.fixture
def page(browser):
    """Return a function that opens a live view; check that no request went elsewhere."""
    asked = []

    def open_(server, ready="document.documentElement.dataset.live"):
        asked.append(server.address.partition("?")[0])
        browser.call("Page.navigate", url=server.address)
        browser.wait(ready)
        return browser

    browser.call("Page.navigate", url="about:blank")
    browser.begin_anew()
    yield open_
    assert [one for one in browser.requests if not one.startswith(tuple(asked))] == []
    assert [one for one in browser.errors if "ERR_" not in one] == []  # a server that was stopped
    assert browser.run("document.documentElement.dataset.error || ''") == ""
