"""Plots of each motor: position, velocity, following error, torque.

The application's state is in rad or m. A drive counts in its own increments. The motor's model, or
a truth with a position in both units, allows a conversion to rad or m. Otherwise increments are
drawn. Missing quantities are not derived from others, with two exceptions, which are labelled. The
velocity demand is the slope of the position demand. The following error of a drive without 60F4h is
its demand minus its actual position.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.frozen import frozen
from motorhil.harness.report.buses import Place, Told
from motorhil.harness.report.collect import Findings
from motorhil.harness.report.series import Track, difference, differences, shortest_step_ns
from motorhil.traces.decoding.attached_rig import MotorFacts

if TYPE_CHECKING:
    from numpy import float64, int64
    from numpy.typing import NDArray

QUANTITIES: Final = ("position", "velocity", "following error", "torque")
_SAME: Final = 0.01
_TRAVEL_INC: Final = 1_000.0


@final
class Scale(NamedTuple):
    """Scale of one motor, as the whole recording tells it.

    Attributes:
        increments: increments in one rad or m; None: unknown.
        origin: their origin as a text.
        step_ns: the shortest distance of two samples of its truth [ns]; None: there are none.
    """

    increments: float | None
    origin: str
    step_ns: int | None


@final
@frozen
class Line:
    """One line of a plot.

    Attributes:
        name: its name.
        role: "demand", "actual", "truth" or "target".
        source: topic and field, or object.
        held: True if a value holds until the next one.
        times_ns, values: by time, shape (n,) each.
        omitted: number of points that were removed while the recording was read.
    """

    name: str
    role: str
    source: str
    held: bool
    times_ns: "NDArray[int64]"
    values: "NDArray[float64]"
    omitted: int = 0


@final
@dataclass(slots=True)
class Plot:
    """One quantity in one unit; without lines it is missing, and `missing` gives the reason."""

    quantity: str
    unit: str
    lines: list[Line] = field(default_factory=list)
    missing: str = ""


@final
@dataclass(slots=True)
class Motor:
    """A motor, or an axis of a node without a known motor.

    Attributes:
        name: its name.
        about: its place as a text.
        place: bus, node and axis.
        told: the values from its drive on a bus.
        plots: one or more for each of `QUANTITIES`.
        scale: the origin of its units, as a text.
    """

    name: str
    about: str
    place: Place | None
    told: Told | None
    plots: list[Plot]
    scale: str
    truth_states: Track | None = None


def motors_of(found: Findings, scales: Mapping[str, Scale] | None = None) -> list[Motor]:
    """Return all motors: those of the rig in its order, then those known from data only.

    Args:
        found: contents of a recording, or their latest part.
        scales: scales by motor, from the whole recording; None: those of `found`.
    """
    motors = [_motor(found, one, None, scales) for one in _known(found).values()]
    places = {motor.place for motor in motors}
    for axis, told in sorted(found.nodes.told.items()):
        if axis not in places and (told.tracks or len(told.pds)):
            motors.append(_nameless(found, axis))
    return motors


def scales_of(found: Findings) -> dict[str, Scale]:
    """Return the scale of each motor with a name."""
    scales: dict[str, Scale] = {}
    for one in _known(found).values():
        truth = _truth_of(found, one)
        unit = _unit(one, truth, bool(found.states.get(one.name)))
        scales[one.name] = _scale(one, truth, unit)
    return scales


def _known(found: Findings) -> dict[str, MotorFacts]:
    """Return the motors of the rig, then those with a state or a truth."""
    facts = dict(found.rig.motors)
    covered = {one.controller for one in facts.values()}
    for name in found.states:
        if name not in facts:
            place = found.names.motors.get(name)
            controller = name if name in found.truths else None
            facts[name] = MotorFacts(name, controller=controller, place=place)
            covered.add(controller)
    for name in found.truths:
        if name not in covered and name not in facts:
            facts[name] = MotorFacts(name, "rad", controller=name)
    return facts


def _unit(facts: MotorFacts, truth: dict[str, Track], has_state: bool) -> str:
    return facts.unit or ("rad" if "position_rad" in truth else "rad or m" if has_state else "")


def _nameless(found: Findings, place: Place) -> Motor:
    bus, node, axis = place
    name = found.names.nodes.get((bus, node), f"{bus} node {node}")
    return _motor(found, MotorFacts(name if axis == 1 else f"{name} axis {axis}"), place)


def _motor(
    found: Findings,
    facts: MotorFacts,
    place: Place | None = None,
    scales: Mapping[str, Scale] | None = None,
) -> Motor:
    if place is None and facts.place is not None:
        place = (*facts.place, facts.channel)
    told = found.nodes.told.get(place) if place is not None else None
    truth = _truth_of(found, facts)
    state = found.states.get(facts.name, {})
    unit = _unit(facts, truth, bool(state))
    known = None if scales is None else scales.get(facts.name)
    scale = _scale(facts, truth, unit) if known is None else known
    builder = _Builder(facts, unit, scale)
    builder.add_state(state)
    builder.add_truth(truth)
    if told is not None:
        builder.add_told(told)
    about = f"{place[0]} node {place[1]}" if place is not None and told is not None else ""
    return Motor(facts.name, about, place, told, builder.plots(), scale.origin, truth.get("state"))


def _truth_of(found: Findings, facts: MotorFacts) -> dict[str, Track]:
    """Return the truth of the motor's controller, for its own channel."""
    if facts.controller is None:
        return {}
    truth = found.truths.get(facts.controller, {})
    prefix = "" if facts.channel == 1 else f"channel_{facts.channel}_"
    if prefix:
        return {k.removeprefix(prefix): t for k, t in truth.items() if k.startswith(prefix)}
    return {key: track for key, track in truth.items() if not key.startswith("channel_")}


def _scale(facts: MotorFacts, truth: dict[str, Track], unit: str) -> Scale:
    """Return the increments in one rad or m according to the truth, with their origin."""
    measured = _measured(truth)
    given = facts.increments_per_unit
    demand = truth.get("demand_inc")
    step_ns = None if demand is None else shortest_step_ns(demand.sorted()[0])
    if measured is not None and (given is None or abs(given / measured - 1.0) > _SAME):
        text = f"1 {unit} is {measured:,.2f} increments, from the truth's position"
        return Scale(measured, text, step_ns)
    if given is not None:
        text = f"1 {unit} is {given:,.2f} increments, by {facts.model or 'its model'}"
        return Scale(given, text, step_ns)
    return Scale(None, "the recording does not give the increments in one rad or m", step_ns)


def _measured(truth: dict[str, Track]) -> float | None:
    """Return the ratio of a truth's positions in both units; None: too little travel."""
    both = truth.get("position_inc"), truth.get("position_rad")
    if both[0] is None or both[1] is None or not len(both[0]):
        return None
    import numpy as np

    values = np.array(both[0].values)
    if not np.isfinite(values).all():
        return None
    low, high = int(values.argmin()), int(values.argmax())
    travel_inc = both[0].values[high] - both[0].values[low]
    travel = both[1].values[high] - both[1].values[low]
    return travel_inc / travel if travel_inc >= _TRAVEL_INC and travel else None


if TYPE_CHECKING:
    _Points = tuple[NDArray[int64], NDArray[float64], int]
    """Times, values, and the number of omitted points."""


@final
class _Builder:
    """Builder of the plots of one motor."""

    def __init__(self, facts: MotorFacts, unit: str, scale: Scale) -> None:
        self._facts = facts
        self._unit = unit
        self._scale = scale.increments
        self._step_ns = scale.step_ns
        self._plots: dict[tuple[str, str], Plot] = {}
        self._roles: set[tuple[str, str]] = set()

    def plots(self) -> list[Plot]:
        """Return the plots by quantity; a missing quantity has a reason instead of lines."""
        found: list[Plot] = []
        for quantity in QUANTITIES:
            own = [plot for (name, _), plot in self._plots.items() if name == quantity]
            found += own or [Plot(quantity, "", missing=_MISSING[quantity])]
        return found

    def add_state(self, state: dict[str, Track]) -> None:
        """Add the state known to the application."""
        topic = f"/motor/{self._facts.name}/state"
        unit = self._unit
        force = {"rad": "N·m", "m": "N"}.get(unit, "N·m or N")
        rate = f"{unit}/s" if unit in ("rad", "m") else f"({unit})/s"
        for name, quantity, own in (
            ("position", "position", unit),
            ("velocity", "velocity", rate),
            ("effort", "torque", force),
        ):
            if name in state:
                self._add(
                    quantity, own, "actual", "actual (application)", f"{topic}.{name}", state[name]
                )

    def add_truth(self, truth: dict[str, Track]) -> None:
        """Add the true state inside the controller."""
        topic = f"/controller/{self._facts.controller}/truth"
        for key, quantity, unit in (
            ("position_rad", "position", "rad"),
            ("velocity_rad_s", "velocity", "rad/s"),
            ("torque_n_m", "torque", "N·m"),
        ):
            if key in truth:
                self._add(quantity, unit, "truth", "true (plant)", f"{topic}.{key}", truth[key])
        error = truth.get("following_error_inc")
        demand, position = truth.get("demand_inc"), truth.get("position_inc")
        source = f"{topic}.following_error_inc"
        if error is not None and self._scale:
            times, values = error.sorted()
            self._line(
                "following error",
                "rad",
                "actual",
                "drive",
                source,
                False,
                (times, values / self._scale, error.omitted),
            )
        elif error is not None:
            self._add("following error", "inc", "actual", "drive", source, error)
        if demand is not None and position is not None and "position_rad" in truth and self._scale:
            self._add_demand(topic, demand, position, truth["position_rad"])

    def _add_demand(self, topic: str, demand: Track, position: Track, true: Track) -> None:
        """Add the demand in rad, relative to the plant position, since homing moves both counts."""
        assert self._scale
        times, wanted = demand.sorted()
        values = true.sorted()[1] + (wanted - position.sorted()[1]) / self._scale
        name = f"{topic}.demand_inc"
        points = times, values, demand.omitted
        self._line("position", "rad", "demand", "demand (drive)", name, False, points)
        points = times, differences(times, wanted / self._scale, self._step_ns), demand.omitted
        told = f"slope of {name}"
        self._line("velocity", "rad/s", "demand", "demand (slope)", told, True, points)

    def add_told(self, told: Told) -> None:
        """Add the drive's values from the bus, where application and truth have none."""
        facts = self._facts
        inc = facts.increments_per_unit
        for index, quantity, role, name in _TOLD:
            track = told.tracks.get(index)
            if track is None or (quantity, role) in self._roles:
                continue
            unit, factor = "inc", 1.0
            if quantity == "velocity":
                unit = "drive units"
                if facts.velocity_unit is not None:
                    unit, factor = f"{facts.unit}/s", facts.velocity_unit
            elif quantity == "torque":
                unit = "‰ of rated"
            elif inc is not None:
                unit, factor = facts.unit, 1.0 / inc
            times, values = track.sorted()
            source = f"{index:04X}h on the bus"
            name = f"{name} {index:04X}h"
            points = times, values * factor, track.omitted
            self._line(quantity, unit, role, name, source, True, points)
        demand, actual = told.tracks.get(0x6062), told.tracks.get(0x6064)
        if demand and actual and not any(name == "following error" for name, _ in self._plots):
            unit, factor = (facts.unit, 1.0 / inc) if inc is not None else ("inc", 1.0)
            times, values = difference(demand, actual)
            self._line(
                "following error",
                unit,
                "actual",
                "6062h minus 6064h",
                "6062h minus 6064h on the bus",
                True,
                (times, values * factor, demand.omitted + actual.omitted),
            )

    def _add(
        self, quantity: str, unit: str, role: str, name: str, source: str, track: Track
    ) -> None:
        points = (*track.sorted(), track.omitted)
        self._line(quantity, unit, role, name, source, track.held, points)

    def _line(
        self,
        quantity: str,
        unit: str,
        role: str,
        name: str,
        source: str,
        held: bool,
        points: "_Points",
    ) -> None:
        times, values, omitted = points
        plot = self._plots.setdefault((quantity, unit), Plot(quantity, unit))
        plot.lines.append(Line(name, role, source, held, times, values, omitted))
        self._roles.add((quantity, role))


_TOLD: Final = (
    (0x6062, "position", "demand", "demand"),
    (0x6064, "position", "actual", "actual"),
    (0x607A, "position", "target", "target"),
    (0x606B, "velocity", "demand", "demand"),
    (0x606C, "velocity", "actual", "actual"),
    (0x60FF, "velocity", "target", "target"),
    (0x60F4, "following error", "actual", "drive"),
    (0x6077, "torque", "actual", "actual"),
)
_MISSING: Final = {
    "position": "no position in the recording: not in a state, not in a truth, and no 6064h in "
    "a known PDO",
    "velocity": "no velocity in the recording: not in a state, not in a truth, and no 606Ch in "
    "a known PDO",
    "following error": "no following error in the recording: not in a truth, and no 60F4h or "
    "6062h in a known PDO",
    "torque": "no torque in the recording",
}
