"""A node on a bench, with a recording host and controlled time."""

from struct import Struct

from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary, Value, Variable
from motorhil.emulators.canopen.outbox import NodeTiming

MS = 1_000_000
NODE_ID = 2
_FRAME = Struct("<IB3x8s")

BOOLEAN, INTEGER8, INTEGER16, INTEGER32 = (
    DataType.BOOLEAN,
    DataType.INTEGER8,
    DataType.INTEGER16,
    DataType.INTEGER32,
)
UNSIGNED8, UNSIGNED16, UNSIGNED32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32


def frame(can_id: int, data: str | bytes = b"") -> bytes:
    """Return a can_frame; data as bytes or as "43 18 10"."""
    raw = bytes.fromhex(data) if isinstance(data, str) else data
    return _FRAME.pack(can_id, len(raw), raw)


def shown(raw: bytes) -> str:
    """Return a can_frame as text: "582 43 18 10 01 04 00 00 00"."""
    can_id, length, data = _FRAME.unpack(raw)
    return f"{can_id:03X} {data[:length].hex(' ').upper()}".rstrip()


class Host:
    """A host that notes every call of the node, with its time."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []

    def on_nmt(self, state: int, now_ns: int) -> None:
        self.calls.append(("nmt", int(state), now_ns))

    def on_reset(self, whole: bool, now_ns: int) -> None:
        self.calls.append(("reset", whole, now_ns))

    def on_write(self, now_ns: int) -> None:
        self.calls.append(("write", now_ns))

    def on_sync(self, now_ns: int) -> None:
        self.calls.append(("sync", now_ns))

    def before_read(self, now_ns: int) -> None:
        self.calls.append(("read", now_ns))

    def on_heartbeat_lost(self, node_id: int, now_ns: int) -> None:
        self.calls.append(("lost", node_id, now_ns))

    def on_bus_off(self, now_ns: int) -> None:
        self.calls.append(("bus-off", now_ns))

    def names(self) -> list[object]:
        return [call[0] for call in self.calls]


def put(
    od: ObjectDictionary,
    index: int,
    subindex: int,
    data_type: int,
    default: Value | None = None,
    access: str = "rw",
    mappable: bool = False,
    low: int | None = None,
    high: int | None = None,
) -> Variable:
    return od.add(Variable(index, subindex, data_type, "", access, mappable, (low, high), default))


def put_pdo(
    od: ObjectDictionary,
    index: int,
    entries: tuple[int, ...],
    transmission_type: int = 255,
    cob_id: int | None = None,
) -> None:
    """Add PDO `index` (1400h.., 1800h..) with eight mapping entries and all parameters."""
    put(od, index, 0, UNSIGNED8, 5, "ro")
    put(od, index, 1, UNSIGNED32, cob_id)
    put(od, index, 2, UNSIGNED8, transmission_type)
    put(od, index, 3, UNSIGNED16, 0)
    put(od, index, 5, UNSIGNED16, 0)
    put(od, index + 0x200, 0, UNSIGNED8, len(entries))
    for subindex in range(1, 9):
        entry = entries[subindex - 1] if subindex <= len(entries) else 0
        put(od, index + 0x200, subindex, UNSIGNED32, entry)


def dictionary() -> ObjectDictionary:
    """Return a dictionary of communication objects, drive objects and many data types."""
    od = ObjectDictionary()
    put(od, 0x1000, 0, UNSIGNED32, 0x0002_0192, "ro")
    put(od, 0x1001, 0, UNSIGNED8, 0, "ro", mappable=True)
    put(od, 0x1003, 0, UNSIGNED8, 0)
    for subindex in (1, 2, 3):
        put(od, 0x1003, subindex, UNSIGNED32, 0, "ro")
    put(od, 0x1005, 0, UNSIGNED32, 0x80)
    put(od, 0x1008, 0, DataType.VISIBLE_STRING, b"Tiny Node - Mega Domains !", "const")
    put(od, 0x1014, 0, UNSIGNED32, 0x80 + NODE_ID)
    put(od, 0x1016, 0, UNSIGNED8, 2, "ro")
    put(od, 0x1016, 1, UNSIGNED32, 0)
    put(od, 0x1016, 2, UNSIGNED32, 0)
    put(od, 0x1017, 0, UNSIGNED16, 0)
    put(od, 0x1018, 0, UNSIGNED8, 1, "ro")
    put(od, 0x1018, 1, UNSIGNED32, 4, "ro")
    put(od, 0x1029, 0, UNSIGNED8, 1, "ro")
    put(od, 0x1029, 1, UNSIGNED8, 0)
    put(od, 0x2000, 0, DataType.VISIBLE_STRING, b"")
    put(od, 0x2001, 0, DataType.DOMAIN, b"")
    put(od, 0x2002, 0, UNSIGNED8, 0, "wo", mappable=True)
    put(od, 0x2003, 0, BOOLEAN, 0, mappable=True)
    put(od, 0x2004, 0, DataType.INTEGER24, 0, mappable=True)
    put(od, 0x2005, 0, DataType.REAL32, 0.0, mappable=True)
    put(od, 0x2006, 0, DataType.UNSIGNED64, 0, mappable=True)
    put(od, 0x6040, 0, UNSIGNED16, 0, "rww", mappable=True)
    put(od, 0x6041, 0, UNSIGNED16, 0x0240, "ro", mappable=True)
    put(od, 0x6060, 0, INTEGER8, 0, "rww", mappable=True, low=-4, high=10)
    put(od, 0x6064, 0, INTEGER32, 0, "ro", mappable=True)
    put(od, 0x607A, 0, INTEGER32, 0, "rww", mappable=True)
    return od


class Bench:
    """A node and its time. `sent` follows every frame at once unless `is_bus_stuck`."""

    def __init__(
        self,
        od: ObjectDictionary | None = None,
        sdo_reply_ns: int = 1 * MS,
        host: Host | None = None,
    ) -> None:
        self.od = dictionary() if od is None else od
        self.host = Host() if host is None else host
        timing = NodeTiming(300 * MS, sdo_reply_ns, 20 * MS)
        self.node = CanopenNode(self.od, NODE_ID, timing, self.host)
        self.now_ns = 0
        self.is_bus_stuck = False
        self.log: list[tuple[int, str]] = []
        self.node.start(0)

    def tell(self, can_id: int, data: str | bytes = b"") -> None:
        """Pass a frame to the node now."""
        self.node.receive(frame(can_id, data), self.now_ns)
        self.drain()

    def drain(self) -> None:
        """Note the frames of the node and confirm them."""
        frames = self.node.take_output()
        while frames:
            for raw in frames:
                self.log.append((self.now_ns, shown(raw)))
                if not self.is_bus_stuck:
                    self.node.sent(raw, self.now_ns)
            frames = self.node.take_output()

    def run(self, until_ns: int) -> None:
        """Let time pass, deadline by deadline."""
        deadline_ns = self.node.next_deadline_ns()
        while deadline_ns is not None and deadline_ns <= until_ns:
            self.now_ns = max(deadline_ns, self.now_ns)
            self.node.expire(self.now_ns)
            self.drain()
            deadline_ns = self.node.next_deadline_ns()
        self.now_ns = until_ns

    def wait(self, duration_ns: int) -> None:
        self.run(self.now_ns + duration_ns)

    def heard(self) -> list[tuple[int, str]]:
        """Return (time, frame) of the output since the last call."""
        log, self.log = self.log, []
        return log

    def frames(self) -> list[str]:
        """Return the frames since the last call."""
        return [text for _, text in self.heard()]

    def boot(self) -> "Bench":
        """Boot the node to PRE-OPERATIONAL."""
        self.run(300 * MS)
        self.frames()
        self.host.calls.clear()
        return self

    def operate(self) -> "Bench":
        """Bring the node to OPERATIONAL."""
        self.boot()
        self.tell(0x000, bytes((1, NODE_ID)))
        self.frames()
        self.host.calls.clear()
        return self

    def ask(self, request: str) -> str:
        """Send an SDO request and return its response, or "" after the reply time."""
        responses = self.ask_all(request)
        return responses[0] if responses else ""

    def ask_all(self, request: str) -> list[str]:
        """Send an SDO request and return all responses within the reply time."""
        before = len(self.log)
        self.tell(0x600 + NODE_ID, request)
        self.wait(1 * MS)
        responses = [text[4:] for _, text in self.log[before:] if text.startswith("582 ")]
        self.log = [entry for entry in self.log if not entry[1].startswith("582 ")]
        return responses

    def download(self, index: int, subindex: int, value: int, size: int) -> str:
        """Download expedited; return "" on success, else the abort code "0601 0002"."""
        command = 0x23 | (4 - size) << 2
        mux = bytes((command, index & 0xFF, index >> 8, subindex))
        response = self.ask((mux + (value & 0xFFFF_FFFF).to_bytes(4, "little")).hex(" "))
        return "" if response.startswith("60") else abort_code(response)


def abort_code(response: str) -> str:
    """Return the code of an SDO abort as "0601 0002", or another response itself."""
    raw = bytes.fromhex(response)
    if len(raw) != 8 or raw[0] != 0x80:
        return response
    code = int.from_bytes(raw[4:], "little")
    return f"{code >> 16:04X} {code & 0xFFFF:04X}"


def transcript(bench: Bench, text: str) -> None:
    """Play `>` lines (client to server) and compare the `<` lines; `--` comments."""
    for line in text.strip().splitlines():
        line = line.split("--")[0].strip()
        if line.startswith(">"):
            response = bench.ask(line[1:].strip())
        elif line.startswith("<"):
            assert response == line[1:].strip().upper(), line
