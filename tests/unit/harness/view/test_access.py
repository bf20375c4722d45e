"""Requests of other sites, of other hosts and without the token are refused."""

import pytest

from motorhil.harness.view.access import Access

ACCESS = Access("secret", 8123)
HOST = "127.0.0.1:8123"


@pytest.mark.parametrize("host", ["127.0.0.1:8123", "localhost:8123", "LOCALHOST:8123"])
def test_own_page_has_access(host):
    assert ACCESS.refusal(host, None, "secret") is None
    assert ACCESS.refusal(host, f"http://{host}", "secret") is None


@pytest.mark.parametrize(
    "host", [None, "", "127.0.0.1", "127.0.0.1:80", "evil.example:8123", "evil.example"]
)
def test_foreign_host_is_refused(host):
    assert ACCESS.refusal(host, None, "secret").startswith("Host: is not this server")


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "https://127.0.0.1:8123", "http://127.0.0.1:81", "", HOST],
)
def test_foreign_origin_is_refused(origin):
    assert ACCESS.refusal(HOST, origin, "secret").startswith("Origin: is another site")


@pytest.mark.parametrize("token", [None, "", "Secret", "secre", "secrets", "geheim ä"])
def test_wrong_token_is_refused(token):
    assert ACCESS.refusal(HOST, None, token).startswith("token: is missing or wrong")


def test_refusals_do_not_tell_the_token():
    refusals = [ACCESS.refusal(HOST, None, "x"), ACCESS.refusal("x", None, "secret")]
    assert not any("secret" in text for text in refusals)
