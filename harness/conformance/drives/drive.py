"""A drive as its clauses use it: objects, states, set-points, motion as seen on the bus.

Every check that fails says what was expected and why, what was seen, when, and the likely cause.
"""

import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final, final

from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from motorhil.frozen import frozen
from motorhil.harness.conformance.clause import NotApplicable, Violated
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.client import Client, Frame
from motorhil.harness.conformance.drives.objects import Entry, Mode, State, state_of
from motorhil.harness.conformance.drives.units import Units, units_of

_NO_EMCY: Final = "the error is not noticed, or EMCY is off (1014h bit 31) or has another COB-ID"
BOOT_S: Final = 12.0
"""Longest wait for a drive to answer after power-on."""
STATE_S: Final = 1.5
"""Longest wait for a transition that needs no motion: power stages and brakes take their time."""
QUIET_S: Final = 0.05
"""Time in which a drive must not do something."""
ABSENT: Final = (0x0602_0000, 0x0609_0011)
"""Abort codes of objects and sub-indices that do not exist."""
_SHORTEST_RAMP_S: Final = 0.1
_LONGEST_RAMP_S: Final = 1.0
_RESET_NODE: Final = 0x81
_SAMPLES: Final = 20
_FEW: Final = 4
_AT_REST: Final = 0.03
_CRUISE_S: Final = 5.0
_FROM, _TO = 0.85, 0.25


@final
@frozen
class Pace:
    """A motion that the drive can make, from its own values at power-on.

    Attributes:
        velocity: of 6081h [velocity units].
        acceleration: of 6083h to 6085h [acceleration units].
        ramp_s: the time of one ramp [s].
        speed: the velocity [position units/s].
        sample_s: the period in which the bus shows one object [s].
    """

    velocity: int
    acceleration: int
    ramp_s: float
    speed: float
    sample_s: float

    def distance(self, cruise_s: float) -> int:
        """Return the distance of a move with this time at full speed [position units]."""
        return round(self.speed * (self.ramp_s + cruise_s))


@final
@frozen
class Sample:
    """A value of an object at a time [ns]."""

    time_ns: int
    value: int


class Drive:
    """One drive on a bus; `boot` must be called first.

    Args:
        client: the host.
        node_id: of the drive.
        stated_units: the table `units` of the rig.
    """

    def __init__(self, client: Client, node_id: int, stated_units: Mapping[str, float]) -> None:
        self.client: Final = client
        self.node_id: Final = node_id
        self._sdo = client.node.sdo
        self._stated_units = stated_units
        self._units: Units | None = None
        self._pace: Pace | None = None
        self._word = 0

    # --- time and objects ---------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        """The bench's time [ns]."""
        return self.client.runtime.now_ns()

    def boot(self) -> None:
        """Wait until the drive answers.

        Raises:
            Violated: it does not.
        """
        begin_ns = self.now_ns
        while self.now_ns - begin_ns < BOOT_S * 1e9:
            try:
                self._sdo.upload(0x1000, 0)
                return
            except SdoCommunicationError:
                continue
            except SdoAbortedError:
                return
        raise self.violated(
            f"node {self.node_id}",
            f"an SDO answer within {BOOT_S:g} s",
            "none",
            "the node has not started, or has another node-ID",
        )

    def read(self, entry: Entry) -> int:
        """Upload an object.

        Raises:
            Violated: the drive aborts the upload, or does not answer.
        """
        try:
            return self._upload(entry)
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise self.violated(f"upload of {entry}", "its value", f"{error}", "") from None

    def find(self, entry: Entry) -> int | None:
        """Upload an object; return None if the drive does not have it."""
        try:
            return self._upload(entry)
        except SdoAbortedError as error:
            if error.code in ABSENT:
                return None
            raise self.violated(f"upload of {entry}", "its value", f"{error}", "") from None

    def require(self, *entries: Entry) -> None:
        """Raise NotApplicable if the drive does not have one of the objects."""
        for entry in entries:
            if self.find(entry) is None:
                raise NotApplicable(f"the drive has no {entry}")

    def write(self, entry: Entry, value: int) -> None:
        """Download an object.

        Raises:
            Violated: the drive aborts the download, or does not answer.
        """
        try:
            self._download(entry, value)
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise self.violated(
                f"download of {value} to {entry}", "accepted", f"{error}", ""
            ) from None

    def set(self, entry: Entry, value: int) -> None:
        """Download an optional object or value; raise NotApplicable if the drive refuses it."""
        code = self.offer_value(entry, value)
        if code:
            raise NotApplicable(f"the drive refuses {value} in {entry}: {code:08X}h")

    def offer_value(self, entry: Entry, value: int) -> int:
        """Download an object; return the abort code, or 0 if the drive takes the value."""
        try:
            self._download(entry, value)
        except SdoAbortedError as error:
            return int(error.code)
        return 0

    def refusal(self, index: int, subindex: int, data: bytes | None = None) -> int:
        """Return the abort code of an upload, or of a download of `data`; 0 if it is accepted."""
        try:
            if data is None:
                self._sdo.upload(index, subindex)
            else:
                self._sdo.download(index, subindex, data)
        except SdoAbortedError as error:
            return int(error.code)
        return 0

    def size_of(self, entry: Entry) -> int | None:
        """Upload an object; return the number of its bytes, or None if the drive refuses it."""
        try:
            return len(self._sdo.upload(entry.index, entry.subindex))
        except SdoAbortedError:
            return None

    def upload(self, index: int, subindex: int) -> bytes:
        """Upload an object that is no number."""
        return bytes(self._sdo.upload(index, subindex))

    def _upload(self, entry: Entry) -> int:
        data = self._sdo.upload(entry.index, entry.subindex)
        size = struct.calcsize(entry.code)
        if len(data) < size:
            wrong = f"{len(data)} bytes"
            raise self.violated(f"upload of {entry}", f"{size} bytes", wrong, "wrong data type")
        return int(struct.unpack_from(f"<{entry.code}", data)[0])

    def _download(self, entry: Entry, value: int) -> None:
        self._sdo.download(entry.index, entry.subindex, struct.pack(f"<{entry.code}", value))

    def reset(self) -> None:
        """Reset the node, and wait until it answers: its objects are as after power-on."""
        self.quiet(0.1)
        self.client.node.nmt.send_command(_RESET_NODE)
        self.quiet(0.1)
        self.boot()

    def leave(self) -> None:
        """Switch the drive off, and reset the node: nothing that was written stays."""
        with suppress(SdoAbortedError, SdoCommunicationError, Violated):
            self.command(od.DISABLE_VOLTAGE)
        with suppress(Violated):
            self.reset()

    # --- verdicts -----------------------------------------------------------------------------

    def violated(self, what: str, expected: str, seen: str, cause: str) -> Violated:
        """Return the verdict for an observation made now."""
        text = f"{what}: expected {expected}; seen {seen} at {self.now_ns / 1e9:.4f} s"
        return Violated(f"{text}; likely cause: {cause}" if cause else text)

    def expect(self, holds: bool, what: str, expected: str, seen: str, cause: str = "") -> None:
        """Raise Violated unless `holds`."""
        if not holds:
            raise self.violated(what, expected, seen, cause)

    def near(
        self, entry: Entry, wanted: float, tolerance: float, what: str, cause: str = ""
    ) -> int:
        """Expect a value of an object within a tolerance; return it."""
        value = self.read(entry)
        expected = f"{entry} = {wanted:.0f} +- {tolerance:.0f}"
        self.expect(abs(value - wanted) <= tolerance, what, expected, f"{value}", cause)
        return value

    # --- states -------------------------------------------------------------------------------

    def statusword(self) -> int:
        """Return 6041h."""
        return self.read(od.STATUSWORD)

    def state(self) -> State | None:
        """Return the state of the PDS FSA, or None if the statusword shows none."""
        return state_of(self.statusword())

    def command(self, word: int) -> None:
        """Write the controlword."""
        self._word = word
        self.write(od.CONTROLWORD, word)

    def become(self, state: State, word: int, why: str, within_s: float = STATE_S) -> None:
        """Write the controlword, and expect the state soon."""
        before = self.state()
        self.command(word)
        self.await_state(state, f"controlword {word:04X}h in {before}", why, within_s)

    def await_state(self, state: State, what: str, why: str, within_s: float = STATE_S) -> int:
        """Expect the state within a time; return the statusword."""
        word = self.until(lambda word: state_of(word) is state, within_s)
        if word is None:
            now = self.statusword()
            raise self.violated(
                what,
                f"{state} within {within_s:g} s ({why})",
                f"{state_of(now) or 'no state'} (6041h = {now:04X}h)",
                "the transition is missing, or its condition is not met",
            )
        return word

    def until(self, holds: Callable[[int], bool], within_s: float) -> int | None:
        """Poll the statusword until `holds(word)`; return it, or None after `within_s` [s]."""
        end_ns = self.now_ns + round(within_s * 1e9)
        while True:
            word = self.statusword()
            if holds(word):
                return word
            if self.now_ns >= end_ns:
                return None

    def quiet(self, duration_s: float = QUIET_S) -> None:
        """Let time pass."""
        self.client.runtime.wait_until(lambda: False, duration_s)

    def has_mode(self, mode: Mode) -> bool:
        """Return whether 6502h names the mode."""
        return bool((self.find(od.SUPPORTED_MODES) or 0) >> (mode - 1) & 1)

    def require_mode(self, mode: Mode) -> None:
        """Raise NotApplicable if the drive does not claim the mode."""
        if self.find(od.SUPPORTED_MODES) is None:
            raise NotApplicable(f"the drive has no {od.SUPPORTED_MODES}: it claims no mode")
        if not self.has_mode(mode):
            raise NotApplicable(f"6502h does not claim {mode} (bit {mode - 1} is 0)")

    def select(self, mode: Mode) -> None:
        """Select a claimed mode, and expect it in 6061h."""
        self.require_mode(mode)
        self.write(od.MODE, mode)
        begin_ns = self.now_ns
        while (shown := self.read(od.MODE_DISPLAY)) != mode:
            if self.now_ns - begin_ns > STATE_S * 1e9:
                seen, cause = f"6061h = {shown}", "6502h claims a mode that the drive lacks"
                raise self.violated(f"6060h = {mode.value}", f"6061h = {mode.value}", seen, cause)

    def enable(self, mode: Mode) -> None:
        """Select a mode, and enable operation from any state."""
        self.select(mode)
        if self.state() in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            self.command(0)
            self.become(State.SWITCH_ON_DISABLED, od.FAULT_RESET, "transition 15")
        self.become(State.READY_TO_SWITCH_ON, od.SHUTDOWN, "transition 2")
        self.become(State.SWITCHED_ON, od.SWITCH_ON, "transition 3")
        self.become(State.OPERATION_ENABLED, od.ENABLE, "transition 4")

    def enable_at_rest(self, mode: Mode, settled_s: float) -> None:
        """Enable as `enable`, and wait for a load, which falls until then, to settle."""
        self.enable(mode)
        self.quiet(settled_s)

    # --- motion -------------------------------------------------------------------------------

    def units(self) -> Units:
        """Return the units of the drive's objects."""
        if self._units is None:
            self._units = units_of(self.find, self._stated_units)
        return self._units

    def turn(self) -> float:
        """Return the position units of one turn of the motor.

        Raises:
            NotApplicable: 608Fh does not state the encoder.
        """
        increments = self.find(od.ENCODER_INCREMENTS) or 0
        if increments <= 1:
            raise NotApplicable("608Fh does not state the increments of the encoder")
        return increments / self.units().position_inc

    def pace(self) -> Pace:
        """Set ramps and speed to what the drive states itself at power-on, and return them.

        Raises:
            NotApplicable: the drive states none.
        """
        if self._pace is None:
            self._pace = self._own_pace()
        self.write(od.PROFILE_VELOCITY, self._pace.velocity)
        self.ramps(self._pace.acceleration)
        return self._pace

    def _own_pace(self) -> Pace:
        self.require(od.PROFILE_VELOCITY, od.ACCELERATION)
        velocity, acceleration = self.read(od.PROFILE_VELOCITY), self.read(od.ACCELERATION)
        units = self.units()
        if not velocity or not acceleration:
            raise NotApplicable(
                f"6081h = {velocity}, 6083h = {acceleration}: state a speed and a ramp that the"
                " motor can follow, as `objects` of the controller"
            )
        velocity = min(velocity, self.find(od.VELOCITY_MAX) or velocity)
        sample_s = self.upload_s()
        shortest_s = max(_SHORTEST_RAMP_S, _SAMPLES * sample_s)
        ramp_s = velocity / (acceleration * units.acceleration)
        if ramp_s < shortest_s:
            acceleration = max(1, int(velocity / (shortest_s * units.acceleration)))
        elif ramp_s > _LONGEST_RAMP_S:
            velocity = max(1, int(acceleration * units.acceleration * _LONGEST_RAMP_S))
        ramp_s = velocity / (acceleration * units.acceleration)
        speed = velocity * units.velocity
        if not 20 < speed * ramp_s < 1e9:
            raise NotApplicable(f"a ramp of {speed * ramp_s:.3g} position units cannot be judged")
        return Pace(velocity, acceleration, ramp_s, speed, sample_s)

    def upload_s(self) -> float:
        """Return the longest of five uploads [s]: the period of samples."""
        begin_ns, longest_ns = self.now_ns, 0
        for _ in range(5):
            self.read(od.STATUSWORD)
            longest_ns, begin_ns = max(longest_ns, self.now_ns - begin_ns), self.now_ns
        return longest_ns / 1e9

    def ramps(self, acceleration: int, quick: int | None = None) -> None:
        """Set 6083h and 6084h, and 6085h to the same or to `quick`, as far as they exist."""
        self.write(od.ACCELERATION, acceleration)
        for entry, value in ((od.DECELERATION, acceleration), (od.QUICK_DECELERATION, quick)):
            if self.find(entry) is not None:
                self.write(entry, acceleration if value is None else value)

    def offer(self, target: int, bits: int = 0) -> None:
        """Offer a set-point with the handshake of bits 4 and 12; `bits` are 5, 6 and 9."""
        self.write(od.TARGET_POSITION, target)
        self.command(od.ENABLE | bits | od.NEW_SET_POINT)
        if self.until(lambda word: word & od.BIT_12 != 0, STATE_S) is None:
            raise self.violated(
                f"set-point {target} (6040h = {self._word:04X}h)",
                "bit 12 of 6041h = 1 (set-point acknowledge)",
                f"6041h = {self.statusword():04X}h",
                "the edge of bit 4 was not taken, or bit 12 is inverted",
            )
        self.command(od.ENABLE | bits)

    def await_target(self, target: int, within_s: float, what: str) -> int:
        """Expect target reached (bit 10) and the position in its window; return the position."""
        reached = self.until(lambda word: word & od.TARGET_REACHED != 0, within_s)
        position = self.read(od.POSITION)
        tolerance = self.window()
        if reached is None or abs(position - target) > tolerance:
            word = self.statusword()
            raise self.violated(
                what,
                f"bit 10 at {target} +- {tolerance} within {within_s:.2f} s (6067h)",
                f"6064h = {position}, 6041h = {word:04X}h",
                "wrong target, wrong units, or bit 10 is stale",
            )
        return position

    def window(self) -> int:
        """Return the tolerance of a position at rest: 6067h, or two units without one."""
        window = self.find(od.POSITION_WINDOW)
        return 2 if window is None or window >= 0xFFFF_FFFF else window + 2

    def range_span(self) -> int:
        """Return the span of positions between the ends of 607Bh, or 0 without them."""
        return (self.find(od.RANGE_MAX) or 0) - (self.find(od.RANGE_MIN) or 0)

    def cruise(self, pace: Pace) -> None:
        """Enable pv, or else pp, and run until the speed of `pace` is reached within 5 %."""
        if self.has_mode(Mode.PV):
            self.enable(Mode.PV)
            self.write(od.TARGET_VELOCITY, pace.velocity)
        else:
            self.enable(Mode.PP)
            self.offer(self.read(od.POSITION) + pace.distance(_CRUISE_S), od.IMMEDIATELY)
        self.await_velocity(pace.velocity, 3 * pace.ramp_s + 0.5)

    def largest_lag(self, pace: Pace, way: int, after_s: float) -> int:
        """Return the largest 60F4h of a move in pp, and of so long after it; then disable."""
        self.enable_at_rest(Mode.PP, 2.0 * pace.ramp_s)
        self.offer(self.read(od.POSITION) + way, od.IMMEDIATELY)
        track = self.watch(od.FOLLOWING_ERROR, lambda _: False, 2.0 * pace.ramp_s + after_s)
        self.command(od.DISABLE_VOLTAGE)
        return max(abs(one.value) for one in track)

    def await_velocity(self, velocity: int, within_s: float) -> None:
        """Expect 606Ch within 5 % of a velocity.

        Raises:
            NotApplicable: the drive tells by bit 11 that a limit of its own is lower.
        """
        begin_ns, seen = self.now_ns, 0
        while self.now_ns - begin_ns < within_s * 1e9:
            seen = self.read(od.VELOCITY)
            if abs(seen - velocity) <= abs(velocity) * 0.05 + 1:
                return
        if self.statusword() & od.INTERNAL_LIMIT:
            raise NotApplicable(
                f"bit 11 (internal limit active) at 606Ch = {seen}, below 6081h ="
                f" {abs(velocity)}: state a lower 6081h as `objects` of the controller"
            )
        expected = f"606Ch = {velocity} +- 5 % within {within_s:.2f} s"
        cause = "wrong sign, wrong units, or the ramp is not 6083h"
        raise self.violated(f"60FFh = {velocity}", expected, f"606Ch = {seen}", cause)

    def watch(self, entry: Entry, ends: Callable[[Sample], bool], within_s: float) -> list[Sample]:
        """Sample an object as often as the bus allows, until `ends(sample)` or `within_s` [s]."""
        samples: list[Sample] = []
        end_ns = self.now_ns + round(within_s * 1e9)
        while self.now_ns < end_ns:
            begin_ns = self.now_ns
            value = self.read(entry)
            samples.append(Sample((begin_ns + self.now_ns) // 2, value))
            if ends(samples[-1]):
                break
        return samples

    def watch_to(self, entry: Entry, value: int, within_s: float, *, sign: int = 1) -> list[Sample]:
        """Sample an object until it reaches a value, from below or (sign = -1) from above."""
        return self.watch(entry, lambda one: sign * (one.value - value) >= 0, within_s)

    def rests_when_selected(self, mode: Mode) -> None:
        """Select a mode while the motor turns; expect it to come to rest, and to stay there.

        Raises:
            NotApplicable: the drive lacks the mode or pv, or selects no mode in motion.
        """
        self.require_mode(Mode.PV)
        self.require_mode(mode)
        pace, name = self.pace(), mode.name.lower()
        self.write(od.TARGET_VELOCITY, pace.velocity)
        self.enable(Mode.PV)
        self.await_velocity(pace.velocity, 3.0 * pace.ramp_s + STATE_S)
        if mode is Mode.CSP:  # which may move there
            self.write(od.TARGET_POSITION, self.read(od.POSITION) + pace.distance(0.0))
        if self.offer_value(od.MODE, mode):
            raise NotApplicable(f"the drive refuses {name} in motion")
        self.quiet()
        if self.read(od.MODE_DISPLAY) != mode:
            raise NotApplicable("the drive selects no mode in motion")
        what = f"{name} selected in motion"
        self.braked(pace.velocity, 3.0 * pace.ramp_s + STATE_S, what)
        self.quiet(0.1)
        self.near(od.VELOCITY, 0, 1 + pace.velocity // 50, what, "it turns on")

    def braked(self, from_velocity: int, within_s: float, what: str) -> float | None:
        """Watch the motor come to rest; return its deceleration [acceleration units].

        Returns:
            The slope of 606Ch between 85 % and 25 % of the speed; None: faster than the bus shows.
        """
        full = abs(from_velocity)
        samples = self.watch(
            od.VELOCITY, lambda one: abs(one.value) <= full * _AT_REST + 1, within_s
        )
        last = samples[-1].value
        if abs(last) > full * _AT_REST + 1:
            expected = f"standstill within {within_s:.2f} s"
            raise self.violated(what, expected, f"606Ch = {last}", "the motor is not stopped")
        part = [one for one in samples if full * _TO < abs(one.value) < full * _FROM]
        if len(part) < _FEW:
            return None
        return slope(part) / self.units().acceleration

    def sped_up(self, pace: Pace) -> float | None:
        """Watch the motor speed up from rest, in either direction.

        Returns:
            The slope of 606Ch [acceleration units]; None: faster than the bus shows.
        """
        full = pace.velocity
        track = self.watch(
            od.VELOCITY, lambda one: abs(one.value) >= 0.95 * full, 6.0 * pace.ramp_s + 0.5
        )
        part = [one for one in track if 0.2 * full < abs(one.value) < 0.8 * full]
        return slope(part) / self.units().acceleration if len(part) >= _FEW else None

    def expect_ramp(self, found: float | None, ramp: int, what: str, source: str) -> None:
        """Expect a measured deceleration within 20 % of a ramp's."""
        seen = "faster than the bus shows" if found is None else f"{found:.0f}"
        self.expect(
            found is not None and 0.8 * ramp <= found <= 1.25 * ramp,
            what,
            f"{ramp} ({source}), -20 % to +25 % for servo and sampling",
            f"{seen} [acceleration units]",
            "another ramp is used, or none",
        )

    # --- EMCY and error control ---------------------------------------------------------------

    @property
    def error_control_id(self) -> int:
        """The identifier of boot-up, heartbeat and node guarding."""
        return 0x700 + self.node_id

    def emergencies(self, since_ns: int) -> list[Frame]:
        """Return the EMCY frames of the drive, complete after `since_ns`."""
        return self.client.heard(0x80 + self.node_id, since_ns)

    def count_emergencies(self, code: int, since_ns: int) -> int:
        """Return how many EMCYs had this error code, complete after `since_ns`."""
        wanted = code.to_bytes(2, "little")
        return sum(one.data[:2] == wanted for one in self.emergencies(since_ns))

    def await_emergency(
        self, code: int, since_ns: int, what: str, within_s: float = STATE_S
    ) -> Frame:
        """Expect an EMCY with this error code after `since_ns`, and return it."""

        def found() -> Frame | None:
            for one in self.emergencies(since_ns):
                if len(one.data) == 8 and int.from_bytes(one.data[:2], "little") == code:
                    return one
            return None

        self.client.wait_for(lambda: found() is not None, within_s)
        frame = found()
        if frame is None:
            seen = [one.data.hex(" ") for one in self.emergencies(since_ns)] or ["none"]
            expected = f"EMCY {code:04X}h on {0x80 + self.node_id:03X}h within {within_s:g} s"
            raise self.violated(what, expected, ", ".join(seen), _NO_EMCY)
        return frame


def slope(samples: list[Sample]) -> float:
    """Return the size of the slope by least squares [1/s]."""
    count = len(samples)
    mean_ns = sum(one.time_ns for one in samples) / count
    mean = sum(one.value for one in samples) / count
    over = sum((one.time_ns - mean_ns) * (one.value - mean) for one in samples)
    under = sum((one.time_ns - mean_ns) ** 2 for one in samples)
    return abs(over / under * 1e9) if under else 0.0
