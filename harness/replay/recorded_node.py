"""Recorded CANopen node, as a controller on an emulated bus.

The node answers a live host as the recorded node answered the recorded host; see `TapePlayer`. A
request that the recording cannot answer is refused by an SDO abort and reported as an error of this
node.

Source: CiA 301, SDO abort transfer protocol, node guarding protocol (toggle bit).
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final, final

from emulators.media.can_bits import INTERMISSION_BITS, measure, phases_of
from emulators.media.can_frame import FRAME_BYTES
from emulators.media.can_port import LENGTHS_MASK
from harness.replay.player import TapePlayer
from harness.replay.recorded_controller import RecordedController
from traces.canopen_tapes import (
    SYNC_KEY,
    masked,
    meant,
    nmt_key,
    pdo_key,
    remote_key,
    sdo_key,
    sentence,
)
from traces.decode_canopen import CanopenDecoder
from traces.tape import Key, Sent, Step, Tape
from traces.traffic import EFF, ERR, RTR, classic

_SYNC: Final = 0x080
_SEGMENTS: Final = (0, 3)  # SDO command specifiers of a client
_TOGGLE: Final = 0x80
_NAMED: Final = 0x7FF
_RESETS: Final = (0x81, 0x82)
NO_DATA: Final = 0x0800_0024
"""SDO abort code: no data available."""


@final
class RecordedNode(RecordedController):
    """Implementation of `emulators.controller.Controller` for a recorded CANopen node.

    Args:
        tape: the exchange log of the node.
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
        tape: Tape,
        decoder: CanopenDecoder,
        node_id: int,
        bit_ns: int = 1000,
        note: str = "",
        data_bit_ns: int = 0,
    ) -> None:
        timed, left_out = _timed(tape, bit_ns, data_bit_ns)
        notes = [note] if note else []
        if left_out:
            notes.append(
                f"{left_out} CAN FD frames of node {node_id} are left out: it is classical"
            )
        super().__init__(TapePlayer(timed), "drive", "; ".join(notes))
        self.node_id: Final = node_id
        self._decoder = decoder
        self._dialogue: Step | None = None
        self._turn = 0
        self._set_points: dict[int, bytes] = {}
        self._syncs = frozenset(tape.syncs or {_SYNC})
        told = {step.key[1] for step in tape.steps if step.key[0] == "pdo"}
        self._pdos = frozenset({*told, *decoder.maps.received_by(node_id)})
        self._remotes = frozenset(step.key[1] for step in tape.steps if step.key[0] == "remote")
        self._toggles = _toggles(tape, node_id)
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
        return replace(one, data=one.data[:8] + data + one.data[9:])

    def _mask(self, identifier: int) -> bytes | None:
        """Return the mask of a PDO's relevant bits at this point of the recording."""
        masks = self.player.tape.masks.get(identifier)
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


def _toggles(tape: Tape, node_id: int) -> bool:
    """Return True if the node guarding answers alternate, as the standard requires."""
    key = remote_key(0x700 + node_id)
    bits = [one.data[8] & _TOGGLE for step in tape.steps if step.key == key for one in step.answers]
    return 2 * sum(a != b for a, b in pairwise(bits)) >= len(bits) - 1


def _is_same(step: Step, recorded: bytes, frame: bytes) -> bool:
    """Return True if a frame continues a transfer as recorded, in its relevant bits."""
    if recorded == frame:
        return True
    is_block_download = step.turns[0].asked[8] >> 5 == 6
    same_head = recorded[:8] == frame[:8]
    return not is_block_download and same_head and meant(recorded[8:]) == meant(frame[8:])


def _timed(tape: Tape, bit_ns: int, data_bit_ns: int) -> tuple[Tape, int]:
    """Return the log with frame durations at these bit times, and the number of omitted frames."""
    left_out = 0

    def length_ns(frame: bytes) -> int:
        nominal, data = phases_of(measure(frame) & LENGTHS_MASK)
        return (nominal - INTERMISSION_BITS) * bit_ns + data * data_bit_ns

    def timed(sent: list[Sent]) -> list[Sent]:
        nonlocal left_out
        kept = [one for one in sent if data_bit_ns or len(one.data) == FRAME_BYTES]
        left_out += len(sent) - len(kept)
        return [replace(one, duration_ns=length_ns(one.data)) for one in kept]

    steps = [
        replace(
            step,
            reactions=timed(step.reactions),
            answers=timed(step.answers),
            turns=[replace(turn, answers=timed(turn.answers)) for turn in step.turns],
        )
        for step in tape.steps
    ]
    return replace(tape, steps=steps), left_out
