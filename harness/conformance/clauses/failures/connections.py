"""L5: the connections that adaptations are made of, to drives that do not answer, or not well.

The CAN drive is one that is not there: its number is free, and it has no frames. The line is one of
this module, and answers as a clause says. The hardware objects are made as an author makes them.
"""

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise
from typing import ClassVar, Final, final

from motorhil.frozen import frozen
from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.helpers import elapsed_s, failure_of, rest_for
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    LinkError,
    Motion,
    Motor,
    MotorBusyError,
    PeerError,
    TrapezoidalTrajectory,
    UsageError,
)
from motorhil.motorapi.api import (
    BoundFence,
    ByteLine,
    CanDrive,
    Exchange,
    ExchangeLine,
    Fault,
    LineProtocolViolation,
    LineUnit,
    Options,
    Registration,
    Runtime,
    SentFrame,
    StreamedCanHardware,
)
from motorhil.motorapi.ownership.claim import LockAction
from motorhil.motorapi.synchronization.bus_load import (
    CanTraffic,
    declare_traffic,
    declared_traffic,
)

_FREE: Final = 250
_BIT_RATE: Final = 1_000_000
_UNUSED_ID: Final = 0x7F0
_TIMEOUT_S: Final = 0.2
_REPEAT_S: Final = 0.06
_CONNECT_S: Final = 0.35
_LIFE_S: Final = 0.1
_PERIOD_S, _LEAD_S = 0.01, 0.02
_STEEP: Final = 4.0
_MANY: Final = 50
_KEY: Final = "a key"
_BENCH: Final = {Ability.SETTINGS}
_SOURCE: Final = "docs: reference, the adaptation API, the hardware object on CAN"
_GOOD, _REFUSED, _SPOILED, _NONE = b"+", b"-", b"?", b""
_ANSWERED_S: Final = 0.01
_SILENT_S: Final = 2.0
_OUTAGES: Final = 3


@final
@frozen
class _NoOptions(Options):
    """No options."""


@final
class _Absent(StreamedCanHardware[_NoOptions]):
    """The hardware object of a drive that is not there."""

    OPTIONS = _NoOptions
    NOUN: ClassVar[str] = "an absent drive"
    NODE_ID_MAX: ClassVar[int] = 255
    LACKS: str = "hello"
    CONNECT_S: float = _CONNECT_S

    def _begin(self) -> None:
        self.asked_ns: list[int] = []
        self.life = self.drive.expect("beat", _LIFE_S, self._lose)
        self._stream(1e3 * _PERIOD_S, 1e3 * _LEAD_S)

    def _knows(self) -> bool:
        return False

    def _greet(self) -> None:
        self.ask()

    def ask(self) -> None:
        """Note the time of a request; nobody hears it."""
        self.asked_ns.append(self.drive.runtime.now_ns())
        expect(len(self.asked_ns) <= _MANY, f"asked {_MANY} times: without a pause")

    @property
    def is_on(self) -> bool:
        return False


def _absent(bench: RigProtocol) -> _Absent:
    """Return the hardware object of a drive that is not on the bus of the motor under test.

    Raises:
        NotApplicable: the motor is on no CAN bus.
    """
    link = bench.link
    if not hasattr(link, "channel_info"):  # of python-can
        raise NotApplicable("the motor is on no CAN bus")
    for node in range(_FREE, 0, -1):
        with suppress(UsageError):  # a motor of the bench has it
            return _Absent(link, node, runtime=bench.runtime)
    raise NotApplicable("no number of a drive is free on this bus")


@clause("API-01", Level.L5, bench=_BENCH, source=_SOURCE)
def request_is_repeated_until_its_time_is_over(bench: RigProtocol) -> None:
    """A connection to a CAN drive repeats a request at its interval, and ends in time."""
    absent = _absent(bench)
    drive, never, key = absent.drive, lambda: False, _KEY
    waits: tuple[tuple[str, float | None, Callable[[float | None], None]], ...] = (
        ("exchange", _REPEAT_S, lambda s: drive.exchange(absent.ask, never, _TIMEOUT_S, key, s)),
        ("exchange", None, lambda s: drive.exchange(absent.ask, never, _TIMEOUT_S, key, s)),
        ("ask", _REPEAT_S, lambda s: drive.ask(key, absent.ask, _TIMEOUT_S, key, s)),
        ("ask", None, lambda s: drive.ask(key, absent.ask, _TIMEOUT_S, key, s)),
    )
    for name, repeat_s, wait in waits:
        what = f"{name}() for {_TIMEOUT_S:g} s, repeated every {repeat_s} s"
        error = _wait(bench, absent, what, partial(wait, repeat_s), _TIMEOUT_S, repeat_s)
        is_told = isinstance(error, DeadlineExceeded) and key in error.awaited
        expect(is_told and f"{_TIMEOUT_S:g} s" in str(error), f"{what}: {error!r}")
    what = f"connect() to a drive that is not there, within {_CONNECT_S:g} s"
    error = _wait(bench, absent, what, absent.connect, _CONNECT_S, _REPEAT_S)
    expect(isinstance(error, LinkError) and absent.LACKS in str(error), f"{what}: {error!r}")
    absent.close()


def _wait(
    bench: RigProtocol,
    absent: _Absent,
    what: str,
    wait: Callable[[], None],
    within_s: float,
    repeat_s: float | None,
) -> Exception | None:
    """Check how often is asked, no more often than at the interval, and for how long; its error."""
    absent.asked_ns.clear()
    begun_ns, slack_s = bench.runtime.now_ns(), bench.facts.time_tolerance_s
    error = failure_of(wait)
    took_s = elapsed_s(bench, begun_ns)
    slack_s = max(slack_s, 2.0 * (repeat_s or 0.0))
    expect(within_s <= took_s + 1e-9 <= within_s + slack_s, f"{what}: ended after {took_s:g} s")
    asked, gaps = absent.asked_ns, [(b - a) / 1e9 for a, b in pairwise(absent.asked_ns)]
    expect(len(asked) > (repeat_s is not None), f"{what}: asked {len(asked)} times")
    expect(bool(gaps) is (repeat_s is not None), f"{what}: asked {len(asked)} times")
    least_s = min(gaps, default=within_s)
    expect(least_s >= (repeat_s or 0.0) - 1e-6, f"{what}: asked again after {least_s:g} s")
    return error


@clause("API-02", Level.L5, bench=_BENCH, source=_SOURCE)
def told_values_are_remembered_until_doubted(bench: RigProtocol) -> None:
    """A CAN drive is taken to know what it was told, until it is lost, or others command it."""
    absent = _absent(bench)
    drive = absent.drive
    expect(drive.remembered(_KEY) is None, "a drive that was told nothing is said to know a value")
    losses: tuple[tuple[str, Callable[[], object]], ...] = (
        ("doubt()", drive.doubt),
        ("forget()", absent.forget),
        ("overheard()", lambda: absent.overheard("a clause", bench.runtime.now_ns())),
        ("a loss of the drive", lambda: rest_for(bench, 2.0 * _LIFE_S)),
    )
    for what, lose in losses:
        drive.remember(_KEY, what)
        found = drive.remembered(_KEY)
        expect(found == what, f"told {what!r}, and remembered {found!r}")
        absent.life.came(bench.runtime.now_ns())
        lose()
        found = drive.remembered(_KEY)
        expect(found is None, f"after {what}, still taken as known to the drive: {found!r}")
    expect(drive.is_lost, f"no beat for {2.0 * _LIFE_S:g} s, and the drive is not lost")
    absent.close()


@clause("API-03", Level.L5, bench=_BENCH, source=_SOURCE)
def declared_start_is_offered_to_groups(bench: RigProtocol) -> None:
    """A drive offers the command that starts its motions to groups once it is declared."""
    absent = _absent(bench)
    absent.close()
    link, before = bench.link, declared_traffic(bench.link)
    declare_traffic(link, CanTraffic(_BIT_RATE))
    for extended in (None, False, True):
        how = {} if extended is None else {"extended": extended}
        drive = CanDrive(link, absent.node_id, absent, runtime=bench.runtime, **how)
        offer = drive.own_offer()
        expect(offer is None, f"no command that starts a motion is declared; the offer is {offer}")
        drive.starts_by(0x123, 8)
        offer = drive.own_offer()
        what = f"a start by 123h with 8 bytes is declared, {how}; the offer is {offer}"
        expect(offer is not None, what)
        firing = None if offer is None else offer.firing
        if firing is None:
            expect(offer is not None and bool(offer.no_firing_bound), what)
        else:
            found = [(one.can_id, one.length, one.extended) for one in firing.frames]
            expect(found == [(0x123, 8, bool(extended))], what)
        drive.close(at_rest=True)
    declare_traffic(link, before)


@clause("API-04", Level.L5, bench=_BENCH, source=_SOURCE)
def cleared_fault_is_awaited_in_turns(bench: RigProtocol) -> None:
    """A fault that a drive is to forget is read again and again, with pauses, and not for ever."""
    absent = _absent(bench)
    for clears in (False, True):
        absent.asked_ns.clear()
        absent.fault = Fault(1, "a fault of a clause", bench.runtime.now_ns())

        def read(clears: bool = clears) -> int:
            absent.ask()
            return 0 if clears and len(absent.asked_ns) > 1 else 1

        begun_ns = bench.runtime.now_ns()
        absent.await_clear(read, _TIMEOUT_S)
        took_s = elapsed_s(bench, begun_ns)
        times = len(absent.asked_ns)
        expect(times > 1, f"a fault that stays for a time was read {times} times")
        most_s = _TIMEOUT_S + bench.facts.time_tolerance_s
        expect(took_s <= most_s, f"a fault was awaited for {took_s:g} s; limit {most_s:g} s")
        is_there = absent.fault is not None
        expect(is_there is not clears, f"read as {int(not clears)}, known as {absent.fault}")
    absent.close()


@clause("API-08", Level.L5, bench=_BENCH, source=_SOURCE)
def streamed_positions_lead_the_drive(bench: RigProtocol) -> None:
    """Positions are streamed once a period, ahead by the lead of the drive, up to the last one."""
    absent = _absent(bench)
    drive, sent = absent.drive, list[tuple[float, float]]()
    motion = Motion(
        *(ControlMode.TRAJECTORY, ControlVariable.POSITION, 0.0, 1.0, 9.0, _STEEP, _STEEP),
        trajectory=TrapezoidalTrajectory(1.0),
    )
    begun_ns = bench.runtime.now_ns()

    def send(value: float, _: BoundFence | None) -> SentFrame:
        sent.append((elapsed_s(bench, begun_ns), value))
        return drive.request(_UNUSED_ID)

    absent.motions.start(motion, 1.0, (0.0, 0.0), send)
    rest_for(bench, 2.0)
    expect(not absent.motions.is_going, "a stream of 1 s goes on after 2 s")
    for (before_s, _), (at_s, _) in pairwise(sent):
        off_s = abs(at_s - before_s - _PERIOD_S)
        expect(off_s < 0.1 * _PERIOD_S, f"set-points {at_s - before_s:g} s apart")
    for at_s, value in sent:
        ahead_s = min(at_s + _LEAD_S, 1.0)
        left_s = min(ahead_s, 1.0 - ahead_s)  # to the nearer end of a symmetrical move
        short = 0.5 * _STEEP * left_s**2
        wanted = short if ahead_s < 0.5 else 1.0 - short
        expect(abs(value - wanted) < 1e-6, f"{value:.6f} sent after {at_s:g} s, not {wanted:.6f}")
    expect(bool(sent) and sent[-1][1] == 1.0, f"the last set-point is {sent[-1:]}")
    absent.close()


@clause("API-05", Level.L5, bench={Ability.SECOND_PROGRAM}, source=_SOURCE)
def foreign_owner_is_told_by_token(bench: RigProtocol) -> None:
    """A connection to a CAN drive tells whether another program owns the motor, or this one."""
    bench.apart()
    motor, other = bench.motor, bench.another_user_of(bench.motor)
    drive: object = getattr(getattr(motor, "hardware", None), "drive", None)
    if not isinstance(drive, CanDrive) or drive.physical is not motor.logical.physical:
        raise NotApplicable("the adaptation is not made of a connection to a CAN drive")

    def expect_owner(what: str, is_ours: bool, is_foreign: bool) -> None:
        found = (drive.is_owned, drive.foreign_token() != 0)
        expect(
            found == (is_ours, is_foreign),
            f"{what}: (ours, another program's) is {found}, by token {drive.foreign_token()}",
        )

    expect_owner("before any command", False, False)
    with other.reserve("a clause"):
        expect_owner("reserved by another program", False, True)
    expect_owner("released by another program", False, False)
    with motor.reserve("a clause"):
        expect_owner("reserved by this program", True, False)
    expect_owner("released by this program", False, False)
    events: list[LockAction] = []
    drive.physical.ownership.listeners.append(lambda event: events.append(event.action))
    _expect_loss_noticed(motor, other, drive, events)


def _expect_loss_noticed(
    motor: Motor, other: Motor, drive: CanDrive, events: Sequence[LockAction]
) -> None:
    """Check that the first command after a takeover is refused, and that the loss is then known."""
    with motor.reserve("a clause"), other.reserve("another clause", take_over=True):
        refusal = failure_of(partial(drive.command, _UNUSED_ID, b""))
        told = ", ".join(one.name for one in events)
        expect(isinstance(refusal, MotorBusyError), f"a command without the motor: {refusal!r}")
        expect(LockAction.LOST in events, f"the loss was noticed by a command; told are: {told}")


@final
class _Wire:
    """A connection whose far end answers as it was told to; see `ByteLine`."""

    name = "a line of a clause"
    framing = "tcp"
    silence_ns = 0
    is_closed = False

    def __init__(self, runtime: Runtime) -> None:
        self.answers: deque[bytes] = deque()
        self.sent_ns: list[int] = []
        self.opened_ns: list[int] = []
        self._runtime = runtime
        self._hear: list[Callable[[bytes, int], None]] = []

    def duration_ns(self, characters: int) -> int:
        return 0

    def send(self, data: bytes) -> None:
        self.sent_ns.append(self._runtime.now_ns())
        answer = self.answers.popleft() if self.answers else _NONE
        timers: list[Registration] = []

        def deliver() -> None:
            timers.pop().cancel()
            self._hear[-1](answer, self._runtime.now_ns())

        if answer:
            timers.append(self._runtime.every(_ANSWERED_S, deliver))

    def listen(self, on_data: Callable[[bytes, int], None]) -> Registration:
        self._hear.append(on_data)
        return _Listening()

    def reconnect(self) -> None:
        self.opened_ns.append(self._runtime.now_ns())


@final
class _Listening:
    def cancel(self) -> None:
        """The far end does not send by itself."""


@final
class _Codec:
    """A protocol of one byte: it is an answer, a refusal, or none of them; see `Codec`."""

    is_inside = False

    def __init__(self) -> None:
        self.heard: bytes = b""

    def begin(self) -> None:
        self.heard = b""

    def encode(self, exchange: Exchange[bytes, bytes]) -> bytes:
        return exchange.request

    def feed(self, data: bytes, exchange: Exchange[bytes, bytes] | None) -> bytes | None:
        self.heard += data
        return data if data in (_GOOD, _REFUSED) else None

    def answers(self, answer: bytes, request: bytes) -> bool:
        return True

    def refusal(self, exchange: Exchange[bytes, bytes], answer: bytes) -> PeerError | None:
        return PeerError("refused by a clause") if answer == _REFUSED else None

    def awaited(self, request: bytes) -> str:
        return "a byte"


@final
class _ByteExchanges(ExchangeLine[bytes, bytes]):
    def _codec(self) -> _Codec:
        return _Codec()


@final
class _Unit(LineUnit[bytes, bytes]):
    LINE = _ByteExchanges

    def _units(self, line: ByteLine) -> range:
        return range(1, 3)


@clause("API-06", Level.L5, bench=_BENCH, source="docs: how to use Modbus drives; LineUnit")
def lost_reading_is_repeated_once(bench: RigProtocol) -> None:
    """A reading is repeated once if its answer is lost or spoiled; others are never repeated."""
    wire = _Wire(bench.runtime)
    unit = _Unit(wire, 1, bench.runtime, wire, _TIMEOUT_S)

    def reading() -> bytes:
        return unit.ask_repeatedly(lambda: b"r")

    def command() -> bytes:
        return unit.command(b"c")

    lost, refused, spoiled = DeadlineExceeded, PeerError, LineProtocolViolation
    for operation, answers, times, error, is_unsure in (
        (reading, (_GOOD,), 1, None, False),
        (reading, (_NONE, _GOOD), 2, None, False),
        (reading, (_SPOILED, _GOOD), 2, None, False),
        (reading, (_REFUSED, _GOOD), 1, refused, False),
        (reading, (_NONE, _REFUSED), 2, refused, False),
        (command, (_GOOD,), 1, None, False),
        (command, (_REFUSED, _GOOD), 1, refused, False),
        (command, (_NONE, _GOOD), 1, lost, True),
        (command, (_SPOILED, _GOOD), 1, spoiled, False),
        (reading, (_NONE, _NONE), 2, lost, True),
    ):
        wire.answers = deque(answers)
        wire.sent_ns.clear()
        before, found = unit.standing, failure_of(operation)
        what = f"a {operation.__name__} with the answers {answers}"
        expect(len(wire.sent_ns) == times, f"{what}: sent {len(wire.sent_ns)} times, not {times}")
        kind = type(None) if error is None else error
        expect(isinstance(found, kind), f"{what}: {found!r}; expected {kind.__name__}")
        changed = unit.standing != before
        expect(changed is is_unsure, f"{what}: values of the drive are doubted: {changed}")
    unit.close()


@clause("API-07", Level.L5, bench=_BENCH, source="docs: how to use Modbus drives; ExchangeLine")
def silent_connection_is_opened_anew(bench: RigProtocol) -> None:
    """A TCP connection that is silent for 2 s is opened anew, and is given 2 s again."""
    wire = _Wire(bench.runtime)
    unit = _Unit(wire, 1, bench.runtime, wire, _TIMEOUT_S)
    begun_ns, most_s = bench.runtime.now_ns(), _OUTAGES * (_SILENT_S + 2.0 * _TIMEOUT_S)
    while elapsed_s(bench, begun_ns) < most_s:
        error = failure_of(partial(unit.command, b"c"))
        expect(isinstance(error, DeadlineExceeded), f"without an answer: {error!r}")
    opened_s = [(at_ns - begun_ns) / 1e9 for at_ns in (begun_ns, *wire.opened_ns)]
    told = ", ".join(f"{at_s:g}" for at_s in opened_s[1:])
    least_s = min((b - a for a, b in pairwise(opened_s)), default=0.0)
    expect(
        len(opened_s) > _OUTAGES and least_s >= _SILENT_S,
        f"silent for {most_s:g} s, and opened anew after {told or 'never'} s",
    )
    wire.answers = deque((_GOOD,))
    unit.command(b"c")
    unit.close()
