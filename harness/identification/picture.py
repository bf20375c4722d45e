"""Page of a fitted plant: its parameters, and recorded against emulated efforts.

The page needs no script and no connection, so that it works from disk.
"""

from html import escape
from typing import TYPE_CHECKING, Final

import numpy as np

from motorhil.harness.identification.output_error import Comparison
from motorhil.harness.report.picture import STYLE, picture_of

if TYPE_CHECKING:
    from numpy import float64
    from numpy.typing import NDArray

_POINTS: Final = 3000
_AROUND_S: Final = 1.0
_STYLE: Final = """
body { font: 14px sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em }
table { border-collapse: collapse } td, th { padding: .2em .8em; text-align: left }
tr + tr { border-top: 1px solid #7773 } .recorded { color: #2f6fb0 } .emulated { color: #b3261e }
@media (prefers-color-scheme: dark) { body { background: #181a1b; color: #ddd }
  .recorded { color: #8ab4f8 } .emulated { color: #f2867e } }
"""


def page_of(
    title: str, verdict: str, rows: list[tuple[str, ...]], found: Comparison, effort: str
) -> str:
    """Return the page (HTML).

    Args:
        title: the title.
        verdict: a sentence about the fit.
        rows: the table of parameters, its head first.
        found: the efforts.
        effort: name and unit of the efforts.
    """
    head, *body = rows
    cells = [_row("th", head), *(_row("td", row) for row in body)]
    worst_s = float(found.times_s[np.argmax(np.abs(found.recorded - found.emulated))])
    near = np.abs(found.times_s - worst_s) <= _AROUND_S
    every = np.ones(len(near), dtype=bool)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\';'
        ' style-src \'unsafe-inline\'">\n<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}{_STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n<p>{escape(verdict)}</p>\n<table>{''.join(cells)}</table>\n"
        f"<h2>{escape(effort)}, recorded and emulated</h2>\n{_curves(found, every, effort)}\n"
        f"<h2>Around the largest difference</h2>\n{_curves(found, near, effort)}\n"
        "</body>\n</html>\n"
    )


def _row(tag: str, cells: tuple[str, ...]) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def _curves(found: Comparison, kept: "NDArray[np.bool_]", effort: str) -> str:
    every = max(1, int(kept.sum()) // _POINTS)

    def curve(values: "NDArray[float64]") -> list[tuple[float, float]]:
        return list(
            zip(found.times_s[kept][::every].tolist(), values[kept][::every].tolist(), strict=True)
        )

    curves = {"recorded": curve(found.recorded), "emulated": curve(found.emulated)}
    return picture_of(curves, about=f"{effort}, recorded and emulated, over time")
