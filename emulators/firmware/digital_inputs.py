"""Digital inputs: limit and home switches, index pulse and wired inputs.

A switch is active over a range of output positions. Its edges belong to the plant and stay where
they are, however positions are numbered. Switches are not polled while the motor is between two
edges. The axis' gate reports the first tick beyond an edge. `look` then returns the edges passed,
in order, each with the encoder count at its place. The latched count is therefore that of the edge,
not of the tick after it.

A fence is a range of the count without a switch, used for software limits. The same gate watches
it.

An edge at E lies where the count changes between E - 1 and E; in both directions it latches E.
"""

from typing import Final, final

from motorhil.emulators.firmware.axis import Axis

# Bits of 60FDh (CiA 402-2, digital inputs). Bits 16 to 31 are manufacturer-specific.
NEGATIVE_LIMIT: Final = 0x01
POSITIVE_LIMIT: Final = 0x02
HOME_SWITCH: Final = 0x04
INTERLOCK: Final = 0x08
TOUCH_PROBE_1: Final = 1 << 16
TOUCH_PROBE_2: Final = 1 << 17
LIMITS: Final = NEGATIVE_LIMIT | POSITIVE_LIMIT
INDEX_PULSE: Final = 1 << 32  # not a bit of 60FDh: the pulse is too short to be read

FAR: Final = 1 << 52  # a count that is never reached
RELEASED: Final = -1
_NO_GATE: Final = 1e300

STIMULI: Final[dict[str, int]] = {
    "negative_limit": NEGATIVE_LIMIT,
    "positive_limit": POSITIVE_LIMIT,
    "home": HOME_SWITCH,
    "interlock": INTERLOCK,
    "touch_probe_1": TOUCH_PROBE_1,
    "touch_probe_2": TOUCH_PROBE_2,
    **{f"digital_input_{bit}": 1 << bit for bit in range(18, 32)},
}


@final
class Switch:
    """An input that is 1 for low <= output count < high; switches with the same bit are ORed."""

    def __init__(self, bit: int, low: int, high: int) -> None:
        self.bit = bit
        self.low = low
        self.high = high


@final
class Edge:
    """A change of an input: its bit, new state, count and direction of motion."""

    def __init__(self, bit: int, active: bool, count: int, forward: bool) -> None:
        self.bit = bit
        self.active = active
        self.count = count
        self.forward = forward


@final
class DigitalInputs:
    """All digital inputs of one drive. Call its methods after `axis.at(now_ns)`.

    Attributes:
        bits: active inputs, as of the last `look`.
        moved: True if an input or a latched value has changed; the reporting code clears it.
        beyond: bit of the limit switch on whose side of the fence the count is; 0 within it.
        is_gated: True if an edge exists somewhere, so that the axis' flags matter even without
            power.
    """

    def __init__(
        self, axis: Axis, switches: tuple[Switch, ...], index_count: int | None, turn: int
    ) -> None:
        """Set up the inputs; all of them are evaluated at the axis' present position.

        Args:
            axis: the axis whose counts move the switches.
            switches: the switches along the output.
            index_count: count of an index pulse; None: the encoder has none.
            turn: counts between index pulses.
        """
        self._axis = axis
        self._switches = switches
        self._index_count = index_count
        self._turn = turn
        self._index_users: int = 0
        self._forced: int = 0  # bits that follow `_forced_bits` instead of their switches
        self._forced_bits: int = 0
        self._output_count: int = axis.output_count()
        self._count: int = axis.count()
        self._fence_low: float = -_NO_GATE
        self._fence_high: float = _NO_GATE
        self.beyond: int = 0
        self.moved: bool = False
        self.is_gated: bool = False
        self.bits: int = self._bits_now()
        self._set_gate()

    def stimulate(self, name: str, value: float) -> list[Edge]:
        """Force an input of STIMULI to 0 or 1, or release it (-1) to follow its switch.

        Returns:
            The edges since the last look, in order.

        Raises:
            ValueError: the value is none of these.
        """
        if value not in (0, 1, RELEASED):
            raise ValueError(
                f"{name} = {value:g}: must be 0, 1 or {RELEASED} (released: the switch's own state)"
            )
        seen = self.look()
        bit = STIMULI[name]
        if value == RELEASED:
            self._forced &= ~bit
        else:
            self._forced |= bit
        self._forced_bits = self._forced_bits & ~bit | (bit if value == 1 else 0)
        return seen + self._settle()

    def watch_index(self, on: bool) -> None:
        """Register or unregister one user of the index pulse's edges.

        Pulses passed before the first user are not its edges.
        """
        if on and self._index_users == 0:
            self._count = self._axis.count()
        self._index_users += 1 if on else -1
        self._set_gate()

    def fence(self, low: float = -_NO_GATE, high: float = _NO_GATE) -> None:
        """Set the range low <= count < high to which `beyond` refers; the default is no limit."""
        if low == self._fence_low and high == self._fence_high:
            return
        self._fence_low = low
        self._fence_high = high
        self._find_beyond()
        self._set_gate()
        self.moved = True

    def look(self) -> list[Edge]:
        """Return the edges since the last look, in the order in which they happened."""
        axis = self._axis
        before, now = self._output_count, axis.output_count()
        count_before, count = self._count, axis.count()
        self._output_count = now
        self._count = count
        found: list[
            tuple[int, int, int, bool]
        ] = []  # sorted by distance, switches before the index pulse
        for switch in self._switches:
            if switch.bit & self._forced:
                continue
            for place, rises in ((switch.low, True), (switch.high, False)):
                if before < place <= now or now < place <= before:
                    at = axis.count_when_output_was(place)
                    active = rises == (now > before)
                    found.append((at if now > before else -at, 0, switch.bit, active))
        if self._index_users and self._index_count is not None:
            low, high = min(count_before, count), max(count_before, count)
            place = self._index_after(low)
            while place <= high:
                found.append((place if count > count_before else -place, 1, INDEX_PULSE, True))
                place += self._turn
        found.sort()
        edges: list[Edge] = []
        for at, _, bit, active in found:
            forward = now > before if bit != INDEX_PULSE else count > count_before
            edges.append(Edge(bit, active, at if forward else -at, forward))
        return edges + self._settle(edges)

    def _settle(self, told: list[Edge] | None = None) -> list[Edge]:
        """Update bits and gate, and return the edges of inputs changed by hand."""
        self.moved = True
        before = self.bits
        for edge in told or ():
            before = before | edge.bit if edge.active else before & ~edge.bit
        self.bits = self._bits_now()
        self._find_beyond()
        changed = (before ^ self.bits) & ~INDEX_PULSE
        edges: list[Edge] = []
        while changed:
            bit = changed & -changed
            changed ^= bit
            forward = self._axis.velocity_inc_s() >= 0.0
            edges.append(Edge(bit, self.bits & bit != 0, self._count, forward))
        self._set_gate()
        return edges

    def _find_beyond(self) -> None:
        count = self._axis.count()
        above = POSITIVE_LIMIT if count >= self._fence_high else 0
        self.beyond = NEGATIVE_LIMIT if count < self._fence_low else above

    def _bits_now(self) -> int:
        bits = self._forced_bits
        for switch in self._switches:
            if not switch.bit & self._forced and switch.low <= self._output_count < switch.high:
                bits |= switch.bit
        return bits

    def _set_gate(self) -> None:
        """Set the axis' gate to the nearest edges in both directions."""
        place = self._output_count
        below, above = -FAR, FAR
        for switch in self._switches:
            if switch.bit & self._forced:
                continue
            for edge in (switch.low, switch.high):
                if edge <= place:
                    below = max(below, edge)
                else:
                    above = min(above, edge)
        low, high = self._fence_low, self._fence_high
        if self.beyond:
            low, high = (high, _NO_GATE) if self.beyond == POSITIVE_LIMIT else (-_NO_GATE, low)
        if self._index_users and self._index_count is not None:
            index_high = float(self._index_after(self._count))
            low, high = max(low, index_high - self._turn), min(high, index_high)
        was_gated = self.is_gated
        self.is_gated = below > -FAR or above < FAR or low > -_NO_GATE or high < _NO_GATE
        if self.is_gated or was_gated:
            self._axis.set_gate(
                low,
                high,
                float(below) if below > -FAR else -_NO_GATE,
                float(above) if above < FAR else _NO_GATE,
            )

    def _index_after(self, count: int) -> int:
        """Return the count of the first index pulse above `count`."""
        index = self._index_count
        if index is None:
            return FAR
        return index + ((count - index) // self._turn + 1) * self._turn
