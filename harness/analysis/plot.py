"""Response times and deadlines of messages as a self-contained SVG picture."""

from math import log10
from typing import Final
from xml.sax.saxutils import escape

from motorhil.harness.analysis.subject import Findings
from motorhil.motorapi.synchronization.can_response_time import Response

_WIDTH: Final = 900
_NAMES: Final = 260
_ROW: Final = 18
_HEAD: Final = 46
_IN_TIME: Final = "#2f6fb0"
_LATE: Final = "#b3261e"
_PLAIN: Final = "#7a8794"


def svg_of(found: list[Findings]) -> str:
    """Return an SVG with one panel per bus: a bar per response time, a mark per deadline.

    Times are on a logarithmic axis. The bar of a message without a bound fills the whole axis.
    """
    height = 10
    parts: list[str] = []
    for one in found:
        parts += _panel(one, height)
        height += _HEAD + _ROW * len(one.responses) + 30
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}"'
        ' font-family="sans-serif" font-size="11">'
    )
    body = "\n".join([f'<rect width="{_WIDTH}" height="{height}" fill="white"/>', *parts])
    return f"{head}\n{body}\n</svg>\n"


def _panel(found: Findings, top: int) -> list[str]:
    load = found.subject.load
    low, high = _range(found.responses)
    used = f"{load.utilisation():.1%} used at most"
    title = f"{load.name}: {load.bitrate_bit_s} bit/s, {used}; longest response | deadline"
    parts = [_text(10, top + 14, title, "black", 13)]
    bottom = top + _HEAD + _ROW * len(found.responses)
    for power in range(round(log10(low)), round(log10(high)) + 1):
        x = _place(10.0**power, low, high)
        parts.append(f'<path d="M{x:.1f} {top + 36}V{bottom}" stroke="#d8dde2"/>')
        parts.append(_text(x - 12, top + 32, _time(10.0**power), _PLAIN))
    for number, one in enumerate(found.responses):
        parts += _row(one, top + _HEAD + number * _ROW, low, high)
    share = min(1.0, load.utilisation())
    width = _WIDTH - _NAMES - 20
    parts.append(_text(10, bottom + 14, "utilisation", _PLAIN))
    parts.append(
        f'<rect x="{_NAMES}" y="{bottom + 5}" width="{width}" height="10" fill="#e9edf0"/>'
    )
    parts.append(
        f'<rect x="{_NAMES}" y="{bottom + 5}" width="{width * share:.1f}" height="10"'
        f' fill="{_IN_TIME if share < 1.0 else _LATE}"/>'
    )
    return parts


def _row(one: Response, y: int, low: float, high: float) -> list[str]:
    message = one.message
    label = f"{message.label} {message.name or message.source}"
    tone = {True: _IN_TIME, False: _LATE, None: _PLAIN}[one.is_in_time]
    told = "no bound" if one.response_ns is None else _time(one.response_ns)
    end = high if one.response_ns is None else float(max(1, one.response_ns))
    width = max(1.0, _place(end, low, high) - _NAMES)
    parts = [
        _text(10, y + 11, label[:40], "black"),
        f'<rect x="{_NAMES}" y="{y + 3}" width="{width:.1f}" height="10" fill="{tone}">'
        f"<title>{escape(f'{label}: {told}')}</title></rect>",
    ]
    if message.deadline_ns is not None:
        x = _place(message.deadline_ns, low, high)
        parts.append(f'<path d="M{x:.1f} {y + 1}v14" stroke="black" stroke-width="2"/>')
    return parts


def _range(responses: tuple[Response, ...]) -> tuple[float, float]:
    """Return the powers of ten [ns] that enclose all responses and deadlines."""
    times = [one.response_ns for one in responses if one.response_ns]
    times += [one.message.deadline_ns for one in responses if one.message.deadline_ns]
    least, most = min(times, default=1000), max(times, default=1000)
    low = 10.0 ** (len(str(least)) - 1)
    return low, max(low * 10, 10.0 ** len(str(most)))


def _place(time_ns: float, low: float, high: float) -> float:
    share = (log10(max(time_ns, low)) - log10(low)) / (log10(high) - log10(low))
    return _NAMES + share * (_WIDTH - _NAMES - 20)


def _text(x: float, y: float, text: str, tone: str, size: int = 11) -> str:
    return f'<text x="{x:.1f}" y="{y}" fill="{tone}" font-size="{size}">{escape(text)}</text>'


def _time(time_ns: float) -> str:
    for factor, unit in ((1e9, "s"), (1e6, "ms"), (1e3, "us")):
        if time_ns >= factor:
            return f"{time_ns / factor:g} {unit}"
    return f"{time_ns:g} ns"
