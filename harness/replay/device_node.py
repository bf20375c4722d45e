"""Recorded CANopen nodes and Modbus units, as controllers on an emulated bus.

They answer a live host as the recorded ones answered the recorded host; see `ExchangePlayer`. A
request that the recording cannot answer is refused, by an SDO abort or an exception, and reported
as an error. Drives with a protocol of their own are in `device_drive`. A rig names them by the kind
`recorded` (entry point `motorhil.controllers`):

[controller.left]
kind = "recorded"
bus = "can0"
node_id = 1                     # on a line: unit
recording = "bench.mcap"        # relative to the rig's folder
recorded_bus = "can0"           # if the recording has the node on more than one bus
recorded_unit = 255             # on a line: if the recording has it as another unit
bitrate_bit_s = 1_000_000       # of the bus
data_bitrate_bit_s = 2_000_000  # of a bus where it may send CAN FD frames

Source: CiA 301, SDO abort transfer protocol, node guarding protocol (toggle bit); MODBUS over
Serial Line V1.02, section 2; Application Protocol V1.1b3, section 7.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import ClassVar, Final, final

from motorhil.emulators.controller import Controller, ControllerContext
from motorhil.emulators.modbus.rtu import crc16, with_crc
from motorhil.frozen import frozen
from motorhil.harness.replay.device_drive import RecordedDrive, RecordedServo
from motorhil.harness.replay.player import ExchangePlayer
from motorhil.harness.replay.recorded_controller import RecordedController, timed_log
from motorhil.harness.rig.config.buses import BUS_KINDS, ID_MAX, NODE_MAX
from motorhil.settings import REQUIRED, Rule, SettingError, read, text, whole, word
from motorhil.traces.can_frame import EFF, ERR, RTR, classic
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.errors import TraceError
from motorhil.traces.exchange.canopen import (
    SYNC_KEY,
    masked,
    meant,
    nmt_key,
    pdo_key,
    remote_key,
    sdo_key,
    sentence,
)
from motorhil.traces.exchange.drive_kinds import CAN_KINDS, LINE_KINDS, readers_of
from motorhil.traces.exchange.modbus import request_key, role_of
from motorhil.traces.exchange.recording import RecordedExchanges, exchanges_of
from motorhil.traces.exchange.steps import ExchangeLog, Key, Role, Sent, Step
from motorhil.traces.formats.modbus import Adu
from motorhil.traces.mcap.reader import read_trace

KIND: Final = "recorded"
SET_POINTS: Final = ("exact", "any")
_RATE_MAX: Final = 1_000_000
_DATA_RATE_MAX: Final = 20_000_000
_SYNC: Final = 0x080
_SEGMENTS: Final = (0, 3)  # SDO command specifiers of a client
_TOGGLE: Final = 0x80
_NAMED: Final = 0x7FF
_RESETS: Final = (0x81, 0x82)
NO_DATA: Final = 0x0800_0024
"""SDO abort code: no data available."""
_SHORTEST: Final = 4
DEVICE_FAILURE: Final = 4
"""Exception code: server device failure."""


@final
class RecordedNode(RecordedController):
    """Implementation of `motorhil.emulators.controller.Controller` for a recorded CANopen node.

    Args:
        log: the exchange log of the node.
        decoder: the decoder that has seen the recording; it describes received commands.
        node_id: the node-ID on this bus, as in the recording.
        bit_ns: bit time [ns], from which the start of recorded frames is computed.
        note: a remark about the recording, reported at power-on.
        data_bit_ns: data bit time of CAN FD [ns]; 0: its recorded CAN FD frames are left out.

    Attributes:
        player: holds the matched commands and the mismatches.
    """

    def __init__(
        self,
        log: ExchangeLog,
        decoder: CanopenDecoder,
        node_id: int,
        bit_ns: int = 1000,
        note: str = "",
        data_bit_ns: int = 0,
    ) -> None:
        timed, left_out = timed_log(log, bit_ns, data_bit_ns)
        notes = [note] if note else []
        fast = sorted(log.periods_ns.keys() - timed.periods_ns.keys())
        if fast:
            named = ", ".join(f"{one:03X}h every {log.periods_ns[one] / 1e3:g} us" for one in fast)
            notes.append(f"more periodic frames than the bus can carry, so not continued: {named}")
        if left_out:
            notes.append(
                f"{left_out} CAN FD frames of node {node_id} are left out: it is classical"
            )
        super().__init__(ExchangePlayer(timed), "drive", "; ".join(notes))
        self.node_id: Final = node_id
        self._decoder = decoder
        self._dialogue: Step | None = None
        self._turn = 0
        self._set_points: dict[int, bytes] = {}
        self._syncs = frozenset(log.syncs or {_SYNC})
        told = {step.key[1] for step in log.steps if step.key[0] == "pdo"}
        self._pdos = frozenset({*told, *decoder.maps.received_by(node_id)})
        self._remotes = frozenset(step.key[1] for step in log.steps if step.key[0] == "remote")
        self._toggles = _toggles(log, node_id)
        self._toggle: int | None = None  # of its last answer to node guarding

    # ------------------------------------------------------------------------- Controller

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle a frame that was on the bus."""
        can_id = int.from_bytes(data[:4], "little")
        identifier = can_id & _NAMED
        if can_id & (EFF | ERR):
            return
        if can_id & RTR:
            step = self.player.poll(remote_key(identifier), now_ns)
            if step is not None and identifier == 0x700 + self.node_id and self._toggles:
                self.player.answer([self._toggled(one) for one in step.answers], now_ns)
            else:
                self._answer(step, now_ns)
        elif identifier == 0:
            self._nmt(data, now_ns)
        elif identifier in self._syncs and data[4] < 2:
            self._sync(now_ns)
        elif identifier == 0x600 + self.node_id:
            self._request(data, now_ns)
        else:
            self._set_point(identifier, data, now_ns)
        self._take(now_ns)

    def expire(self, now_ns: int) -> None:
        """Send the frames that are due."""
        self._take(now_ns)

    def identifiers(self) -> Sequence[int] | None:
        """Return the identifiers that the recorded node received, and its SDO server's."""
        plain = {0, *self._syncs, 0x600 + self.node_id, *self._pdos}
        return sorted(plain | {RTR | identifier for identifier in self._remotes})

    # ------------------------------------------------------------------------------ inside

    def _nmt(self, data: bytes, now_ns: int) -> None:
        if data[4] < 2 or data[9] not in (0, self.node_id):
            return
        if data[8] in _RESETS:
            self._begin_anew()
        before = self.player.matched
        self._command(nmt_key(data[8:10]), data, now_ns)
        if self.player.matched > before:
            self.player.forget_latest()

    def _take(self, now_ns: int) -> None:
        """Send the due frames; after a boot-up message, forget all received values."""
        boot_up = (0x700 + self.node_id).to_bytes(4, "little")
        for frame in self.player.take(now_ns):
            self._output.append(frame)
            if frame[:4] == boot_up and frame[4] == 1 and not frame[8]:
                self._begin_anew()
                self.player.forget()

    def _begin_anew(self) -> None:
        self._set_points.clear()
        self._dialogue = None
        self._toggle = None

    def _toggled(self, one: Sent) -> Sent:
        """Return a node guarding answer with its toggle bit inverted since the last one."""
        state = one.data[8]
        self._toggle = state & _TOGGLE if self._toggle is None else self._toggle ^ _TOGGLE
        data = bytes([state & ~_TOGGLE | self._toggle])
        return one._replace(data=one.data[:8] + data + one.data[9:])

    def _mask(self, identifier: int) -> bytes | None:
        """Return the mask of a PDO's relevant bits at this point of the recording."""
        masks = self.player.log.masks.get(identifier)
        if not masks:
            return None
        gone = self.player.commands_gone()
        return next((mask for first, mask in reversed(masks) if first <= gone), masks[0][1])

    def _set_point(self, identifier: int, frame: bytes, now_ns: int) -> None:
        mask = self._mask(identifier)
        told = frame if mask is None else masked(frame, mask)
        if self._set_points.get(identifier) != told:
            self._set_points[identifier] = told
            self._command(pdo_key(identifier, told), frame, now_ns)

    def _sync(self, now_ns: int) -> None:
        """Handle a SYNC: a command if the recorded one triggered something, else a poll."""
        if self.player.is_next(SYNC_KEY):
            step = self.player.command(SYNC_KEY, now_ns)
        else:
            step = self.player.poll(SYNC_KEY, now_ns)
        self._answer(step, now_ns)

    def _answer(self, step: Step | None, now_ns: int) -> None:
        """Send the answer to a SYNC or a remote frame, if it is known."""
        if step is not None:
            self.player.answer(step.answers, now_ns)

    def _command(self, key: Key, frame: bytes, now_ns: int) -> None:
        if self.player.command(key, now_ns) is None:
            self._refuse(key, frame, now_ns)

    def _request(self, frame: bytes, now_ns: int) -> None:
        """Handle a frame of the SDO client: continue the current transfer, or begin one."""
        step = self._dialogue
        if step is not None and self._turn < len(step.turns):
            turn = step.turns[self._turn]
            if _is_same(step, turn.asked, frame):
                self._turn += 1
                self.player.answer(turn.answers, now_ns)
                return
        data = frame[8:16]
        if data[0] == 0x80:
            self._dialogue = None
            self.player.forget_answers(0x580 + self.node_id)
            return
        key, place = sdo_key(data), data[1:4]
        if step is not None and data[0] >> 5 in _SEGMENTS:  # segments do not name their object
            place = step.key[2][1:4]
        step = self._find(key, data, now_ns)
        if step is None or not step.turns:
            self._dialogue = None
            self._refuse(key, frame, now_ns)
            abort = b"\x80" + place + NO_DATA.to_bytes(4, "little")
            self.player.answer([Sent(0, classic(0x580 + self.node_id, abort))], now_ns)
            return
        self._dialogue, self._turn = step, 1
        self.player.answer(step.turns[0].answers, now_ns)

    def _find(self, key: Key, data: bytes, now_ns: int) -> Step | None:
        """Find the recorded step for a request; a write is a command, a read is a poll."""
        kind = data[0] >> 5
        if kind == 2 or (kind == 5 and not data[0] & 0x03):
            return self.player.poll(key, now_ns)
        if kind == 1 or (kind == 6 and not data[0] & 0x01):
            return self.player.command(key, now_ns)
        return None

    def _refuse(self, key: Key, frame: bytes, now_ns: int) -> None:
        mismatch = self.player.refuse(key, self._decoder.decode(frame).text, now_ns)
        expected = mismatch.expected
        if expected is not None:
            expected.text = sentence(expected, self._decoder)
        self._events.append(("error", str(mismatch)))


def _toggles(log: ExchangeLog, node_id: int) -> bool:
    """Return True if the node guarding answers alternate, as the standard requires."""
    key = remote_key(0x700 + node_id)
    bits = [one.data[8] & _TOGGLE for step in log.steps if step.key == key for one in step.answers]
    return 2 * sum(a != b for a, b in pairwise(bits)) >= len(bits) - 1


def _is_same(step: Step, recorded: bytes, frame: bytes) -> bool:
    """Return True if a frame continues a transfer as recorded, in its relevant bits."""
    if recorded == frame:
        return True
    is_block_download = step.turns[0].asked[8] >> 5 == 6
    same_head = recorded[:8] == frame[:8]
    return not is_block_download and same_head and meant(recorded[8:]) == meant(frame[8:])


@final
class RecordedUnit(RecordedController):
    """Implementation of `motorhil.emulators.controller.Controller` for a recorded Modbus unit.

    Args:
        log: the exchange log of the unit.
        unit: its server address on this line.

    Attributes:
        player: holds the matched commands and the mismatches.
    """

    def __init__(self, log: ExchangeLog, unit: int, note: str = "") -> None:
        super().__init__(ExchangePlayer(log), "unit", note)
        self.unit: Final = unit

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle the bytes between two silences on the line; b"": they were corrupted."""
        if len(data) < _SHORTEST or crc16(data[:-2]) != data[-2:]:
            return
        if data[0] not in (0, self.unit):
            return
        pdu = data[1:-2]
        key = request_key(pdu)
        is_command = role_of(pdu) is Role.COMMAND
        step = self.player.command(key, now_ns) if is_command else self.player.poll(key, now_ns)
        if step is not None:
            if data[0] and step.turns:
                self.player.answer(step.turns[0].answers, now_ns)
        else:
            adu = Adu(now_ns, None, True, 0, data[0], pdu)
            mismatch = self.player.refuse(key, ModbusDecoder().decode(adu).text, now_ns)
            self._events.append(("error", str(mismatch)))
            if data[0]:
                refusal = bytes([self.unit, pdu[0] | 0x80, DEVICE_FAILURE])
                self.player.answer([Sent(0, refusal)], now_ns)
        self.expire(now_ns)

    def expire(self, now_ns: int) -> None:
        """Send the frames that are due."""
        address = bytes([self.unit])  # the recording may have another address
        self._output += [with_crc(address + frame[1:]) for frame in self.player.take(now_ns)]

    def identifiers(self) -> Sequence[int] | None:
        """Return None: every unit on a line hears everything."""
        return None


@final
@frozen(kw_only=True, slots=False)
class RecordedTable:
    """A controller that a recording stands in for."""

    recording: str = text(
        REQUIRED, "The recording, from the rig's folder on.", example='"bench.mcap"'
    )
    node_id: int | None = whole(None, 0, NODE_MAX, "", "Its node-ID, on a CAN bus.")
    unit: int | None = whole(None, 1, ID_MAX, "", "Its server address or id, on a line.")
    recorded_bus: str | None = text(None, "Its bus in the recording, if there are several.")
    recorded_unit: int | None = whole(None, 0, 255, "", "Its address there; absent: unit.")
    set_points: str = word("exact", SET_POINTS, "comparison", "Comparison of set-points.")
    bitrate_bit_s: int = whole(
        _RATE_MAX,
        1000,
        _RATE_MAX,
        "bit/s",
        "Bit rate of its frames.",
        plausible=(10_000, _RATE_MAX),
    )
    data_bitrate_bit_s: int | None = whole(
        None,
        1000,
        _DATA_RATE_MAX,
        "bit/s",
        "Bit rate of the data of its CAN FD frames.",
        plausible=(100_000, _DATA_RATE_MAX),
    )

    RULES: ClassVar = (
        Rule("unit", otherwise=True, required=("node_id",), remedy="write node_id, or unit"),
    )

    def __post_init__(self) -> None:
        """Refuse a data bit rate below the nominal one (SettingError)."""
        if (self.data_bitrate_bit_s or self.bitrate_bit_s) < self.bitrate_bit_s:
            message = f"{self.data_bitrate_bit_s} bit/s is below {self.bitrate_bit_s} bit/s"
            raise SettingError(("data_bitrate_bit_s",), message, "exchange them")


def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the controller that a rig describes.

    Args:
        settings: its table without `kind` and `bus`.
        context: its name, the folder of relative paths, and the seed.

    Raises:
        SettingError: a key or value is wrong, or the recording has no such controller.
    """
    own = read(RecordedTable, settings)
    is_unit = own.unit is not None
    number = own.node_id if own.unit is None else own.unit
    assert number is not None
    path, found = _recording(own, context.folder)
    recorded = number
    if is_unit and own.recorded_unit is not None:  # TCP servers may use 0 or 255
        recorded = own.recorded_unit
    log = _log(path, found, own.recorded_bus, recorded, is_unit)
    note = ""
    if found.cut and log is next(iter(found.logs.values())):  # reported only once
        note = f"{path} is {found.cut}; commands behind that are not in it"
    table, is_any = found.drives.get((log.bus, recorded)), own.set_points == SET_POINTS[1]
    is_known = table is not None and table["kind"] in (LINE_KINDS if is_unit else CAN_KINDS)
    readers = readers_of(str(table["kind"]), recorded, table) if table and is_known else None
    if is_unit and readers is not None:
        if number != recorded:
            problem = f"{recorded} is not unit {number}; the packets of a servo have its id"
            raise SettingError(("recorded_unit",), problem, "leave it out")
        return RecordedServo(log, number, readers, note, is_any)
    if is_unit:
        return RecordedUnit(log, number, note)
    bit_ns = 1_000_000_000 // own.bitrate_bit_s
    data_bit_ns = 0 if own.data_bitrate_bit_s is None else 1_000_000_000 // own.data_bitrate_bit_s
    if readers is not None:
        return RecordedDrive(log, readers, bit_ns, note, data_bit_ns, is_any)
    # Decoding changes a decoder, and `found` is that of all rigs of this process.
    decoder = deepcopy(found.decoders[log.bus])
    return RecordedNode(log, decoder, number, bit_ns, note, data_bit_ns)


build.bus_kinds = BUS_KINDS  # type: ignore[attr-defined]  # how a plugin says where it can be


def _recording(own: RecordedTable, folder: Path) -> tuple[Path, RecordedExchanges]:
    path = folder / own.recording
    try:
        return path, recorded_exchanges(path, own.set_points == SET_POINTS[1])
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        remedy = "paths are relative to the rig's folder"
        raise SettingError(("recording",), f"{path}: {reason}", remedy) from None
    except TraceError as error:
        raise SettingError(("recording",), str(error)) from None


def recorded_exchanges(path: Path, any_set_point: bool = False) -> RecordedExchanges:
    """Return the exchange logs in a file, which is read once for all its controllers.

    Raises:
        OSError: the file does not exist.
        TraceError: the file cannot be read.
    """
    about = path.stat()
    return _exchanges(path, about.st_mtime_ns, about.st_size, any_set_point)


@lru_cache(maxsize=2)
def _exchanges(path: Path, modified_ns: int, size: int, any_set_point: bool) -> RecordedExchanges:
    """Return all exchange logs of a file in its present version."""
    with read_trace(path) as trace:
        return exchanges_of(trace, any_set_point)


def _log(
    path: Path, found: RecordedExchanges, bus: str | None, number: int, is_unit: bool
) -> ExchangeLog:
    word = "unit" if is_unit else "node"
    fitting = {
        where: log
        for (where, of), log in found.logs.items()
        if of == number and (where in found.decoders) is not is_unit and bus in (None, where)
    }
    if len(fitting) == 1:
        return next(iter(fitting.values()))
    if fitting:
        several = ", ".join(fitting)
        problem = f"{path} has {word} {number} on several buses: {several}"
        raise SettingError(("recorded_bus",), "is missing", f"name one of them; {problem}")
    known = ", ".join(
        f"{of} on {where}" for where, of in found.logs if (where in found.decoders) is not is_unit
    )
    on = f" on {bus}" if isinstance(bus, str) else ""
    raise SettingError(
        ("recording",),
        f"{path} has no data of {word} {number}{on}",
        f"available: {word}s {known}" if known else f"it has no {word}s",
    )
