"""A CAN bus with ports: who may send when, how long it takes, who hears it.

A core like a controller: told frames, told the time, asked for its next deadline. Who may send is
said in `can_arbitration`; here is what becomes of it.

Two nodes that send one identifier and frame type destroy each other's frames on a real bus. Here
the lower port goes first, and `statistics.collisions` tells. Faults cost one flag while there are
none. Left for later, and where: error frames, error counters and bus-off (where a frame is
complete; a sender nobody acknowledges succeeds here).
"""

from heapq import heappush
from typing import final

from emulators.media.can_arbitration import CanArbitration
from emulators.media.can_bits import CLASSICAL_MAX
from emulators.media.can_node import PLAIN, CanNode, FrameSupport
from emulators.media.can_port import CUT_OFF, PORT_MASK, PORT_SHIFT, CanPort
from emulators.media.delivery import (
    DELIVERED,
    HEARD,
    KIND_MASK,
    LOST,
    Delivery,
    hears,
    kind_without,
)
from emulators.media.fault_seam import ERROR_FRAME_BITS, FaultSeam
from emulators.media.faults import NEVER_NS, FaultEvent, FaultPlan, FaultRule

__all__ = ["DELIVERED", "HEARD", "KIND_MASK", "LOST", "CanBus", "Delivery", "hears"]


@final
class CanBus(CanArbitration):
    """A CAN bus, classical or FD. Sans-I/O; times are int nanoseconds on one timeline from 0 on.

    Whoever drives it calls `expire` with the time of each `next_deadline_ns` as it comes, and
    never submits at a time later than a deadline still due.

    Memory grows as `CanStatistics` says (at most 16 bytes per frame), by what is submitted and not
    yet sent, and by the events of faults until they are taken.

    Args:
        name: how records call it.
        bitrate_bit_s: nominal bit rate [bit/s]; a bit must be a whole number of nanoseconds.
        faults: what goes wrong; None: nothing ever will. An empty plan costs nothing either.
        data_bitrate_bit_s: of the data phase of CAN FD frames with a bit rate switch [bit/s]; as
            the other one, and not below it. None: the bus is classical.

    Attributes (read only): name, bitrate_bit_s, data_bitrate_bit_s, bit_ns [ns], data_bit_ns [ns],
    statistics.

    Raises:
        ValueError: a bit at these rates is no whole number of nanoseconds, or the data rate is the
            lower one.
    """

    def __init__(
        self,
        name: str,
        bitrate_bit_s: int = 1_000_000,
        faults: FaultPlan | None = None,
        data_bitrate_bit_s: int | None = None,
    ) -> None:
        bit_ns = _bit_ns(name, bitrate_bit_s)
        data_bit_ns = 0 if data_bitrate_bit_s is None else _bit_ns(name, data_bitrate_bit_s)
        if data_bit_ns > bit_ns:
            raise ValueError(
                f"bus {name}: the data bit rate of {data_bitrate_bit_s} bit/s is below the "
                f"nominal one of {bitrate_bit_s} bit/s"
            )
        super().__init__(name, bit_ns, data_bit_ns)
        self.bitrate_bit_s = bitrate_bit_s
        self.data_bitrate_bit_s = data_bitrate_bit_s
        self._fd_kind = DELIVERED  # of a CAN FD frame: only FD nodes hear it
        self._faults = FaultSeam(faults) if faults is not None else None
        self._faulty = False
        if faults is not None:
            self._recheck_faults(0)

    def attach(self, name: str, chip: CanNode = PLAIN) -> int:
        """A new node is on the bus; its port number, counted from 0.

        Raises:
            ValueError: the name is taken, or 4096 ports are attached.
        """
        number = len(self._ports)
        if number > PORT_MASK:
            raise ValueError(f"bus {self.name}: no more than {PORT_MASK + 1} ports")
        if name in self.port_names():
            raise ValueError(f"bus {self.name}: a port is called {name} already")
        node = CanPort(number, name, chip)
        self._ports.append(node)
        if chip.frames is not FrameSupport.FD:
            self._fd_kind = kind_without(self._fd_kind, 1 << number)
        if self._faults is not None and self._faults.attach(name):
            node.entry = CUT_OFF
        return number

    def next_deadline_ns(self) -> int | None:
        """When something is complete, or a fault is due [ns]; None: only if something comes in."""
        due_ns = self.deadline_ns()
        return None if due_ns == NEVER_NS else due_ns

    def deadline_ns(self) -> int:
        """As `next_deadline_ns`, with NEVER_NS (-1) for None."""
        if self._faulty:
            return self._deadline_with_faults_ns()
        return self._end_ns if self._flight else NEVER_NS

    def expire(self, now_ns: int) -> list[Delivery]:
        """What became complete up to `now_ns`, in order; the next arbitration is decided."""
        deliveries: list[Delivery] = []
        if self._faulty:
            self._expire_with_faults(now_ns, deliveries)
            return deliveries
        while self._flight and self._end_ns <= now_ns:
            entry = self._flight
            number = entry >> PORT_SHIFT & PORT_MASK
            node = self._ports[number]
            kind = DELIVERED if self._lengths <= CLASSICAL_MAX else self._fd_kind
            deliveries.append((node.frame, number, kind))
            self._succeed(node, entry)
            if self._competing:
                self._arbitrate(self._free_ns)
            else:
                self._flight = 0
        return deliveries

    # --- with faults

    def inject(self, rule: FaultRule, now_ns: int) -> None:
        """The rule holds from now on; `next_deadline_ns` may be another.

        Raises:
            ValueError: the bus was made without a fault plan, or has had a rule of that name.
        """
        self._fault_seam().plan.add(rule)
        self._recheck_faults(now_ns)

    def lift(self, name: str, now_ns: int) -> None:
        """The rule of this name holds no longer; what it delayed still comes.

        Raises:
            ValueError: the bus was made without a fault plan, or has no such rule.
        """
        self._fault_seam().plan.remove(name)
        self._recheck_faults(now_ns)

    def take_fault_events(self) -> list[FaultEvent]:
        """(time [ns], rule, what happened, frame) of each firing since last asked."""
        return self._faults.plan.take_events() if self._faults is not None else []

    def faults_fired(self) -> dict[str, int]:
        """How often each rule has fired, by name, in the order of adding."""
        return self._faults.plan.fired() if self._faults is not None else {}

    def _fault_seam(self) -> FaultSeam:
        if self._faults is None:
            raise ValueError(f"bus {self.name} has no fault plan; give it one, empty if need be")
        return self._faults

    def _recheck_faults(self, now_ns: int) -> None:
        """The rules have changed."""
        faults = self._fault_seam()
        self._keep_cuts(faults, now_ns)
        self._settle_faults(faults)

    def _settle_faults(self, faults: FaultSeam) -> None:
        """From now on faults cost something, or nothing."""
        self._faulty = not faults.is_idle()
        if not self._faulty:
            for node in self._ports:
                node.repeated = b""

    def _deadline_with_faults_ns(self) -> int:
        due_ns = self._fault_seam().next_ns()
        if self._flight and not 0 <= due_ns <= self._end_ns:
            return self._end_ns
        return due_ns

    def _expire_with_faults(self, now_ns: int, out: list[Delivery]) -> None:
        """As `expire`; of what is due at one time, cuts come first and late frames last."""
        faults = self._fault_seam()
        due_ns = self._deadline_with_faults_ns()
        while 0 <= due_ns <= now_ns:
            if faults.is_cut_due(due_ns):
                self._keep_cuts(faults, due_ns)
            elif self._flight and self._end_ns == due_ns:
                self._complete_with_faults(faults, out)
            else:
                faults.hear_late(due_ns, out)
            due_ns = self._deadline_with_faults_ns()
        self._settle_faults(faults)

    def _complete_with_faults(self, faults: FaultSeam, out: list[Delivery]) -> None:
        """The frame in flight is complete, or destroyed because its sender was cut off."""
        entry = self._flight
        number = entry >> PORT_SHIFT & PORT_MASK
        node = self._ports[number]
        if faults.was_cut(number):
            self._occupy(0)
            self._send_again(node, faults.is_cut(number))
        elif node.frame == node.repeated:
            node.repeated = b""
            faults.deliver(node.frame, number, out)
            self._succeed(node, entry)
        elif faults.complete(node.frame, number, self._end_ns, out):
            node.repeated = node.frame
            self._occupy(ERROR_FRAME_BITS)
            self._send_again(node, False)
        else:
            self._succeed(node, entry)
        faults.forget_flight()
        self._arbitrate(self._free_ns)

    def _send_again(self, node: CanPort, cut_off: bool) -> None:
        """The candidate was in flight and failed; it competes again, or waits cut off."""
        if cut_off:
            node.put_back()
            node.entry = CUT_OFF
        else:
            node.starts_seen = self._starts
            heappush(self._competing, node.entry)

    def _keep_cuts(self, faults: FaultSeam, now_ns: int) -> None:
        """Ports have left the bus or come back."""
        changed = faults.keep_cuts(now_ns, self._flight != 0 and now_ns > self._start_ns)
        for number, node in enumerate(self._ports):
            if changed >> number & 1:
                if faults.is_cut(number):
                    self._cut_off(node, now_ns)
                else:
                    self._reconnect(node, now_ns)

    def _cut_off(self, node: CanPort, now_ns: int) -> None:
        """The node competes no longer; what it has in flight runs on to its end, in vain."""
        if node.entry == self._flight and self._flight:
            if now_ns >= self._joinable_ns:
                return
            node.put_back()
            self._starts -= 1  # the same arbitration, without this node
            self._arbitrate(self._start_ns)
        elif node.entry:
            self._drop_out(node.entry)
            node.losses += self._starts - node.starts_seen
            node.put_back()
        node.entry = CUT_OFF

    def _reconnect(self, node: CanPort, now_ns: int) -> None:
        """The node competes with what it has, unless it never stopped sending.

        It cannot join a frame that has started: it was not there to see it.
        """
        if node.entry != CUT_OFF or not node.promote():
            return
        if self._flight and now_ns <= self._start_ns:
            self._compete(node, now_ns)
            return
        node.starts_seen = self._starts
        heappush(self._competing, node.entry)
        if not self._flight:
            self._arbitrate(max(now_ns, self._free_ns))


def _bit_ns(name: str, rate_bit_s: int) -> int:
    """How long a bit takes [ns]."""
    if rate_bit_s <= 0 or 1_000_000_000 % rate_bit_s:
        raise ValueError(
            f"bus {name}: a bit at {rate_bit_s} bit/s is no whole number of nanoseconds; 8M, 5M, "
            "4M, 2M, 1M, 800k, 500k, 250k, 125k, 100k, 50k, 20k and 10k are"
        )
    return 1_000_000_000 // rate_bit_s
