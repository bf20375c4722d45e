"""The hardware class of a drive with impedance control, in its own units: rad, N m at the output.

The drive has no profile generator and tells its state only in answers to commands. While this
program controls the motor, it repeats a command every period: a motion, a stop, or a position to
hold. After an error of its stream that is the last set-point, until another program commands it.
Otherwise it sends a command to be limp, which only reads, and this only if no answer to
another program was heard for a while.

A position is held beyond the end of the ownership, but not against the next owner, whose commands
need not be recognisable. An owner holds a motor that has current and no other commands. A stop of
another program's motor is repeated until the motor has another owner, or its command is recognised.

The state "on" is in the answers of Damiao and RobStride. Other drives do not tell it: it follows
from the requests on the bus. A drive that nobody has switched on counts as off.
"""

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import copysign
from typing import TYPE_CHECKING, Any, ClassVar, Final

from motorhil.motorapi.adaptations.mit.frames import Answer, Command, Frames, Maker, Ranges, Special
from motorhil.motorapi.api import (
    ControlVariable,
    Estimate,
    LinkError,
    MotorBusyError,
    Options,
    PeerError,
    SentFrame,
    StreamedCanHardware,
    amount,
    positive,
)

if TYPE_CHECKING:
    from motorhil.motorapi.api import BoundFence, Fault

LIMP: Final = Command()
_PARAMETERS: Final = 0x7FF
_READ: Final = 0x33
_P_MAX: Final = 21  # parameters of Damiao; the next two are those of velocity and torque
FOLLOWING_ERROR: Final = 0xFF
"""The code of the fault that this class notices, not the drive."""
_ANSWER_S: Final = 0.2
_AGAIN_S: Final = 0.02
_FLIGHT_S: Final = 0.001  # in which the answers to earlier requests come
_WAY_RAD: Final = 0.5
_WAYS: Final = 3  # of that length that must disagree, by ratios within a factor
_ALIKE: Final = 1.15
_RATIO: Final = (0.8, 1.25)


def _range(unit: str, of: str, plausible: tuple[float, float]) -> Any:
    return positive(None, unit, f"Range of {of}; absent: the model's.", plausible)


@dataclass(frozen=True, slots=True, kw_only=True)
class MitOptions(Options, ABC):
    """The options of a hardware object; in a rig, keys of the motor's table."""

    kp_n_m_rad: float = positive(50.0, "N·m/rad", "Stiffness.", (0.1, 1e5))
    kd_n_m_s_rad: float = positive(2.0, "N·m·s/rad", "Damping.", (0.01, 1e3))
    inertia_kg_m2: float = amount(0.0, "kg·m²", "Inertia at the output, fed forward.", (1e-6, 10.0))
    friction_n_m: float = amount(0.0, "N·m", "Friction at the output, fed forward.", (1e-3, 10.0))
    period_ms: float = positive(5.0, "ms", "Period of commands.", (0.5, 100.0))
    following_error_rad: float = positive(
        0.2, "rad", "Deviation from the demand at which it is switched off.", (0.01, 3.0)
    )
    quiet_ms: float = positive(
        20.0, "ms", "Time without an answer after which a reader asks.", (1.0, 1e3)
    )
    timeout_ms: float = positive(
        100.0, "ms", "Time without an answer after which it is lost.", (5.0, 1e4)
    )
    connect_timeout_s: float = positive(2.0, "s", "Time for its first answer.", (0.1, 60.0))
    p_max_rad: float | None = _range("rad", "positions, either way", (1.0, 200.0))
    v_max_rad_s: float | None = _range("rad/s", "velocities, either way", (1.0, 1000.0))
    t_max_n_m: float | None = _range("N·m", "torques, either way", (0.1, 1000.0))
    kp_max_n_m_rad: float | None = _range("N·m/rad", "stiffness", (1.0, 1e5))
    kd_max_n_m_s_rad: float | None = _range("N·m·s/rad", "damping", (0.1, 1e3))

    @abstractmethod
    def frames(self, node_id: int) -> Frames:
        """Return the frames of the drive with this number."""

    def ranges(self, model: Ranges) -> Ranges:
        """Return the ranges: the model's, or those given."""
        own = (self.p_max_rad, self.v_max_rad_s, self.t_max_n_m)
        pairs = zip((*own, self.kp_max_n_m_rad, self.kd_max_n_m_s_rad), model, strict=True)
        return Ranges(*(known if given is None else given for given, known in pairs))


class MitHwMotor(StreamedCanHardware[MitOptions]):
    """One drive on a CAN bus; see `StreamedCanHardware`.

    The fault is the drive's, or `FOLLOWING_ERROR`. While `motions.variable` is None, another
    program, or nobody, controls the motor.

    Attributes:
        frames: its frames, with the ranges.
        answer, time_ns: the last answer, and when it was complete on the bus; None: none yet.
        behind: the demand minus the last position [rad]; None: no position is demanded.
        mismatch: why the ranges are wrong; "": nothing says so.
        is_zeroed: whether the zero was set since the drive was first heard.
    """

    NOUN: ClassVar[str] = "a drive with MIT frames"
    NODE_ID_MIN: ClassVar[int] = 1
    NODE_ID_MAX: ClassVar[int] = 127
    estimate: Estimate | None
    fault: "Fault | None"

    def _begin(self) -> None:
        own, drive = self.options, self.drive
        self.frames: Frames = own.frames(self.node_id)
        self.LACKS = f"answer of motor {self.node_id} on identifier {self.frames.master_id:X}h"
        self.CONNECT_S = own.connect_timeout_s
        self._reading = bytes((self.node_id, 0, _READ))  # begins answers of parameters
        self.answer: Answer | None = None
        self.time_ns: int = 0
        self.behind: float | None = None
        self._is_on = False
        self.is_zeroed: bool = False
        self.mismatch: str = ""
        self._stream(own.period_ms, 0.0)
        self._is_asking = False
        self._stopped_token = 0  # of another program, which the last command has stopped
        self._deaf_ns = self._polled_ns = 0
        self._moved = self._summed = 0.0
        self._ratios: list[float] = []  # velocity to way, of the last ways that disagreed
        self._others: set[str] = set()
        self._parameters: dict[int, float] = {}
        self._awaited: bytes | None = None  # the beginning of the answer to a reading
        self._life = drive.expect("answer", own.timeout_ms / 1e3, self._lose)
        self._handle(self.frames.answers())
        for can_id in self.frames.requests():
            drive.handle(can_id, partial(self._on_request, can_id))
        drive.every(own.period_ms / 1e3, self._beat)
        can_id, data = self.frames.command(LIMP)
        drive.starts_by(can_id, len(data))

    def _handle(self, answers: Iterable[int]) -> None:
        for can_id in answers:
            self.drive.handle(can_id, partial(self._on_answer, can_id))

    def connect(self) -> None:
        """Wait until the drive is heard, and check its ranges as far as it tells them.

        Raises:
            LinkError: it is not heard, or this object is closed, or the bus is off.
            PeerError: its ranges are others than those of the model.
        """
        try:
            super().connect()
        except LinkError as error:
            if self.is_up() or not self._others:
                raise
            heard = ", ".join(sorted(self._others))
            text = f"no {self.LACKS}; heard there: {heard}; check node_id, master_id and drive"
            raise LinkError(link=self.label, reason=text) from error

    def _connected(self) -> None:
        if self.frames.maker is Maker.DAMIAO:
            self._check_ranges()
        period_s = self.options.period_ms / 1e3
        answer_id, (can_id, data) = next(iter(self.frames.answers())), self.frames.command(LIMP)
        self.drive.note_frames([(answer_id, 8, period_s)], [(can_id, len(data), period_s)])

    def _knows(self) -> bool:
        return self.answer is not None

    def _greet(self) -> None:
        self._ask()

    # --- commands ----------------------------------------------------------------------------

    def send(
        self, variable: ControlVariable, value: float, fence: "BoundFence | None"
    ) -> SentFrame:
        """Send a set-point in rad, rad/s or N m, with what its derivatives need."""
        self._stopped_token = 0
        command = self._of(variable, value, *self.motions.rates())
        return self.drive.command(*self.frames.command(command), fence=fence)

    def hold(self) -> SentFrame:
        """Command the present position; without current, the drive executes it when enabled."""
        return self.motions.hold(self.measured(), partial(self.send, ControlVariable.POSITION))

    def stop_anyway(self) -> SentFrame:
        """Send the present command, whoever owns the motor."""
        self._stopped_token = self.drive.foreign_token()
        return self.drive.stop_command(*self.frames.command(self.present()))

    def _of(self, variable: ControlVariable, value: float, first: float, second: float) -> Command:
        own = self.options
        if variable is ControlVariable.TORQUE:
            return Command(t=value)
        is_position = variable is ControlVariable.POSITION
        velocity = first if is_position else value
        rubs = copysign(own.friction_n_m, velocity) if velocity else 0.0
        if not is_position:
            return Command(0.0, value, 0.0, own.kd_n_m_s_rad, rubs)
        t = own.inertia_kg_m2 * second + rubs
        return Command(value, velocity, own.kp_n_m_rad, own.kd_n_m_s_rad, t)

    @property
    def is_on(self) -> bool:
        """True if the motor has current, as far as known."""
        return self._is_on

    @property
    def is_held(self) -> bool:
        """True if the motor has current, and commands of this program or another one."""
        is_told = self.time_ns - self._polled_ns > self.options.quiet_ms * 1e6
        return self.is_on and (self.motions.variable is not None or is_told)

    def present(self) -> Command:
        """Return the command that is repeated now; LIMP: none."""
        variable = self.motions.variable
        return LIMP if variable is None else self._of(variable, *self.motions.demand())

    def trust_ranges(self) -> None:
        """Begin the comparison of ways and velocities anew."""
        self._moved = self._summed = 0.0
        self._ratios.clear()

    def release(self) -> None:
        """End all commands; the motor is limp."""
        self.drive.command(*self.frames.command(LIMP))
        self.motions.forget()

    def tell(self, special: Special) -> SentFrame:
        """Send a special request; raises as `CanDrive.command`."""
        sent = self.drive.command(*self.frames.special(special))
        if special in (Special.ENTER, Special.LEAVE):
            self._is_on = special is Special.ENTER  # a drive that tells corrects it
        return sent

    def ask(self, special: Special, is_there: Callable[[], bool], awaited: str) -> None:
        """Send a special request until an answer shows its effect.

        Raises:
            DeadlineExceeded: none did.
        """
        runtime = self.drive.runtime
        self._is_asking = True  # no other request: each has an answer, which does not name it
        try:
            runtime.wait_until(lambda: False, _FLIGHT_S)
            since_ns = runtime.now_ns()
            self.drive.exchange(
                lambda: self.tell(special),
                lambda: self.time_ns > since_ns and is_there(),
                *(_ANSWER_S, awaited, _AGAIN_S),
            )
        finally:
            self._is_asking = False

    def set_zero(self) -> None:
        """Make the present position the zero, and wait until the drive answers again."""
        self.tell(Special.ZERO)
        runtime, zero_s = self.drive.runtime, self.frames.maker.zero_s
        self._deaf_ns = runtime.now_ns() + round(zero_s * 1e9)
        runtime.wait_until(lambda: False, zero_s)
        since_ns = runtime.now_ns()
        self.drive.exchange(
            *(self._ask, lambda: self.time_ns > since_ns, _ANSWER_S, "an answer", _AGAIN_S)
        )
        self.is_zeroed = True

    # --- background --------------------------------------------------------------------------

    def _ask(self) -> None:
        if self.motions.variable is None:
            self._polled_ns = self.drive.runtime.now_ns()
        self.drive.request(*self.frames.command(self.present()))

    def _beat(self) -> None:
        now_ns, motions = self.drive.runtime.now_ns(), self.motions
        if now_ns < self._deaf_ns:
            self._life.came(now_ns)
        elif self.drive.status.is_off:
            self._lose()
        elif self._is_asking or motions.is_going:
            return
        elif motions.variable is not None and self._is_taken():
            self.forget()
        elif motions.variable is not None or now_ns - self.time_ns >= self.options.quiet_ms * 1e6:
            with suppress(LinkError, MotorBusyError):
                self._take_hold()
                self._ask()

    def _is_taken(self) -> bool:
        """Return whether another program has taken the motor since the last command."""
        return self.drive.foreign_token() not in (0, self._stopped_token)

    def _take_hold(self) -> None:
        """Hold a motor that has current without commands, if this program owns it."""
        is_free = self.motions.variable is None and self.drive.physical.access is None
        if is_free and self._is_on and self.drive.is_owned:
            self.hold()

    def _on_answer(self, can_id: int, data: bytes, time_ns: int) -> None:
        is_read = self.frames.maker is Maker.DAMIAO and data[:3] == self._reading
        if is_read and len(data) == 8:
            if data[:4] == self._awaited:
                self._parameters[data[3]] = struct.unpack_from("<f", data, 4)[0]
                self._awaited = None
            return  # a repeated one is no position near the end of the range
        self._handle(self.frames.more_answers(can_id))
        answer = self.frames.answer(can_id, data)
        if isinstance(answer, str):
            self._others.add(answer)
            return
        before = self.answer
        if before is None and not self.frames.maker.has_fault(answer.fault):
            self._others.add(f"fault {answer.fault:02X}h, which such a drive does not have")
            return
        self.answer = answer
        self.estimate = Estimate(answer.p, answer.v, time_ns)
        elapsed_s = (time_ns - self.time_ns) / 1e9
        self.time_ns = time_ns
        if answer.is_on is not None:
            self._is_on = answer.is_on
        present = self.present()
        self.behind = present.p - answer.p if present.kp else None
        is_far = abs(self.behind or 0.0) > self.options.following_error_rad
        if answer.fault or is_far or (self.fault and self.fault.code != FOLLOWING_ERROR):
            self._set_fault(answer.fault or (FOLLOWING_ERROR if is_far else 0), time_ns)
        r = self.frames.ranges  # codes are coarse near 0; at their ends they stand, or turn over
        is_told = 0.01 < abs(answer.v) / r.v < 0.95 and abs(answer.p) < 0.95 * r.p
        if before is not None and elapsed_s < 0.1 and is_told:
            self._compare(before, answer, elapsed_s)
        self._life.came(time_ns)

    def _set_fault(self, code: int, time_ns: int) -> None:
        """Note a fault, with which the motor has no current, or its end."""
        if not code:
            self.fault = None
        elif self.fault is None or code != self.fault.code:
            is_own = code == FOLLOWING_ERROR
            text = "following error" if is_own else self.frames.maker.text_of(code)
            self.see_fault(code, text, time_ns)
            self._is_on = False
            if is_own:
                with suppress(LinkError):
                    self.drive.stop_command(*self.frames.special(Special.LEAVE))

    def _compare(self, before: Answer, answer: Answer, elapsed_s: float) -> None:
        """Compare way and velocity: their ranges are wrong if they disagree, and always alike.

        Answers that are late or lost disagree, too, but each time by another ratio.
        """
        self._moved += answer.p - before.p
        self._summed += 0.5 * (answer.v + before.v) * elapsed_s
        if abs(self._moved) < _WAY_RAD:
            return
        low, high = _RATIO
        ratio = self._summed / self._moved
        self._ratios = [] if low < ratio < high else [*self._ratios[1 - _WAYS :], ratio]
        if len(self._ratios) == _WAYS and max(self._ratios) < _ALIKE * min(self._ratios):
            p, v = self.frames.ranges[:2]
            self.mismatch = (
                f"{self.label}: positions changed by {self._moved:.3g} rad, but velocities tell"
                f" {self._summed:.3g} rad; the ranges +-{p:g} rad and +-{v:g} rad/s are not those"
                " of the drive; set drive, p_max_rad or v_max_rad_s"
            )
        self._moved = self._summed = 0.0

    def _on_request(self, can_id: int, data: bytes, time_ns: int) -> None:
        """Handle a request of another program."""
        self._handle(self.frames.more_answers(can_id))
        asked = self.frames.asked(can_id, data)
        if asked in (Special.ENTER, Special.LEAVE):
            self._is_on = asked is Special.ENTER
        is_command = asked is True and can_id == self.frames.command(LIMP)[0]
        if is_command and self.motions.is_queued:
            return  # ours comes after it, and replaces it
        if asked:
            self.overheard(f"request {data.hex()}", time_ns)

    def _lose(self) -> None:
        super()._lose()
        self._is_on = self.is_zeroed = False
        self._parameters.clear()

    def _check_ranges(self) -> None:
        """Compare the ranges that a Damiao drive tells with those of the model."""
        for one in range(_P_MAX, _P_MAX + 3):
            if one not in self._parameters:
                self._awaited = self._reading + bytes((one,))
                self.drive.exchange(
                    partial(self.drive.request, _PARAMETERS, self._awaited + bytes(4)),
                    partial(self._parameters.__contains__, one),
                    *(
                        _ANSWER_S,
                        f"parameter {one}, which a Damiao drive tells; check drive",
                        _AGAIN_S,
                    ),
                )
        told = [self._parameters[one] for one in sorted(self._parameters)]
        ours = self.frames.ranges[:3]
        if any(abs(a - b) > 1e-3 * b for a, b in zip(told, ours, strict=True)):
            texts = [", ".join(f"{one:g}" for one in values) for values in (told, ours)]
            self._parameters.clear()
            raise PeerError(
                f"{self.label}: its ranges are {texts[0]} (rad, rad/s, N m); expected {texts[1]};"
                " set drive, p_max_rad, v_max_rad_s or t_max_n_m"
            )
