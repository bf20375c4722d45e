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
    "start.js",
)


def render(document: Json, packed: str) -> str:
    """Return the page; its content security policy forbids every connection.

    Args:
        document: the document made by `document_of`.
        packed: the arrays that it refers to.
    """
    told = json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return assembled(
        read_template("page.html"),
        title=str(document["title"]),
        style=read_template("page.css"),
        script="\n".join(read_template(name) for name in SCRIPTS),
        connect="",
        parts={"document": told.replace("<", "\\u003c"), "packed": packed},
    )


def read_template(name: str) -> str:
    """Return a file of the template."""
    return (files("motorhil.harness.report") / "template" / name).read_text("utf-8")


def assembled(
    page: str, *, title: str, style: str, script: str, connect: str, parts: dict[str, str]
) -> str:
    """Return the page with its parts in place of @@names@@.

    Args:
        page: the template.
        title: the title, as plain text.
        style: the style.
        script: the script.
        connect: the connections that its content security policy allows; "": none.
        parts: further parts by name, as HTML.
    """
    script = '"use strict";\n' + script
    told = parts | {
        "body": read_template("body.html"),
        "policy": _policy(script, style, connect),
        "style": style,
        "script": script,
        "title": _escaped(title),
    }
    return re.sub("@@([a-z]+)@@", lambda found: told[found[1]], page)


def _policy(script: str, style: str, connect: str) -> str:
    """Return a content security policy that allows only this script and this style."""
    connections = f" connect-src {connect};" if connect else ""
    return (
        f"default-src 'none'; img-src data:; script-src '{_digest(script)}';"
        f" style-src '{_digest(style)}';{connections} base-uri 'none'; form-action 'none'"
    )


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
