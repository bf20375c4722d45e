"""The connection of a hardware object to one drive on a CAN bus: what every drive repeats.

A hardware object contains one `CanDrive`. It registers the physical motor, locks and fences it
between programs, passes received frames on, confirms sent ones, notices the loss of the drive, and
keeps what the drive was told. It knows no protocol.

Costs: a received frame of the bus costs one look-up, however many drives there are; nothing grows
with time.
"""

from collections.abc import Callable, Hashable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, final

from motorhil.motorapi.api.bus_traffic import traffic_on
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, UsageError
from motorhil.motorapi.locking.directory import bus_name
from motorhil.motorapi.locking.process_lock import ProcessLock, can_share_time
from motorhil.motorapi.ownership.fencing import NodeFence, announce
from motorhil.motorapi.ownership.physical_motor import (
    PhysicalMotor,
    RunStatus,
    register_physical_motor,
    release_physical_motor,
)
from motorhil.motorapi.runtime.api import ChangeCounter, wait_until
from motorhil.motorapi.runtime.can_link import Transmission as SentFrame
from motorhil.motorapi.runtime.can_link import bus_label, open_link, release_link
from motorhil.motorapi.runtime.can_sources import BusStatus, pack
from motorhil.motorapi.runtime.turn_lock import TurnLock
from motorhil.motorapi.runtime.wall import runtime_of
from motorhil.motorapi.synchronization.bus_load import (
    NodeTraffic,
    PeriodicMessage,
    note_node,
    own_traffic,
)
from motorhil.motorapi.synchronization.offer import Firing, OneFrame, SyncOffer
from motorhil.motorapi.synchronization.quality import SyncLevel

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.ownership.fencing import BoundFence
    from motorhil.motorapi.runtime.api import Registration, Runtime
    from motorhil.motorapi.runtime.can_link import FrameHandler

DataHandler = Callable[[bytes, int], None]
"""(data of the frame; empty for a remote frame, time when it was complete on the bus [ns])."""

_EXTENDED: Final = 0x8000_0000
_ID: Final = 0x1FFF_FFFF
_BRS: Final = 1
_REMOTE: Final = 0x4000_0000
_DATA_AT: Final = 8
_LOOKS: Final = 6  # per timeout of a sign of life
_CONNECT_ASK_S: Final = 0.1


@final
class SignOfLife:
    """A message that the drive sends periodically, or when it is asked.

    Attributes:
        last_ns: when the last one was complete on the bus [ns]; None before the first one.
        lost_since_ns: when its absence was noticed [ns]; None while it comes.
    """

    def __init__(self, name: str, timeout_s: float, on_loss: Callable[[], None] | None) -> None:
        self.name: Final = name
        self.timeout_s: Final = timeout_s
        self.on_loss: Final = on_loss
        self.last_ns: int | None = None
        self.lost_since_ns: int | None = None

    def came(self, time_ns: int) -> bool:
        """Record that it came. Return True after a loss, and for the first one."""
        is_new = self.last_ns is None or self.lost_since_ns is not None
        self.last_ns, self.lost_since_ns = time_ns, None
        return is_new

    def has_just_ended(self, now_ns: int) -> bool:
        """Return True once, when it is missing for longer than its timeout."""
        if self.last_ns is None or self.lost_since_ns is not None:
            return False
        if now_ns - self.last_ns <= self.timeout_s * 1e9:
            return False
        self.lost_since_ns = now_ns
        return True


@final
class CanDrive:
    """One drive on a CAN bus, for its hardware object.

    Args:
        bus: an open python-can bus with any interface.
        node: the number of the drive on the bus, 0 to 255; no two motors of a bus share it.
        owner: the hardware object, named if another one is built for the same drive.
        runtime: the runtime for waits; None: the bus's own (virtual time), else wall time.
        extended: True for identifiers of 29 bits.
        fd: True if the drive sends CAN FD frames; the bus object must be open for them.

    Attributes:
        runtime: the runtime for waits.
        label: the name of the drive in messages ("can0 node 3").
        physical: the record that its logical motors share.
        news: counts changes that may end a motion.
        status: the state of the bus from the host's CAN controller.
        is_closed: True after `close`.
        users: the number of motors built on it from settings (`Shared`).

    Raises:
        UsageError: a hardware object for this drive exists already; or `fd`, and the bus object is
            open for classical CAN only.
    """

    def __init__(
        self,
        bus: "can.BusABC",
        node: int,
        owner: object,
        *,
        runtime: "Runtime | None" = None,
        extended: bool = False,
        fd: bool = False,
    ) -> None:
        self.runtime: Final = runtime_of(bus) if runtime is None else runtime
        self.label: Final = f"{bus_label(bus)} node {node}"
        self.news: Final = ChangeCounter()
        self.is_closed: bool = False
        self.users: int = 0
        self._bus: Final = bus
        self._node: Final = node
        self._flag: Final = _EXTENDED if extended else 0
        self._fd: Final = fd
        self._handlers: Final[dict[int, FrameHandler]] = {}
        self._signs: Final[list[SignOfLife]] = []
        self._heard: tuple[bytes, int] | None = None  # the last frame, and its time
        self._told: Final[dict[Hashable, object]] = {}
        self._told_token = -1
        self._answers: Final[dict[Hashable, int]] = {}
        self._start: tuple[int, int, int | None] | None = None
        self._connecting: Final = TurnLock(self.runtime)
        where = bus_name(bus) if can_share_time(self.runtime) else None
        lock: ProcessLock | None = None
        if where is not None:
            lock = ProcessLock(f"{where}-node{node}", self.label, runtime=self.runtime)
        self.physical: Final[PhysicalMotor] = register_physical_motor(
            bus, node, self.label, owner, lock
        )
        self.physical.news = self.news
        self.physical.check_heard = self.check
        self._owner: Final = owner
        self._fence: Final = (
            None
            if lock is None
            else NodeFence(lock, self.physical.ownership, self.runtime, bus, node)
        )
        if lock is not None:
            announce(self.physical.ownership, bus, node)
        self._activities: Final[list[Registration]] = []
        try:
            self._link: Final = open_link(bus, self.runtime, fd=fd)
        except BaseException:
            release_physical_motor(bus, node, owner)
            raise
        self.status: Final[BusStatus] = self._link.status
        self._link.on_bus_off.append(self.news.grow)

    def close(self, *, at_rest: bool) -> None:
        """Stop sending and receiving; closing again does nothing.

        `at_rest`: False if a motion of the drive goes on; waits for it then fail.
        """
        if self.is_closed:
            return
        status = RunStatus.DONE if at_rest else RunStatus.GOING
        self.physical.end(f"close() of {self.label}", self.runtime.now_ns(), status)
        self.is_closed = True
        for one in self._activities:
            one.cancel()
        for can_id, handler in self._handlers.items():
            self._link.unsubscribe(can_id, handler)
        self._link.on_bus_off.remove(self.news.grow)
        release_link(self._link)
        release_physical_motor(self._bus, self._node, self._owner)
        self.news.grow()

    # --- receiving ---------------------------------------------------------------------------

    def handle(self, can_id: int, handler: DataHandler, *, is_news: bool = True) -> None:
        """Pass received data frames with this identifier to `handler`, in place of any other.

        Register commands to the drive as well: they are then those of other programs.

        Args:
            can_id: the identifier.
            handler: called in a callback; it must not wait.
            is_news: each of these frames may end a motion, and is counted in `news`; False: the
                handler counts those that may.
        """

        def hear(frame: bytes, time_ns: int) -> None:
            self._heard = frame, time_ns
            handler(frame[_DATA_AT : _DATA_AT + frame[4]], time_ns)
            if is_news:
                self.news.grow()

        word = can_id | self._flag
        before = self._handlers.get(word)
        if before is not None:
            self._link.unsubscribe(word, before)
        self._handlers[word] = hear
        self._link.subscribe(word, hear, fd=self._fd)

    def every(self, period_s: float, action: Callable[[], None]) -> None:
        """Run `action` every `period_s` [s] until `close`; it must not wait."""
        self._activities.append(self.runtime.every(period_s, action))

    def repeat(self, period_s: float, send: Callable[[], object]) -> None:
        """As `every`, but not while the bus is off; a frame that it does not accept is left out."""

        def action() -> None:
            if not self.status.is_off:
                with suppress(LinkError):
                    send()

        self.every(period_s, action)

    def answered(self, key: Hashable) -> None:
        """Note an answer, for `ask`; handlers of answers call it."""
        self._answers[key] = self._answers.get(key, 0) + 1

    def expect(
        self, name: str, timeout_s: float, on_loss: Callable[[], None] | None = None
    ) -> SignOfLife:
        """Declare a message that keeps coming; its handler calls `came` of what this returns.

        Args:
            name: the name of the message in errors ("heartbeat").
            timeout_s: the drive is lost without it for this time [s]; noticed within a sixth more.
            on_loss: called at a loss, in a callback.
        """
        sign = SignOfLife(name, timeout_s, on_loss)
        self._signs.append(sign)
        self.every(timeout_s / _LOOKS, lambda: self._look(sign))
        return sign

    @property
    def is_lost(self) -> bool:
        """True if the drive cannot be heard now: closed, bus off, or a sign of life is missing."""
        missing = any(one.lost_since_ns is not None for one in self._signs)
        return self.is_closed or self.status.is_off or missing

    def check(self) -> None:
        """Raise LinkError if the drive cannot be heard now; names the reason."""
        self.check_open()
        self.status.check()
        for one in self._signs:
            if one.lost_since_ns is not None:
                reason = f"no {one.name} for {one.timeout_s * 1e3:g} ms"
                raise LinkError(link=self.label, reason=reason, since_ns=one.lost_since_ns)

    def check_open(self) -> None:
        """Raise LinkError if the drive is closed."""
        if self.is_closed:
            raise LinkError(link=self.label, reason="this hardware object is closed")

    def connect(
        self, is_up: Callable[[], bool], ask: Callable[[], object], timeout_s: float, lacks: str
    ) -> None:
        """Ask the drive again and again until it is heard; one caller at a time.

        Args:
            is_up: returns True if all is known that commands need.
            ask: sends a request; it must not wait.
            timeout_s: longest time [s].
            lacks: the missing messages, for the error ("heartbeat and version").

        Raises:
            LinkError: the drive is not heard within `timeout_s`, or is closed, or the bus is off.
        """
        self.check_open()
        self.status.check()
        if is_up():
            return
        with self._connecting.turn(2.0 * timeout_s, f"{self.label}: connecting"):
            end_ns = self.runtime.now_ns() + round(timeout_s * 1e9)
            while not is_up():
                if self.runtime.now_ns() >= end_ns:
                    reason = f"no {lacks} within {timeout_s:g} s"
                    if self._heard is not None:
                        reason += f"; last heard: {self._last_heard()}"
                    raise LinkError(link=self.label, reason=reason)
                ask()
                wait_until(self.runtime, is_up, _CONNECT_ASK_S)

    def overheard(self, by: str, time_ns: int) -> None:
        """Record that another program commanded the drive, and so ended the active motion.

        `by` names the command ("message 0Ch"). What the drive was told is forgotten in any case.
        """
        self.doubt()
        run = self.physical.run
        if run is not None:
            self.physical.ownership.notice(run.owner)  # the error then names the new owner
            self.physical.stopped_elsewhere(f"another program ({by})", time_ns)

    # --- sending -------------------------------------------------------------------------------

    def command(
        self,
        can_id: int,
        data: bytes,
        *,
        fence: "BoundFence | None" = None,
        flags: int | None = None,
    ) -> SentFrame:
        """Send a frame that may start or change a motion or a setting.

        Args:
            can_id: the identifier.
            data: its data.
            fence: the ownership of a stream (`stream_fence`); None: the present one.
            flags: the flags of a CAN FD frame (1: bit rate switch); None: a classical frame.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: another user owns the motor, or has low-level access.
        """
        with self.physical.passage(self.label, of_holder=True):
            return self._send(can_id, data, self._fence if fence is None else fence, flags)

    def stop_command(self, can_id: int, data: bytes, *, flags: int | None = None) -> SentFrame:
        """Send a frame that stops the drive: this needs no ownership. Raises as `command`."""
        with self.physical.passage(self.label, of_holder=True):
            return self._send(can_id, data, None, flags)

    def request(
        self, can_id: int, data: bytes = b"", *, remote: int | None = None, flags: int | None = None
    ) -> SentFrame:
        """Send a frame that only reads; `remote`: as a remote frame for so many bytes.

        It passes low-level access, so that a drive stays heard: do not request in answer to a call
        of a user; use `exchange`.
        """
        return self._send(can_id, data, None, flags, remote)

    def exchange(
        self,
        request: Callable[[], object],
        is_there: Callable[[], bool],
        timeout_s: float,
        awaited: str,
        repeat_s: float | None = None,
    ) -> None:
        """Send a request, and wait for its answer.

        Args:
            request: sends it.
            is_there: returns True when the answer has been received.
            timeout_s: longest time [s].
            awaited: the answer, for the error.
            repeat_s: time after which the request is sent again [s]; None: it is sent once.

        Raises:
            DeadlineExceeded: no answer came within `timeout_s`.
            LinkError: the bus does not accept the frame, or went off.
            MotorBusyError: another user has low-level access.
        """
        status, offs = self.status, self.status.offs
        end_ns = self.runtime.now_ns() + round(timeout_s * 1e9)
        left_s = timeout_s
        with self.physical.passage(self.label, of_holder=True):
            while left_s > 0.0 and status.offs == offs:
                request()
                turn_s = left_s if repeat_s is None else min(repeat_s, left_s)
                wait_until(self.runtime, lambda: is_there() or status.offs != offs, turn_s)
                if is_there():
                    return
                left_s = (end_ns - self.runtime.now_ns()) / 1e9
        if status.offs != offs:
            raise status.failure()
        raise DeadlineExceeded(
            awaited=f"{self.label}: {awaited}",
            timeout_s=timeout_s,
            last_heard=status.trouble() or self._last_heard(),
        )

    def ask(
        self,
        key: Hashable,
        request: Callable[[], object],
        timeout_s: float,
        awaited: str,
        repeat_s: float | None = None,
    ) -> None:
        """Send a request, and wait for an answer that is noted under this key; see `exchange`."""
        before = self._answers.get(key, 0)
        self.exchange(
            request, lambda: self._answers.get(key, 0) > before, timeout_s, awaited, repeat_s
        )

    def confirm(self, sent: SentFrame, timeout_s: float = 0.5) -> int:
        """Return when the frame, and so all frames before it, was on the bus [ns].

        Raises:
            LinkError: not within `timeout_s` [s], or the bus went off.
        """
        self._link.confirmed((sent,), timeout_s)
        assert sent.time_ns is not None  # checked by the link
        return sent.time_ns

    @property
    def is_owned(self) -> bool:
        """True if this program owns the motor; False if no other program can."""
        return self._fence is not None and self._fence.is_owned

    def foreign_token(self) -> int:
        """Return the token by which another program owns the motor now; 0: none does."""
        lock = self.physical.ownership.lock
        if lock is None or self.is_owned:
            return 0
        view = lock.look()
        return 0 if view.holder is None else view.token

    def stream_fence(self, purpose: str) -> "BoundFence | None":
        """Return the fence of a stream that begins now; None: no other program can have the motor.

        The owner of the stream calls `release` of the fence at its end.

        Raises:
            MotorBusyError: another program holds the motor.
        """
        return None if self._fence is None else self._fence.bound(purpose)

    def note_traffic(
        self, sent: tuple[PeriodicMessage, ...], ours: tuple[PeriodicMessage, ...] = ()
    ) -> None:
        """Declare periodic frames of the drive, and ours to it, for bounds of others on the bus."""
        note_node(self._bus, self._node, NodeTraffic(sent=sent, ours=ours))

    def note_frames(
        self, sent: Iterable[tuple[int, int, float]], ours: Iterable[tuple[int, int, float]] = ()
    ) -> None:
        """As `note_traffic`, for frames of the drive's kind: (identifier, bytes, period [s])."""

        def messages(frames: Iterable[tuple[int, int, float]]) -> tuple[PeriodicMessage, ...]:
            return tuple(
                PeriodicMessage(
                    *(can_id & _ID, length, period_s),
                    extended=bool((can_id | self._flag) & _EXTENDED),
                    fd=self._fd,
                    bit_rate_switch=self._fd,
                )
                for can_id, length, period_s in frames
            )

        self.note_traffic(messages(sent), messages(ours))

    def starts_by(self, can_id: int, length: int, *, flags: int | None = None) -> None:
        """Declare the command that starts a motion, for `own_offer`; arguments: `start_offer`."""
        self._start = can_id, length, flags

    def own_offer(self) -> SyncOffer | None:
        """Return the offer of a start by the declared command, or None without one."""
        if self._start is None:
            return None
        can_id, length, flags = self._start
        return self.start_offer(can_id, length, flags=flags)

    def start_offer(self, can_id: int, length: int, *, flags: int | None = None) -> SyncOffer:
        """Return the offer of a drive that a command of its own starts.

        The skew to other drives is bounded as far as frames determine it: until the command was
        received. The adaptation adds what it knows of the drive (`dataclasses.replace`).

        Args:
            can_id: the identifier of the command.
            length: its data bytes.
            flags: the flags of a CAN FD frame; None: a classical frame.
        """
        traffic, unbounded = traffic_on(self._link)
        if any(one.sent_at_sync or one.ours_at_sync for one in own_traffic(self._bus)):
            traffic, unbounded = None, "frames of other motors follow SYNC on the same bus"
        frame = OneFrame(
            *(can_id & _ID, length),
            extended=bool((can_id | self._flag) & _EXTENDED),
            fd=flags is not None,
            bit_rate_switch=bool((flags or 0) & _BRS),
        )
        firing = None if traffic is None else Firing(self._link.name, traffic, (frame,), 0.0, 1)
        return SyncOffer(
            *(SyncLevel.SEQUENTIAL, self.label, None, "it is started by a command of its own"),
            firing,
            no_firing_bound=unbounded,
            no_start_bound="the drive's own cycle is not known",
            no_end_bound="the drive's own clock is not known",
        )

    # --- what the drive was told ---------------------------------------------------------------

    def remember(self, key: Hashable, value: object) -> None:
        """Remember that the drive was told `value`; valid until another program has the motor."""
        if self._told_token != self.physical.token:
            self._told.clear()
            self._told_token = self.physical.token
        self._told[key] = value

    def remembered(self, key: Hashable) -> Any:  # Any: what its caller remembered
        """Return what the drive was told last under this key, or None if it is not known."""
        return self._told.get(key) if self._told_token == self.physical.token else None

    def doubt(self) -> None:
        """Forget all that the drive was told."""
        self._told.clear()

    # --- helpers -------------------------------------------------------------------------------

    def _send(
        self,
        can_id: int,
        data: bytes,
        fence: "NodeFence | BoundFence | None",
        flags: int | None,
        remote: int | None = None,
    ) -> SentFrame:
        self.check_open()
        word = can_id | self._flag | (0 if remote is None else _REMOTE)
        return self._link.send_tracked(pack(word, data, flags=flags, remote=remote), fence)

    def _last_heard(self) -> str:
        """Return the last frame that was passed on, in words."""
        if self._heard is None:
            return "nothing"
        frame, time_ns = self._heard
        can_id = int.from_bytes(frame[:4], "little") & ~(_EXTENDED | _REMOTE)
        data = frame[_DATA_AT : _DATA_AT + frame[4]].hex(" ") or "no data"
        return f"{can_id:03X}h with {data} at {time_ns / 1e9:.6f} s"

    def _look(self, sign: SignOfLife) -> None:
        if sign.has_just_ended(self.runtime.now_ns()):
            if sign.on_loss is not None:
                sign.on_loss()
            self.news.grow()


def checked_node(node: object, limit: int, what: str, *, low: int = 0) -> int:
    """Return a node number up to `limit`; `what` names it with its drive ("node_id of an X").

    Raises:
        UsageError: it is not one.
    """
    if not isinstance(node, int) or isinstance(node, bool) or not low <= node <= limit:
        raise UsageError(f"{what} = {node!r}: out of range; expected {low} to {limit}")
    return node
