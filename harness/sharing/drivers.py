"""Workers of `harness.sharing.processes` that share real motors: on a hub, or on SocketCAN.

    facts = {"channel": "/tmp/hub", "model": "wheel_model.toml", "node_ids": [1]}
    outcome = run(Plan(work="harness.sharing.drivers:work_motor", workers=4, facts=facts))

Their motors are drives by CiA 402, unless facts["make"] names a function "module:function" of your
own that is given the desk and returns the motors of that process, in the same order in each, named
alike but for the process. Each worker opens the bus for itself, as unrelated programs do.

`work_motor` shares the first motor: reserves it, with a lease if facts["lease_s"] says so, or takes
it over, moves it there and back, and gives it back. `work_groups` shares all: it reserves them as a
group for facts["rounds"] rounds, every other worker in the opposite order, and moves them in every
facts["move_every"]-th; each round that ends is counted as a use of the motor "rounds".
"""

from collections.abc import Callable
from contextlib import ExitStack
from importlib import import_module
from typing import TYPE_CHECKING, Final, cast

from harness.sharing.desk import Desk
from harness.sharing.history import Action, Answer, Note
from motorapi import (
    ControlMode,
    Motor,
    MotorBusyError,
    MotorError,
    MotorGroup,
    MotorModel,
    TrapezoidalTrajectory,
)
from motorapi.ownership_events import LockAction, OwnershipEvent

if TYPE_CHECKING:
    from motorapi.reservation import Reservation

_PATIENCE_S: Final = 60.0
_TAKEN: Final = (LockAction.TAKEN, LockAction.BROKEN, LockAction.TAKEN_OVER)


def drives(desk: Desk) -> list[Motor]:
    """A motor on each drive of facts["node_ids"], on the bus of facts["channel"]."""
    import can

    from motorapi.adaptations.cia402 import Cia402HwMotor, Cia402Motor, HwOptions

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
    return motor._physical.label  # noqa: SLF001 -- the same in every process


def work_motor(desk: Desk) -> None:
    """Reserves the first motor again and again and moves it; see above."""
    motor = _motors(desk)[0]
    told: list[OwnershipEvent] = []
    motor._physical.ownership.listeners.append(told.append)  # noqa: SLF001 -- who has it
    turn = 0
    while not desk.is_over:
        turn += 1
        by_force = desk.random.random() < desk.fact("take_over", 0.0)
        take = desk.history.call(desk.name, _label(motor), Action.TAKE, forced=by_force)
        told.clear()
        lease_s = desk.fact("lease_s", 0.0) or None
        try:
            with ExitStack() as stack:
                reservation = stack.enter_context(
                    motor.reserve(
                        f"turn {turn}",
                        timeout_s=None if by_force else _PATIENCE_S,
                        lease_s=lease_s,
                        take_over=by_force,
                    )
                )
                taken = next(event for event in reversed(told) if event.action in _TAKEN)
                forced = taken.action is LockAction.TAKEN_OVER
                take.returned(token=reservation.token, forced=forced)
                desk.note_inside(True)
                give = _move_in_turn(desk, motor, reservation, turn)
            desk.note_inside(False)
            give.returned(_given(desk, reservation))
        except MotorBusyError:  # in reserve(): inside of the block they are seen to
            was_taken = any(event.action in _TAKEN for event in told)
            take.returned(Answer.UNKNOWN if was_taken else Answer.REFUSED)
            if was_taken:  # and lost again, or given back because somebody was stopping it
                desk.history.call(desk.name, _label(motor), Action.GIVE).returned(Answer.UNKNOWN)


def _move_in_turn(desk: Desk, motor: Motor, reservation: "Reservation", turn: int) -> Note:
    """A motion or two were made, as far as the motor was still his; he is about to give it back."""
    for number in range(round(desk.fact("commands", 2))):
        value = (turn * 10 + number) * 1000 + desk.number
        command = desk.history.call(desk.name, _label(motor), Action.COMMAND, value=value)
        try:
            _set_course(desk, motor)
            motor.start()
        except MotorBusyError:
            lost = reservation.lost_to is not None
            command.returned(Answer.LOST if lost else Answer.UNKNOWN)  # unknown: somebody stops it
            break
        except MotorError:
            command.returned(Answer.UNKNOWN)
            break
        command.returned()
        if desk.random.random() < desk.fact("stalls", 0.0):
            desk.spend(desk.fact("stall_s", 0.1))  # neither waits nor commands, as behind a prompt
        try:
            motor.wait_until_done(_PATIENCE_S)
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
    """Reserves all motors as a group, round by round; see above."""
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
        with group.reserve(f"round {number}", timeout_s=_PATIENCE_S) as reservation:
            tokens = dict(zip(reservation.names, reservation.tokens, strict=True))
            for take, motor in zip(takes, motors, strict=True):
                take.returned(token=tokens[motor.name])
            if number % every == 0:
                for motor in motors:
                    _set_course(desk, motor)
                group.start()
                group.wait_until_done(_PATIENCE_S)
            gives = [desk.history.call(desk.name, _label(motor), Action.GIVE) for motor in motors]
        for give in gives:
            give.returned()
        ended.returned()
