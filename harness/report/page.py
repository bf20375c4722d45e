"""Self-contained HTML file: template, style, script and data in one text."""

import base64
import hashlib
import json
import re
from importlib.resources import files
from typing import Final

from motorhil.harness.report.document import Json

SCRIPTS: Final = (
    "data.js",
    "axes.js",
    "plots.js",
    "traffic.js",
    "timelines.js",
    "moves.js",
    "responses.js",
    "page.js",
)


def render(document: Json, packed: str) -> str:
    """Return the page; its content security policy forbids every connection.

    Args:
        document: the document made by `document_of`.
        packed: the arrays that it refers to.
    """
    folder = files("motorhil.harness.report") / "template"
    style = (folder / "page.css").read_text("utf-8")
    script = '"use strict";\n' + "\n".join((folder / name).read_text("utf-8") for name in SCRIPTS)
    told = json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    page = (folder / "page.html").read_text("utf-8")
    parts = {
        "policy": _policy(script, style),
        "style": style,
        "script": script,
        "title": _escaped(str(document["title"])),
        "document": told.replace("<", "\\u003c"),
        "packed": packed,
    }
    return re.sub("@@([a-z]+)@@", lambda found: parts[found[1]], page)


def _policy(script: str, style: str) -> str:
    """Return a content security policy that allows only this script and this style."""
    return (
        f"default-src 'none'; img-src data:; script-src '{_digest(script)}';"
        f" style-src '{_digest(style)}'; base-uri 'none'; form-action 'none'"
    )


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
