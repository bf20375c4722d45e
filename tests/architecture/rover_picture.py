"""Drawing of README's picture from a recorded demo.

motorhil demo && python -m tests.architecture.rover_picture out/demo.mcap docs/rover.svg

The picture shows the truth channel of each controller, read with mcap's and protobuf's own readers.
Curves are thinned to a third of a pixel, which cannot be seen.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

Curve = list[tuple[float, float]]

WIDTH, LEFT, RIGHT, TOP = 960, 62, 112, 58
PANEL, GAP = 118, 34
LEGS = ("arc", "crab", "turn")
CORNERS = ("fl", "fr", "ml", "mr", "rl", "rr")
# Okabe and Ito's colours, which colour-blind readers can distinguish; rear wheels are also dashed.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#aa4499", "#56b4e9", "#e69f00")
STYLE = """
text { font: 12px system-ui, sans-serif; fill: #333 }
.title { font-size: 15px; font-weight: 600 }
.small { font-size: 11px; fill: #666 }
.leg { fill: #f1f4f8 }
.grid { stroke: #dde2e8 }
.zero { stroke: #aab2bd }
polyline { fill: none; stroke-width: 1.6; stroke-linejoin: round }
"""


def read_truth(path: Path) -> dict[str, list[tuple[float, object]]]:
    """Return (time [s], truth message) of every controller."""
    truth: dict[str, list[tuple[float, object]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            words = channel.topic.split("/")
            if words[1] == "controller":
                truth.setdefault(words[2], []).append((message.log_time / 1e9, decoded))
    return truth


def thinned(points: Curve, tolerance: float = 0.35) -> Curve:
    """Thin a curve (Ramer, Douglas, Peucker); dropped points are within the tolerance."""
    if len(points) < 3:
        return points
    (x0, y0), (x1, y1) = points[0], points[-1]
    length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5 or 1.0
    away = [abs((x1 - x0) * (y0 - y) - (x0 - x) * (y1 - y0)) / length for x, y in points]
    far = max(range(len(points)), key=away.__getitem__)
    if away[far] <= tolerance:
        return [points[0], points[-1]]
    return thinned(points[: far + 1])[:-1] + thinned(points[far:])


def spans(curves: Sequence[Curve], threshold: float) -> list[tuple[float, float]]:
    """Return spans [s] in which a curve exceeds the threshold, split at pauses of 0.5 s."""
    times = sorted(t for curve in curves for t, value in curve if abs(value) > threshold)
    found: list[tuple[float, float]] = []
    for t in times:
        if found and t - found[-1][1] < 0.5:
            found[-1] = (found[-1][0], t)
        else:
            found.append((t, t))
    return found


class Picture:
    """Panels, one below the other, on one time axis."""

    def __init__(self, end_s: float, panels: int) -> None:
        self.parts: list[str] = []
        self.end_s = end_s
        self.bottom = TOP + panels * (PANEL + GAP) - GAP
        self.height = self.bottom + 44
        self.top = TOP - PANEL - GAP

    def x(self, t: float) -> float:
        """Return the x coordinate of a time."""
        return LEFT + t / self.end_s * (WIDTH - LEFT - RIGHT)

    def text(self, x: float, y: float, words: str, attributes: str = "") -> None:
        """Add a text at a position."""
        self.parts.append(f'<text x="{x:.1f}" y="{y:.1f}" {attributes}>{words}</text>')

    def line(self, x0: float, y0: float, x1: float, y1: float, kind: str) -> None:
        """Add a straight line of a style."""
        self.parts.append(
            f'<line class="{kind}" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>'
        )

    def panel(self, title: str, low: float, high: float, ticks: Sequence[float]) -> None:
        """Start the next panel, with a title, a range and a line at each tick."""
        self.top += PANEL + GAP
        self.low, self.high = low, high
        self.text(LEFT, self.top - 7, title)
        for tick in ticks:
            y = self.y(tick)
            self.line(LEFT, y, WIDTH - RIGHT, y, "zero" if tick == 0 else "grid")
            self.text(LEFT - 8, y + 4, f"{tick:g}".replace("-", "\N{MINUS SIGN}"), END)

    def y(self, value: float) -> float:
        """Return the y coordinate of a value in the present panel."""
        return self.top + PANEL * (self.high - value) / (self.high - self.low)

    def curve(self, curve: Curve, colour: str, dash: str = "") -> None:
        """Add a curve to the present panel."""
        points = thinned([(self.x(t), self.y(value)) for t, value in curve])
        places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self.parts.append(f'<polyline stroke="{colour}"{dashed} points="{places}"/>')

    def legend(self, names: Sequence[str]) -> None:
        """Add the names of the curves of the present panel, in their colours."""
        for number, name in enumerate(names):
            y = self.top + 14 + 18 * number
            dash = f' stroke-dasharray="{DASH}"' if name in ("rl", "rr") else ""
            x = WIDTH - RIGHT + 14
            places = f"{x},{y - 4} {x + 22},{y - 4}"
            self.parts.append(f'<polyline stroke="{COLOURS[number]}"{dash} points="{places}"/>')
            self.text(x + 28, y, name)

    def svg(self) -> str:
        """Return the whole picture."""
        return "\n".join(
            [
                f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {self.height}">',
                f"<style>{STYLE}</style>",
                f'<rect width="{WIDTH}" height="{self.height}" rx="8" fill="#fff"/>',
                *self.parts,
                "</svg>\n",
            ]
        )


END = 'text-anchor="end" class="small"'
MIDDLE = 'text-anchor="middle" class="small"'
DASH = "5 4"


def draw(path: Path) -> str:
    """Return the picture of a recorded demo as SVG."""
    truth = read_truth(path)

    def curves(names: Sequence[str], value: Callable[[object], float]) -> list[Curve]:
        end_s = max(t for samples in truth.values() for t, _ in samples)
        found = [[(t, value(m)) for t, m in truth[name]] for name in names]
        return [[*curve, (end_s, curve[-1][1])] for curve in found]

    wheels = [f"drive_{corner}" for corner in CORNERS]
    steering = [f"steer_{corner}" for corner in CORNERS]
    speeds = curves(wheels, lambda m: m.velocity_rad_s)
    errors = curves(wheels, lambda m: m.following_error_inc)
    angles = curves(steering, lambda m: m.position_rad)
    mast = curves(["pan", "tilt"], lambda m: m.position_rad)
    picture = Picture(max(curve[-1][0] for curve in speeds), 4)
    picture.text(LEFT, 26, "motorhil demo: arc, crab, turn, as recorded", 'class="title"')
    legs = spans(speeds, 0.02)
    for name, (begin, end) in zip(LEGS, legs, strict=True):
        x0, x1 = picture.x(begin), picture.x(end)
        picture.parts.append(
            f'<rect class="leg" x="{x0:.1f}" y="{TOP - 22}" width="{x1 - x0:.1f}" '
            f'height="{picture.bottom - TOP + 22}"/>'
        )
        picture.text((x0 + x1) / 2, TOP - 8, f"wheels roll: {name}", MIDDLE)
    peak = max(abs(value) for curve in errors for _, value in curve)
    reach = 10.0 * (1 + peak // 10.0)
    for title, group, low, high, ticks, names in (
        ("wheel velocity [rad/s]", speeds, -3.2, 3.2, (-3, 0, 3), CORNERS),
        ("wheel following error [increments]", errors, -reach, reach, (-reach, 0, reach), CORNERS),
        ("steering angle [rad]", angles, -1.6, 1.6, (-1.5, 0, 1.5), CORNERS),
        ("mast, tracking a point while the rover drives [rad]", mast, -1.1, 1.1, (-1, 0, 1), ()),
    ):
        picture.panel(title, low, high, ticks)
        for number, curve in enumerate(group):
            picture.curve(curve, COLOURS[number], DASH if number in (4, 5) else "")
        picture.legend(names or ("pan", "tilt"))
    for second in range(0, int(picture.end_s) + 1, 2):
        picture.text(picture.x(second), picture.bottom + 18, f"{second} s", MIDDLE)
    return picture.svg()


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(draw(Path(sys.argv[1])), encoding="utf-8")
