"""The client of canopen, an independent implementation, connected to a bench node."""

import canopen
from canopen.objectdictionary import ODRecord, ODVariable

from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary
from tests.support.canopen.node_bench import MS, NODE_ID, Bench


class Loop(canopen.Network):
    """A network without a bus: client frames go to the node, 2 ms pass, responses go back."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self.bench = bench
        self.remote = self.add_node(canopen.RemoteNode(NODE_ID, client_dictionary(bench.od)))
        self.remote.sdo.RESPONSE_TIMEOUT = 0.01
        self.remote.sdo.MAX_RETRIES = 0

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.bench.tell(can_id | (0x4000_0000 if remote else 0), bytes(data))
        self.bench.wait(2 * MS)
        self.deliver()

    def deliver(self) -> None:
        """Pass all output of the node to the client."""
        for time_ns, text in self.bench.heard():
            can_id, _, data = text.partition(" ")
            self.notify(int(can_id, 16), bytearray.fromhex(data), time_ns / 1e9)


def client_dictionary(od: ObjectDictionary) -> canopen.ObjectDictionary:
    """Return the same objects in canopen's classes."""
    theirs = canopen.ObjectDictionary()
    for ours in od:
        variable = ODVariable(f"{ours.index:04X}:{ours.subindex:02X}", ours.index, ours.subindex)
        variable.data_type = int(ours.data_type)
        variable.access_type = ours.access
        variable.pdo_mappable = ours.pdo_mappable
        if len(od.subindices(ours.index)) == 1:
            theirs.add_object(variable)
            continue
        if ours.index not in theirs:
            theirs.add_object(ODRecord(f"{ours.index:04X}", ours.index))
        theirs[ours.index].add_member(variable)
    return theirs


def raw_of(value: object, data_type: int) -> object:
    """Return our value in the form of canopen's `raw`."""
    if isinstance(value, bytes) and data_type == DataType.VISIBLE_STRING:
        return value.decode()
    return bool(value) if data_type == DataType.BOOLEAN else value
