"""SDO transfers by canopen's client, waiting in a Runtime.

Importing this module loads canopen. canopen's client blocks on a queue and on the wall clock. Here
it blocks in `Runtime.wait_until`, with a deadline of the runtime's time. It never accepts a stale
answer:

- An answer to another object or service, or with the toggle bit of the segment before, is counted
  and dropped. So is an answer that came before the request itself was on the wire. Buses repeat
  frames when their last bit is disturbed (ISO 11898-1), and servers may be slow.
- After a request without an answer in time the channel is in *quarantine*: the next request waits
  until the late answer has come (it is dropped), the node has booted, or a time limit has passed.
  Otherwise a second request for the same object would return the old value. The channel is also in
  quarantine after another process has died in the middle of a transfer.
- A stop waits neither for quarantine nor for its turn: it is sent *at once*, and its answer is not
  evaluated. Until that answer has come, or a time limit has passed, no request is sent that it
  could seem to answer (a download of the same object). If such a transfer is already active, here
  or in another process that hears the request, its answer counts once both have been answered.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Final, final

import canopen
from canopen.sdo.client import ReadableStream, SdoClient, WritableStream
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from motorhil.motorapi.adaptations.canopen.errors import ProtocolViolation, SdoAborted
from motorhil.motorapi.adaptations.canopen.objects import Value, decode
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    MotorBusyError,
    MotorError,
    UsageError,
)
from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock
from motorhil.motorapi.runtime.api import Runtime
from motorhil.motorapi.runtime.can_link import CanLink, Transmission, can_frame
from motorhil.motorapi.runtime.turn_lock import TurnLock

if TYPE_CHECKING:
    from motorhil.motorapi.ownership.fencing import Fence
    from motorhil.motorapi.ownership.physical_motor import PhysicalMotor


_RTR: Final = 0x4000_0000
_EFF: Final = 0x8000_0000
_ABORT: Final = 0x80
_TIMED_OUT: Final = 0x0504_0000
_NOT_NOW: Final = 0x0800_0021  # "... because of local control"
_TOGGLE: Final = 0x10
_DOWNLOADED: Final = 0x60
_EXPEDITED: Final = 0x03  # with its size
_NO_PLACE: Final = b"\0\0\0"
# client command specifiers
_DOWNLOAD_SEGMENT: Final = 0
_DOWNLOAD: Final = 1
_UPLOAD: Final = 2
_UPLOAD_SEGMENT: Final = 3
_BLOCK_UPLOAD: Final = 5
_BLOCK_DOWNLOAD: Final = 6
_PLACE: Final = struct.Struct("<HB")  # index and sub-index
_CONTROLWORD: Final = b"\x40\x60\x00"
_TURN_TIMEOUT_S: Final = 10.0
_OTHER_CLIENTS: Final = "another SDO client may be using this channel"
REQUEST_ID: Final = 0x600
RESPONSE_ID: Final = 0x580


@final
class LinkNetwork(canopen.Network):
    """canopen's network over a link: never connected, so it has no thread and no Notifier."""

    def __init__(self, link: CanLink) -> None:
        super().__init__()
        self._link = link

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Queue a frame on the link's bus."""
        if can_id > 0x7FF:
            can_id |= _EFF
        if remote:
            can_id |= _RTR
        self._link.send(can_frame(can_id, bytes(data)))


@final
class _NothingKnown(canopen.ObjectDictionary):
    """A dictionary without entries: answers are returned as bytes."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # canopen's

    def get_variable(self, index: int | str, subindex: int = 0) -> None:
        """Return None; the inherited method takes longer than the decoding of a frame."""
        return


@final
class NoAnswer(SdoCommunicationError):  # noqa: N818 -- the name says what happened
    """No answer came in time."""


@final
class _Download(WritableStream):
    """A download whose garbage collection sends nothing.

    The inherited class ends an unfinished transfer when it is collected, at any later time.
    """

    def __del__(self) -> None:
        self._done = True


@final
class ChannelClient(SdoClient):
    """canopen's SDO client, blocking in the runtime instead of on the wall clock."""

    def __init__(self, link: CanLink, node_id: int, timeout_s: float) -> None:
        super().__init__(  # type: ignore[no-untyped-call]  # canopen's
            REQUEST_ID + node_id, RESPONSE_ID + node_id, _NothingKnown()
        )
        self.network: LinkNetwork = LinkNetwork(link)
        self.timeout_s = timeout_s
        self.strays: int = 0
        self.booted: bool = False
        self._link = link
        self._runtime: Runtime = link.runtime
        self._request: Transmission | None = None
        self.fence: Fence | None = None  # of a transfer that requires ownership to write
        self.is_under_way: bool = False  # a request of the transfer has been sent
        self._offs = 0  # number of bus-offs before the request
        self._opened = b""  # index and sub-index of the transfer
        self._opened_service = _UPLOAD
        self.odd: bytes | None = None  # a frame during the transfer that was not its answer
        self._answered = b""  # the last answer, which the bus may repeat
        self._answers: deque[bytes] = deque()
        self._quarantine_ns: int | None = None
        self._due: list[tuple[bytes, int]] = []  # places of unawaited answers, and time limits
        self._held: list[bytes] = []  # answers that may be such ones

    # --- canopen's hooks

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object; an answer must have the length that it announces."""
        stream = ReadableStream(self, index, subindex)  # type: ignore[no-untyped-call]  # canopen's
        data: bytes = stream.read()  # type: ignore[no-untyped-call]  # canopen's
        announced: int | None = stream.size
        if announced is not None and announced != len(data):
            raise SdoCommunicationError(f"{len(data)} bytes came of {announced} announced")
        return data

    def download(self, index: int, subindex: int, data: bytes, force_segment: bool = False) -> None:
        """Write the bytes of an object; after a failure, nothing more is sent for it."""
        size = len(data)
        stream = _Download(self, index, subindex, size, force_segment)  # type: ignore[no-untyped-call]  # canopen's
        at = 0
        while at < size:
            at += stream.write(data[at:])  # type: ignore[no-untyped-call]  # canopen's
        stream.close()  # type: ignore[no-untyped-call]  # canopen's

    def request_response(self, sdo_request: bytes | bytearray) -> bytes:
        """Send a request once and return its answer; the caller may repeat it after quarantine.

        The inherited method reads a queue, which stays empty here, and takes its lock.
        """
        self.send_request(sdo_request)
        try:
            return self.read_response()
        except SdoCommunicationError:
            self.abort(_TIMED_OUT)
            raise

    def send_request(self, request: bytes | bytearray) -> None:
        """Send a request; earlier frames do not count as its answer."""
        data = bytes(request)
        service = data[0] >> 5
        if service in (_DOWNLOAD, _UPLOAD) or (
            service in (_BLOCK_UPLOAD, _BLOCK_DOWNLOAD) and not data[0] & 0x03  # its beginning
        ):
            self._opened = data[1:4]
            if self._opened_service != _BLOCK_DOWNLOAD:  # any further frame of which may be data
                self._opened_service = service
                self.is_under_way = False
        self._answers.clear()
        self._offs = self._link.status.offs
        transmission = Transmission(can_frame(self.rx_cobid, data))
        if data[0] == _ABORT:
            self._request = None
            self._link.send_as(transmission)
            return
        self._request = transmission
        try:
            self._link.send_as(transmission, self.fence if self._commands(service) else None)
        except MotorBusyError:
            self._request = None
            if self.is_under_way:  # the server waits for the rest, which will not come
                self.is_under_way = False
                self.abort(_NOT_NOW)
            raise
        self.is_under_way = True

    def _commands(self, service: int) -> bool:
        """Return whether a request of the service writes, including frames of a block."""
        in_block = self._opened_service == _BLOCK_DOWNLOAD
        return in_block or service in (_DOWNLOAD, _DOWNLOAD_SEGMENT, _BLOCK_DOWNLOAD)

    def read_response(self) -> bytes:
        """Return the answer, within the runtime's deadline."""
        if not self._answers:
            self._runtime.wait_until(self._is_over, self.timeout_s)
        if not self._answers:
            if self._link.status.offs != self._offs:
                raise self._link.status.failure()
            raise NoAnswer(f"nothing within {self.timeout_s:g} s")
        answer = self._answered = self._answers.popleft()
        if answer[0] == _ABORT:
            raise SdoAbortedError(int.from_bytes(answer[4:8], "little"))
        return answer

    def abort(self, abort_code: int = 0x0800_0000) -> None:
        """Abort the transfer at the server; errors are raised, not logged."""
        self.send_request(
            bytearray(bytes((_ABORT,)) + self._opened + abort_code.to_bytes(4, "little"))
        )

    # --- the channel's side

    def _is_over(self) -> bool:
        return bool(self._answers) or self.booted or self._link.status.offs != self._offs

    def heard(self, frame: bytes, time_ns: int) -> None:
        """Handle a frame of the server; keep it if it can answer the pending request."""
        request, data = self._request, frame[8:16]
        is_due = self._is_due(data[1:4], data[0])
        if is_due:
            self._due.remove(next(one for one in self._due if one[0] == data[1:4]))
        if request is None or (request.time_ns is None and self._link.confirms):
            self.strays += 1
            if not is_due:
                self._quarantine_ns = None  # most likely the late answer: nothing else can come
            return
        if not self._can_answer(data, request.frame[8]):
            self.strays += 1
            if not is_due and data != self._answered:
                self.odd = data
            return
        self._held.append(data)
        if not is_due:  # all have come, so the first one answers the first request
            self.strays += len(self._held) - 1
            self._answers.append(self._held[0])
            self._held.clear()

    def expect(self, place: bytes, until_ns: int) -> None:
        """Expect an answer to a download of this object that no request here waits for."""
        self._due.append((place, until_ns))

    def send_at_once(
        self, place: bytes, data: bytes, fence: "Fence | None", until_ns: int
    ) -> Transmission:
        """Send an expedited download, even during another transfer."""
        command = _DOWNLOAD << 5 | (4 - len(data)) << 2 | _EXPEDITED
        request = bytes((command,)) + place + data.ljust(4, b"\0")
        self.expect(place, until_ns)
        try:
            return self._link.send_as(Transmission(can_frame(self.rx_cobid, request)), fence)
        except BaseException:
            self._due.remove((place, until_ns))
            raise

    def _is_due(self, place: bytes, command: int = _ABORT) -> bool:
        """Return whether an unawaited answer to a download of this object (b"": of any) is due."""
        if not self._due:  # nearly always
            return False
        now_ns = self._runtime.now_ns()
        self._due = [one for one in self._due if one[1] > now_ns]
        if command not in (_ABORT, _DOWNLOADED):
            return False
        return any(not place or one[0] == place for one in self._due)

    def _can_answer(self, data: bytes, asked: int) -> bool:
        """Return whether this can answer the command byte `asked` (CiA 301, SDO protocols)."""
        command = data[0]
        service = asked >> 5
        if command == _ABORT:
            # An abort without an object means that the server has no transfer: not the one just
            # begun.
            just_begun = service in (_DOWNLOAD, _UPLOAD)
            return data[1:4] == self._opened or (data[1:4] == _NO_PLACE and not just_begun)
        if service == _DOWNLOAD:
            return command >> 5 == 3 and data[1:4] == self._opened
        if service == _UPLOAD:
            return command >> 5 == 2 and data[1:4] == self._opened
        if service == _DOWNLOAD_SEGMENT:
            return command >> 5 == 1 and command & _TOGGLE == asked & _TOGGLE
        if service == _UPLOAD_SEGMENT:
            return command >> 5 == 0 and command & _TOGGLE == asked & _TOGGLE
        return True  # block transfer: canopen's client checks it

    def odd_text(self) -> str:
        """Return the frame that was not an answer, in hex, and the trouble of the bus."""
        text = "nothing" if self.odd is None else self.odd.hex(" ").upper()
        trouble = self._link.status.trouble()
        return f"{text}; {trouble}" if trouble else text

    def is_odd_about_this(self) -> bool:
        """Return whether the odd frame concerns the object of the transfer."""
        return self.odd is not None and self.odd[1:4] == self._opened

    def place(self) -> tuple[int, int]:
        """Return (index, sub-index) of the transfer, or zeros if none has begun."""
        opened = self._opened.ljust(3, b"\0")
        return int.from_bytes(opened[:2], "little"), opened[2]

    def aborted(self, node_id: int, code: int) -> SdoAborted:
        """Return the interface's error for an abort of the transfer."""
        index, subindex = self.place()
        return SdoAborted(node_id=node_id, index=index, subindex=subindex, abort_code=code)

    def begin(self, place: bytes, fence: "Fence | None") -> None:
        """Begin a transfer of this object, once no old answer is due."""
        self._opened = place
        self._opened_service = _UPLOAD
        self.fence = fence
        self.is_under_way = False
        self.odd = None
        self.booted = False
        self._held.clear()
        if self._is_due(place):
            left_ns = max(until_ns for _, until_ns in self._due) - self._runtime.now_ns()
            self._runtime.wait_until(lambda: not self._is_due(place), left_ns / 1e9)
        if self._quarantine_ns is not None:
            left_ns = self._quarantine_ns - self._runtime.now_ns()
            if left_ns > 0:
                self._runtime.wait_until(self._is_clean, left_ns / 1e9)
            self._quarantine_ns = None
            self.booted = False

    def end(self) -> None:
        """End the transfer; later answers are strays."""
        self._request = None

    def _is_clean(self) -> bool:
        return self._quarantine_ns is None or self.booted

    def rebooted(self) -> None:
        """Record a boot-up: the node no longer answers earlier requests."""
        self.booted = True
        self._due.clear()

    def quarantine(self, until_ns: int) -> None:
        """Begin quarantine: an answer may still come until then."""
        self._request = None
        self._quarantine_ns = until_ns


@final
class SdoChannel:
    """The default SDO channel of one node: 600h + node-ID there, 580h + node-ID back.

    For functions not wrapped here (block transfer, streams), use canopen's own client inside
    `alone`.

    Attributes:
        physical: the motor whose low-level access excludes other threads; None: no motor.
        process_lock: the lock that separates the transfers of processes; None: there is one
            process.
        before_writing: called before writes while the node is set up; raises if they are not
            permitted.
        fence: the fence that permits downloads only while the node is owned; None: no other process
            can take it over.
        on_control: called with controlwords (6040h) that other programs write, or None.
    """

    def __init__(
        self, link: CanLink, node_id: int, *, timeout_s: float, quarantine_s: float
    ) -> None:
        self.physical: PhysicalMotor | None = None
        self.process_lock: ProcessLock | None = None
        self.before_writing: Callable[[], None] | None = None
        self.fence: Fence | None = None
        self.on_control: Callable[[int, int], None] | None = None
        self._link = link
        self._node_id = node_id
        self._quarantine_ns = round(quarantine_s * 1e9)
        self._client = ChannelClient(link, node_id, timeout_s)
        self._abandoned = 0  # token of the last hold whose previous holder died with it
        self._lock = TurnLock(link.runtime)
        self._what = f"the SDO channel of node {node_id}"
        link.handle(RESPONSE_ID + node_id, self._client.heard)
        link.handle(REQUEST_ID + node_id, self._asked_by_others)

    @contextmanager
    def alone(self) -> Iterator[SdoClient]:
        """Provide canopen's client, exclusively inside the block, and with no old answer due.

        Its own errors, SdoAbortedError and SdoCommunicationError, leave the block as those of
        `upload`.
        """
        with self._lock.turn(_TURN_TIMEOUT_S, self._what), ExitStack() as held:
            if self.physical is not None:
                self.physical.require_not_held_elsewhere()
            if self.process_lock is not None:
                held.enter_context(self._take(self.process_lock))
            client = self._client
            client.begin(b"", self.fence)
            bound_ns = self._link.runtime.now_ns() + self._quarantine_ns
            try:
                yield client
            except SdoAbortedError as error:
                raise client.aborted(self._node_id, error.code) from error
            except SdoCommunicationError as error:
                self._quarantine(bound_ns)
                index, subindex = client.place()
                if isinstance(error, NoAnswer):
                    raise self._no_answer(index, subindex) from error
                where, problem = _where(index, subindex), f"{error} ({_OTHER_CLIENTS})"
                raise ProtocolViolation(
                    node_id=self._node_id, where=where, problem=problem
                ) from error
            finally:
                client.end()

    def finish(self) -> None:
        """Wait for the active transfer; later callers check their permission first.

        Raises:
            DeadlineExceeded: another user keeps the channel.
        """
        with self._lock.turn(_TURN_TIMEOUT_S, self._what):
            pass

    @property
    def strays(self) -> int:
        """The number of answers that matched no request."""
        return self._client.strays

    def rebooted(self) -> None:
        """Forget earlier requests, as the node has booted."""
        self._client.rebooted()

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object, read from the device.

        Raises:
            SdoAborted: the device refused.
            DeadlineExceeded: it did not answer in time.
            ProtocolViolation: its answer does not match the request.
        """
        return self._transfer(index, subindex, None)

    def download(self, index: int, subindex: int, data: bytes, *, stops: bool = False) -> None:
        """Write `data` to an object of the device; with `stops`, without owning it.

        After DeadlineExceeded it is not known whether the device has received the data.

        Raises:
            MotorBusyError: another program owns the device now.
            SdoAborted, DeadlineExceeded, ProtocolViolation: as `upload`.
        """
        if not isinstance(data, bytes):
            raise UsageError(f"{self._what}: data {data!r}: must be bytes")
        self.check_writing()
        self._transfer(index, subindex, data, None if stops else self.fence)

    def send_at_once(
        self, index: int, subindex: int, data: bytes, fence: "Fence | None" = None
    ) -> "Transmission":
        """Send `data` (1 to 4 bytes) to an object without waiting, outside of any turn.

        The result is not reported. An active segmented transfer is lost.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: the fence refuses the frame.
        """
        until_ns = self._link.runtime.now_ns() + self._quarantine_ns
        return self._client.send_at_once(_PLACE.pack(index, subindex), data, fence, until_ns)

    def _asked_by_others(self, frame: bytes, time_ns: int) -> None:
        """Expect the answer to another program's stop, which may not have waited for our turn."""
        if frame[8] >> 5 == _DOWNLOAD and frame[9:12] == _CONTROLWORD:
            until_ns = self._link.runtime.now_ns() + self._quarantine_ns
            self._client.expect(_CONTROLWORD, until_ns)
            if self.on_control is not None:
                self.on_control(int.from_bytes(frame[12:14], "little"), time_ns)

    def check_writing(self) -> None:
        """Raise MotorBusyError if the node is being set up, and another process owns it."""
        if self.before_writing is not None:
            self.before_writing()

    def _quarantine(self, until_ns: int) -> None:
        """Send no request before `until_ns`, neither here nor in another process."""
        self._client.quarantine(until_ns)
        hold = None if self.process_lock is None else self.process_lock.hold
        if hold is not None:
            runtime = self._link.runtime
            hold.keep_for(runtime, (until_ns - runtime.now_ns()) / 1e9)

    def _take(self, lock: ProcessLock) -> LockHandle:
        runtime = self._link.runtime
        hold = lock.acquire(runtime, "an SDO transfer", _TURN_TIMEOUT_S, self)
        if hold.was_abandoned and hold.token != self._abandoned:
            self._abandoned = hold.token  # one hold may be taken repeatedly
            self._client.quarantine(runtime.now_ns() + self._quarantine_ns)
        return hold

    def _transfer(
        self, index: int, subindex: int, data: bytes | None, fence: "Fence | None" = None
    ) -> bytes:
        """Perform an upload (`data` None) or a download."""
        client = self._client
        try:
            place = _PLACE.pack(index, subindex)
        except struct.error:
            place_text = f"index {index!r}, sub-index {subindex!r}"
            raise UsageError(f"{self._what}: {place_text}: 0 to FFFFh, 0 to FFh") from None
        turn = self._lock.take(_TURN_TIMEOUT_S, self._what)
        hold: LockHandle | None = None
        try:
            if self.physical is not None and self.physical.access is not None:
                self.physical.require_not_held_elsewhere()
            if self.process_lock is not None:
                hold = self._take(self.process_lock)
            client.begin(place, fence)
            bound_ns = self._link.runtime.now_ns() + self._quarantine_ns
            try:
                if data is None:
                    return client.upload(index, subindex)
                client.download(index, subindex, data)
                return b""
            except SdoAbortedError as error:
                raise SdoAborted(
                    node_id=self._node_id, index=index, subindex=subindex, abort_code=error.code
                ) from None
            except NoAnswer:
                self._quarantine(bound_ns)
                raise self._no_answer(index, subindex) from None
            except SdoCommunicationError as error:
                self._quarantine(bound_ns)
                raise ProtocolViolation(
                    node_id=self._node_id,
                    where=_where(index, subindex),
                    problem=f"{error} ({_OTHER_CLIENTS})",
                ) from None
            except BaseException:
                if client.is_under_way:  # interrupted in the middle: an answer is still due
                    self._quarantine(bound_ns)
                raise
            finally:
                client.end()
        finally:
            if hold is not None:
                hold.release()
            self._lock.give_back(turn)

    def _no_answer(self, index: int, subindex: int) -> MotorError:
        client = self._client
        heard = "a boot-up" if client.booted else client.odd_text()
        where = _where(index, subindex)
        if client.is_odd_about_this():
            problem = f"no answer but {heard}"
            return ProtocolViolation(node_id=self._node_id, where=where, problem=problem)
        return DeadlineExceeded(
            awaited=f"node {self._node_id} on {self._link.name}: answer to {where}",
            timeout_s=client.timeout_s,
            last_heard=heard,
        )


def _where(index: int, subindex: int) -> str:
    return f"SDO {index:04X}h:{subindex:02X}h"


def decode_answer(node_id: int, place: tuple[int, int], kind: str, data: bytes) -> Value:
    """Return the value of an answer to an upload.

    Raises:
        ProtocolViolation: the answer is shorter than the data type.
    """
    try:
        return decode(kind, data)
    except ValueError as error:
        raise ProtocolViolation(node_id=node_id, where=_where(*place), problem=str(error)) from None
