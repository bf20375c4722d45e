"""Fencing of a servo that lost its motor while paused."""

import signal
from contextlib import suppress
from pathlib import Path

import can
import pytest

from motorhil.emulators.cia401.node import build
from motorhil.emulators.controller import ControllerContext
from motorhil.motorapi import (
    ControlMode,
    MotorBusyError,
    MotorError,
    TrapezoidalTrajectory,
    WallRuntime,
)
from motorhil.motorapi.locking.directory import VARIABLE
from motorhil.motorapi.locking.lock_status import read_process
from tests.support.line_programs import LONG_S, Program
from tests.support.programs.fenced_owner import open_bus
from tests.support.programs.fenced_servo import servo_on
from tests.support.served_hub import Listener
from tests.system.wall.hub.test_hub import serving
from tests.system.wall.sharing.test_fencing import Sent, is_commanding, not_of_the_heir

pytestmark = pytest.mark.wall

OUTPUTS, ENABLE = 0x301, 0x201


class Servos:
    """A hub with one I/O node; an owner in a separate process, and an heir here."""

    def __init__(self, path, how):
        self.path = path
        self.runtime = WallRuntime()
        self.bus = can.Bus(interface="emulated", channel=path)
        self.heir = servo_on(self.bus, "heir", self.runtime)
        self.sent = Sent(self.bus, self.runtime)
        self.listener = Listener(open_bus(path), is_commanding)
        self.owner = Program("fenced_servo", path, how)
        assert self.owner.hear() == "holding"

    def pause(self):
        self.owner.signal(signal.SIGSTOP)
        stopped = self.runtime.wait_until(lambda: read_process(self.owner.pid)[0] in "Tt", LONG_S)
        assert stopped

    def move(self):
        motor = self.heir
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(0.2))
        motor.enable()
        motor.start()
        motor.wait_until_done(LONG_S)

    def others(self, since):
        """Return the outputs and enable bits on the bus since then, except the heir's."""
        difference = not_of_the_heir(self.listener, self.sent, since)
        return [can_id for can_id, _ in difference if can_id in (OUTPUTS, ENABLE)]

    def other(self, since):
        """Return whether there is such a frame."""
        for _ in range(round(LONG_S / 0.02)):
            if self.others(since):
                return
            self.runtime.wait_until(lambda: False, 0.02)
        pytest.fail("the heir alone has commanded it")

    def close(self):
        self.owner.end()
        self.listener.close()
        self.heir.hardware.close()
        self.bus.shutdown()
        self.runtime.close()


@pytest.fixture
def servos(tmp_path, monkeypatch):
    locks = tmp_path / "locks"
    locks.mkdir(mode=0o700)
    monkeypatch.setenv(VARIABLE, str(locks))
    path = str(tmp_path / "hub")
    core = build({"node_id": 1}, ControllerContext(name="io", folder=Path(), seed=1))
    made = []
    with serving(path, core):
        yield lambda how: made.append(Servos(path, how)) or made[-1]
        for one in made:
            one.close()


@pytest.mark.parametrize("how", ["fenced", "unfenced"])
def test_resumed_servo_sends_no_output_on_the_bus(servos, how):
    stage = servos(how)
    assert stage.owner.ask("look") == "holds"
    with pytest.raises(MotorBusyError, match="for survey"):
        stage.heir.enable()
    while True:
        stage.pause()
        try:
            reservation = stage.heir.reserve("rescue", take_over=True)
            reservation.__enter__()
        except MotorBusyError as error:  # it was paused in the middle of a write, or of a set-up
            told = str(error)
            assert "in the middle of a write" in told or "for set-up of" in told
            stage.owner.signal(signal.SIGCONT)
        else:
            break
    try:
        stage.move()
        since = stage.sent.mark(stage.listener)
        stage.owner.signal(signal.SIGCONT)
        if how == "fenced":
            ended = stage.owner.ask("wait")
            assert ended.startswith("ended: ")
            assert "was taken over (on demand) by pid " in ended
            stage.move()
            assert stage.others(since) == []
        else:
            with suppress(MotorError):  # two servos on one node
                stage.move()
            stage.other(since)
    finally:
        reservation.__exit__(None, None, None)
