"""Page of the view: the report's drawing, fed by events instead of its own data."""

from importlib.resources import files
from typing import Final

from motorhil.harness.report.page import SCRIPTS, assembled, read_template

OWN: Final = ("growth.js", "detail.js", "tables.js", "hands.js", "live.js")


def live_page(title: str) -> str:
    """Return the page; its content security policy allows connections to its own server only."""
    folder = files("motorhil.harness.view") / "template"
    own: list[str] = [(folder / name).read_text("utf-8") for name in OWN]
    drawing = [read_template(name) for name in SCRIPTS if name != "start.js"]
    style = read_template("page.css") + (folder / "live.css").read_text("utf-8")
    return assembled(
        (folder / "live.html").read_text("utf-8"),
        title=title,
        style=style,
        script="\n".join((*drawing, *own)),
        connect="'self'",
        parts={},
    )
