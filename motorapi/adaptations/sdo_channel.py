"""SDO transfers by canopen's client, waiting in a Runtime. Importing this loads canopen.

canopen's client blocks on a queue and on the wall clock. Here it blocks in `Runtime.wait_until`,
with a deadline of the runtime's own time, and never believes a stale answer:

- An answer to another object or another service than the one asked for, or with the toggle bit of
  the segment before, is counted and dropped, and so is one that came before the request itself was
  on the wire. Buses repeat frames when their last bit is hit (ISO 11898-1), servers are slow.
- After a request that was not answered in time the channel is in *quarantine*: the next request
  waits until the late answer has come (it is dropped), the node has booted, or a bound has passed.
  Without that, asking the same object again would return the old value.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Final, final

import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from motorapi.adaptations.canopen_errors import ProtocolViolation, SdoAborted
from motorapi.adaptations.canopen_link import CanopenLink, Transmission, can_frame
from motorapi.adaptations.turn_lock import TurnLock
from motorapi.errors import DeadlineExceeded, MotorError, UsageError
from motorapi.process_lock import Hold, ProcessLock

if TYPE_CHECKING:
    from motorapi.runtime import Runtime
    from motorapi.sharing import PhysicalMotor

_RTR: Final = 0x4000_0000
_EFF: Final = 0x8000_0000
_ABORT: Final = 0x80
_TOGGLE: Final = 0x10
_NO_PLACE: Final = b"\0\0\0"
# client command specifiers
_DOWNLOAD_SEGMENT: Final = 0
_DOWNLOAD: Final = 1
_UPLOAD: Final = 2
_UPLOAD_SEGMENT: Final = 3
_BLOCK_UPLOAD: Final = 5
_BLOCK_DOWNLOAD: Final = 6
_PLACE: Final = struct.Struct("<HB")  # index and sub-index
_REQUEST_ID: Final = 0x600
_RESPONSE_ID: Final = 0x580
_TURN_TIMEOUT_S: Final = 10.0
_OTHER_CLIENTS: Final = "another SDO client may be using this channel"


@final
class LinkNetwork(canopen.Network):
    """canopen's network over a link: never connected, so it has no thread and no Notifier."""

    def __init__(self, link: CanopenLink) -> None:
        super().__init__()
        self._link = link

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """The frame waits its turn on the link's bus."""
        if can_id > 0x7FF:
            can_id |= _EFF
        if remote:
            can_id |= _RTR
        self._link.send(can_frame(can_id, bytes(data)))


@final
class _NothingKnown(canopen.ObjectDictionary):
    """A dictionary without entries: answers come as the bytes they are."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # canopen's

    def get_variable(self, index: int | str, subindex: int = 0) -> None:
        """None; the inherited one takes longer to say so than a frame takes to decode."""
        return


@final
class _NoAnswer(SdoCommunicationError):  # noqa: N818 -- never leaves this module
    """Nothing came in time."""


@final
class _Client(SdoClient):
    """canopen's SDO client, blocking in the runtime instead of on the wall clock."""

    MAX_RETRIES = 1  # a request is sent once: who asks again is the caller, after quarantine

    def __init__(self, link: CanopenLink, node_id: int, timeout_s: float) -> None:
        super().__init__(  # type: ignore[no-untyped-call]  # canopen's
            _REQUEST_ID + node_id, _RESPONSE_ID + node_id, _NothingKnown()
        )
        self.network = link.network
        self.timeout_s = timeout_s
        self.strays = 0
        self.booted = False
        self._link = link
        self._runtime: Runtime = link.runtime
        self._request: Transmission | None = None
        self._opened = b""  # index and sub-index of the transfer
        self.odd: bytes | None = None  # a frame during the transfer that was no answer to it
        self._answers: deque[bytes] = deque()
        self._quarantine_ns: int | None = None

    # --- canopen's hooks

    def send_request(self, request: bytearray) -> None:
        """The request is on its way; what came before it is no answer to it."""
        data = bytes(request)
        service = data[0] >> 5
        if service in (_DOWNLOAD, _UPLOAD) or (
            service in (_BLOCK_UPLOAD, _BLOCK_DOWNLOAD) and not data[0] & 0x03  # its beginning
        ):
            self._opened = data[1:4]
        self._answers.clear()
        transmission = Transmission(can_frame(self.rx_cobid, data))
        self._request = None if data[0] == _ABORT else transmission
        self._link.send_as(transmission)

    def read_response(self) -> bytes:
        """The answer, within the runtime's deadline."""
        if not self._answers:
            self._runtime.wait_until(self._is_over, self.timeout_s)
        if not self._answers:
            raise _NoAnswer(f"nothing within {self.timeout_s:g} s")
        answer = self._answers.popleft()
        if answer[0] == _ABORT:
            raise SdoAbortedError(int.from_bytes(answer[4:8], "little"))
        return answer

    def abort(self, abort_code: int = 0x0800_0000) -> None:
        """The server is told that the transfer is over; what went wrong is raised, not logged."""
        self.send_request(
            bytearray(bytes((_ABORT,)) + self._opened + abort_code.to_bytes(4, "little"))
        )

    # --- the channel's side

    def _is_over(self) -> bool:
        return bool(self._answers) or self.booted

    def heard(self, frame: bytes, time_ns: int) -> None:
        """A frame of the server; kept if it can be the answer to the request that waits."""
        request = self._request
        if request is None or (request.time_ns is None and self._link.confirms):
            self.strays += 1
            self._quarantine_ns = None  # the late answer, most likely: nothing else can come
            return
        data = frame[8:16]
        if not self._can_answer(data, request.frame[8]):
            self.strays += 1
            self.odd = data
            return
        self._answers.append(data)

    def _can_answer(self, data: bytes, asked: int) -> bool:
        """Whether this can be the answer to the command byte `asked` (CiA 301, SDO protocols)."""
        command = data[0]
        service = asked >> 5
        if command == _ABORT:
            # One that names no object says that a server has no transfer: not the one just begun.
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
        return True  # block transfer: the client of canopen looks itself

    def odd_text(self) -> str:
        """The frame that was no answer, in hex."""
        return "nothing" if self.odd is None else self.odd.hex(" ").upper()

    def is_odd_about_this(self) -> bool:
        """Whether it was about the very object of the transfer, so that the server meant it."""
        return self.odd is not None and self.odd[1:4] == self._opened

    def place(self) -> tuple[int, int]:
        """(index, sub-index) of the transfer; 0 where none has begun."""
        opened = self._opened.ljust(3, b"\0")
        return int.from_bytes(opened[:2], "little"), opened[2]

    def aborted(self, node_id: int, code: int) -> SdoAborted:
        """The error of the interface for an abort of the transfer."""
        index, subindex = self.place()
        return SdoAborted(node_id=node_id, index=index, subindex=subindex, abort_code=code)

    def begin(self, place: bytes) -> None:
        """A transfer of this object begins; it waits while an old answer may still come."""
        self._opened = place
        self.odd = None
        self.booted = False
        if self._quarantine_ns is not None:
            left_ns = self._quarantine_ns - self._runtime.now_ns()
            if left_ns > 0:
                self._runtime.wait_until(self._is_clean, left_ns / 1e9)
            self._quarantine_ns = None
            self.booted = False

    def end(self) -> None:
        """The transfer is over: whatever comes now is stray."""
        self._request = None

    def _is_clean(self) -> bool:
        return self._quarantine_ns is None or self.booted

    def quarantine(self, until_ns: int) -> None:
        """An answer may still come until then."""
        self._request = None
        self._quarantine_ns = until_ns


@final
class SdoChannel:
    """The default SDO channel of one node: 600h + node-ID there, 580h + node-ID back.

    What is not wrapped here (block transfer, streams) canopen's own client does, inside `alone`.

    Attributes:
        physical: whose low-level access keeps other threads out; None: nobody's.
        process_lock: keeps the transfers of other processes apart; None: there are none.
        before_writing: while the node is set up: raises if it may not be written to.
    """

    def __init__(
        self, link: CanopenLink, node_id: int, *, timeout_s: float, quarantine_s: float
    ) -> None:
        self.physical: PhysicalMotor | None = None
        self.process_lock: ProcessLock | None = None
        self.before_writing: Callable[[], None] | None = None
        self._link = link
        self._node_id = node_id
        self._quarantine_ns = round(quarantine_s * 1e9)
        self._client = _Client(link, node_id, timeout_s)
        self._lock = TurnLock(link.runtime)
        self._what = f"the SDO channel of node {node_id}"
        link.handle(_RESPONSE_ID + node_id, self._client.heard)

    @contextmanager
    def alone(self) -> Iterator[SdoClient]:
        """The client of canopen, used by nobody else inside the block, and with no old answer due.

        Its own errors, SdoAbortedError and SdoCommunicationError, leave the block as `upload`'s.
        """
        with self._lock.turn(_TURN_TIMEOUT_S, self._what), ExitStack() as held:
            if self.physical is not None:
                self.physical.require_not_held_elsewhere()
            if self.process_lock is not None:
                held.enter_context(self._take(self.process_lock))
            client = self._client
            client.begin(b"")
            bound_ns = self._link.runtime.now_ns() + self._quarantine_ns
            try:
                yield client
            except SdoAbortedError as error:
                raise client.aborted(self._node_id, error.code) from error
            except SdoCommunicationError as error:
                self._quarantine(bound_ns)
                index, subindex = client.place()
                if isinstance(error, _NoAnswer):
                    raise self._no_answer(index, subindex) from error
                where, problem = _where(index, subindex), f"{error} ({_OTHER_CLIENTS})"
                raise ProtocolViolation(
                    node_id=self._node_id, where=where, problem=problem
                ) from error
            finally:
                client.end()

    def finish(self) -> None:
        """What was under way is over, and who comes now has found out who may come.

        Raises:
            DeadlineExceeded: somebody keeps the channel.
        """
        with self._lock.turn(_TURN_TIMEOUT_S, self._what):
            pass

    @property
    def strays(self) -> int:
        """How many answers came to nothing that was asked."""
        return self._client.strays

    def rebooted(self) -> None:
        """The node has booted: what it was asked before is forgotten."""
        self._client.booted = True

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """The bytes of an object, read from the device.

        Raises:
            SdoAborted: the device refused.
            DeadlineExceeded: it did not answer in time.
            ProtocolViolation: it answered something else.
        """
        return self._transfer(index, subindex, None)

    def download(self, index: int, subindex: int, data: bytes) -> None:
        """`data` was written to an object of the device.

        Raises: as `upload`. After DeadlineExceeded it is not known whether the device has it.
        """
        if not isinstance(data, bytes):
            raise UsageError(f"{self._what}: data {data!r}: what is written are bytes")
        self.check_writing()
        self._transfer(index, subindex, data)

    def check_writing(self) -> None:
        """Raises MotorBusyError if the node is being set up, and another process owns it."""
        if self.before_writing is not None:
            self.before_writing()

    def _quarantine(self, until_ns: int) -> None:
        """An answer may still come until then; nor does another process ask anything."""
        self._client.quarantine(until_ns)
        hold = None if self.process_lock is None else self.process_lock.hold
        if hold is not None:
            runtime = self._link.runtime
            hold.keep_for(runtime, (until_ns - runtime.now_ns()) / 1e9)

    def _take(self, lock: ProcessLock) -> Hold:
        return lock.acquire(self._link.runtime, "an SDO transfer", _TURN_TIMEOUT_S, self)

    def _transfer(self, index: int, subindex: int, data: bytes | None) -> bytes:
        """An upload where there are no `data`."""
        client = self._client
        try:
            place = _PLACE.pack(index, subindex)
        except struct.error:
            place_text = f"index {index!r}, sub-index {subindex!r}"
            raise UsageError(f"{self._what}: {place_text}: 0 to FFFFh, 0 to FFh") from None
        turn = self._lock.take(_TURN_TIMEOUT_S, self._what)
        hold: Hold | None = None
        try:
            if self.physical is not None and self.physical.access is not None:
                self.physical.require_not_held_elsewhere()
            if self.process_lock is not None:
                hold = self._take(self.process_lock)
            client.begin(place)
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
            except _NoAnswer:
                self._quarantine(bound_ns)
                raise self._no_answer(index, subindex) from None
            except SdoCommunicationError as error:
                self._quarantine(bound_ns)
                raise ProtocolViolation(
                    node_id=self._node_id,
                    where=_where(index, subindex),
                    problem=f"{error} ({_OTHER_CLIENTS})",
                ) from None
            except BaseException:  # interrupted in the middle: an answer is still to come
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
