"""Passive decoder of SDO transfers, with the data of complete transfers.

The decoder takes part in no transfer. It follows as far as possible a transfer whose beginning was
not recorded, or that breaks the protocol.

Source: CiA 301, SDO protocols (download, upload, segments, block transfer, abort).
"""

from dataclasses import dataclass
from enum import Enum
from typing import Final, final


@final
class Step(Enum):
    """The purpose of one frame of a transfer."""

    ASK_UPLOAD = "asks for"
    UPLOADED = "tells"
    UPLOAD_BEGINS = "begins upload of"
    ASK_SEGMENT = "requests the next segment of"
    SEGMENT_UPLOADED = "uploads a segment of"
    DOWNLOAD = "writes"
    DOWNLOAD_BEGINS = "begins to write"
    SEGMENT_DOWNLOAD = "writes a segment of"
    SEGMENT_TAKEN = "confirms a segment of"
    DOWNLOAD_TAKEN = "takes"
    DOWNLOAD_READY = "is ready for"
    ABORT = "aborts"
    BLOCK = "block transfer of"
    NONE = "no SDO"


@final
@dataclass(slots=True)  # not frozen: making a frozen one takes four times as long
class SdoStep:
    """One frame of a transfer. Nobody changes it.

    Attributes:
        step: its purpose.
        index, subindex: of the object; None: the beginning of the transfer was not seen.
        data: the part of the object in this frame.
        whole: the object's data, if this frame completes or confirms them.
        abort_code: of an abort.
        upload: True if the transfer reads from the node.
        size: the size announced at the beginning of a segmented transfer.
        toggle: of a segment.
        last: True for the last segment.
        begins: True if the client begins a transfer with it.
    """

    step: Step
    index: int | None = None
    subindex: int | None = None
    data: bytes = b""
    whole: bytes | None = None
    abort_code: int = 0
    upload: bool = True
    size: int | None = None
    toggle: bool = False
    last: bool = False
    begins: bool = False


@final
class _Transfer:
    def __init__(self, index: int, subindex: int, upload: bool) -> None:
        self.index = index
        self.subindex = subindex
        self.upload = upload
        self.data = b""
        self.complete = False
        self.in_block = False


_NO_SDO: Final = SdoStep(Step.NONE)


@final
class SdoReader:
    """Decoder of the SDO server channel of one node."""

    def __init__(self) -> None:
        self._transfer: _Transfer | None = None

    def read(self, data: bytes, from_server: bool) -> SdoStep:
        """Decode a frame."""
        if len(data) < 8:
            return _NO_SDO
        command = data[0]
        index, subindex = int.from_bytes(data[1:3], "little"), data[3]
        known = self._transfer
        if command == 0x80:
            upload = known.upload if known else True
            self._transfer = None
            code = int.from_bytes(data[4:8], "little")
            return SdoStep(Step.ABORT, index, subindex, abort_code=code, upload=upload)
        if known is not None and known.in_block and known.upload == from_server:
            return self._block_segment(known, data)
        if from_server:
            return self._response(command, index, subindex, data)
        return self._request(command, index, subindex, data)

    def _request(self, command: int, index: int, subindex: int, data: bytes) -> SdoStep:
        kind = command >> 5
        known = self._transfer
        if kind == 2:
            self._transfer = _Transfer(index, subindex, True)
            return SdoStep(Step.ASK_UPLOAD, index, subindex, begins=True)
        if kind == 1:
            begun = self._transfer = _Transfer(index, subindex, False)
            if command & 0x02:
                begun.data, begun.complete = _expedited(command, data), True
                return SdoStep(
                    Step.DOWNLOAD, index, subindex, begun.data, upload=False, begins=True
                )
            size = int.from_bytes(data[4:8], "little") if command & 0x01 else None
            return SdoStep(
                *(Step.DOWNLOAD_BEGINS, index, subindex), upload=False, size=size, begins=True
            )
        if kind in (5, 6):
            return self._block(kind == 5, command, index, subindex, False)
        if kind == 3:
            return self._about(Step.ASK_SEGMENT, known, toggle=bool(command & 0x10))
        if kind == 0:
            piece = data[1 : 8 - (command >> 1 & 7)]
            if known is not None:
                known.data += piece
                known.complete = bool(command & 1)
            return self._about(
                Step.SEGMENT_DOWNLOAD, known, piece, bool(command & 0x10), bool(command & 1)
            )
        return _NO_SDO

    def _response(self, command: int, index: int, subindex: int, data: bytes) -> SdoStep:
        kind = command >> 5
        known = self._transfer
        if kind == 2:
            if command & 0x02:
                self._transfer = None
                value = _expedited(command, data)
                return SdoStep(Step.UPLOADED, index, subindex, value, value)
            self._transfer = _Transfer(index, subindex, True)
            size = int.from_bytes(data[4:8], "little") if command & 0x01 else None
            return SdoStep(Step.UPLOAD_BEGINS, index, subindex, size=size)
        if kind == 3:
            fits = known is not None and (known.index, known.subindex) == (index, subindex)
            if known is not None and fits and known.complete and not known.upload:
                self._transfer = None
                return SdoStep(Step.DOWNLOAD_TAKEN, index, subindex, whole=known.data, upload=False)
            if known is not None and fits:
                return SdoStep(Step.DOWNLOAD_READY, index, subindex, upload=False)
            return SdoStep(Step.DOWNLOAD_TAKEN, index, subindex, upload=False)
        if kind == 0:
            piece, last = data[1 : 8 - (command >> 1 & 7)], bool(command & 1)
            if known is not None:
                known.data += piece
            whole = known.data if known is not None and last else None
            if last:
                self._transfer = None
            return self._about(
                Step.SEGMENT_UPLOADED, known, piece, bool(command & 0x10), last, whole
            )
        if kind == 1:
            whole = None
            if known is not None and known.complete:
                whole, self._transfer = known.data, None
            return self._about(
                Step.SEGMENT_TAKEN, known, b"", bool(command & 0x10), whole is not None, whole
            )
        if kind in (5, 6):
            return self._block(kind == 6, command, index, subindex, True)
        return _NO_SDO

    @staticmethod
    def _about(
        step: Step,
        known: _Transfer | None,
        data: bytes = b"",
        toggle: bool = False,
        last: bool = False,
        whole: bytes | None = None,
    ) -> SdoStep:
        """Return the step of a frame that does not name its object."""
        if known is None:
            return SdoStep(step, data=data, toggle=toggle, last=last)
        return SdoStep(
            *(step, known.index, known.subindex, data, whole),
            upload=known.upload,
            toggle=toggle,
            last=last,
        )

    def _block(
        self, upload: bool, command: int, index: int, subindex: int, from_server: bool
    ) -> SdoStep:
        """Decode a frame around the segments of a block transfer, whose data is not assembled."""
        part = command & 0x03
        known = self._transfer
        starts = not from_server and not (part if upload else command & 0x01)
        if known is None or starts:
            known = self._transfer = _Transfer(index, subindex, upload)
        elif (upload and not from_server and part == 3) or (
            not upload and from_server and part == 0
        ):
            known.in_block = True
        return SdoStep(Step.BLOCK, known.index, known.subindex, upload=upload, begins=starts)

    @staticmethod
    def _block_segment(known: _Transfer, data: bytes) -> SdoStep:
        if data[0] & 0x80:
            known.in_block = False
        return SdoStep(
            *(Step.BLOCK, known.index, known.subindex, data[1:]),
            upload=known.upload,
            last=bool(data[0] & 0x80),
        )


def _expedited(command: int, data: bytes) -> bytes:
    """Return the data of an expedited transfer; all four bytes if the size is not indicated."""
    return data[4 : 8 - (command >> 2 & 3)] if command & 0x01 else data[4:8]
