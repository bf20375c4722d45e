"""Drives with one defect each, to check that the tests find it: name, and what to break.

Each breaks a class of the emulator for the duration of one test (pytest's monkeypatch).
"""

from collections.abc import Callable
from typing import Final

import pytest

from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.cia402 import state_machine as pds_fsa
from motorhil.emulators.cia402.modes.profile_position import ProfilePosition
from motorhil.emulators.cia402.modes.profile_velocity_torque import ProfileVelocity
from motorhil.emulators.cia402.objects.motion import MotionObjects
from motorhil.emulators.cia402.power_drive import PowerDrive
from motorhil.emulators.cia402.state_machine import Command, PdsState
from motorhil.emulators.firmware.axis import Axis

Break = Callable[[pytest.MonkeyPatch], None]


def _fault_reset_is_a_level(patch: pytest.MonkeyPatch) -> None:
    good = pds_fsa.decode_controlword

    def decode(word: int, previous: int) -> Command | None:
        return Command.FAULT_RESET if word & 0x80 else good(word, previous)

    patch.setattr(pds_fsa, "decode_controlword", decode)


def _enable_ends_every_quick_stop(patch: pytest.MonkeyPatch) -> None:
    good = PowerDrive._is_earned
    patch.setattr(
        PowerDrive,
        "_is_earned",
        lambda self, transition, now_ns: transition == 16 or good(self, transition, now_ns),
    )


def _shutdown_is_ignored_when_switched_on(patch: pytest.MonkeyPatch) -> None:
    patch.delitem(pds_fsa.TRANSITIONS, (PdsState.SWITCHED_ON, Command.SHUTDOWN))


def _enabled_right_out_of_switch_on_disabled(patch: pytest.MonkeyPatch) -> None:
    place = (PdsState.SWITCH_ON_DISABLED, Command.ENABLE_OPERATION)
    patch.setitem(pds_fsa.TRANSITIONS, place, 2)


def _power_is_never_cut(patch: pytest.MonkeyPatch) -> None:
    good = Axis.power
    patch.setattr(Axis, "power", lambda self, on: good(self, True) if on else None)


def _stops_do_not_brake(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Axis, "ramp_to_rest", lambda self, *_: None)


def _faults_are_not_told(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(CanopenNode, "emergency", lambda self, *_: None)


def _software_limits_do_not_limit(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(MotionObjects, "within_limits_inc", lambda self, target: target)


def _a_set_point_needs_no_edge(patch: pytest.MonkeyPatch) -> None:
    good = ProfilePosition.obey
    patch.setattr(
        ProfilePosition, "obey", lambda self, word, _, now_ns: good(self, word, 0x10, now_ns)
    )


def _halt_does_not_halt(patch: pytest.MonkeyPatch) -> None:
    for mode in (ProfilePosition, ProfileVelocity):
        good = mode.obey
        patch.setattr(
            mode,
            "obey",
            lambda self, word, rising, now_ns, good=good: good(
                self, word & ~0x100, rising & ~0x100, now_ns
            ),
        )


def _no_limit_of_speed(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(MotionObjects, "velocity_max_inc_s", lambda self: 1e9)


def _a_controlword_is_taken_twice(patch: pytest.MonkeyPatch) -> None:
    good = PowerDrive._write_controlword

    def write(self: PowerDrive, word: int, now_ns: int) -> None:
        good(self, word, now_ns)
        good(self, word & 0x7F | 0x06, now_ns)

    patch.setattr(PowerDrive, "_write_controlword", write)


MUTANTS: Final[dict[str, Break]] = {
    function.__name__.strip("_"): function
    for function in (
        _fault_reset_is_a_level,
        _enable_ends_every_quick_stop,
        _shutdown_is_ignored_when_switched_on,
        _enabled_right_out_of_switch_on_disabled,
        _power_is_never_cut,
        _stops_do_not_brake,
        _faults_are_not_told,
        _software_limits_do_not_limit,
        _a_set_point_needs_no_edge,
        _halt_does_not_halt,
        _no_limit_of_speed,
        _a_controlword_is_taken_twice,
    )
}
