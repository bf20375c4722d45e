"""One Modbus line or connection of the report: its load and its exceptions."""

from typing import Final, final

from harness.report.incidents import Incidents, Severity
from harness.report.traffic import Traffic
from traces.decode_modbus import ModbusDecoder, adu_of
from traces.protobuf import Value
from traces.recorded_names import RecordedNames
from traces.schema import Direction

_FUNCTIONS: Final = {
    1: "read coils",
    2: "read discrete inputs",
    3: "read registers",
    4: "read input registers",
    5: "write coil",
    6: "write register",
    8: "diagnostics",
    15: "write coils",
    16: "write registers",
    22: "mask register",
    23: "read and write registers",
    43: "encapsulated interface",
}
_NS: Final = 1e9


@final
class ModbusLine:
    """Collector of the ADUs of one line.

    Attributes:
        traffic: the load; in ns of occupation on a serial line, otherwise in bits of ADUs.
    """

    def __init__(self, name: str, tcp: bool, names: RecordedNames, incidents: Incidents) -> None:
        """Set up the collector; events go to `incidents`; `tcp`: the framing is MBAP."""
        if tcp:
            why = "a TCP connection has no bit rate of its own"
            self.traffic = Traffic(name, "Modbus/TCP", "bit", None, why)
        else:
            self.traffic = Traffic(name, "Modbus RTU", "ns", _NS)
        self._name = name
        self._incidents = incidents
        self._units = {n: c for (bus, n), c in names.nodes.items() if bus == name}
        self._decoder = ModbusDecoder(self._units)
        self._labels: dict[tuple[int, int, bool], int] = {}

    def take(self, time_ns: int, fields: dict[str, Value], begin_ns: int) -> None:
        """Take a recorded ADU; `time_ns` counts from `begin_ns`, unlike the times in its fields."""
        data = fields.get("data", b"")
        assert isinstance(data, bytes)
        to_server = fields.get("direction") == Direction.TRANSMITTED
        start_ns, end_ns = fields.get("start_ns", 0), fields.get("end_ns", 0)
        assert isinstance(start_ns, int)
        assert isinstance(end_ns, int)
        tcp = bool(fields.get("tcp"))
        adu, problem = adu_of(time_ns, data, tcp=tcp, to_server=to_server)
        if fields.get("spoiled"):
            adu, problem = None, "corrupted on the line"
        is_busy = self.traffic.unit == "ns" and end_ns > start_ns
        weight = end_ns - start_ns if is_busy else 8 * len(data)
        if self.traffic.unit == "ns" and not is_busy:
            weight = 0
        ended_ns = end_ns - begin_ns if is_busy else time_ns
        self.traffic.add(ended_ns, self._label(data, tcp, to_server, adu is None), weight)
        if adu is None:
            text = f"no ADU ({problem}): {data.hex(' ').upper()}"
            self._incidents.add(time_ns, Severity.WARNING, "no Modbus ADU", self._name, text)
            return
        sender = str(fields.get("sender", ""))
        if not to_server and sender:
            self._decoder.call(adu.unit, sender)
        said = self._decoder.decode(adu)
        if said.facts and said.facts[0].subject.endswith("refused"):
            self._incidents.add(
                time_ns, Severity.WARNING, "Modbus exception", self._name, said.text
            )

    def _label(self, data: bytes, tcp: bool, to_server: bool, broken: bool) -> int:
        at = 6 if tcp else 0
        unit, function = (-1, 0) if broken or len(data) < at + 2 else (data[at], data[at + 1])
        key = (unit, function & 0x7F, to_server)
        found = self._labels.get(key)
        if found is None:
            found = self._labels[key] = self._new_label(*key)
        return found

    def _new_label(self, unit: int, function: int, to_server: bool) -> int:
        if unit < 0:
            return self.traffic.label("broken", 1 << 30)
        way = "request" if to_server else "response"
        rank = unit << 16 | function << 1 | (not to_server)
        what = _FUNCTIONS.get(function, f"function {function:02X}h")
        return self.traffic.label(f"unit {unit} {function:02X}h {way}", rank, what)
