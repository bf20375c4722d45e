"""Workers that share real motors, on a hub or on SocketCAN.

    facts = {"channel": "/tmp/hub", "model": "wheel_model.toml", "node_ids": [1]}
    work = "motorhil.harness.sharing_tests.workers:work_motor"
    outcome = run(Plan(work=work, workers=4, facts=facts))

A worker process has a `Desk`: its name, its history, and a page shared with the arena. The simplest
worker, `work_lock`, takes a bare lock. The others' motors are CiA 402 drives, unless facts["make"]
names your own function as "module:function". The function takes the desk and returns the motors of
that process. All processes must use the same order, and the same names apart from the process. Each
worker opens the bus by itself, as unrelated programs do.

`work_motor` shares the first motor: it reserves the motor, with a lease if facts["lease_s"] is set,
or takes it over. Then it moves the motor there and back, and releases it. `work_groups` shares all
motors: it reserves them as a group for facts["rounds"] rounds. Every other worker uses the opposite
order. The motors move in every facts["move_every"]-th round. Each completed round counts as a use
of the motor "rounds".
"""

import os
import random
import time
from collections.abc import Callable
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast, final

from motorhil.harness.sharing_tests.history import Action, Answer, History, Note, Use, to_note
from motorhil.harness.sharing_tests.processes import Plan
from motorhil.motorapi import (
    ControlMode,
    Motor,
    MotorBusyError,
    MotorError,
    MotorGroup,
    MotorModel,
    TrapezoidalTrajectory,
)
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock
from motorhil.motorapi.ownership.claim import LockAction, OwnershipEvent
from motorhil.motorapi.runtime.api import Runtime
from motorhil.motorapi.runtime.wall import WallRuntime

if TYPE_CHECKING:
    from motorhil.motorapi.ownership.reservation import Reservation

OVER: Final = 0
INSIDE: Final = 1
_VALUE: Final = 2
_PATIENCE_S: Final = 10.0
_DRIVER_TIMEOUT_S: Final = 60.0
_TAKEN: Final = (LockAction.TAKEN, LockAction.BROKEN, LockAction.TAKEN_OVER)


@final
class Desk:
    """The equipment of a worker.

    Attributes:
        folder: a private folder of all workers.
        facts: the facts of the plan.
        number, name: identify the worker.
        random: its own random generator.
        page: numbers that all processes share; one is written as a whole (`struct` writes 0 first).
        history: notes the worker's uses.
    """

    def __init__(
        self, folder: Path, plan: Plan, number: int, page: "memoryview[int]", log: int
    ) -> None:
        self.folder: Final = folder
        self.facts: Final = plan.facts
        self.number: Final = number
        self.name: Final = f"{number}"
        self.random: Final = random.Random(f"{plan.seed}:{number}")
        self.history: Final = History(time.monotonic_ns, self._write_use)
        self.page: Final = page
        self._log = log

    def _write_use(self, use: Use) -> None:
        os.write(self._log, to_note(use))

    @property
    def is_over(self) -> bool:
        """True when the worker has to end."""
        return self.page[OVER] != 0

    def note_inside(self, inside: bool) -> None:
        """Note whether this worker has the motor, by its own account."""
        if inside:
            self.page[INSIDE] = os.getpid()
        elif self.page[INSIDE] == os.getpid():
            self.page[INSIDE] = 0

    @property
    def value(self) -> int:
        """The number in the shared page, the simplest thing to command."""
        return self.page[_VALUE]

    @value.setter
    def value(self, value: int) -> None:
        self.page[_VALUE] = value

    def fact(self, name: str, otherwise: float) -> float:
        """Return a number of the plan's facts."""
        return float(cast("float", self.facts.get(name, otherwise)))

    def spend(self, time_s: float) -> None:
        """Keep the processor busy for this wall time [s]."""
        until_ns = time.monotonic_ns() + round(time_s * 1e9)
        while time.monotonic_ns() < until_ns:
            pass


def work_lock(desk: Desk) -> None:
    """Take a bare lock repeatedly, and command a number in memory while holding it.

    A worker takes the lock at least once, so that one that begins after the last kill does as well.

    Facts: inside_s, lease_s (0: none), take_over (probability), commands (each time).
    """
    lock = ProcessLock("lock", "the lock", LockDirectory(desk.folder / "locks"))
    runtime = WallRuntime()
    lease_s = desk.fact("lease_s", 0.0) or None
    commands = round(desk.fact("commands", 2))
    turn, has_taken = 0, False
    while not (has_taken and desk.is_over):
        turn += 1
        by_force = desk.random.random() < desk.fact("take_over", 0.0)
        take = desk.history.call(desk.name, "lock", Action.TAKE, forced=by_force)

        def wait(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None) -> bool:
            if not by_force:  # noqa: B023 -- of this turn
                take.queued()  # noqa: B023 -- likewise
            return runtime.wait_until(done, timeout_s)

        try:
            hold = lock.acquire(
                runtime, "stress", _PATIENCE_S, wait=wait, lease_s=lease_s, take_over=by_force
            )
        except MotorBusyError:
            take.returned(Answer.REFUSED)
            continue
        take.returned(token=hold.token, forced=hold.was_taken_over)
        has_taken = True
        desk.note_inside(True)
        for number in range(commands):
            desk.spend(desk.fact("inside_s", 50e-6) / commands)
            _command(desk, lock, hold, turn * 1_000_000 + number * 1000 + desk.number % 1000)
        desk.note_inside(False)
        give = desk.history.call(desk.name, "lock", Action.GIVE)
        is_lost = hold.lost_to is not None
        hold.release()
        can_be_lost = bool(lease_s) or desk.fact("take_over", 0.0) > 0.0
        unsure = Answer.UNKNOWN if can_be_lost else Answer.DONE  # lost after the check
        give.returned(Answer.LOST if is_lost else unsure)


def _command(desk: Desk, lock: ProcessLock, hold: LockHandle, value: int) -> None:
    command = desk.history.call(desk.name, "lock", Action.COMMAND, value=value)
    try:
        lock.begin_write()
    except MotorBusyError:
        # A takeover that never ends, as its process was paused or killed, takes nothing away.
        command.returned(Answer.UNKNOWN if hold.lost_to is None else Answer.LOST)
        return
    desk.value = value
    lock.end_write()
    command.returned()
    read = desk.history.call(desk.name, "lock", Action.READ)
    read.returned(value=desk.value)


def drives(desk: Desk) -> list[Motor]:
    """Return a motor for each drive of facts["node_ids"], on the bus of facts["channel"]."""
    import can

    from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
    from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
    from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor

    patient = HwOptions(heartbeat_timeout_ms=10_000, sdo_timeout_s=10.0, connect_timeout_s=30.0)
    interface = str(desk.facts.get("interface", "emulated"))
    bus = can.Bus(interface=interface, channel=str(desk.facts["channel"]))
    model = MotorModel.load(str(desk.facts["model"]))
    node_ids = cast("list[int]", desk.facts["node_ids"])
    return [
        Cia402Motor(
            Cia402HwMotor(bus, node_id=number, options=patient),
            model=model,
            name=f"{number} of {desk.name}",
        )
        for number in node_ids
    ]


def _motors(desk: Desk) -> list[Motor]:
    module, _, function = str(desk.facts.get("make", f"{__name__}:drives")).partition(":")
    make: Callable[[Desk], list[Motor]] = getattr(import_module(module), function)
    return make(desk)


def _label(motor: Motor) -> str:
    return motor.logical.physical.label  # the same in every process


def work_motor(desk: Desk) -> None:
    """Reserve and move the first motor repeatedly; see the module's description."""
    motor = _motors(desk)[0]
    events: list[OwnershipEvent] = []
    motor.ownership.listeners.append(events.append)
    turn = 0
    while not desk.is_over:
        turn += 1
        by_force = desk.random.random() < desk.fact("take_over", 0.0)
        take = desk.history.call(desk.name, _label(motor), Action.TAKE, forced=by_force)
        events.clear()
        lease_s = desk.fact("lease_s", 0.0) or None
        try:
            with ExitStack() as stack:
                reservation = stack.enter_context(
                    motor.reserve(
                        f"turn {turn}",
                        timeout_s=None if by_force else _DRIVER_TIMEOUT_S,
                        lease_s=lease_s,
                        take_over=by_force,
                    )
                )
                taken = next(event for event in reversed(events) if event.action in _TAKEN)
                forced = taken.action is LockAction.TAKEN_OVER
                take.returned(token=reservation.token, forced=forced)
                desk.note_inside(True)
                give = _move_in_turn(desk, motor, reservation, turn)
            desk.note_inside(False)
            give.returned(_given(desk, reservation))
        except MotorBusyError:  # from reserve(); inside the block it is handled there
            was_taken = any(event.action in _TAKEN for event in events)
            take.returned(Answer.UNKNOWN if was_taken else Answer.REFUSED)
            if was_taken:  # lost again, or released because another process was stopping it
                desk.history.call(desk.name, _label(motor), Action.GIVE).returned(Answer.UNKNOWN)


def _move_in_turn(desk: Desk, motor: Motor, reservation: "Reservation", turn: int) -> Note:
    """Make a motion or two while the motor is owned; return the note of the coming release."""
    for number in range(round(desk.fact("commands", 2))):
        value = (turn * 10 + number) * 1000 + desk.number
        command = desk.history.call(desk.name, _label(motor), Action.COMMAND, value=value)
        try:
            _set_course(desk, motor)
            motor.start()
        except MotorBusyError:
            lost = reservation.lost_to is not None
            command.returned(Answer.LOST if lost else Answer.UNKNOWN)  # it is being stopped
            break
        except MotorError:
            command.returned(Answer.UNKNOWN)
            break
        command.returned()
        if desk.random.random() < desk.fact("stalls", 0.0):
            desk.spend(desk.fact("stall_s", 0.1))  # idle, like a program at a prompt
        try:
            motor.wait_until_done(_DRIVER_TIMEOUT_S)
        except MotorError:
            break
    return desk.history.call(desk.name, _label(motor), Action.GIVE)


def _given(desk: Desk, reservation: "Reservation") -> Answer:
    if reservation.lost_to is not None:
        return Answer.LOST
    can_be_lost = desk.fact("lease_s", 0.0) > 0.0 or desk.fact("take_over", 0.0) > 0.0
    return Answer.UNKNOWN if can_be_lost else Answer.DONE


def _set_course(desk: Desk, motor: Motor) -> None:
    distance = desk.fact("distance", 0.02)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(
        TrapezoidalTrajectory(
            -distance if motor.position() > 0.0 else distance,
            duration_s=desk.fact("duration_s", 0.15),
        )
    )


def work_groups(desk: Desk) -> None:
    """Reserve all motors as a group, in rounds; see the module's description."""
    motors = _motors(desk)
    if desk.number % 2:
        motors.reverse()
    group = MotorGroup(*motors)
    every = round(desk.fact("move_every", 100))
    for number in range(round(desk.fact("rounds", 500))):
        if desk.is_over:
            return
        ended = desk.history.call(desk.name, "rounds", Action.READ)
        takes = [desk.history.call(desk.name, _label(motor), Action.TAKE) for motor in motors]
        with group.reserve(f"round {number}", timeout_s=_DRIVER_TIMEOUT_S) as reservation:
            tokens = dict(zip(reservation.names, reservation.tokens, strict=True))
            for take, motor in zip(takes, motors, strict=True):
                take.returned(token=tokens[motor.name])
            if number % every == 0:
                for motor in motors:
                    _set_course(desk, motor)
                group.start()
                group.wait_until_done(_DRIVER_TIMEOUT_S)
            gives = [desk.history.call(desk.name, _label(motor), Action.GIVE) for motor in motors]
        for give in gives:
            give.returned()
        ended.returned()
