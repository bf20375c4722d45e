"""The bus compared with bitwise nodes on a wired AND."""

from dataclasses import dataclass, field

from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.controller_config import CanNode, QueueOrder
from tests.support.can import frame_bits as wire
from tests.support.can.deliveries import BIT, run


@dataclass
class BitNode:
    """A node without keys or lengths: it sends bits and watches the bus."""

    by_priority: bool
    waiting: list[wire.Fields] = field(default_factory=list)
    sending: str = ""
    frame: wire.Fields | None = None
    losses: int = 0

    def choose(self) -> None:
        """Choose the next frame: the oldest, or the most dominant, of equal ones the oldest."""
        place = 0
        if self.by_priority:
            rivals = [wire.arbitration_field(frame) for frame in self.waiting]
            # A shorter field ends in a dominant IDE bit, so text order is wire order.
            place = min(range(len(rivals)), key=lambda number: rivals[number])
        self.frame = self.waiting.pop(place)
        self.sending = wire.on_the_wire(self.frame)

    def give_up(self) -> None:
        assert self.frame is not None
        self.losses += 1
        self.waiting.insert(0, self.frame)
        self.sending = ""


def run_bits(
    nodes: list[BitNode], submissions: list[tuple[int, int, wire.Fields]]
) -> list[tuple[int, bytes, int]]:
    """Return (end of frame [bit times], frame, node) of every frame; submissions in bit times."""
    sent: list[tuple[int, bytes, int]] = []
    todo = list(submissions)
    now = 0
    quiet = wire.INTERMISSION
    position = -1  # in the frame on the bus; -1: none
    while todo or position >= 0 or any(node.waiting for node in nodes):
        while todo and todo[0][0] <= now:
            _, number, frame = todo.pop(0)
            nodes[number].waiting.append(frame)
        if position < 0 and quiet >= wire.INTERMISSION:
            for node in nodes:
                if node.waiting:
                    node.choose()
                    position = 0
        if position < 0:
            quiet += 1
            now += 1
            continue
        senders = [node for node in nodes if node.sending]
        level = min(node.sending[position] for node in senders)  # dominant is 0, and wins
        for node in senders:
            if node.sending[position] != level:
                node.give_up()
        now += 1
        position += 1
        (winner, *others) = [number for number, node in enumerate(nodes) if node.sending]
        if position == len(nodes[winner].sending):
            assert not others
            frame = nodes[winner].frame
            assert frame is not None
            sent.append((now, frame.can_frame(), winner))
            nodes[winner].sending = ""
            position = -1
            quiet = 0
    return sent


NODES = st.lists(st.booleans(), min_size=1, max_size=5)


@st.composite
def traffic(draw: st.DrawFn) -> tuple[list[bool], list[tuple[int, int, wire.Fields]]]:
    """Draw nodes with their queue order, and frames with unique identifiers."""
    orders = draw(NODES)
    owner: dict[str, int] = {}
    submissions: list[tuple[int, int, wire.Fields]] = []
    now = 0
    for frame in draw(st.lists(wire.fields(), max_size=12)):
        now += draw(st.sampled_from([0, 0, 0, 1, 2, 3, 30, 60, 111, 500]))
        wish = draw(st.integers(0, len(orders) - 1))
        number = owner.setdefault(wire.arbitration_field(frame), wish)
        submissions.append((now, number, frame))
    return orders, submissions


@given(traffic())
def test_frame_ends_and_losses_equal_bitwise_model(case):
    orders, submissions = case
    nodes = [BitNode(by_priority) for by_priority in orders]
    expected = run_bits(nodes, submissions)

    bus = CanBus("can0")
    for number, by_priority in enumerate(orders):
        order = QueueOrder.PRIORITY if by_priority else QueueOrder.FIFO
        bus.attach(f"{number}", CanNode(order))
    bus.attach("ear")
    deliveries = run(
        bus, [(now * BIT, number, frame.can_frame()) for now, number, frame in submissions]
    )
    assert [(end_ns / BIT, frame, port) for end_ns, (frame, port, _) in deliveries] == expected
    losses = [node.losses for node in nodes]
    assert [bus.arbitration_losses(port) for port in range(len(nodes))] == losses
    assert bus.statistics.collisions() == {}
    event("contended" if sum(losses) else "not contended")


def test_bitwise_model_has_contention():
    low = wire.Fields(0x100, False, False, 0, b"")
    high = wire.Fields(0x101, False, False, 0, b"")
    nodes = [BitNode(False), BitNode(False)]
    sent = run_bits(nodes, [(0, 0, high), (0, 1, low)])
    assert [number for _, _, number in sent] == [1, 0]
    assert [node.losses for node in nodes] == [1, 0]
