"""Random fault sequences: legal counters, and no frame lost unnoticed."""

import random
from collections import Counter

from hypothesis import event, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from motorhil.emulators.can import error_confinement as told
from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.bus.port import KIND_MASK, TOLD, confirms, hears
from motorhil.emulators.can.controller_config import CanNode
from motorhil.emulators.can.error_confinement import ErrorState
from motorhil.emulators.can.fault_rules import PARTING, FaultKind, FaultRule, FrameError, WireLevel
from motorhil.emulators.can.frame import can_id_of, pack
from tests.support.can.deliveries import BIT
from tests.support.repetition import examples

NAMES = ("a", "b", "c", "d")
PORTS = st.integers(0, len(NAMES) - 1)
GROUPS = st.lists(st.sampled_from(NAMES), min_size=1, max_size=3, unique=True).map(tuple)


class Errors(RuleBasedStateMachine):
    """A bus of four nodes; one recovers by command, and one is one-shot."""

    def __init__(self) -> None:
        super().__init__()
        self.bus = CanBus("can0", faults=FaultPlan([], random.Random(5).random))
        chips = (CanNode(error_reporting=True), CanNode(), CanNode(recovery_ns=None))
        for name, chip in zip(NAMES, (*chips, CanNode(one_shot=True)), strict=True):
            self.bus.attach(name, chip)
        self.now_ns = 0
        self.number = 0
        self.submitted: list[list[bytes]] = [[] for _ in NAMES]
        self.known: list[list[bytes]] = [[] for _ in NAMES]
        self.heard: list[list[bytes]] = [[] for _ in NAMES]
        self.given_up: list[list[bytes]] = [[] for _ in NAMES]
        self.lasting: list[str] = []
        self.struck = 0
        self.failed_unseen = [0] * len(NAMES)  # sender errors after which others may have the frame
        self.moves = 0  # nodes left or entered a wire; a frame may have been nearly sent

    def name(self) -> str:
        self.number += 1
        return f"rule {self.number}"

    def advance(self, until_ns: int) -> None:
        due_ns = self.bus.next_deadline_ns()
        steps = 0
        while due_ns is not None and due_ns <= until_ns:
            assert due_ns >= self.now_ns, "time runs backwards"
            self.now_ns = due_ns
            for frame, sender, kind in self.bus.expire(due_ns):
                if kind & KIND_MASK == TOLD:
                    self.hear_message(frame, sender)
                    continue
                if confirms(kind):
                    self.known[sender].append(frame)
                for port in range(len(NAMES)):
                    if port != sender and hears(kind, port):
                        self.heard[port].append(frame)
            due_ns = self.bus.next_deadline_ns()
            steps += 1
            assert steps < 100_000, "it does not come to rest"
        self.now_ns = until_ns
        for _, name, what, frame in self.bus.take_fault_events():
            if what.startswith("not sent"):
                self.given_up[NAMES.index(name)].append(frame)

    def hear_message(self, message: bytes, port: int) -> None:
        passive = max(message[14], message[15]) > 127  # its flag is invisible to the others
        if message[10] & told.TRANSMITTING and (passive or message[11] == told.END_OF_FRAME):
            self.failed_unseen[port] += 1
        if can_id_of(message) & told.RESTARTED:
            event("a node has recovered")
        if can_id_of(message) & told.MESSAGE_BUS_OFF:
            event("a node is bus-off")
        self.struck += 1

    @rule(port=PORTS, data=st.binary(max_size=8), urgent=st.booleans())
    def submit(self, port: int, data: bytes, urgent: bool) -> None:
        frame = pack((0x080 if urgent else 0x180) + len(self.submitted[port]) % 16 * 4 + port, data)
        self.submitted[port].append(frame)
        self.bus.submit(port, frame, self.now_ns)

    @rule(bits=st.integers(1, 300))
    def wait(self, bits: int) -> None:
        self.advance(self.now_ns + bits * BIT // 2)

    @rule(bit=st.integers(1, 120), ports=st.just(()) | GROUPS, limit=st.sampled_from([1, 3, 40]))
    def strike(self, bit: int, ports: tuple[str, ...], limit: int) -> None:
        self.bus.inject(
            FaultRule(self.name(), FaultKind.ERROR, bit=bit, ports=ports, limit=limit), self.now_ns
        )

    @rule(error=st.sampled_from(FrameError), limit=st.sampled_from([1, 20]))
    def strike_with(self, error: FrameError, limit: int) -> None:
        self.bus.inject(
            FaultRule(self.name(), FaultKind.ERROR, error=error, limit=limit), self.now_ns
        )

    @rule(kind=st.sampled_from([FaultKind.CUT, FaultKind.SPLIT]), ports=GROUPS)
    def part(self, kind: FaultKind, ports: tuple[str, ...]) -> None:
        self.begin(FaultRule(self.name(), kind, ports=ports))

    @rule(rate=st.sampled_from([1e-3, 1e-2]), ports=st.just(()) | GROUPS)
    def noise(self, rate: float, ports: tuple[str, ...]) -> None:
        self.begin(FaultRule(self.name(), FaultKind.NOISE, bit_error_rate=rate, ports=ports))

    @rule(level=st.sampled_from(WireLevel))
    def short(self, level: WireLevel) -> None:
        self.begin(FaultRule(self.name(), FaultKind.SHORT, level=level))

    def begin(self, fault: FaultRule) -> None:
        self.moves += len(fault.ports) if fault.kind in PARTING else 0
        event(fault.kind.value)
        self.bus.inject(fault, self.now_ns)
        self.lasting.append(fault.name)

    @rule(data=st.data())
    def end(self, data: st.DataObject) -> None:
        if self.lasting:
            name = data.draw(st.sampled_from(self.lasting))
            self.lasting.remove(name)
            self.bus.lift(name, self.now_ns)
            self.moves += len(NAMES)

    @rule(port=PORTS)
    def restart(self, port: int) -> None:
        if self.bus.error_state(port) is ErrorState.BUS_OFF:
            self.bus.restart(port, self.now_ns)

    @invariant()
    def counters_are_legal(self) -> None:
        for port in range(len(NAMES)):
            node = self.bus.node(port)
            counters = node.confinement
            assert counters.tec >= 0
            assert 0 <= counters.rec <= 255
            if node.state() is not ErrorState.BUS_OFF:
                assert counters.tec < 256

    def teardown(self) -> None:
        """End all faults and account for all submitted frames."""
        self.advance(self.now_ns + 10 * BIT)
        for name in self.lasting:
            self.bus.lift(name, self.now_ns)
        self.advance(self.now_ns + 100_000 * BIT)
        for port in range(len(NAMES)):
            if self.bus.error_state(port) is ErrorState.BUS_OFF:
                self.bus.restart(port, self.now_ns)
        self.advance(self.now_ns + 100_000 * BIT)
        for port in range(len(NAMES)):
            done = sorted(self.known[port] + self.given_up[port])
            assert done == sorted(self.submitted[port]), "lost, or made up"
            assert self.bus.pending(port) == 0
            assert self.bus.node(port).aborted == len(self.given_up[port])
        for port in range(len(NAMES)):
            others = [one for one in range(len(NAMES)) if one != port]
            again = sum(self.failed_unseen[one] for one in others)
            for frame, count in Counter(self.heard[port]).items():
                known = sum(self.known[one].count(frame) for one in others)
                if count > known:
                    event("a frame was heard again")
                    again -= count - known
            assert again + self.moves >= 0, "doubled without a trace"
        event("nothing was struck" if not self.struck else "something was struck")


TestErrors = Errors.TestCase
TestErrors.settings = settings(max_examples=examples(60), stateful_step_count=25, deadline=None)
