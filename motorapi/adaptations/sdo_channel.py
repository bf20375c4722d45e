"""SDO transfers by canopen's client, waiting in a Runtime.

Importing this module loads canopen. canopen's client blocks on a queue and on the wall clock. Here
it blocks in `Runtime.wait_until`, with a deadline of the runtime's time, and never accepts a stale
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
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Final, final

from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from motorapi.adaptations.canopen_errors import ProtocolViolation, SdoAborted
from motorapi.adaptations.canopen_link import CanopenLink
from motorapi.adaptations.sdo_client import REQUEST_ID, RESPONSE_ID, ChannelClient, NoAnswer
from motorapi.adaptations.turn_lock import TurnLock
from motorapi.errors import DeadlineExceeded, MotorError, UsageError
from motorapi.process_lock import Hold, ProcessLock

if TYPE_CHECKING:
    from motorapi.adaptations.canopen_link import Transmission
    from motorapi.fencing import Fence
    from motorapi.sharing import PhysicalMotor

_PLACE: Final = struct.Struct("<HB")  # index and sub-index
_CONTROLWORD: Final = b"\x40\x60\x00"
_INITIATE_DOWNLOAD: Final = 1
_TURN_TIMEOUT_S: Final = 10.0
_OTHER_CLIENTS: Final = "another SDO client may be using this channel"


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
    """

    def __init__(
        self, link: CanopenLink, node_id: int, *, timeout_s: float, quarantine_s: float
    ) -> None:
        self.physical: PhysicalMotor | None = None
        self.process_lock: ProcessLock | None = None
        self.before_writing: Callable[[], None] | None = None
        self.fence: Fence | None = None
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
        if frame[8] >> 5 == _INITIATE_DOWNLOAD and frame[9:12] == _CONTROLWORD:
            until_ns = self._link.runtime.now_ns() + self._quarantine_ns
            self._client.expect(_CONTROLWORD, until_ns)

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

    def _take(self, lock: ProcessLock) -> Hold:
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
        hold: Hold | None = None
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
