"""A CANopen node (CiA 301): NMT, SDO server, PDOs, SYNC, EMCY and heartbeat over one dictionary.

A drive is composed of a node, it does not inherit from it: it answers the node's `NodeHost` calls
and hands `receive`, `sent`, `expire`, `take_output` and the rest through.
"""

from collections.abc import Sequence
from typing import Final, Protocol, final

from emulators.canopen.object_dictionary import ObjectDictionary

MS: Final = 1_000_000


@final
class NodeTiming:
    """The delays of a node [ns]: real ones are never zero.

    Attributes:
        boot_up_ns: from power-on or reset node to the boot-up message.
        reset_communication_ns: from reset communication to the boot-up message.
        sdo_reply_ns: from an SDO request to its response.
    """

    def __init__(
        self,
        boot_up_ns: int = 300 * MS,
        sdo_reply_ns: int = 1 * MS,
        reset_communication_ns: int = 20 * MS,
    ) -> None:
        self.boot_up_ns = boot_up_ns
        self.sdo_reply_ns = sdo_reply_ns
        self.reset_communication_ns = reset_communication_ns


class NodeHost(Protocol):
    """The device around a node. All calls come from within the node's own calls."""

    def on_nmt(self, state: int, now_ns: int) -> None:
        """The NMT state (an `NmtState`) has changed; values and callbacks are settled."""

    def on_reset(self, whole: bool, now_ns: int) -> None:
        """NMT reset: `whole` reset node (and power-on), else reset communication.

        The values concerned have just become their defaults, without any writer being asked:
        1000h-1FFFh always, the others too if `whole`.
        """

    def on_write(self, now_ns: int) -> None:
        """One SDO download, one RPDO, or all RPDOs of one SYNC have been written, writers asked."""

    def on_sync(self, now_ns: int) -> None:
        """SYNC came, in OPERATIONAL: latched RPDOs are written, TPDOs are not yet sampled."""

    def before_read(self, now_ns: int) -> None:
        """Values are about to be read (SDO upload, TPDO): readers must now answer as of now."""

    def on_heartbeat_lost(self, node_id: int, now_ns: int) -> None:
        """A node of 1016h fell silent; EMCY 8130h and what 1029h asks for have been done."""


@final
class CanopenNode:
    """One CANopen slave, sans-I/O. Frames are Linux can_frame, 16 bytes; times int ns from 0.

    `state` is the NMT state; read it, never write it.
    """

    def __init__(
        self, od: ObjectDictionary, node_id: int, timing: NodeTiming, host: NodeHost
    ) -> None:
        raise NotImplementedError

    # --- what a Controller (emulators/controller.py) hands through

    def start(self, now_ns: int) -> None:
        """Power comes on: all values are defaults; boot-up after `boot_up_ns`."""
        raise NotImplementedError

    def receive(self, data: bytes, now_ns: int) -> None:
        """A frame was on the bus; whatever is not for this node is ignored."""
        raise NotImplementedError

    def sent(self, data: bytes, now_ns: int) -> None:
        """An own frame has left the bus. Must be called: a TPDO waits for the one before it."""
        raise NotImplementedError

    def next_deadline_ns(self) -> int | None:
        """When `expire` must be called at the latest [ns]."""
        raise NotImplementedError

    def expire(self, now_ns: int) -> None:
        """What is due at `now_ns` is done."""
        raise NotImplementedError

    def take_output(self) -> Sequence[bytes]:
        """The frames to send now, in order; () if none."""
        raise NotImplementedError

    def take_events(self) -> Sequence[tuple[str, str]]:
        """(level, text) of what happened since last asked; () if nothing."""
        raise NotImplementedError

    def identifiers(self) -> Sequence[int]:
        """The CAN identifiers this node listens to, in any NMT state."""
        raise NotImplementedError

    def identifiers_revision(self) -> int:
        """Grows whenever `identifiers` would answer something new."""
        raise NotImplementedError

    # --- what the device around it asks for

    def emergency(self, code: int, error_register: int, vendor: bytes, now_ns: int) -> None:
        """EMCY is sent (not in STOPPED), 1001h and the history 1003h are kept.

        Args:
            code: the error code (603Fh); 0000h says that errors are gone.
            error_register: the device's own bits of 1001h from now on; bit 0 (generic error) is
                set with any other, and what the node itself has found (communication) is added.
            vendor: up to 5 manufacturer-specific bytes.
            now_ns: the time [ns].
        """
        raise NotImplementedError

    def object_changed(self, index: int, subindex: int, now_ns: int) -> None:
        """An event for the TPDOs that map it: types 254, 255 at once (inhibit time), 0 at SYNC."""
        raise NotImplementedError
