"""SDO server (CiA 301, 7.2.4): expedited, segmented and block transfers, aborts.

The state is one of five: idle, or an upload or a download, in segments or in blocks. A new initiate
request replaces the current transfer, except between the segments of a block download, which have
no command. If the client is silent for `TIMEOUT_NS` during a transfer, the server aborts it (0504
0000h). Every response is sent `reply_ns` after its request. Values are read and written at the time
of the request.

Block transfer (CiA 301, 7.2.4.3.9 to 7.2.4.3.15): a block has up to 127 segments of 7 bytes,
numbered from 1, and is confirmed as a whole. The receiver reports the last number that arrived in
sequence, and the size of the next block. Segments behind a gap are sent again. The last segment
carries a flag. The end message has the number of its valid bytes, and the CRC of all data if both
sides support it.
"""

from collections import deque
from struct import Struct
from typing import Final, final

from motorhil.emulators.canopen.codes import INVALID, AbortCode
from motorhil.emulators.canopen.object_dictionary import DictionaryAccess, ObjectDictionary
from motorhil.emulators.canopen.outbox import MS, NEVER, Outbox

SEGMENT_BYTES: Final = 7
BLOCK_MAX: Final = 127

_LAST: Final = 0x80
_POLYNOMIAL: Final = 0x1021

MAX_DOWNLOAD_BYTES: Final = 1 << 20
TIMEOUT_NS: Final = 1_000 * MS  # as in CANopenNode; CiA 301 does not define a time

_BLOCK_RESPONSE: Final = Struct("<IB3xBBB5s")
_RESPONSE: Final = Struct("<IB3xBHB4s")  # an SDO frame with command, index, sub-index and 4 bytes
_SEGMENT: Final = Struct("<IB3xB7s")

# Client command specifiers, bits 7..5 of the command byte
_DOWNLOAD_SEGMENT: Final = 0
_DOWNLOAD: Final = 1
_UPLOAD: Final = 2
_UPLOAD_SEGMENT: Final = 3
_ABORT: Final = 4
_BLOCK_UPLOAD: Final = 5
_BLOCK_DOWNLOAD: Final = 6

_BLOCK_SEGMENTS: Final = 8  # a state, not a specifier: frames of a block download

# Client subcommands of block transfers, and flags of their content. The expected subcommand of a
# block upload, added to _BLOCK_UPLOADS, is a state.
_BLOCK_UPLOADS: Final = 16
_END: Final = 1
_CONFIRM: Final = 2
_START: Final = 3
_HAS_CRC: Final = 4
_HAS_SIZE: Final = 2

_IDLE: Final = -1

_TOGGLE: Final = 0x10
_ABORTED: Final = 0x80


def _table() -> list[int]:
    out: list[int] = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = crc << 1 ^ _POLYNOMIAL if crc & 0x8000 else crc << 1
        out.append(crc & 0xFFFF)
    return out


_CRC: Final = _table()


def block_crc(data: bytes) -> int:
    """Return the CRC of a block transfer: x^16 + x^12 + x^5 + 1, from 0 (CiA 301, 7.2.4.3.16)."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC[crc >> 8 ^ byte]
    return crc


@final
class BlockDownload:
    """Collects the data that a client sends in blocks.

    Attributes:
        expected: the announced number of bytes, or None.
        block_size: the maximum number of segments in a block.
        is_complete: the last segment has arrived; the end message is expected.
    """

    def __init__(self, expected: int | None, has_crc: bool, limit: int) -> None:
        """Expect this many bytes (None: unknown), `limit` at most, with or without a CRC."""
        self.block_size = BLOCK_MAX
        self.is_complete: bool = False
        self.expected = expected
        self._has_crc = has_crc
        self._limit = limit
        self._data = bytearray()
        self._good = 0  # number of the last segment in sequence, in this block

    def segment(self, head: int, data: bytes) -> int | None:
        """Return the number to confirm if the block is over, else None.

        Segments behind a gap are dropped; the client learns this at the end of the block.
        """
        number = head & ~_LAST
        if number == self._good + 1:
            self._good = number
            self._data += data
            if head & _LAST:
                self.is_complete = True
        if number < self.block_size and not head & _LAST:
            return None
        good, self._good = self._good, 0
        return good

    def overflows(self) -> bool:
        """Return whether more data have arrived than allowed."""
        most = self._limit if self.expected is None else self.expected
        return len(self._data) >= most + SEGMENT_BYTES

    def end(self, unused: int, crc: int) -> bytes | AbortCode:
        """Return all data without the unused bytes of the last segment, or an abort code."""
        data = bytes(self._data[: len(self._data) - unused])
        if self._has_crc and block_crc(data) != crc:
            return AbortCode.CRC_ERROR
        if self.expected is not None and len(data) != self.expected:
            too_low = len(data) < self.expected
            return AbortCode.LENGTH_TOO_LOW if too_low else AbortCode.LENGTH_TOO_HIGH
        return data


@final
class BlockUpload:
    """Sends a value in blocks."""

    def __init__(self, data: bytes, block_size: int, has_crc: bool) -> None:
        """Send blocks of this many segments, with or without a CRC at the end."""
        self._data = data
        self._block_size = block_size
        self._has_crc = has_crc
        self._begun = 0  # start of the unconfirmed block in the data
        self._sent = 0  # segments of this block

    def block(self) -> list[tuple[int, bytes]]:
        """Return the segments of the next block: head and up to 7 bytes each."""
        out: list[tuple[int, bytes]] = []
        at = self._begun
        while len(out) < self._block_size:
            part = self._data[at : at + SEGMENT_BYTES]
            at += SEGMENT_BYTES
            is_last = at >= len(self._data)
            out.append((len(out) + 1 | (_LAST if is_last else 0), part))
            if is_last:
                break
        self._sent = len(out)
        return out

    def confirm(self, good: int, block_size: int) -> AbortCode | None:
        """Confirm `good` segments and set the next block size; return an abort code or None."""
        if good > self._sent:
            return AbortCode.INVALID_SEQUENCE_NUMBER
        if not 1 <= block_size <= BLOCK_MAX:
            return AbortCode.INVALID_BLOCK_SIZE
        self._begun += good * SEGMENT_BYTES
        self._block_size = block_size
        return None

    def is_over(self) -> bool:
        """Return whether all data are confirmed."""
        return self._begun >= len(self._data) and self._begun > 0

    def end(self) -> tuple[int, int]:
        """Return (number of unused bytes in the last segment, CRC or 0)."""
        return -len(self._data) % SEGMENT_BYTES if self._data else SEGMENT_BYTES, (
            block_crc(self._data) if self._has_crc else 0
        )


def sdo_can_id(od: ObjectDictionary, subindex: int, default: int) -> int:
    """Return the identifier in 1200h, or that of the default SDO channel if it is not valid."""
    cob_id = od.integer(0x1200, subindex, 0)
    return default if not cob_id & 0x7FF or cob_id & INVALID else cob_id & 0x7FF


@final
class SdoServer:
    """One SDO channel. `receive` takes requests; `expire` sends the responses when due."""

    def __init__(self, access: DictionaryAccess, reply_ns: int, outbox: Outbox) -> None:
        self._access = access
        self._reply_ns = reply_ns
        self._outbox = outbox
        self._response_id = 0
        self._replies: deque[tuple[int, bytes]] = deque()
        self.deadline_ns: int = NEVER
        self._timeout_ns: int = NEVER  # when an abandoned transfer is aborted
        self._state: int = _IDLE  # or the expected command, as _UPLOAD_SEGMENT
        self._index = 0
        self._subindex = 0
        self._toggle = 0
        self._data = b""  # rest of the upload
        self._parts: list[bytes] = []  # parts of the download
        self._collected = 0
        self._expected: int | None = None
        self._incoming: BlockDownload | None = None
        self._outgoing: BlockUpload | None = None

    def configure(self, response_id: int) -> None:
        """Set the identifier of the responses."""
        self._response_id = response_id

    def stop(self) -> None:
        """Drop the transfer and all pending responses."""
        self._end()
        self._replies.clear()
        self.deadline_ns = NEVER
        self._outbox.deadlines_moved = True

    def receive(self, frame: bytes, now_ns: int) -> None:
        """Process a request."""
        if frame[4] != 8:
            return  # an SDO always has 8 bytes
        command = frame[8]
        specifier = command >> 5
        if self._state == _BLOCK_SEGMENTS and command != _ABORTED:
            self._block_segment(command, frame, now_ns)
        elif specifier == _UPLOAD:
            self._begin_upload(frame[9] | frame[10] << 8, frame[11], now_ns)
        elif specifier == _DOWNLOAD:
            self._begin_download(command, frame, now_ns)
        elif specifier == _UPLOAD_SEGMENT:
            self._upload_segment(command, now_ns)
        elif specifier == _DOWNLOAD_SEGMENT:
            self._download_segment(command, frame, now_ns)
        elif specifier == _ABORT:
            self._end()
        elif specifier == _BLOCK_UPLOAD:
            self._block_upload(command, frame, now_ns)
        elif specifier == _BLOCK_DOWNLOAD:
            self._block_download(command, frame, now_ns)
        else:
            self._abort(AbortCode.COMMAND_SPECIFIER_UNKNOWN, now_ns)

    def expire(self, now_ns: int) -> None:
        """Send the responses due by now."""
        if self._timeout_ns <= now_ns:
            self._abort(AbortCode.PROTOCOL_TIMED_OUT, now_ns)
        replies = self._replies
        while replies and replies[0][0] <= now_ns:
            self._outbox.frames.append(replies.popleft()[1])
        self.deadline_ns = replies[0][0] if replies else self._timeout_ns
        self._outbox.deadlines_moved = True

    def _begin_upload(self, index: int, subindex: int, now_ns: int) -> None:
        self._begin(index, subindex)
        data = self._access.upload(index, subindex, now_ns)
        if isinstance(data, int):
            self._abort(data, now_ns)
            return
        size = len(data)
        if 0 < size <= 4:
            self._index = self._subindex = 0  # transfer complete
            command = 0x43 | (4 - size) << 2  # expedited, size indicated
        else:
            self._state = _UPLOAD_SEGMENT
            self._wait(now_ns)
            self._data = data
            command = 0x41
            data = size.to_bytes(4, "little")
        self._reply(_RESPONSE.pack(self._response_id, 8, command, index, subindex, data), now_ns)

    def _upload_segment(self, command: int, now_ns: int) -> None:
        if self._state != _UPLOAD_SEGMENT:
            self._abort(AbortCode.COMMAND_SPECIFIER_UNKNOWN, now_ns)
        elif command & _TOGGLE != self._toggle:
            self._abort(AbortCode.TOGGLE_BIT_NOT_ALTERNATED, now_ns)
        else:
            part = self._data[:7]
            self._data = self._data[7:]
            response = self._toggle | (7 - len(part)) << 1
            self._toggle ^= _TOGGLE
            if not self._data:
                response |= 1
                self._end()
            else:
                self._wait(now_ns)
            self._reply(_SEGMENT.pack(self._response_id, 8, response, part), now_ns)

    def _begin_download(self, command: int, frame: bytes, now_ns: int) -> None:
        index, subindex = frame[9] | frame[10] << 8, frame[11]
        is_sized = command & 1 != 0
        self._begin(index, subindex)
        if command & 2:  # expedited
            size = 4 - (command >> 2 & 3) if is_sized else self._access.size_bytes(index, subindex)
            data = frame[12 : 12 + size] if 0 < size <= 4 else frame[12:16]
            code = self._access.download(index, subindex, data, now_ns)
            if code == 0:
                self._accept(now_ns)
                self._end()
            else:
                self._abort(code, now_ns)
            return
        expected = int.from_bytes(frame[12:16], "little") if is_sized else None
        if self._refuses(index, subindex, expected, now_ns):
            return
        self._state = _DOWNLOAD_SEGMENT
        self._wait(now_ns)
        self._expected = expected
        self._accept(now_ns)

    def _refuses(self, index: int, subindex: int, expected: int | None, now_ns: int) -> bool:
        """Abort a download of this size (None: unknown) that cannot begin; return True then."""
        code = self._access.refusal(index, subindex, expected)
        if code == 0 and expected is not None and expected > MAX_DOWNLOAD_BYTES:
            code = AbortCode.OUT_OF_MEMORY
        if code:
            self._abort(code, now_ns)
        return code != 0

    def _download_segment(self, command: int, frame: bytes, now_ns: int) -> None:
        if self._state != _DOWNLOAD_SEGMENT:
            self._abort(AbortCode.COMMAND_SPECIFIER_UNKNOWN, now_ns)
            return
        if command & _TOGGLE != self._toggle:
            self._abort(AbortCode.TOGGLE_BIT_NOT_ALTERNATED, now_ns)
            return
        part = frame[9 : 16 - (command >> 1 & 7)]
        self._parts.append(part)
        self._collected += len(part)
        is_last = command & 1 != 0
        code = self._judge(is_last)
        if code == 0 and is_last:
            data = b"".join(self._parts)
            code = self._access.download(self._index, self._subindex, data, now_ns)
        if code:
            self._abort(code, now_ns)
            return
        response = 0x20 | self._toggle
        self._toggle ^= _TOGGLE
        if is_last:
            self._end()
        else:
            self._wait(now_ns)
        self._reply(_SEGMENT.pack(self._response_id, 8, response, b""), now_ns)

    # --- block transfers

    def _block_download(self, command: int, frame: bytes, now_ns: int) -> None:
        """Begin or end a block download."""
        if command & 1:
            self._end_block_download(command, frame, now_ns)
            return
        index, subindex = frame[9] | frame[10] << 8, frame[11]
        self._begin(index, subindex)
        expected = int.from_bytes(frame[12:16], "little") if command & _HAS_SIZE else None
        if self._refuses(index, subindex, expected, now_ns):
            return
        self._state = _BLOCK_SEGMENTS
        self._wait(now_ns)
        self._incoming = BlockDownload(expected, command & _HAS_CRC != 0, MAX_DOWNLOAD_BYTES)
        size = bytes((self._incoming.block_size,))
        self._reply(_RESPONSE.pack(self._response_id, 8, 0xA4, index, subindex, size), now_ns)

    def _block_segment(self, command: int, frame: bytes, now_ns: int) -> None:
        incoming = self._incoming
        assert incoming is not None
        if not 1 <= command & 0x7F <= incoming.block_size:
            self._abort(AbortCode.INVALID_SEQUENCE_NUMBER, now_ns)
            return
        self._wait(now_ns)
        good = incoming.segment(command, frame[9:16])
        if incoming.overflows():
            is_told = incoming.expected is not None
            self._abort(AbortCode.LENGTH_TOO_HIGH if is_told else AbortCode.OUT_OF_MEMORY, now_ns)
        elif good is not None:
            if incoming.is_complete:
                self._state = _BLOCK_DOWNLOAD
            head = (self._response_id, 8, 0xA2, good, incoming.block_size, b"")
            self._reply(_BLOCK_RESPONSE.pack(*head), now_ns)

    def _end_block_download(self, command: int, frame: bytes, now_ns: int) -> None:
        incoming = self._incoming
        if self._state != _BLOCK_DOWNLOAD or incoming is None:
            self._abort(AbortCode.COMMAND_SPECIFIER_UNKNOWN, now_ns)
            return
        data = incoming.end(command >> 2 & 7, frame[9] | frame[10] << 8)
        code: int = data if isinstance(data, AbortCode) else AbortCode.OK
        if isinstance(data, bytes):
            code = self._access.download(self._index, self._subindex, data, now_ns)
        if code:
            self._abort(code, now_ns)
            return
        self._end()
        self._reply(_SEGMENT.pack(self._response_id, 8, 0xA1, b""), now_ns)

    def _block_upload(self, command: int, frame: bytes, now_ns: int) -> None:
        """Begin or continue a block upload."""
        step = command & 3
        if step == 0:
            self._begin_block_upload(command, frame, now_ns)
            return
        outgoing = self._outgoing
        if self._state != _BLOCK_UPLOADS + step or outgoing is None:
            self._abort(AbortCode.COMMAND_SPECIFIER_UNKNOWN, now_ns)
        elif step == _START:
            self._send_block(outgoing, now_ns)
        elif step == _CONFIRM:
            code = outgoing.confirm(frame[9], frame[10])
            if code is not None:
                self._abort(code, now_ns)
            elif outgoing.is_over():
                self._state = _BLOCK_UPLOADS + _END
                self._wait(now_ns)
                unused, crc = outgoing.end()
                end = crc.to_bytes(2, "little")
                self._reply(_SEGMENT.pack(self._response_id, 8, 0xC1 | unused << 2, end), now_ns)
            else:
                self._send_block(outgoing, now_ns)
        else:
            self._end()

    def _begin_block_upload(self, command: int, frame: bytes, now_ns: int) -> None:
        index, subindex = frame[9] | frame[10] << 8, frame[11]
        block_size, threshold = frame[12], frame[13]
        self._begin(index, subindex)
        data = self._access.upload(index, subindex, now_ns)
        if isinstance(data, int):
            self._abort(data, now_ns)
            return
        if not 1 <= block_size <= BLOCK_MAX:
            self._abort(AbortCode.INVALID_BLOCK_SIZE, now_ns)
            return
        if 0 < len(data) <= threshold:  # the client prefers a plain transfer for this size
            self._begin_upload(index, subindex, now_ns)
            return
        self._state = _BLOCK_UPLOADS + _START
        self._wait(now_ns)
        self._outgoing = BlockUpload(data, block_size, command & _HAS_CRC != 0)
        size = len(data).to_bytes(4, "little")
        self._reply(_RESPONSE.pack(self._response_id, 8, 0xC6, index, subindex, size), now_ns)

    def _send_block(self, outgoing: BlockUpload, now_ns: int) -> None:
        self._state = _BLOCK_UPLOADS + _CONFIRM
        self._wait(now_ns)
        for head, part in outgoing.block():
            self._reply(_SEGMENT.pack(self._response_id, 8, head, part), now_ns)

    def _judge(self, is_last: bool) -> int:
        """Return the abort code for the length collected so far, or 0."""
        expected = self._expected
        if expected is None:
            return AbortCode.OUT_OF_MEMORY if self._collected > MAX_DOWNLOAD_BYTES else 0
        if self._collected > expected:
            return AbortCode.LENGTH_TOO_HIGH
        return AbortCode.LENGTH_TOO_LOW if is_last and self._collected < expected else 0

    def _wait(self, now_ns: int) -> None:
        """Restart the timeout, counted from the response."""
        self._timeout_ns = now_ns + self._reply_ns + TIMEOUT_NS
        if not self._replies:
            self.deadline_ns = self._timeout_ns
            self._outbox.deadlines_moved = True

    def _end(self) -> None:
        self._begin(0, 0)

    def _begin(self, index: int, subindex: int) -> None:
        """Drop the current transfer and set the object of the next one."""
        self._index = index
        self._subindex = subindex
        if self._state == _IDLE:
            return
        self._state = _IDLE
        self._timeout_ns = NEVER
        if not self._replies:
            self.deadline_ns = NEVER
            self._outbox.deadlines_moved = True
        self._toggle = 0
        self._data = b""
        self._parts = []
        self._collected = 0
        self._expected = None
        self._incoming = None
        self._outgoing = None

    def _accept(self, now_ns: int) -> None:
        response = (self._response_id, 8, 0x60, self._index, self._subindex, b"")
        self._reply(_RESPONSE.pack(*response), now_ns)

    def _abort(self, code: int, now_ns: int) -> None:
        data = int(code).to_bytes(4, "little")
        response = (self._response_id, 8, 0x80, self._index, self._subindex, data)
        self._end()
        self._reply(_RESPONSE.pack(*response), now_ns)

    def _reply(self, frame: bytes, now_ns: int) -> None:
        if not self._reply_ns:
            self._outbox.frames.append(frame)
            return
        self._replies.append((now_ns + self._reply_ns, frame))
        self.deadline_ns = self._replies[0][0]
        self._outbox.deadlines_moved = True
