"""Picture of a moment: curves of one quantity over time, as SVG.

Colours are the page's: a line has its name as class, and `currentColor`.
"""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Final

_WIDTH, _HEIGHT, _LEFT = 900, 200, 70
_DASHES: Final = {"demand": "6 3", "told": "2 2", "truth": "", "target": "1 3"}
STYLE: Final = """
.demand { color: #2f6fb0 } .told { color: #b3261e } .truth { color: #287a2c }
.target, .pairs { color: #a8477f } .rate { color: #2f6fb0 }
.axis { color: #777 } .moment { color: #b3261e }
svg { max-width: 100%; height: auto }
@media (prefers-color-scheme: dark) { .demand { color: #8ab4f8 } .told { color: #f2867e }
  .truth { color: #7cc47f } .target, .pairs { color: #e79cc8 } .rate { color: #8ab4f8 }
  .axis { color: #aaa } .moment { color: #f2867e } }
"""
"""Style sheet for a page with pictures."""
Curve = Sequence[tuple[float, float]]


def picture_of(
    curves: Mapping[str, Curve],
    at_s: float | None = None,
    about: str = "position over time",
    shown: Callable[[float], str] = "{:.3f} s".format,
) -> str:
    """Return an SVG of curves over time; "" without values.

    Args:
        curves: by name, such as "demand", "told", "truth": (time [s], value).
        at_s: the moment, which gets a line [s].
        about: what the picture shows.
        shown: returns a time as text.
    """
    points = [point for curve in curves.values() for point in curve]
    if not points:
        return ""
    begin_s, end_s = min(point[0] for point in points), max(point[0] for point in points)
    low, high = min(point[1] for point in points), max(point[1] for point in points)
    if end_s == begin_s:
        return ""
    margin = 0.05 * (high - low) or 0.5
    low, high = (0.0 if 0.0 <= low < margin else low - margin), high + margin

    def across(time_s: float) -> float:
        return _LEFT + (time_s - begin_s) / (end_s - begin_s) * (_WIDTH - _LEFT)

    parts = []
    for number, (name, curve) in enumerate(curves.items()):
        line = " ".join(
            f"{across(time_s):.1f},{(high - value) / (high - low) * _HEIGHT:.1f}"
            for time_s, value in curve
        )
        parts.append(
            f'<g class="{name}"><polyline points="{line}" fill="none" stroke="currentColor"'
            f' stroke-width="1.5" stroke-dasharray="{_DASHES.get(name, "")}"/>'
            f'<text x="{_LEFT + 90 * number}" y="{_HEIGHT + 30}" fill="currentColor">{name}</text>'
            "</g>"
        )
    if at_s is not None and begin_s <= at_s <= end_s:
        parts.append(_moment(across(at_s), at_s))
    texts = (
        (0, 10, "start", f"{high:.4g}"),
        (0, _HEIGHT, "start", f"{low:.4g}"),
        (_LEFT, _HEIGHT + 14, "start", shown(begin_s)),
        (_WIDTH, _HEIGHT + 14, "end", shown(end_s)),
    )
    parts += [
        f'<text class="axis" x="{x}" y="{y}" text-anchor="{anchor}" fill="currentColor">'
        f"{escape(text)}</text>"
        for x, y, anchor, text in texts
    ]
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT + 36}" font-size="11" role="img"'
        f' aria-label="{escape(about)}">{"".join(parts)}</svg>'
    )


def _moment(x: float, at_s: float) -> str:
    end = ' text-anchor="end"' if x > _WIDTH / 2 else ""
    place = x - 4 if end else x + 4
    return (
        f'<g class="moment"><line x1="{x:.1f}" y1="0" x2="{x:.1f}" y2="{_HEIGHT}"'
        f' stroke="currentColor"/><text x="{place:.1f}" y="10" fill="currentColor"{end}>'
        f"{at_s:.6f} s</text></g>"
    )
