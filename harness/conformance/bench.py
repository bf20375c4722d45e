"""The protocol between clauses and benches, for emulated rigs and real benches."""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.conformance import Facts
from motorhil.settings import Declaration

if TYPE_CHECKING:  # the supervisor starts sooner without the motor interface
    from motorhil.motorapi import Motor, MotorModel
    from motorhil.motorapi.ownership.claim import LockAction
    from motorhil.motorapi.runtime.api import Runtime

Lost = Callable[[], int]
"""Number of frames or answers lost so far. A fault that hit nothing has tested nothing."""


@final
class Ability(Enum):
    """Something that a bench can do or see."""

    TRUTH = "see the true position of the motor"
    LOAD = "load the motor"
    FAULT = "cause a drive fault"
    CUT = "cut a drive off the bus for a time"
    LOSE = "lose frames or answers of a drive"
    LATE = "delay answers of a drive"
    ONE_KIND = "lose all frames with one identifier"
    SILENCE_HOST = "drop everything the host sends"
    BUS_ERRORS = "disturb frames on a CAN bus until a node goes bus-off"
    AFRESH = "switch everything off and on again"
    STOP_SYNC = "stop the signal that clocks streamed motions"
    CLOCK = "produce the signal that clocks streamed motions"
    OTHER_PROGRAM = "stop a drive from another program"
    RESTART = "switch a drive off and on again"
    TRAFFIC = "see the commands sent to a drive"
    SECOND_MOTOR = "move a second motor"
    SEVERAL_USERS = "create several logical motors for one physical motor"
    SOLE_USER = "have a motor without any other user"
    ONE_PROGRAM = "have all users of a motor in one program"
    SECOND_PROGRAM = "run a second program on the motor's bus"
    OWNERS = "hear which program announces that it owns a motor"
    SETTINGS = "build the motor and its drive with other settings"


@final
class Announced(NamedTuple):
    """One announcement of the ownership of a motor.

    Attributes:
        action: the kind of event.
        token: of the ownership; 0 for a request.
        owner, purpose: in words.
        sender: the name of the program's port on the bus.
    """

    action: "LockAction"
    token: int
    owner: str
    purpose: str
    sender: str


@final
@frozen
class Stated:
    """The settings of a motor or of its drive, as the bench states them.

    Attributes:
        declaration: the keys that there are.
        values: the stated ones, by key.
    """

    declaration: Declaration
    values: Mapping[str, object]


class RigProtocol(Protocol):
    """A bench that is switched on, with new motors that have not been used yet.

    A method that needs an `Ability` may be called only by clauses that name this ability. Time
    passes only by waiting in `runtime`. U is the unit of the motors' position, rad or m.
    """

    @property
    def facts(self) -> Facts:
        """The facts declared for the bench and its motors: distances, tolerances, bounds."""

    @property
    def abilities(self) -> Collection[Ability]:
        """The abilities of the bench."""

    @property
    def runtime(self) -> "Runtime":
        """The runtime in which a clause waits."""

    @property
    def seed(self) -> int:
        """The seed of all random numbers."""

    @property
    def motor(self) -> "Motor":
        """The motor under test."""

    @property
    def motors(self) -> "Sequence[Motor]":
        """All motors under test, which can form a group; `motor` is the first."""

    def another_user_of(self, motor: "Motor") -> "Motor":
        """Return another logical motor on the same physical motor (Ability.SEVERAL_USERS)."""

    def apart(self) -> None:
        """Switch everything off and on again; other users are of another program from now on.

        The two programs share the bus, and know of each other only by locks
        (Ability.SECOND_PROGRAM).
        """

    def killed_after(self, motor: "Motor", messages: int) -> AbstractContextManager[Lost]:
        """Kill this motor's program in the block, once it has sent so many messages on its bus.

        It ends as by `kill -9`: frames that it has queued are still sent, and the kernel lets go of
        its locks (Ability.SECOND_PROGRAM). Yields the number of messages sent so far. The program
        is called in a party of its own, which may never end.
        """

    def owners_of(self, motor: "Motor") -> AbstractContextManager[Sequence[Announced]]:
        """Record what programs announce of a motor's ownership, in the block (Ability.OWNERS)."""

    def true_position(self, motor: "Motor") -> float:
        """Return the motor's true position [U], not from the adaptation (Ability.TRUTH)."""

    def load(self, motor: "Motor", torque_n_m: float) -> None:
        """Apply a constant load torque [N·m], or force [N], to the motor (Ability.LOAD).

        The load acts at the motor's output from now on. A positive load turns it towards negative
        positions.
        """

    def fail(self, motor: "Motor", code: int | None = None) -> int:
        """Cause a short fault in the motor's drive; return its error code (Ability.FAULT).

        The code is this one, of those in `facts.fault_texts`, or the usual one of the bench.
        """

    def cut(self, motor: "Motor") -> AbstractContextManager[Lost]:
        """Cut the motor's drive off the bus within the block; it keeps its power (Ability.CUT)."""

    def silence_host(
        self, *, skip: int = 0, limit: int | None = None
    ) -> AbstractContextManager[Lost]:
        """Drop all frames sent by the host within the block (Ability.SILENCE_HOST).

        The first `skip` frames pass, and at most `limit` frames are lost, as in `lose_answers_of`.
        """

    def lose_answers_of(
        self, motor: "Motor", *, skip: int = 0, limit: int | None = None
    ) -> AbstractContextManager[Lost]:
        """Drop the answers of the motor's drive within the block (Ability.LOSE)."""

    def delay_answers_of(
        self, motor: "Motor", delay_s: float, *, skip: int = 0, limit: int | None = None
    ) -> AbstractContextManager[Lost]:
        """Delay the drive's answers to requests by this time [s] within the block (Ability.LATE).

        Frames that the drive sends by itself are not delayed, as a bus keeps their order.
        """

    def identifiers(self) -> AbstractContextManager[Sequence[int]]:
        """Record the identifiers of all frames in the block, each once (Ability.ONE_KIND)."""

    def lose_identifier(self, identifier: int) -> AbstractContextManager[Lost]:
        """Drop all frames with this identifier within the block (Ability.ONE_KIND)."""

    def strike(
        self, motor: "Motor | None", times: int, *, skip: int = 0
    ) -> AbstractContextManager[Lost]:
        """Destroy `times` transmission attempts of the drive, or of the host (None), in the block.

        Bit errors destroy successive attempts (Ability.BUS_ERRORS): 16 make a CAN controller error
        passive, and 32 put it in bus-off, from which it recovers by itself a moment later. The
        first `skip` frames pass. If `skip` is 0, the host has a frame to send.
        """

    def noise(self, bit_error_rate: float) -> AbstractContextManager[Lost]:
        """Corrupt bits on the bus at this error rate within the block (Ability.BUS_ERRORS)."""

    def stop_sync(self) -> AbstractContextManager[Lost]:
        """Drop the signal that clocks streamed motions within the block (Ability.STOP_SYNC)."""

    def clock(self) -> AbstractContextManager[Sequence[int]]:
        """Record the times of the host's clock signals in the block [ns] (Ability.CLOCK)."""

    def another_clock(self, period_s: float) -> AbstractContextManager[None]:
        """Let another node produce the clock signal with this period [s] (Ability.CLOCK)."""

    def stop_from_elsewhere(self, motor: "Motor") -> None:
        """Stop the drive by a command of another program (Ability.OTHER_PROGRAM).

        The drive brakes, and then rests, enabled.
        """

    def restart(self, motor: "Motor") -> None:
        """Restart the motor's drive, as after a power failure (Ability.RESTART)."""

    def commands_to(self, motor: "Motor") -> AbstractContextManager[Sequence[str]]:
        """Record host commands that may move or change the motor's drive (Ability.TRAFFIC)."""

    def stated(self, of_drive: bool = False) -> Stated | None:
        """Return the settings of the motor, or of its drive (Ability.SETTINGS).

        None: their keys are not declared (`motorhil.adaptation_settings`).
        """

    @property
    def link(self) -> Any:
        """The bus or line of the motor under test, or None (Ability.SETTINGS)."""

    def build(self, settings: Mapping[str, object], model: "MotorModel | None" = None) -> "Motor":
        """Return a further motor in the place of the motor under test (Ability.SETTINGS).

        It has these settings, and this model or that of the motor under test. Who asks closes it.
        Raises whatever the adaptation raises.
        """

    def altered(
        self, motor: Mapping[str, object], drive: Mapping[str, object]
    ) -> AbstractContextManager[None]:
        """Switch everything off, and on with these settings for the block (Ability.SETTINGS).

        The motor under test and its drive have them beside their own. `motors` are new.
        """

    def refusal(self, motor: "Motor", name: str, value: float) -> str:
        """Set a physical input of the motor's emulated drive, by its name (Ability.SETTINGS).

        Return the words by which the drive refuses it; "" if it has taken it.
        """

    def told(self, motor: "Motor") -> Sequence[str]:
        """Return what the motor's emulated drive has told the rig's record (Ability.SETTINGS)."""

    def afresh(self) -> None:
        """Switch everything off and on again (Ability.AFRESH); `motors` are new and unused."""


class Opener(Protocol):
    """A callable that switches on a new bench with every call."""

    def __call__(self) -> AbstractContextManager[RigProtocol]:
        """Return a context manager whose bench is on inside the block."""
