"""Buses and lines of a rig in another process, as its programs see them."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, final

from motorhil.emulators.simulation.ownership_notice import OwnershipNotice, pack_owns
from motorhil.frozen import frozen
from motorhil.harness.rig.config.buses import MODBUS_TCP
from motorhil.harness.rig.lines import serial_line
from motorhil.harness.shared_time import records
from motorhil.harness.shared_time.records import PortFlags
from motorhil.motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorhil.emulators.media.serial_line import SerialLine
    from motorhil.emulators.simulation.endpoints import HostListener
    from motorhil.harness.rig.config.buses import BusDescription
    from motorhil.harness.shared_time.remote_runtime import RemoteLink, RemoteRuntime


@final
@frozen
class RemoteBus:
    """Facts of a bus that a program knows: its data bit rate [bit/s], None for classical CAN."""

    data_bitrate_bit_s: int | None


@final
class RemotePort:
    """A program's port on a bus or line of the rig.

    Attributes:
        name: its name on the bus.
        number: its number on the connection.
    """

    def __init__(self, name: str, number: int, link: "RemoteLink", runtime: "RemoteRuntime"):
        self.name: Final[str] = name
        self.number: Final[int] = number
        self._link: Final[RemoteLink] = link
        self._runtime: Final[RemoteRuntime] = runtime
        self._flags = PortFlags(0)
        self._head: Final[bytes] = records.NUMBERED.pack(records.SEND, number)

    def send(self, frame: bytes) -> None:
        """Queue the frame for the bus, or send these characters of a line."""
        self._link.send(self._head + frame)

    def note_use(self, *, keeps: bool, own: bool) -> None:
        """Tell the rig what happens to frames of this port, so that it calls less often.

        Args:
            keeps: True if they are kept until a party looks for them; nothing else happens.
            own: True if frames that this port has sent are of use.
        """
        flags = PortFlags.QUIET if keeps else PortFlags(0)
        if not own:
            flags |= PortFlags.OTHERS
        if flags != self._flags:
            self._flags = flags
            self._link.hold(records.PORT_FLAGS.pack(records.PORT, self.number, flags))

    def pending(self) -> int:
        """Return 0: the rig itself refuses too many frames."""
        return 0

    def close(self) -> None:
        """Stop deliveries to the program; queued frames are still sent."""
        if self._runtime.ports.pop(self.number, None) is not None and self._link.is_open:
            self._link.send(records.NUMBERED.pack(records.CLOSE, self.number))


@final
class RemoteWorld:
    """The buses of the rig, and its lines by their descriptions."""

    def __init__(
        self,
        buses: Mapping[str, int | None],
        lines: "Mapping[str, BusDescription]",
        link: "RemoteLink",
        runtime: "RemoteRuntime",
    ) -> None:
        self._lines: Final = lines
        self._buses: Final[dict[str, RemoteBus]] = {
            name: RemoteBus(rate) for name, rate in buses.items()
        }
        self._link: Final[RemoteLink] = link
        self._runtime: Final[RemoteRuntime] = runtime
        self._ports: dict[str, RemotePort] = {}

    def bus_names(self) -> list[str]:
        """Return the names of the buses in the order of the rig."""
        return list(self._buses)

    def bus(self, name: str) -> RemoteBus:
        """Return what is known of a bus."""
        return self._buses[name]

    def add_host(
        self,
        bus: str,
        name: str,
        on_frame: "HostListener",
        on_error: "HostListener | None" = None,
    ) -> RemotePort:
        """Return a port of this program on the bus; raises UsageError if the rig has ended.

        A program opens its buses in its own turn, never in a callback.
        """
        fd = self._buses[bus].data_bitrate_bit_s is not None
        return self._open(bus, fd, on_frame, on_error or on_frame)

    def serial_line(self, name: str) -> "SerialLine | None":
        """Return the wires of a line, for their times; None on TCP."""
        line = self._lines[name]
        return None if line.kind == MODBUS_TCP else serial_line(line)

    def add_line_host(self, line: str, name: str, on_data: "HostListener") -> RemotePort:
        """Return a port of this program on the line; on TCP a connection; else as `add_host`."""
        return self._open(line, False, on_data, on_data)

    def _open(
        self, bus: str, fd: bool, on_frame: "HostListener", on_error: "HostListener"
    ) -> RemotePort:
        if self._runtime.is_in_callback():
            raise UsageError(
                f"bus {bus}: opened in a callback; expected a turn of the program; open it before"
            )
        self._link.send(records.numbered(records.OPEN, int(fd), bus))
        record = self._link.receive()
        _, number = records.NUMBERED.unpack_from(record)
        told = records.text_of(record, records.NUMBERED.size)
        self._runtime.ports[number] = on_frame, on_error
        port = self._ports[told] = RemotePort(told, number, self._link, self._runtime)
        return port

    def tell_ownership(self, bus: str, sender: str, notice: OwnershipNotice) -> None:
        """Pass on a notice of this program about the ownership of a motor."""
        head = records.NUMBERED.pack(records.NOTICE, self._ports[sender].number)
        self._link.send(head + pack_owns(notice))
