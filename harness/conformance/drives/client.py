"""canopen's client on one bus, waiting in a runtime of virtual or wall time.

`canopen.Network` is never connected: frames go out by the runtime, and come in by `notify`. The SDO
client waits in the runtime. All frames are kept with the times when they were complete on the bus.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoCommunicationError

from motorhil.emulators.can.frame import (
    EFF_FLAG,
    ERR_FLAG,
    RTR_FLAG,
    can_id_of,
    data_of,
    pack,
    pack_remote,
)
from motorhil.frozen import frozen
from motorhil.motorapi.runtime.api import Runtime

if TYPE_CHECKING:
    import can

NMT: Final = 0x000
SYNC: Final = 0x080
_SDO_TIMEOUT_S: Final = 0.5
_ANSWER_S: Final = 0.1


@final
@frozen
class Frame:
    """A frame, complete on the bus at `time_ns`; `is_ours` if the client sent it."""

    time_ns: int
    can_id: int
    data: bytes
    is_ours: bool


@final
class _Client(SdoClient):
    """canopen's SDO client; waits in the runtime of its network."""

    RESPONSE_TIMEOUT = _SDO_TIMEOUT_S

    def read_response(self) -> bytes:
        """Return the response, or raise the client's own errors."""
        assert isinstance(self.network, Client)
        runtime = self.network.runtime
        if not runtime.wait_until(lambda: not self.responses.empty(), self.RESPONSE_TIMEOUT):
            raise SdoCommunicationError("No SDO response received")
        response: bytes = super().read_response()  # type: ignore[no-untyped-call]  # canopen's
        return response

    def abort(self, abort_code: int = 0x0800_0000) -> None:
        """Abort the transfer; the inherited method logs, but the clauses tell what they see."""
        request = b"\x80\0\0\0" + abort_code.to_bytes(4, "little")
        self.send_request(request)  # type: ignore[no-untyped-call]  # canopen's


@final
class _Node(canopen.RemoteNode):
    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> SdoClient:
        """Add a client that waits in the runtime."""
        client = _Client(  # type: ignore[no-untyped-call]  # canopen's
            rx_cobid, tx_cobid, self.object_dictionary
        )
        self.sdo_channels.append(client)
        return client


@final
class Client(canopen.Network):
    """A host on the bus of a drive.

    Attributes:
        runtime: where the client waits.
        node: canopen's node; it knows no dictionary, and transfers bytes.
        frames: all frames so far, in the order of their completion.
    """

    def __init__(self, bus: "can.BusABC", runtime: Runtime, node_id: int) -> None:
        super().__init__()
        self.runtime: Final = runtime
        self.frames: list[Frame] = []
        self._bus = bus
        self._registration = runtime.listen(bus, self._on_frame)
        self.node: Final = _Node(
            node_id,
            canopen.ObjectDictionary(),  # type: ignore[no-untyped-call]  # canopen's
        )
        self.add_node(self.node)

    def close(self) -> None:
        """Stop listening."""
        self._registration.cancel()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Queue a frame."""
        self.runtime.send(self._bus, pack_remote(can_id) if remote else pack(can_id, bytes(data)))

    def ask(
        self, can_id: int, data: bytes, answer_id: int, *, count: int = 1, remote: bool = False
    ) -> list[Frame]:
        """Queue a request; return the answers that begin to come within 0.1 s of each other.

        Args:
            can_id: of the request.
            data: of the request.
            answer_id: the identifier of the answers.
            count: the number of answers to wait for.
            remote: the request is a remote frame.
        """
        begin_ns = self.runtime.now_ns()
        self.send_message(can_id, data, remote)
        heard: list[Frame] = []
        for number in range(1, count + 1):
            self.runtime.wait_until(
                lambda least=number: len(self.heard(answer_id, begin_ns)) >= least,  # type: ignore[misc]  # mypy#15459
                _ANSWER_S,
            )
            heard = self.heard(answer_id, begin_ns)
            if len(heard) < number:
                break
        return heard

    def send(self, can_id: int, data: bytes = b"") -> Frame:
        """Send a frame and wait until it was on the bus; return it with its time.

        Raises:
            SdoCommunicationError: the bus does not transmit it within 0.5 s.
        """
        first = len(self.frames)
        self.send_message(can_id, data)

        def own() -> Frame | None:
            for one in self.frames[first:]:
                if one.is_ours and one.can_id == can_id and one.data == data:
                    return one
            return None

        self.runtime.wait_until(lambda: own() is not None, _SDO_TIMEOUT_S)
        sent = own()
        if sent is None:
            raise SdoCommunicationError(f"frame {can_id:03X}h was not transmitted")
        return sent

    def heard(self, can_id: int, since_ns: int) -> list[Frame]:
        """Return the frames with this identifier from others, complete after `since_ns`."""
        found: list[Frame] = []
        for one in reversed(self.frames):
            if one.time_ns <= since_ns:
                break
            if one.can_id == can_id and not one.is_ours:
                found.append(one)
        return found[::-1]

    def wait_for(self, holds: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until `holds()`; return whether it did within `timeout_s` [s]."""
        return self.runtime.wait_until(holds, timeout_s)

    def _on_frame(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        can_id = can_id_of(frame)
        if can_id & (ERR_FLAG | EFF_FLAG | RTR_FLAG):
            return
        data = data_of(frame)
        self.frames.append(Frame(time_ns, can_id, data, transmitted))
        if not transmitted:
            self.notify(can_id, bytearray(data), time_ns / 1e9)
