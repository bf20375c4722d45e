"""The part of an emulated drive with one motor that no protocol changes.

A drive derives from `MotorDrive`, and adds frames and states. The rest of `Controller` is here: the
queues, the times, the physical inputs, the faults that the plant causes, and the true values of the
motor. `CanMotorDrive` is the same on CAN. `drive_builder` makes the `build` of its kind.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import ClassVar, Final, TypeVar

from motorhil.emulators.can.frame import EFF_FLAG, ERR_FLAG, RTR_FLAG, can_id_of, data_of, pack
from motorhil.emulators.controller import Controller, ControllerContext, controller
from motorhil.emulators.firmware.axis import NEVER_NS, Axis
from motorhil.emulators.firmware.clock import on_own_time
from motorhil.emulators.plant.dc_motor import RANGES
from motorhil.emulators.settings.motor import MotorSettings, MotorTable, axis_of
from motorhil.settings import read

_INPUTS: Final = ("load_torque_n_m", "supply_v", "power", "fault")


class MotorDrive(ABC):
    """A drive without its protocol; see `motorhil.emulators.api.Controller`.

    Args:
        axis: its axis, or the motor of which the axis is made.
        faults: the codes that the input "fault" accepts.
        causes: the codes of the faults that the plant can cause, by flag of the axis.

    Attributes:
        INPUTS: its own physical inputs, with the range of each.
        axis: its motor.
        is_powered: whether it has power.
        now_ns: the time of the last update.
        due_ns: its times by name or method, see `wake`; the loss of power cancels them.
        revision: the number of changes of its identifiers; see `renumber`.
    """

    INPUTS: ClassVar[Mapping[str, tuple[float, float]]] = {}

    def __init__(
        self,
        axis: MotorSettings | Axis,
        faults: Collection[int],
        causes: Mapping[int, int] | None = None,
    ) -> None:
        self.axis: Final[Axis] = (
            axis if isinstance(axis, Axis) else axis_of(axis, axis.oscillator.rate())
        )
        self.is_powered: bool = False
        self.now_ns: int = 0
        self.due_ns: Final[dict[Hashable, int]] = {}
        self.revision: int = 0
        self._faults: Final = faults
        self._causes: Final = causes or {}
        self._watched_flags: Final = sum(self._causes)
        self._later: list[tuple[int, bytes]] = []
        self._out: list[bytes] = []
        self._events: list[tuple[str, str]] = []
        if not isinstance(axis, Axis) and not axis.oscillator.is_ideal():
            self.note("info", axis.oscillator.told())

    # --- what a drive adds

    @abstractmethod
    def boot(self, now_ns: int) -> None:
        """Begin anew with power."""

    def advance(self, now_ns: int) -> None:
        """Update the drive to this time, before an input changes."""
        self.now_ns = now_ns
        self.axis.at(now_ns)

    def expire(self, now_ns: int) -> None:
        """Update the drive; call the methods that are due, and queue the delayed frames."""
        if not self.is_powered:
            return
        self.advance(now_ns)
        due = [one for one, due_ns in self.due_ns.items() if due_ns <= now_ns and callable(one)]
        if len(due) > 1:
            due.sort(key=self.due_ns.__getitem__)
        for method in due:
            if self.is_due(method):  # unless one before it has changed that
                method()
        if self._later:
            self.queue_due()

    def causes(self) -> list[int]:
        """Return the codes of the faults that the plant causes now."""
        active = self.axis.flags & self._watched_flags
        if not active:
            return []
        return [code for flag, code in self._causes.items() if active & flag]

    def watches(self) -> bool:
        """Return whether events of the motor, such as limits of its plant, must be noticed."""
        return False

    def set_input(self, name: str, value: float) -> None:
        """Set one of its own `INPUTS`, in range.

        Raises:
            TypeError: its class does not override this method.
        """
        raise TypeError(f"{type(self).__name__}: INPUTS has {name!r}; expected a set_input of it")

    @abstractmethod
    def inject(self, fault: int) -> None:
        """Cause a fault."""

    @abstractmethod
    def go_dark(self) -> None:
        """Lose the power: no current, no frames, no deadlines."""

    def truth(self) -> Mapping[str, float]:
        """Return true values of its own."""
        return {}

    # --- queues

    def queue(self, frame: bytes) -> None:
        """Queue a frame."""
        self._out.append(frame)

    def queue_at(self, frame: bytes, due_ns: int) -> None:
        """Queue a frame by the `queue_due` at this time."""
        self._later.append((due_ns, frame))

    def queue_due(self) -> None:
        """Queue the delayed frames whose time has come."""
        for due_ns, frame in self._later:
            if due_ns <= self.now_ns:
                self.queue(frame)
        self._later = [one for one in self._later if one[0] > self.now_ns]

    def note(self, level: str, message: str) -> None:
        """Add an event: "info", "warning" or "error"."""
        self._events.append((level, message))

    def warn(self, message: str) -> None:
        """Add an event of level "warning"."""
        self.note("warning", message)

    def take_output(self) -> Sequence[bytes]:
        """Return the frames to queue now."""
        out, self._out = self._out, []
        return out

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return (level, text) of the events since the last call."""
        events, self._events = self._events, []
        return events

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Handle a transmitted frame of this drive; nothing follows from it."""
        return False

    def wants_sent(self) -> bool:
        """Return False: calls of `sent` are not needed."""
        return False

    def identifiers_revision(self) -> int:
        """Return a number that grows with every change of the identifiers."""
        return self.revision

    def renumber(self) -> None:
        """Note that the identifiers have changed."""
        self.revision += 1

    # --- times

    def is_due(self, name: Hashable) -> bool:
        """Return True, once, if the time of this name has come."""
        if self.now_ns < self.due_ns.get(name, NEVER_NS):
            return False
        del self.due_ns[name]
        return True

    def wake(self, name: Hashable, wait_ns: int) -> None:
        """Set the time of this name, so long after the last update; 0: cancel it.

        In place of a name, a method without arguments is called by `expire`; of those that are due
        at one time, the one that was set first.
        """
        if wait_ns:
            self.due_ns[name] = self.now_ns + wait_ns
        else:
            self.due_ns.pop(name, None)

    def cancel_times(self) -> None:
        """Cancel all times and delayed frames."""
        self.due_ns.clear()
        self._later.clear()

    def next_deadline_ns(self) -> int | None:
        """Return the latest time of the next call of `expire` [ns]."""
        if not self.is_powered:
            return None
        due_ns = min(self.due_ns.values(), default=NEVER_NS)
        for later_ns, _ in self._later:
            due_ns = min(due_ns, later_ns)
        if self.watches():
            due_ns = min(due_ns, self.axis.event_ns(due_ns))
        return None if due_ns >= NEVER_NS else due_ns

    # --- physical inputs, and the truth

    def start(self, now_ns: int) -> None:
        """Switch the power on."""
        self.now_ns = now_ns
        self.axis.at(now_ns)
        self.is_powered = True
        self.boot(now_ns)

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set load [N·m] at the output, supply [V] or power (1, 0), or cause a fault.

        Raises:
            ValueError: there is no such input, or the value is out of range.
        """
        own = self.INPUTS
        if name not in (*own, *_INPUTS):
            known = ", ".join((*_INPUTS, *own))
            raise ValueError(f"there is no stimulus {name!r}; known: {known}")
        low, high = own.get(name) or RANGES.get(name, (value, value))
        if not low <= value <= high:
            raise ValueError(f"{name} = {value}: out of range; expected {low:g} to {high:g}")
        if name == "fault" and not (float(value).is_integer() and int(value) in self._faults):
            codes = _listed(self._faults)
            raise ValueError(f"{name} = {value}: out of range; expected {codes}")
        if name == "power" and value not in (0, 1):
            raise ValueError(f"{name} = {value}: out of range; expected 0 or 1")
        self.advance(now_ns)
        if name in own:
            self.set_input(name, value)
        elif name == "load_torque_n_m":
            self.axis.set_load(value)
        elif name == "supply_v":
            self.axis.set_supply(value)
        elif name == "fault":
            self.inject(int(value))
        elif value and not self.is_powered:
            self.start(now_ns)
        elif not value:
            self.is_powered = False
            self.cancel_times()
            self.go_dark()

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true values at `now_ns`; those in rad and N·m are at the gear's output."""
        axis = self.axis
        axis.at(now_ns)
        return {**axis.truth(), **self.truth(), **axis.truth_of_extras()}


class CanMotorDrive(MotorDrive):
    """A `MotorDrive` on CAN, which hears classical data frames with its kind of identifiers.

    Attributes:
        FLAG: EFF_FLAG for identifiers of 29 bits.
    """

    FLAG: ClassVar[int] = 0

    def hears(self, now_ns: int) -> bool:
        """Return whether it hears frames at all, with power."""
        return True

    @abstractmethod
    def hear(self, can_id: int, data: bytes) -> None:
        """Handle a data frame; the drive is up to date."""

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle a frame from the bus, unless it is remote or of the other kind."""
        can_id = can_id_of(data)
        if can_id & (EFF_FLAG | ERR_FLAG | RTR_FLAG) != self.FLAG:
            return
        if self.is_powered and self.hears(now_ns):
            self.advance(now_ns)
            self.hear(can_id & ~self.FLAG, data_of(data))

    def send(self, can_id: int, data: bytes, wait_ns: int = 0) -> None:
        """Queue a frame, so long after the last update."""
        frame = pack(can_id | self.FLAG, data)
        if wait_ns:
            self.queue_at(frame, self.now_ns + wait_ns)
        else:
            self.queue(frame)


def truncated(value: float, bits: int, *, signed: bool = True) -> int:
    """Return a number truncated toward zero, and limited to a size in bits."""
    if not signed:
        return int(max(0, min((1 << bits) - 1, value)))
    most = 1 << bits - 1
    return int(max(-most, min(most - 1, value)))


def to_code(value: float, limit: float, bits: int, low: float | None = None) -> int:
    """Return the code of a value over low..limit (None: -limit..limit), truncated, unlimited."""
    least = -limit if low is None else low
    return int((value - least) * ((1 << bits) - 1) / (limit - least))


def of_code(code: int, limit: float, bits: int, low: float | None = None) -> float:
    """Return the value of a code; see `to_code`."""
    least = -limit if low is None else low
    return code * (limit - least) / ((1 << bits) - 1) + least


def _listed(codes: Collection[int]) -> str:
    if isinstance(codes, range):
        return f"{codes.start} to {codes.stop - 1}"
    return ", ".join(map(str, codes)) or "none"


TableT = TypeVar("TableT", bound=MotorTable)


def drive_builder(
    table: type[TableT],
    make: Callable[[TableT, ControllerContext], Controller],
    *,
    api: int,
    bus_kinds: Sequence[str] = ("can",),
) -> Callable[[Mapping[str, object], ControllerContext], Controller]:
    """Return the `build` of a drive, marked by `controller`: from its table, on its own clock.

    Args:
        table: the class of its settings.
        make: makes the drive: its class.
        api: as of `controller`.
        bus_kinds: as of `controller`.
    """

    @controller(api=api, bus_kinds=bus_kinds)
    def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
        """Build the drive from its table in a rig.

        Raises:
            SettingError: a key or value is wrong; names the keys.
        """
        own = read(table, settings)
        return on_own_time(make(own, context), own.motor(context.stream()).oscillator)

    return build
