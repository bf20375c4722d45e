"""SDO transfers: in segments, in blocks, wrong ones, and abandoned ones.

The frames are built here from CiA 301, 7.2.4.3, since canopen's client makes no mistakes.
"""

from binascii import crc_hqx
from collections.abc import Callable, Sequence
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry

_NAME: Final = Entry(0x1008, 0, "I", "manufacturer device name")
_SEGMENT: Final = 7
_LAST: Final = 0x80
_VALUE_MS: Final = 1234
_ABANDONED_S: Final = 1.5
_TOGGLE_ERROR: Final = 0x0503_0000
_UNKNOWN_COMMAND: Final = 0x0504_0001
_BLOCK_SIZE: Final = 0x0504_0002
_SEQUENCE: Final = 0x0504_0003
_CRC: Final = 0x0504_0004
_TOO_LONG: Final = 0x0607_0012
_TOO_SHORT: Final = 0x0607_0013
_NO_OBJECT: Final = 0x0602_0000
_LENGTHS: Final = (0x0607_0010, _TOO_LONG, _TOO_SHORT)


def _ask(drive: Drive, *head: int, data: bytes = b"", count: int = 1) -> list[bytes]:
    """Send a request; return the data of its answers."""
    request = (bytes(head) + data).ljust(8, b"\0")
    node = drive.node_id
    heard = drive.client.ask(0x600 + node, request, 0x580 + node, count=count)
    answers = [one.data for one in heard]
    what = f"SDO request {request.hex(' ')}"
    is_whole = all(len(one) == 8 for one in answers)
    drive.expect(is_whole, what, "answers of 8 bytes", _text(answers), "wrong length of a frame")
    return answers


def _place(entry: Entry) -> bytes:
    return bytes((entry.index & 0xFF, entry.index >> 8, entry.subindex))


def _size(length: int) -> bytes:
    return length.to_bytes(4, "little")


def _text(answers: Sequence[bytes]) -> str:
    return ", ".join(one.hex(" ") for one in answers) or "nothing"


def _expect(drive: Drive, answers: Sequence[bytes], head: bytes, what: str, why: str) -> bytes:
    """Expect one answer that begins with these bytes; return it."""
    is_right = len(answers) == 1 and answers[0].startswith(head)
    drive.expect(is_right, what, f"one answer {head.hex(' ')}", _text(answers), why)
    return answers[0]


def _expect_abort(
    drive: Drive, answers: Sequence[bytes], codes: Sequence[int], entry: Entry | None, what: str
) -> None:
    """Expect an abort with one of these codes, of this object if it is known."""
    place = b"" if entry is None else _place(entry)
    is_right = (
        len(answers) == 1
        and answers[0][0] == 0x80
        and answers[0][1:].startswith(place)
        and int.from_bytes(answers[0][4:8], "little") in codes
    )
    expected = "an abort with " + " or ".join(f"{code:08X}h" for code in codes)
    drive.expect(is_right, what, expected, _text(answers), "the mistake is not noticed")


def _uploaded(drive: Drive) -> bytes:
    """Return 1008h, uploaded in segments."""
    begun = _ask(drive, 0x40, data=_place(_NAME))
    if len(begun) == 1 and begun[0][0] == 0x80:
        raise NotApplicable(f"the drive has no {_NAME}")
    if len(begun) == 1 and begun[0][0] & 2:
        raise NotApplicable(f"{_NAME} has no more than four bytes")
    head = _expect(drive, begun, b"\x41" + _place(_NAME), f"upload of {_NAME}", "no size")
    size = int.from_bytes(head[4:8], "little")
    if not size:
        raise NotApplicable(f"{_NAME} is empty")
    data, toggle = b"", 0
    while True:
        what = f"segment {len(data) // _SEGMENT + 1} of {_NAME}"
        answers = _ask(drive, 0x60 | toggle)
        drive.expect(len(answers) == 1, what, "one answer", _text(answers))
        command, part = answers[0][0], answers[0][1:]
        drive.expect(command & 0xF0 == toggle, what, f"toggle bit {toggle:02X}h", _text(answers))
        data += part[: _SEGMENT - (command >> 1 & 7)]
        toggle ^= 0x10
        if command & 1 or len(data) > size:
            break
    drive.expect(len(data) == size, f"upload of {_NAME}", f"{size} bytes", f"{len(data)}")
    return data


def _begin_blocks(drive: Drive, size: int, threshold: int = 0) -> list[bytes]:
    return _ask(drive, 0xA4, data=_place(_NAME) + bytes((size, threshold)))


def _block(drive: Drive, head: tuple[int, ...], left: bytes, size: int, what: str) -> bytes:
    """Ask for a block; expect the segments of `left` from 1 on, and return its bytes."""
    wanted = [left[at : at + _SEGMENT] for at in range(0, len(left), _SEGMENT)][:size]
    answers = _ask(drive, *head, count=len(wanted))
    has_all = len(wanted) * _SEGMENT >= len(left)
    numbers = [
        number | (_LAST if has_all and number == len(wanted) else 0)
        for number in range(1, len(wanted) + 1)
    ]
    right = [
        bytes((number,)) + part.ljust(_SEGMENT, b"\0")
        for number, part in zip(numbers, wanted, strict=True)
    ]
    expected = f"{len(right)} segments {_text(right)}"
    drive.expect(answers == right, what, expected, _text(answers), "wrong numbers, bytes or end")
    return b"".join(wanted)


@drive_clause("SDO-01", Level.L0, source="CiA 301, 7.2.4.3.3 to 7.2.4.3.16, SDO upload; CRC")
def uploads(bench: DriveBench) -> None:
    """1008h is the same in segments and in blocks of any size, and its CRC is right."""
    drive = bench.drive
    whole = _uploaded(drive)
    begun = _begin_blocks(drive, 127)
    if len(begun) == 1 and begun[0][0] == 0x80:
        raise NotApplicable("the drive does not upload in blocks, which is optional")
    _ask(drive, 0x80)  # ends it without an answer
    for size in (1, 2, 127):
        what = f"block upload of {_NAME}, {size} segments a block"
        begun = _begin_blocks(drive, size)
        head = _expect(drive, begun, b"\xc6" + _place(_NAME), what, "no size, or no CRC")
        told = int.from_bytes(head[4:8], "little")
        drive.expect(told == len(whole), what, f"{len(whole)} bytes", f"{told}")
        begin: tuple[int, ...] = (0xA3,)
        left, is_repeated = whole, False
        while left:
            part = _block(drive, begin, left, size, what)
            count = -(-len(part) // _SEGMENT)
            good = count if is_repeated else count - 1  # the last one of the first block is lost
            is_repeated = True
            left = left[good * _SEGMENT :]
            begin = (0xA2, good, size)
        unused = -len(whole) % _SEGMENT
        end = bytes((0xC1 | unused << 2,)) + crc_hqx(whole, 0).to_bytes(2, "little")
        why = "the CRC is not x^16 + x^12 + x^5 + 1 from 0, or the unused bytes are wrong"
        _expect(drive, _ask(drive, *begin), end, f"end of {what}", why)
        _ask(drive, 0xA1)
    what = f"block upload of {_NAME}, for which the client prefers segments"
    _expect(drive, _begin_blocks(drive, 2, 255), b"\x41" + _place(_NAME), what, "still in blocks")
    _ask(drive, 0x80)
    again = _uploaded(drive)
    drive.expect(again == whole, f"{_NAME} after all", f"{whole!r}", f"{again!r}")


@drive_clause("SDO-02", Level.L0, source="CiA 301, 7.2.4.3.3 to 7.2.4.3.17, SDO download")
def downloads(bench: DriveBench) -> None:
    """A value is downloaded at once, in segments or in blocks, and taken once it is complete."""
    drive = bench.drive
    drive.require(od.HEARTBEAT_PRODUCER)
    entry, place = od.HEARTBEAT_PRODUCER, _place(od.HEARTBEAT_PRODUCER)
    value = _VALUE_MS.to_bytes(2, "little")
    drive.write(entry, 0)
    for head, size in ((0x21, 2), (0x20, 0)):
        what = f"download of {entry} in segments ({head:02X}h)"
        _expect(drive, _ask(drive, head, data=place + _size(size)), b"\x60" + place, what, "")
        _expect(drive, _ask(drive, 0x0C, data=value[:1]), b"\x20", f"{what}, segment 1", "")
        drive.client.send_message(0x700, b"")  # another frame between them does no harm
        _expect(drive, _ask(drive, 0x1D, data=value[1:]), b"\x30", f"{what}, segment 2", "")
        drive.near(entry, _VALUE_MS, 0, what, "segments are joined wrongly")
        drive.write(entry, 0)
    for head in (0x2B, 0x22):
        what = f"expedited download of {entry} ({head:02X}h)"
        cause = "e = 1 and s = 0: the number of bytes is not stated"
        answers = _ask(drive, head, data=place + value)
        _expect(drive, answers, b"\x60" + place, what, cause if head == 0x22 else "")
        drive.near(entry, _VALUE_MS, 0, what)
        drive.write(entry, 0)
    begun = _ask(drive, 0xC6, data=place + _size(2))
    if len(begun) == 1 and begun[0][0] == 0x80:
        raise NotApplicable("the drive does not download in blocks, which is optional")
    _ask(drive, 0x80)
    crc = crc_hqx(value, 0).to_bytes(2, "little")
    what = f"download of {entry} in blocks"
    for head in (0xC6, 0xC4, 0xC0):  # with size and CRC, with CRC, with neither
        size = 2 if head & 2 else 0
        begun = _ask(drive, head, data=place + _size(size))
        answer = _expect(drive, begun, b"\xa4" + place, what, "no CRC, or another object")
        drive.expect(1 <= answer[4] <= 127, what, "1 to 127 segments a block", f"{answer[4]}")
        lost = _ask(drive, 2 | _LAST, data=value)
        _expect(drive, lost, b"\xa2\x00", f"{what}, segment 1 lost", "a gap is not noticed")
        early = _ask(drive, 1, data=value[:1])
        drive.expect(not early, f"{what}, within a block", "no answer", _text(early))
        _ask(drive, 0x80)
        _ask(drive, head, data=place + _size(size))
        _expect(drive, _ask(drive, 1 | _LAST, data=value), b"\xa2\x01", f"{what}, segment 1", "")
        end = _ask(drive, 0xC1 | 5 << 2, data=crc)
        _expect(drive, end, b"\xa1", f"{what}, end", "the CRC or the unused bytes are wrong")
        drive.near(entry, _VALUE_MS, 0, what, "the value is taken wrongly")
        drive.write(entry, 0)


@drive_clause("SDO-03", Level.L0, source="CiA 301, 7.2.4.3.17, SDO abort codes 0503h to 0504h")
def wrong_transfers(bench: DriveBench) -> None:
    """A wrong transfer is aborted with the code of its mistake, changes nothing, and is over."""
    drive = bench.drive
    drive.require(od.HEARTBEAT_PRODUCER)
    entry, place = od.HEARTBEAT_PRODUCER, _place(od.HEARTBEAT_PRODUCER)
    drive.write(entry, 0)
    _uploaded(drive)

    def begin_upload() -> None:
        _ask(drive, 0x40, data=_place(_NAME))

    def begin_download(size: int = 2) -> None:
        _ask(drive, 0x21, data=place + _size(size))

    def tried(
        what: str,
        code: int | Sequence[int],
        *request: int,
        data: bytes = b"",
        of: Entry | None = None,
        begin: Callable[[], None] | None = None,
    ) -> None:
        if begin is not None:
            begin()
        codes = (code,) if isinstance(code, int) else code
        _expect_abort(drive, _ask(drive, *request, data=data), codes, of, what)
        drive.near(entry, 0, 0, what, "a value was taken all the same")

    tried("command E0h", _UNKNOWN_COMMAND, 0xE0)
    tried("a segment of no upload", _UNKNOWN_COMMAND, 0x60)
    tried("a segment of no download", _UNKNOWN_COMMAND, 0x0D, data=b"\x01")
    tried("toggle bit 1 first, upload", _TOGGLE_ERROR, 0x70, of=_NAME, begin=begin_upload)
    tried("toggle bit 1 first, download", _TOGGLE_ERROR, 0x1D, of=entry, begin=begin_download)
    tried("one byte of two", _LENGTHS, 0x0D, data=b"\x01", of=entry, begin=begin_download)
    tried("seven bytes of two", _LENGTHS, 0x01, data=b"\x01", of=entry, begin=begin_download)
    tried("a size of 8 for 2 bytes", _LENGTHS, 0x21, data=place + _size(8), of=entry)
    absent = Entry(0x5FFF, 0, "B", "absent")
    tried("an absent object", _NO_OBJECT, 0x21, data=_place(absent) + _size(2), of=absent)
    begin_upload()
    begin_download()  # a new transfer ends the one before
    tried("a segment of the transfer before", _UNKNOWN_COMMAND, 0x60)
    begin_upload()
    _ask(drive, 0x80, data=_place(_NAME))
    tried("a segment after an abort", _UNKNOWN_COMMAND, 0x60)
    short = drive.client.ask(0x600 + drive.node_id, b"\x40" + _place(_NAME), 0x580 + drive.node_id)
    drive.expect(not short, "a request of 4 bytes", "no answer", _text([one.data for one in short]))
    _try_blocks(drive, tried)


def _try_blocks(drive: Drive, tried: Callable[..., None]) -> None:
    entry, place = od.HEARTBEAT_PRODUCER, _place(od.HEARTBEAT_PRODUCER)
    value = _VALUE_MS.to_bytes(2, "little")

    def begin_blocks(size: int = 2) -> None:
        _ask(drive, 0xC6, data=place + _size(size))

    def sent_block() -> None:
        begin_blocks()
        _ask(drive, 1 | _LAST, data=value)

    if (_begin_blocks(drive, 1) or [b"\x80"])[0][0] != 0x80:
        tried("a confirmation of an upload not begun", _UNKNOWN_COMMAND, 0xA2, 1, 1)
        upload = _place(_NAME)
        tried("blocks of 0 segments", _BLOCK_SIZE, 0xA4, data=upload + b"\0\0", of=_NAME)
        tried("blocks of 128 segments", _BLOCK_SIZE, 0xA4, data=upload + b"\x80\0", of=_NAME)

        def got_block() -> None:
            _begin_blocks(drive, 1)
            _ask(drive, 0xA3)

        tried("2 of 1 confirmed", _SEQUENCE, 0xA2, 2, 1, of=_NAME, begin=got_block)
        tried("the next block of 0", _BLOCK_SIZE, 0xA2, 1, 0, of=_NAME, begin=got_block)
        tried("the next block of 128", _BLOCK_SIZE, 0xA2, 1, 128, of=_NAME, begin=got_block)
        tried("absent", _NO_OBJECT, 0xA4, data=b"\xff\x5f\x00\x01\x00")
    if (_ask(drive, 0xC6, data=place + _size(2)) or [b"\x80"])[0][0] != 0x80:
        _ask(drive, 0x80)
        tried("segment 0", _SEQUENCE, 0x00, data=value, of=entry, begin=begin_blocks)
        wrong = (crc_hqx(value, 0) ^ 1).to_bytes(2, "little")
        tried("a wrong CRC", _CRC, 0xC1 | 5 << 2, data=wrong, of=entry, begin=sent_block)
        right = crc_hqx(value[:1], 0).to_bytes(2, "little")
        tried("6 unused bytes", _LENGTHS, 0xC1 | 6 << 2, data=right, of=entry, begin=sent_block)
        tried("an end before the blocks", _UNKNOWN_COMMAND, 0xC1)
        tried("a size of 8 in blocks", _LENGTHS, 0xC6, data=place + _size(8), of=entry)
        begin_blocks()
        again = _ask(drive, 0x80, data=place)
        drive.expect(not again, "an abort within a block", "no answer", _text(again))
        drive.near(entry, 0, 0, "an abort within a block")
        begin_blocks()
        _ask(drive, 1, data=value)
        drive.quiet(_ABANDONED_S)  # the drive may abort
        _ask(drive, 0x80, data=place)
        drive.near(entry, 0, 0, "a block that was abandoned")
