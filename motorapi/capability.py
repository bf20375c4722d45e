"""Synchronization capability of a group before a motion, and quality afterwards."""

# ruff: noqa: SLF001 -- it works the hooks of motors, as Motor does its own

from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

from motorapi import planning
from motorapi.errors import UsageError
from motorapi.execution import Started, plan
from motorapi.group_planning import TIME, Common
from motorapi.skew import Bound, Member, command_bound, end_bound, start_bound
from motorapi.synchronization import (
    SyncCapability,
    SyncLevel,
    SyncQuality,
    spread_s,
)

if TYPE_CHECKING:
    from motorapi.motor import Motor


def capability_of(motors: Sequence["Motor"], common: Common = TIME) -> SyncCapability:
    """Return how closely together `motors` can begin and end with the present settings.

    Args:
        motors: motors of one runtime.
        common: the common properties of their motions.

    Raises:
        MotorError: a motor does not answer.
    """
    with ExitStack() as passages:
        for motor in motors:
            passages.enter_context(motor._physical.passage(motor.name))
        return _capability(motors, common)


def _capability(motors: Sequence["Motor"], common: Common) -> SyncCapability:
    for motor in motors:
        motor._call(motor._connect)
    offers = [motor._call(motor._sync_offer) for motor in motors]  # only when all are connected
    weakest = min(range(len(offers)), key=lambda place: offers[place].level)
    level, reason = offers[weakest].level, offers[weakest].reason
    for place, offer in enumerate(offers):
        if offer.group != offers[0].group and level is not SyncLevel.SEQUENTIAL:
            level, weakest = SyncLevel.SEQUENTIAL, place
            reason = f"it has another trigger ({offer.group}) than {motors[0].name}"
    durations, not_planned = _durations_s(motors, common)
    members = [
        Member(motor.name, offer, duration_s)
        for motor, offer, duration_s in zip(motors, offers, durations, strict=True)
    ]
    command = command_bound(members)
    start = start_bound(members, command)
    end = Bound(None, not_planned) if not_planned else end_bound(members, start)
    return SyncCapability(
        level=level,
        command_skew_s=command.value_s,
        start_skew_s=start.value_s,
        end_skew_s=end.value_s,
        weakest=motors[weakest].name,
        reason=reason,
        no_command_bound=command.reason,
        no_start_bound=start.reason,
        no_end_bound=end.reason,
    )


def quality_of(started: Sequence[Started]) -> SyncQuality:
    """Return how closely a start began and ended together; times still to come are None.

    Raises:
        MotorError: a motor does not answer.
    """
    times = tuple((one.motor.name, one.motor._call(one.motor._motion_times)) for one in started)
    known = [its for one, (_, its) in zip(started, times, strict=True) if not stays(one)]
    offers = [one.motor._call(one.motor._sync_offer) for one in started]
    members = [
        Member(one.motor.name, offer, None)
        for one, offer in zip(started, offers, strict=True)
        if not stays(one)
    ]
    return SyncQuality(
        predicted_start_skew_s=start_bound(members, command_bound(members)).value_s,
        predicted_end_skew_s=end_skew_s(started),
        start_skew_s=spread_s([None if its is None else its.started_ns for its in known]),
        end_skew_s=spread_s([None if its is None else its.ended_ns for its in known]),
        times=times,
        command_skew_s=spread_s([None if its is None else its.latched_ns for its in known]),
        straddles=max((0 if its is None else its.straddles for its in known), default=0),
    )


def stays(one: Started) -> bool:
    """Return True if the motor is at its target within the resolution: it cannot end late."""
    motion = one.motion
    return (
        motion.trajectory is not None and motion.function is None and one.quantised.distance == 0.0
    )


def end_skew_s(started: Sequence[Started]) -> float:
    """Return the time between the ends of the quantised profiles [s], without motors at rest."""
    durations_s = [
        planning.duration_of(one.quantised)
        for one in started
        if one.motion.duration_s is not None and not stays(one)
    ]
    return max(durations_s) - min(durations_s) if durations_s else 0.0


def _durations_s(motors: Sequence["Motor"], common: Common) -> tuple[list[float | None], str]:
    """Return the quantised duration of each motor [s], and why no start is possible, or "".

    A duration is None if the motion does not end by itself.
    """
    try:
        motions = plan(motors, common)
    except UsageError as error:
        return [None for _ in motors], f"no start is possible now: {error}"
    durations: list[float | None] = []
    for motor, motion in zip(motors, motions, strict=True):
        one = Started(motor, motion, motor._call(motor._quantise, motion))
        ends = motion.duration_s is not None and not stays(one)
        durations.append(planning.duration_of(one.quantised) if ends else None)
    return durations, ""
