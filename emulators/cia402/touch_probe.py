"""Touch probe: two position latches, by input or index pulse (CiA 402-2).

60B8h, the function, has a byte for each probe, and so has 60B9h, the status:

====  =========================================  =========================
bit   60B8h                                      60B9h
====  =========================================  =========================
0     the probe is on                            the probe is on
1     0: first event, 1: every event             a rising edge was latched
2, 3  0: its input, 1: index pulse, 2: by 60D0h  a falling edge was latched (2)
4     latches rising edges
5     latches falling edges
====  =========================================  =========================

After a first event nothing is latched until bit 4 or 5, or bit 0, has been 0. The index pulse has a
rising edge only. 60D5h to 60D8h count the latched events and wrap from FFFFh to 0. Source 3 is
reserved, as are the sources of 60D0h other than 1, 2 (the inputs), 5 and 6 (index pulse).
"""

from typing import Final, final

from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary
from motorhil.emulators.cia402.objects.changes import Choice, ObjectChange, ObjectChanges, Watch
from motorhil.emulators.cia402.objects.units import FactorGroup
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.digital_inputs import (
    INDEX_PULSE,
    TOUCH_PROBE_1,
    TOUCH_PROBE_2,
    DigitalInputs,
    Edge,
)

_CHANGE: Final = int(ObjectChange.TOUCH_PROBE)
_ON: Final = 0x01
_EVERY: Final = 0x02
_RISING: Final = 0x10
_FALLING: Final = 0x20
_INPUTS: Final = (TOUCH_PROBE_1, TOUCH_PROBE_2)
_SOURCES: Final = {1: TOUCH_PROBE_1, 2: TOUCH_PROBE_2, 5: INDEX_PULSE, 6: INDEX_PULSE}
_D = DataType


@final
class Latch:
    """One edge of one probe: its latched value, its count, and its armed state."""

    def __init__(self, enabling: int, shown: int, rising: bool) -> None:
        self.enabling = enabling  # its bit in the function
        self.shown = shown  # its bit in the status
        self.rising = rising
        self.armed: bool = False
        self.latched: bool = False
        self.position_raw: int = 0
        self.events: int = 0

    def value(self) -> int:
        """Return 60BAh to 60BDh [position unit]."""
        return self.position_raw

    def count(self) -> int:
        """Return 60D5h to 60D8h."""
        return self.events


@final
class Probe:
    """One of the two probes, with its byte of the function."""

    def __init__(self) -> None:
        self.function: int = 0
        self.source: int = 0
        self.latches: tuple[Latch, Latch] = (
            Latch(_RISING, 0x02, True),
            Latch(_FALLING, 0x04, False),
        )

    def status(self) -> int:
        """Return its byte of the status."""
        bits = self.function & _ON
        for latch in self.latches:
            if latch.latched:
                bits |= latch.shown
        return bits


@final
class TouchProbe:
    """Both probes of a drive.

    Attributes:
        status: 60B9h.
    """

    def __init__(
        self,
        od: ObjectDictionary,
        axis: Axis,
        inputs: DigitalInputs,
        factors: FactorGroup,
        changes: ObjectChanges,
    ) -> None:
        self._axis = axis
        self._inputs = inputs
        self._factors = factors
        self.status: int = 0
        self._watches_index: bool = False
        self._probes: tuple[Probe, Probe] = (Probe(), Probe())
        self._function = od.ensure(0x60B8, 0, _D.UNSIGNED16, 0)
        self._function.writer = Watch(changes, _CHANGE).write
        self._sources = (
            od.ensure(0x60D0, 1, _D.INTEGER16, 1),
            od.ensure(0x60D0, 2, _D.INTEGER16, 2),
        )
        for variable in self._sources:
            variable.writer = Choice(frozenset(_SOURCES), changes, _CHANGE).write
        shown = od.get(0x60B9)
        if shown is not None:
            shown.reader = self._read_status
        for place in range(4):
            latch = self._probes[place // 2].latches[place % 2]
            value, events = od.get(0x60BA + place), od.get(0x60D5 + place)
            if value is not None:
                value.reader = latch.value
            if events is not None:
                events.reader = latch.count

    def configure(self) -> None:
        """Apply 60B8h and 60D0h."""
        function = self._function.integer()
        for place, probe in enumerate(self._probes):
            self._set(probe, place, function >> 8 * place & 0xFF)
        watches = any(probe.source == INDEX_PULSE for probe in self._probes)
        if watches != self._watches_index:
            self._watches_index = watches
            self._inputs.watch_index(watches)
        self._show()

    def sees(self, edges: list[Edge]) -> None:
        """Latch the position at edges of the probes' sources."""
        for edge in edges:
            for probe in self._probes:
                if edge.bit == probe.source:
                    self._latch(probe, edge)
                    self._show()

    def _show(self) -> None:
        self._inputs.moved = True
        self.status = self._probes[0].status() | self._probes[1].status() << 8

    def _read_status(self) -> int:
        return self.status

    def _set(self, probe: Probe, place: int, function: int) -> None:
        choice = function >> 2 & 3
        probe.source = 0
        if function & _ON and choice == 0:
            probe.source = _INPUTS[place]
        elif function & _ON and choice == 1:
            probe.source = INDEX_PULSE
        elif function & _ON and choice == 2:
            probe.source = _SOURCES.get(self._sources[place].integer(), 0)
        for latch in probe.latches:
            needed = _ON | latch.enabling
            if function & needed != needed:
                latch.armed = latch.latched = False
            elif probe.function & needed != needed:
                latch.armed = True
        probe.function = function

    def _latch(self, probe: Probe, edge: Edge) -> None:
        for latch in probe.latches:
            if latch.armed and latch.rising == edge.active:
                axis = self._axis
                position_inc = edge.count + axis.position_inc() - axis.count()
                latch.position_raw = self._factors.units.position_raw(position_inc)
                latch.events = latch.events + 1 & 0xFFFF
                latch.latched = True
                latch.armed = probe.function & _EVERY != 0
