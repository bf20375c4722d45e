"""Types shared by the parts of a node: host, timing and outbox."""

from typing import Final, Protocol, final

US: Final = 1_000  # [ns]
MS: Final = 1_000_000  # [ns]
NEVER: Final = 1 << 61  # a deadline that never comes [ns]; a small int to the compiler


@final
class NodeTiming:
    """The delays of a node [ns]; those of real nodes are never zero.

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
        """Handle a changed NMT state (an `NmtState`); at INITIALISING `on_reset` follows."""

    def on_reset(self, whole: bool, now_ns: int) -> None:
        """Handle an NMT reset: `whole` for reset node (and power-on), else reset communication.

        The values concerned have just become their defaults, without a call of their writers:
        1000h-1FFFh always, the others too if `whole`.
        """

    def on_write(self, now_ns: int) -> None:
        """Handle writes by one SDO download, one RPDO, or all RPDOs of one SYNC."""

    def on_sync(self, now_ns: int) -> None:
        """Handle SYNC in OPERATIONAL: latched RPDOs are written, TPDOs are not yet sampled."""

    def before_read(self, now_ns: int) -> None:
        """Prepare for reading (SDO upload, TPDO): readers must return values as of now."""

    def on_heartbeat_lost(self, node_id: int, now_ns: int) -> None:
        """Handle the loss of a node of 1016h, or of the master that guards this node (node 0).

        EMCY 8130h and the reaction of 1029h have been done.
        """

    def on_bus_off(self, now_ns: int) -> None:
        """Handle bus-off of the node; the reaction of 1029h has been done."""


@final
class Outbox:
    """The output of a call: frames in order, events, and whether a deadline has moved."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.events: list[tuple[str, str]] = []
        self.deadlines_moved = True
