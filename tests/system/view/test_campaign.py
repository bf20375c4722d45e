"""The page of a campaign, served: its files, and who may read them."""

import pytest

from motorhil.harness.view.campaign import CampaignServer
from tests.support.view.growing import TOKEN, get
from tests.support.view.watched import Watched

pytestmark = pytest.mark.wall

PAGE = "<!doctype html><title>swarm</title><a href='failures/a.toml'>a</a>"
PROGRAM = "def run(rig):\n    rig.runtime.run_for(0.01)\n"


@pytest.fixture
def folder(tmp_path):
    """Return a campaign's folder, and a file beside it."""
    folder = tmp_path / "swarm"
    (folder / "failures").mkdir(parents=True)
    (folder / "index.html").write_text(PAGE)
    for name, text in (("a.toml", "[[fault]]"), ("a.html", PAGE), ("a.mcap", "x" * 200_000)):
        (folder / "failures" / name).write_text(text)
    (tmp_path / "secret.toml").write_text("secret")
    (folder / "link.toml").symlink_to(tmp_path / "secret.toml")
    return folder


@pytest.fixture
def served(folder):
    with CampaignServer(folder, token=TOKEN) as server:
        yield server.port


def test_page_and_files_of_failures_are_served(served):
    status, headers, body = get(served, f"/{TOKEN}/")
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert body == PAGE.encode()
    status, headers, body = get(served, f"/{TOKEN}/failures/a.toml")
    assert (status, headers["Content-Type"], body) == (
        200,
        "text/plain; charset=utf-8",
        b"[[fault]]",
    )
    status, headers, body = get(served, f"/{TOKEN}/failures/a.mcap")
    assert (status, headers["Content-Disposition"], len(body)) == (200, "attachment", 200_000)


@pytest.mark.parametrize("path", ["/", "/index.html", "/wrong/", "/%00/", "/..", f"/x{TOKEN}/"])
def test_token_is_needed(served, path):
    assert get(served, path)[0] == 403


def test_other_sites_are_refused(served):
    assert get(served, f"/{TOKEN}/", Host="evil.example")[0] == 403
    assert get(served, f"/{TOKEN}/", Origin="http://evil.example")[0] == 403


@pytest.mark.parametrize(
    "name",
    [
        *("../secret.toml", "..%2fsecret.toml", "link.toml", "failures", "failures/a.html"),
        *("//etc/passwd", "%2fetc%2fpasswd", "failures/../../secret.toml", "%00", "none.toml"),
    ],
)
def test_other_files_are_not_served(served, name):
    status, _, body = get(served, f"/{TOKEN}/{name}")
    assert (status, body[:12]) == (404, b"no such file")


def test_page_is_served_while_the_campaign_runs_and_after(wheels, page):
    (wheels / "program.py").write_text(PROGRAM)
    words = ["swarm", "wheels/rig.toml", "program:run", "--seeds", "4", "-o", "out", "--view"]
    with Watched(*words) as watched:
        watched.line("the run is over")
        browser = page(watched, "document.querySelector('h1')")
        assert "program:run" in browser.run("document.querySelector('h1').textContent")
        status, out = watched.interrupted()
    assert status == 0
    assert "4 worlds: 4 pass" in out
