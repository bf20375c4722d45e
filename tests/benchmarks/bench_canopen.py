"""CANopen figures: the slave's hot paths, and canopen as client and peer."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from struct import pack

import canopen

from motorhil import emulators
from motorhil.emulators.can.frame import data_of
from motorhil.emulators.can.frame import pack as frame
from motorhil.emulators.canopen.files.eds import read_eds
from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from motorhil.emulators.canopen.outbox import NodeTiming

MS = 1_000_000
NODE_ID = 3
CYCLES = 20_000
UPLOADS = 5_000
EDS = Path(emulators.__file__).parent / "eds" / "motorhil_cia402.eds"


class _Quiet:
    """A device that does nothing."""

    def on_nmt(self, state: int, now_ns: int) -> None: ...

    def on_reset(self, whole: bool, now_ns: int) -> None: ...

    def on_write(self, now_ns: int) -> None: ...

    def on_sync(self, now_ns: int) -> None: ...

    def before_read(self, now_ns: int) -> None: ...

    def on_heartbeat_lost(self, node_id: int, now_ns: int) -> None: ...

    def on_bus_off(self, now_ns: int) -> None: ...


def _node(sdo_reply_ns: int) -> CanopenNode:
    """Return an operational node: RPDO 6040h+607Ah, TPDO 6041h+6064h of type 1, as in csp."""
    od = ObjectDictionary()
    for index, data_type, access in (
        (0x6040, DataType.UNSIGNED16, "rww"),
        (0x607A, DataType.INTEGER32, "rww"),
        (0x6041, DataType.UNSIGNED16, "ro"),
        (0x6064, DataType.INTEGER32, "ro"),
    ):
        od.add(Variable(index, 0, data_type, "", access, True))
    od.add(Variable(0x1018, 1, DataType.UNSIGNED32, default=4))
    for index, entries in (
        (0x1400, (0x6040_0010, 0x607A_0020)),
        (0x1800, (0x6041_0010, 0x6064_0020)),
    ):
        od.add(Variable(index, 1, DataType.UNSIGNED32))
        od.add(Variable(index, 2, DataType.UNSIGNED8, default=1))
        od.add(Variable(index + 0x200, 0, DataType.UNSIGNED8, default=2))
        for subindex, entry in enumerate(entries, start=1):
            od.add(Variable(index + 0x200, subindex, DataType.UNSIGNED32, default=entry))
    for index in (0x6040, 0x607A):
        variable = od.get(index)
        assert variable is not None
        variable.writer = lambda _value: 0
    for index in (0x6041, 0x6064):
        variable = od.get(index)
        assert variable is not None
        variable.reader = lambda: 7
    node = CanopenNode(od, NODE_ID, NodeTiming(300 * MS, sdo_reply_ns), _Quiet())
    node.start(0)
    node.expire(300 * MS)
    node.receive(frame(0x000, b"\x01\x00"), 300 * MS)
    node.take_output()
    return node


def _best_us(
    action: Callable[[], object], count: int, clock: Callable[[], float] = time.process_time
) -> float:
    """Return the fastest of five rounds, per call [us]; other load only adds time."""
    rounds = []
    for _ in range(5):
        start = clock()
        for _ in range(count):
            action()
        rounds.append((clock() - start) / count * 1e6)
    return min(rounds)


def _csp_cycle_us() -> float:
    node = _node(1 * MS)
    rpdo, sync = frame(0x200 + NODE_ID, pack("<Hi", 15, 1000)), frame(0x080)

    def cycle() -> None:
        node.receive(rpdo, 0)
        node.next_deadline_ns()
        node.receive(sync, 0)
        for tpdo in node.take_output():
            node.sent(tpdo, 0)
        node.next_deadline_ns()

    return _best_us(cycle, CYCLES)


def _foreign_frame_us() -> float:
    node = _node(1 * MS)
    foreign = frame(0x181, bytes(8))
    return _best_us(lambda: node.receive(foreign, 0), CYCLES)


def _sdo_upload_us() -> float:
    node = _node(1 * MS)
    request = frame(0x600 + NODE_ID, bytes.fromhex("40 64 60 00 00 00 00 00"))

    def upload() -> None:
        node.receive(request, 0)
        node.expire(node.next_deadline_ns() or 0)
        node.take_output()

    return _best_us(upload, CYCLES)


class _Direct(canopen.Network):
    """canopen's client connected directly to our node."""

    def __init__(self, node: CanopenNode) -> None:
        super().__init__()
        self.node = node

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.node.receive(frame(can_id, bytes(data)), 0)
        for answer in self.node.take_output():
            self.notify(answer[0] | answer[1] << 8, bytearray(data_of(answer)), 0.0)


def _client_uploads_per_s() -> float:
    network = _Direct(_node(0))
    client = network.add_node(canopen.RemoteNode(NODE_ID, canopen.ObjectDictionary()))
    return 1e6 / _best_us(lambda: client.sdo.upload(0x1018, 1), UPLOADS, time.perf_counter)


def _peer_uploads_per_s(clock: Callable[[], float] = time.perf_counter) -> float:
    """Measure canopen's LocalNode over python-can's `virtual` bus, with its threads."""
    od = canopen.ObjectDictionary()
    variable = canopen.objectdictionary.ODVariable("x", 0x2000, 0)
    variable.data_type = canopen.objectdictionary.UNSIGNED32
    variable.default = 4
    od.add_object(variable)
    server, client = canopen.Network(), canopen.Network()
    server.connect(interface="virtual", channel="bench_canopen")
    client.connect(interface="virtual", channel="bench_canopen")
    try:
        server.add_node(canopen.LocalNode(NODE_ID, od))
        remote = client.add_node(canopen.RemoteNode(NODE_ID, od))
        upload = partial(remote.sdo.upload, 0x2000, 0)
        return 1e6 / _best_us(upload, UPLOADS // 5, clock)
    finally:
        client.disconnect()
        server.disconnect()


def run() -> list[tuple[str, float, str]]:
    """Return the figures as (name, figure, unit)."""
    ours, peer = _client_uploads_per_s(), _peer_uploads_per_s()
    return [
        ("csp cycle (RPDO, SYNC, TPDO) of one node", _csp_cycle_us(), "us"),
        ("frame that is not for the node", _foreign_frame_us(), "us"),
        ("SDO upload, server alone", _sdo_upload_us(), "us"),
        ("client's SDO uploads from our node, no bus", ours, "1/s"),
        ("the same from canopen's LocalNode, python-can virtual", peer, "1/s"),
        ("ours against that", ours / peer, "x"),
        ("reading our own EDS", _best_us(_read, 3) / 1e3, "ms"),
    ]


def _read() -> None:
    read_eds(EDS, NODE_ID).dictionary()
