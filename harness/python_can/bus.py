"""python-can interface to an emulated bus: `can.Bus(interface="emulated", channel=...)`.

`channel` is the name of a bus of the rig that is open in this process ("can0"). Alternatively it is
the path of the socket that `motorhil serve --socket` created. A program written for python-can
needs no other change. In a rig of this process, `recv` and `send_periodic` use the rig's time; over
a socket they use wall time, and stamps count from 1970. The bus passes every frame to the program's
receive queue.

A received message's `channel` is the `channel` of `can.Bus`, as with python-can's `virtual` and
`socketcan`. If `motorhil run` replaces another interface, it is the channel of that interface.

CAN FD works as with SocketCAN: a connection opened without `fd=True` neither sends nor receives CAN
FD frames. The bus must be an FD bus (`data_bitrate_bit_s`).

Errors seen by the program's own CAN controller arrive as error frames, as from SocketCAN.
`can_filters` do not apply to them. `ignore_rx_error_frames=True` suppresses them. `state` is
derived from them: ACTIVE (error active, including the warning level), PASSIVE (error passive) or
ERROR (bus-off). python-can's own SocketCAN interface never queries the controller and always
reports ACTIVE.

Source: Linux include/uapi/linux/can/error.h; python-can 4.6.1, can/bus.py and interfaces.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, Protocol, final

import can
from can import BusState, CanInitializationError, CanOperationError, CanProtocol, Message
from can.broadcastmanager import (
    CyclicSendTaskABC,
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)

from motorhil.emulators.can.error_confinement import (
    CONTROLLER,
    ERROR_ACTIVE,
    MESSAGE_BUS_OFF,
    RESTARTED,
    RX_PASSIVE,
    RX_WARNING,
    TX_PASSIVE,
    TX_WARNING,
)
from motorhil.emulators.can.frame import ERR_FLAG, can_id_of
from motorhil.emulators.simulation.ownership_notice import OwnershipNotice
from motorhil.harness.python_can.hub_client import HubLink
from motorhil.harness.python_can.messages import to_frame, to_message
from motorhil.harness.python_can.receive_queue import ReceiveQueue
from motorhil.harness.python_can.send_limit import SendLimit

if TYPE_CHECKING:
    from motorhil.harness.virtual_time.runtime import VirtualRuntime
    from motorhil.motorapi.errors import MotorBusyError
    from motorhil.motorapi.runtime.api import FrameListener, Registration

_STATE_AT: Final = 9  # data[1] of the message
_PASSIVE: Final = RX_PASSIVE | TX_PASSIVE
_ACTIVE: Final = RX_WARNING | TX_WARNING | ERROR_ACTIVE
_BACKLOG_MAX: Final = 65_536
_LONG_NS: Final = 600 * 10**9  # of an endless loop over messages
_OPEN: dict[str, "tuple[Buses, VirtualRuntime, str]"] = {}


class HostPort(Protocol):
    """A port of an application on a bus."""

    @property
    def name(self) -> str:
        """Its name on the bus."""

    def send(self, frame: bytes, /) -> None:
        """Queue the frame for the bus."""

    def pending(self) -> int:
        """Return the number of its frames that are not yet sent."""

    def close(self) -> None:
        """Stop deliveries to the application."""


class BusFacts(Protocol):
    """Facts of a bus that an application needs."""

    @property
    def data_bitrate_bit_s(self) -> int | None:
        """The data bit rate [bit/s]; None for classical CAN."""


class Buses(Protocol):
    """The buses of a rig: its World in this process, or their like in another one."""

    def bus_names(self) -> list[str]:
        """Return the names of the buses in the order of the rig."""

    def bus(self, name: str) -> BusFacts:
        """Return what is known of a bus."""

    def add_host(
        self, bus: str, name: str, on_frame: "FrameListener", on_error: "FrameListener | None", /
    ) -> HostPort:
        """Return an application's port on the bus, which hears every frame."""

    def tell_ownership(self, bus: str, sender: str, notice: OwnershipNotice) -> None:
        """Pass on a host's notice about the ownership of a motor."""


def is_error(frame: bytes) -> bool:
    """Return True for an error message of a CAN controller, False for a frame of the bus."""
    return bool(can_id_of(frame) & ERR_FLAG)


def state_after(message: bytes, before: BusState) -> BusState:
    """Return the state after this error message; most messages do not change it."""
    classes = can_id_of(message)
    if classes & MESSAGE_BUS_OFF:
        return BusState.ERROR
    if classes & CONTROLLER and message[_STATE_AT] & _PASSIVE:
        return BusState.PASSIVE
    if classes & RESTARTED or (classes & CONTROLLER and message[_STATE_AT] & _ACTIVE):
        return BusState.ACTIVE
    return before


def open_rig(world: Buses, runtime: "VirtualRuntime", shared_at: str = "") -> None:
    """Make the rig's buses available by name in this process.

    `shared_at` is the socket through which processes share the rig; "": this one has it alone.

    Raises:
        CanInitializationError: a bus of that name is open already.
    """
    for name in world.bus_names():
        if name in _OPEN:
            remedy = "close that rig first"
            if _runs_in_virtual_time():
                remedy += "; a program that opens its own rig is run by python, not by motorhil run"
            raise CanInitializationError(
                f"bus {name!r}: another rig that is open in this process has a bus of that "
                f"name; {remedy}"
            )
    for name in world.bus_names():
        _OPEN[name] = (world, runtime, shared_at)


def close_rig(world: Buses) -> None:
    """Withdraw the rig's buses; they can no longer be joined by name."""
    for name in [name for name, (owner, _, _) in _OPEN.items() if owner is world]:
        del _OPEN[name]


def bus_names() -> tuple[str, ...]:
    """Return the names of the buses that can be joined in this process."""
    return tuple(_OPEN)


def _overtaken(motor: str, token: int, newer: tuple[int, str]) -> "MotorBusyError":
    from motorhil.motorapi.errors import MotorBusyError  # only where motorapi is used

    since = f"it took it over (token {newer[0]}; ours was {token})"
    return MotorBusyError(motor=motor, holder=newer[1], since_ns=0, since=since)


def _runs_in_virtual_time() -> bool:
    from motorhil.harness.virtual_time.stdlib.threads import program_here  # only for programs

    return program_here() is not None


def _refuse_in_virtual_time(channel: str) -> None:
    if _runs_in_virtual_time():
        raise CanInitializationError(
            f"channel {channel!r} is a socket in wall time, but this program runs in virtual "
            "time; join a bus of the rig by its name, or run the program with 'motorhil serve "
            "RIG -- python SCRIPT'"
        )


@final
class _Subscription:
    """A listener on an emulated bus, until cancelled."""

    def __init__(self, listeners: "list[FrameListener]", listener: "FrameListener") -> None:
        self._listeners = listeners
        self._listener = listener
        listeners.append(listener)

    def cancel(self) -> None:
        """Remove the listener."""
        if self._listener in self._listeners:
            self._listeners.remove(self._listener)


@final
class EmulatedBus(can.BusABC):
    """One application's connection to an emulated bus, in virtual time or through a socket.

    Args:
        channel: the name of a bus, or a hub's socket.
        can_filters: the filters of received messages.
        told_channel: the channel of received messages; None: `channel` itself.
        receive_own_messages: True to receive messages of this object too.
        ignore_rx_error_frames: True to receive no error frames.
        fd: True to send and receive CAN FD frames.
        shared_at: the socket through which processes share the rig; "": as the rig was opened.

    Attributes:
        channel: the name of the bus or the hub's socket.
        runtime: the rig's Runtime if the rig is in this process; absent over a socket.
    """

    def __init__(
        self,
        channel: Any = "can0",  # Any: a text, or a path object
        can_filters: can.typechecking.CanFilters | None = None,
        *,
        told_channel: Any = None,  # Any: a channel of any interface
        receive_own_messages: bool = False,
        ignore_rx_error_frames: bool = False,
        fd: bool = False,
        shared_at: str = "",
        **kwargs: Any,  # Any: python-can passes every option of its configuration here
    ) -> None:
        self.channel_info: str = f"emulated bus {channel}"
        self.channel: str = str(channel)
        self._told_channel = channel if told_channel is None else told_channel
        self._own = receive_own_messages
        self._ignores_errors = ignore_rx_error_frames
        self._state = BusState.ACTIVE
        self._queue = ReceiveQueue(receive_own_messages, _BACKLOG_MAX, fd)
        self._fd = fd
        self._has_received = False
        self._limit: SendLimit | None = None  # a hub has its own
        self._is_shutdown = True  # until fully open, because BusABC.__del__ reads it
        self._hub: HubLink | None = None
        self._port: HostPort | None = None
        self._shared_at = ""
        if self.channel in _OPEN:
            world, runtime, opened_at = _OPEN[self.channel]
            self._shared_at = shared_at or opened_at
            self.runtime: VirtualRuntime = runtime
            self._world = world
            if fd and world.bus(self.channel).data_bitrate_bit_s is None:
                raise CanInitializationError(
                    f"fd=True: bus {self.channel} is classical CAN; give [bus.{self.channel}] "
                    "of the rig a data_bitrate_bit_s"
                )
            try:
                self._port = world.add_host(
                    self.channel, "host", self._queue.receive, self._receive_error
                )
            except ValueError as error:  # the bus is full
                raise CanInitializationError(str(error)) from None
            self._limit = SendLimit(self._port, self.channel)
            self._note_use()
        elif "/" in self.channel:
            _refuse_in_virtual_time(self.channel)
            self._hub = HubLink(self.channel, fd)
        else:
            known = ", ".join(_OPEN) or "none"
            raise CanInitializationError(
                f"channel {self.channel!r}: neither a bus of a rig open in this process (open: "
                f"{known}) nor a socket of 'motorhil serve'; open the rig first, or run the "
                "program with 'motorhil run RIG SCRIPT'"
            )
        self._is_shutdown = False
        super().__init__(channel=self.channel, can_filters=can_filters, **kwargs)
        self._can_protocol = CanProtocol.CAN_FD if fd else CanProtocol.CAN_20

    # --- interface of the motor interface (Linux frames) --------------------------------------

    def subscribe(self, on_frame: "FrameListener", fd: bool = False) -> "Registration":
        """Call `on_frame` for every frame, for CAN FD frames with fd=True only.

        Unless `recv` has been used, nothing is queued for it any more.
        """
        self._check_open()
        if not self._has_received:
            self._queue.keeps = False
            self._queue.backlog.clear()
        queue = self._queue
        made = _Subscription(queue.fd_listeners if fd else queue.listeners, on_frame)
        self._note_use()
        return made

    def _note_use(self) -> None:
        note = getattr(self._port, "note_use", None)  # of a rig in another process
        if note is not None:
            calls = bool(self._queue.listeners or self._queue.fd_listeners)
            note(keeps=not calls, own=calls or self._own)

    @property
    def hub_bus(self) -> tuple[str, str] | None:
        """The (socket path, bus name) by which processes share it; None in a rig of this one."""
        if self._shared_at:
            return self._shared_at, self.channel
        return None if self._hub is None else (self._hub.path, self._hub.bus)

    @property
    def dropped(self) -> int:
        """The number of unread frames discarded, oldest first (at most 65,536 wait)."""
        return self._queue.dropped

    def pending(self) -> int:
        """Return the number of own frames that are not yet sent; 0 over a socket."""
        return 0 if self._port is None else self._port.pending()

    def transmit(self, frame: bytes) -> None:
        """Queue the frame for transmission on the bus.

        Raises:
            CanOperationError: it is closed, or too many frames wait already.
        """
        if self._is_shutdown:
            self._check_open()
        if self._port is not None:
            self._port.send(frame)
            if self._limit is not None:
                try:
                    self._limit.count()
                except ValueError as error:
                    raise CanOperationError(str(error)) from None
        elif self._hub is not None:
            self._hub.send(frame)

    def transmit_fenced(self, frame: bytes, resource: int, token: int) -> None:
        """Transmit a commanding frame with its fencing token, which a hub checks.

        Raises:
            MotorBusyError: the hub has already refused that token.
        """
        if self._hub is None:
            self.transmit(frame)
            return
        if self._is_shutdown:
            self._check_open()
        self.check_token(resource, token)
        self._hub.send_fenced(frame, resource, token)

    def check_token(self, resource: int, token: int) -> None:
        """Raise MotorBusyError if the hub has refused frames with this token; names the owner."""
        newer = None if self._hub is None else self._hub.stale.get(resource)
        if newer is not None and token < newer[0]:
            raise _overtaken(f"{self.channel} node {resource & 0xFF}", token, newer)

    def announce_ownership(self, resource: int, action: int, token: int, **facts: Any) -> None:
        """Announce who owns a motor, to the hub or to the open rig.

        `facts` are the further fields of OwnershipNotice.
        """
        if self._is_shutdown:
            return
        notice = OwnershipNotice(resource, action, token, **facts)
        if self._hub is not None:
            self._hub.announce(notice)
        elif self._port is not None:
            self._world.tell_ownership(self.channel, self._port.name, notice)

    def _check_open(self) -> None:
        if self._is_shutdown:
            raise CanOperationError(f"{self.channel_info}: this bus object was shut down")

    # --- interface of python-can ---------------------------------------------------------------

    def send(self, msg: Message, timeout: float | None = None) -> None:
        """Queue the message for transmission on the bus."""
        if msg.is_fd and not self._fd:
            raise CanOperationError(
                f"CAN FD frame {msg.arbitration_id:X}h: {self.channel_info} was opened for "
                "classical CAN; open it with fd=True"
            )
        try:
            self.transmit(to_frame(msg))
        except ValueError as error:
            raise CanOperationError(str(error)) from error

    def __iter__(self) -> Iterator[Message]:
        """Yield messages for ever, as python-can does; warn once of a loop without an end."""
        end_ns = None if self._hub is not None else self.runtime.now_ns() + _LONG_NS
        while True:
            message = self.recv(timeout=1.0)
            if message is not None:
                yield message
            if end_ns is not None and self.runtime.now_ns() >= end_ns:
                end_ns = None
                warnings.warn(
                    f"for message in {self.channel}: the loop has run through 10 min of virtual"
                    " time, and never ends by itself; leave it with break, or receive with"
                    " bus.recv(timeout) until a time of rig.runtime.now_ns()",
                    stacklevel=2,
                )

    def recv(self, timeout: float | None = None) -> Message | None:
        """Return the next message, or None after `timeout` [s] of the rig's time."""
        if self._hub is not None:
            return super().recv(timeout)
        self._check_open()
        self._queue.keeps = self._has_received = True
        deadline_ns = (
            None if timeout is None else self.runtime.now_ns() + round(max(timeout, 0.0) * 1e9)
        )
        while True:
            left_s = None
            if deadline_ns is not None:
                left_s = max(0, deadline_ns - self.runtime.now_ns()) / 1e9
            if not self.runtime.wait_until(self._queue.has_frame, left_s):
                return None
            frame, time_ns, transmitted = self._queue.backlog.popleft()
            message = to_message(frame, time_ns, self._told_channel, received=not transmitted)
            if message.is_error_frame:
                if not self._ignores_errors:
                    return message
            elif self._matches_filters(message):
                return message

    def _recv_internal(self, timeout: float | None) -> tuple[Message | None, bool]:
        """Receive over a socket only; BusABC.recv applies the filters and the timeout."""
        if self._hub is None:
            return None, False
        while True:
            received = self._hub.receive(timeout)
            if received is None:
                return None, False
            frame, time_ns, transmitted = received
            is_error_frame = is_error(frame)
            if is_error_frame:
                self._state = state_after(frame, self._state)
            if not self._ignores_errors if is_error_frame else self._own or not transmitted:
                time_ns += self._hub.begin_ns
                message = to_message(frame, time_ns, self._told_channel, received=not transmitted)
                return message, is_error_frame

    def _receive_error(self, message: bytes, time_ns: int, _: bool) -> None:
        self._state = state_after(message, self._state)
        self._queue.receive(message, time_ns, False)

    @property
    def bus_off_remedy(self) -> str:
        """The remedy for bus-off, for error messages of the motor interface."""
        return "recovery: recovery_s of its node in the rig, or rig.faults.restart()"

    @property
    def state(self) -> BusState:
        """The state of the CAN controller: PASSIVE is error passive, ERROR is bus-off.

        Over a socket it is the state as of the last message that was read.
        """
        return self._state

    @state.setter
    def state(self, new_state: BusState) -> None:
        raise NotImplementedError(
            f"{self.channel_info}: the state cannot be set; it follows from the errors on the bus"
        )

    def receive_frame(self, timeout_s: float) -> tuple[bytes, int, bool] | None:
        """Return the next (frame, hub time [ns], transmitted), own ones too; socket only."""
        return None if self._hub is None else self._hub.receive(timeout_s)

    def fileno(self) -> int:
        """Return the socket's descriptor, or -1 in a rig of this process, which has none."""
        return -1 if self._hub is None else self._hub.fileno()

    def _send_periodic_internal(
        self,
        msgs: Sequence[Message] | Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[Message], None] | None = None,
    ) -> CyclicSendTaskABC:
        """Send periodically in the rig's time; the inherited method starts a wall-time thread."""
        if self._hub is not None:
            return super()._send_periodic_internal(
                msgs, period, duration, autostart, modifier_callback
            )
        task = _PeriodicTask(self, msgs, period, duration, modifier_callback)
        if autostart:
            task.start()
        return task

    def shutdown(self) -> None:
        """Leave the bus; frames still queued are transmitted."""
        was_open = not self._is_shutdown
        super().shutdown()  # first, so that a reader in another thread sees the reason
        if was_open and self._port is not None:
            self._port.close()
        if was_open and self._hub is not None:
            self._hub.close()


@final
class _PeriodicTask(
    LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC
):
    """python-can's cyclic task, driven by the rig's time."""

    def __init__(
        self,
        bus: EmulatedBus,
        messages: Sequence[Message] | Message,
        period_s: float,
        duration_s: float | None,
        modifier: Callable[[Message], None] | None,
    ) -> None:
        super().__init__(messages, period_s, duration_s)
        self._bus = bus
        self._modifier = modifier
        self._next = 0
        self._end_ns: int | None = None
        self._registration: Registration | None = None

    def start(self) -> None:
        """Send the first message now and one more after each period."""
        self.stop()
        runtime = self._bus.runtime
        if self.duration is not None:
            self._end_ns = runtime.now_ns() + round(self.duration * 1e9)
        self._send_one()
        self._registration = runtime.every(self.period, self._send_one)

    def _send_one(self) -> None:
        if self._end_ns is not None and self._bus.runtime.now_ns() >= self._end_ns:
            self.stop()
            return
        message = self.messages[self._next]
        self._next = (self._next + 1) % len(self.messages)
        if self._modifier is not None:
            self._modifier(message)
        self._bus.send(message)

    def stop(self) -> None:
        """Stop sending."""
        if self._registration is not None:
            self._registration.cancel()
            self._registration = None
