"""Who is on one wire, how each takes part, and what becomes of the frames of those who do not.

Nodes that may not send keep their frames: their port's entry is CUT_OFF.
"""

from heapq import heappush

from emulators.media.can_arbitration import CanArbitration
from emulators.media.can_frame import FRAME_BYTES
from emulators.media.can_node import CanNode, FrameSupport
from emulators.media.can_port import CUT_OFF, CanPort
from emulators.media.can_presence import Presence, Role
from emulators.media.can_sampling import ONE
from emulators.media.fault_rule import WireLevel
from emulators.media.fault_seam import FaultSeam
from emulators.media.noise import NoiseSource


class CanMembers(CanArbitration):
    """One wire, and the nodes on it.

    Args:
        name: of the bus.
        bit_ns, data_bit_ns: how long a bit takes [ns], as of `CanArbitration`.
        seam: what goes wrong on the bus.
        nodes: of the whole bus, by number.

    Attributes (read only): members, who is on this wire, by number.
    """

    __slots__ = (
        "_hearing",
        "_hearing_fd",
        "_held",
        "_is_alone",
        "_is_apart",
        "_is_mixed",
        "_is_mixed_told",
        "_level",
        "_nodes",
        "_noises",
        "_now_ns",
        "_seam",
        "_unwell",
        "_watchful",
        "members",
    )

    def __init__(
        self, name: str, bit_ns: int, data_bit_ns: int, seam: FaultSeam, nodes: list[Presence]
    ) -> None:
        super().__init__(name, bit_ns, data_bit_ns)
        self._seam = seam
        self._nodes = nodes
        self.members: list[Presence] = []
        self._held: list[Presence] = []  # members that may not send now
        self._hearing = 0  # mask of the members that hear, and acknowledge
        self._hearing_fd = 0  # those of them that see CAN FD frames
        self._watchful = False  # more can happen to a frame than noise
        self._unwell = False  # a member has a counter above 0
        self._is_mixed = False  # a member that hears destroys CAN FD frames
        self._is_mixed_told = False  # who it is was told
        self._is_apart = False  # two members' clocks differ by more than both can stand
        self._noises: list[NoiseSource] = []
        self._level: WireLevel | None = None  # at which the wire is stuck
        self._now_ns = 0  # of the step that is made
        self._is_alone = False  # nobody acknowledges, and that was told

    def add_port(self, port: CanPort) -> None:
        """The bus has another port; its node is not on this wire."""
        self._ports.append(port)

    def take_port(self, number: int, other: "CanMembers") -> None:
        """What waits at this port on the other wire, waits on this one."""
        self._ports[number].adopt(other.port(number))

    def port(self, number: int) -> CanPort:
        """The transmit side of this node, as far as this wire is concerned."""
        return self._ports[number]

    def _add(self, node: Presence) -> None:
        """The node is on this wire."""
        if node.chip.clock_error_1e12:
            self._skew()
        self.members.append(node)
        self.members.sort(key=_number_of)
        self._keep(node)
        before = self._is_apart
        self.count_members()
        if self._is_apart and not before:
            told = "its clock and another node's are too far apart: not all frames can be read"
            self._seam.plan.note(self._now_ns, node.name, told, b"")

    def _remove(self, node: Presence) -> None:
        """The node is on this wire no longer. Its frame is in flight no longer."""
        port = self._ports[node.number]
        if port.entry > 0:
            if port.entry != self._flight:
                self._leave_race(port)
            self._put_back(port)
        port.entry = CUT_OFF
        self.members.remove(node)
        self.count_members()

    def _keep(self, node: Presence) -> None:
        """The node competes with what it has, or does not, as its role is."""
        port = self._ports[node.number]
        if node.role is Role.ON:
            if port.entry == CUT_OFF and port.promote():
                port.starts_seen = self._starts
                heappush(self._competing, port.entry)
        elif port.entry != CUT_OFF:
            if port.entry > 0:
                self._leave_race(port)
                self._put_back(port)
            port.entry = CUT_OFF
        if node.role is Role.OFF:
            self._abort_all(node)

    def count_members(self) -> None:
        """What follows from who is there, and how."""
        members = self.members
        self._held = [node for node in members if node.role is not Role.ON]
        hearing = 0
        unwell = False
        fd = 0
        mixed = False
        for node in members:
            if node.hears():
                hearing |= 1 << node.number
                mixed = mixed or node.chip.frames is FrameSupport.CLASSICAL
                if node.chip.frames is FrameSupport.FD:
                    fd |= 1 << node.number
            unwell = unwell or not node.is_well()
        self._is_mixed = mixed and self.data_bit_ns != 0
        self._is_apart = self._is_skewed and clocks_are_apart([node.chip for node in members])
        self._hearing = hearing
        self._hearing_fd = fd
        self._unwell = unwell
        self._watchful = (
            hearing & (hearing - 1) == 0
            or bool(self._held)
            or self._is_apart
            or self._is_mixed
            or (self.data_bit_ns != 0 and fd & (fd - 1) == 0)
            or (self.data_bit_ns != 0 and any(node.confinement.is_passive() for node in members))
            or self._level is not None
            or self._seam.plan.has_errors()
            or any(node.chip.one_shot for node in members)
        )
        self._is_alone = self._is_alone and hearing & (hearing - 1) == 0

    def tell_mixed(self) -> None:
        """Who cannot stand the CAN FD frame that is sent here is told, once."""
        if self._is_mixed_told:
            return
        self._is_mixed_told = True
        for node in self.members:
            if node.hears() and node.chip.frames is FrameSupport.CLASSICAL:
                told = "destroys CAN FD frames: its CAN controller is classical"
                self._seam.plan.note(self._now_ns, node.name, told, b"")

    def _ears_for(self, frame: bytes) -> int:
        """Mask of the members that hear this frame, and acknowledge it."""
        return self._hearing_fd if len(frame) > FRAME_BYTES else self._hearing

    def _put_back(self, port: CanPort) -> None:
        """The candidate waits behind; a babble is forgotten."""
        if port.babbling:
            port.babbling = False
            port.entry = 0
        else:
            port.put_back()

    def _abort_all(self, node: Presence) -> None:
        """A bus-off node gives up what it has; `pending` frames would be stale afterwards."""
        port = self._ports[node.number]
        for _, _, _, frame in sorted(port.behind):
            self._abort(node, frame, "bus-off")
        port.behind.clear()

    def _abort(self, node: Presence, frame: bytes, why: str) -> None:
        """The frame is given up, and that is told."""
        node.aborted += 1
        self._seam.plan.note(self._now_ns, node.name, f"not sent: {why}", frame)


def clocks_are_apart(chips: list[CanNode]) -> bool:
    """Whether two of these may misread one another's frames, because of their clocks."""
    if not chips:
        return False
    errors = [chip.clock_error_1e12 for chip in chips]
    slowest = min(errors)
    drift = (max(errors) - slowest) * ONE // (ONE + slowest)
    return drift > min(chip.timing.tolerance_1e12() for chip in chips)


def _number_of(node: Presence) -> int:
    return node.number
