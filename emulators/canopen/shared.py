"""What the parts of a node share: its host and timing, and what comes out of one call."""

from typing import Final, Protocol, final

US: Final = 1_000  # [ns]
MS: Final = 1_000_000  # [ns]
NEVER: Final = 1 << 61  # a deadline that does not come [ns]; a small int to the compiler


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
        """The NMT state (an `NmtState`) has changed; at INITIALISING `on_reset` follows."""

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
        """A node of 1016h fell silent, or nobody guards this one any more (node 0).

        EMCY 8130h and what 1029h asks for have been done.
        """

    def on_bus_off(self, now_ns: int) -> None:
        """The node is off the bus; what 1029h asks for has been done."""


@final
class Outbox:
    """What comes out of a call: frames in order, events, and whether a deadline has moved."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.events: list[tuple[str, str]] = []
        self.deadlines_moved = True
