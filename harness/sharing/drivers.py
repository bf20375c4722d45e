"""Workers that share real motors, on a hub or on SocketCAN.

    facts = {"channel": "/tmp/hub", "model": "wheel_model.toml", "node_ids": [1]}
    outcome = run(Plan(work="harness.sharing.drivers:work_motor", workers=4, facts=facts))

Their motors are CiA 402 drives, unless facts["make"] names your own function as "module:function".
The function takes the desk and returns the motors of that process. All processes must use the same
order, and the same names apart from the process. Each worker opens the bus by itself, as unrelated
programs do.

`work_motor` shares the first motor: it reserves the motor, with a lease if facts["lease_s"] is set,
or takes it over. Then it moves the motor there and back, and releases it. `work_groups` shares all
motors: it reserves them as a group for facts["rounds"] rounds. Every other worker uses the opposite
order. The motors move in every facts["move_every"]-th round. Each completed round counts as a use
of the motor "rounds".
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
    """Return a motor for each drive of facts["node_ids"], on the bus of facts["channel"]."""
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
    """Reserve and move the first motor repeatedly; see the module's description."""
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
        except MotorBusyError:  # from reserve(); inside the block it is handled there
            was_taken = any(event.action in _TAKEN for event in told)
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
