"""Nodes on one wire, and the frames of absent nodes.

Nodes that may not send keep their frames: the entry of their port is CUT_OFF.
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
        name: the name of the bus.
        bit_ns, data_bit_ns: bit durations [ns], as for `CanArbitration`.
        seam: the faults of the bus.
        nodes: the nodes of the whole bus, by number.

    Attributes (read only): members, the nodes on this wire, by number.
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
        self._hearing = 0  # mask of the members that hear and acknowledge
        self._hearing_fd = 0  # those of them that receive CAN FD frames
        self._watchful = False  # faults other than noise can strike a frame
        self._unwell = False  # a member has an error counter above 0
        self._is_mixed = False  # a member that hears destroys CAN FD frames
        self._is_mixed_told = False  # these members have been reported
        self._is_apart = False  # the clocks of two members differ by more than both tolerate
        self._noises: list[NoiseSource] = []
        self._level: WireLevel | None = None  # level at which the wire is stuck
        self._now_ns = 0  # time of the current step
        self._is_alone = False  # the missing acknowledgement has been reported

    def add_port(self, port: CanPort) -> None:
        """Add a port of the bus; its node is not on this wire yet."""
        self._ports.append(port)

    def take_port(self, number: int, other: "CanMembers") -> None:
        """Take over the frames that wait at this port on the other wire."""
        self._ports[number].adopt(other.port(number))

    def port(self, number: int) -> CanPort:
        """Return the transmit side of this node on this wire."""
        return self._ports[number]

    def _add(self, node: Presence) -> None:
        """Add a node to this wire."""
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
        """Remove a node from this wire, with its frame in flight."""
        port = self._ports[node.number]
        if port.entry > 0:
            if port.entry != self._flight:
                self._leave_race(port)
            self._put_back(port)
        port.entry = CUT_OFF
        self.members.remove(node)
        self.count_members()

    def _keep(self, node: Presence) -> None:
        """Let the node compete with its frames, or not, according to its role."""
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
        """Recompute the flags and masks that depend on the members."""
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
        """Report, once, the nodes that destroy the CAN FD frame being sent."""
        if self._is_mixed_told:
            return
        self._is_mixed_told = True
        for node in self.members:
            if node.hears() and node.chip.frames is FrameSupport.CLASSICAL:
                told = "destroys CAN FD frames: its CAN controller is classical"
                self._seam.plan.note(self._now_ns, node.name, told, b"")

    def _ears_for(self, frame: bytes) -> int:
        """Return the mask of the members that hear and acknowledge this frame."""
        return self._hearing_fd if len(frame) > FRAME_BYTES else self._hearing

    def _put_back(self, port: CanPort) -> None:
        """Put the candidate back into the queue; discard a babbled frame."""
        if port.babbling:
            port.babbling = False
            port.entry = 0
        else:
            port.put_back()

    def _abort_all(self, node: Presence) -> None:
        """Give up the frames of a bus-off node; they would be stale after recovery."""
        port = self._ports[node.number]
        for _, _, _, frame in sorted(port.behind):
            self._abort(node, frame, "bus-off")
        port.behind.clear()

    def _abort(self, node: Presence, frame: bytes, why: str) -> None:
        """Give up the frame and record it."""
        node.aborted += 1
        self._seam.plan.note(self._now_ns, node.name, f"not sent: {why}", frame)


def clocks_are_apart(chips: list[CanNode]) -> bool:
    """Return whether two of these may misread each other's frames because of their clocks."""
    if not chips:
        return False
    errors = [chip.clock_error_1e12 for chip in chips]
    slowest = min(errors)
    drift = (max(errors) - slowest) * ONE // (ONE + slowest)
    return drift > min(chip.timing.tolerance_1e12() for chip in chips)


def _number_of(node: Presence) -> int:
    return node.number
