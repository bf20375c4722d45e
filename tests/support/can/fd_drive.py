"""A drive that speaks CAN FD only, and its adaptation of six hooks.

The emulated one is that of the template behind long frames (identifiers + node-ID, little endian):

| identifier | from  | data                                                                   |
| ---------- | ----- | ---------------------------------------------------------------------- |
| 180h       | drive | state u8, number u8, moving u8, -, fault u16, position i32,            |
|            |       | velocity i32, 2 bytes of padding                                       |
| 200h       | host  | code u8, number u8, 2 bytes, target, velocity, acceleration,           |
|            |       | deceleration (4 bytes each)                                            |
"""

from dataclasses import dataclass
from math import tau
from struct import Struct

from motorhil.emulators.api import controller
from motorhil.emulators.can.frame import can_id_of, data_of, pack, pack_fd
from motorhil.harness.examples.new_drive import emulated
from motorhil.motorapi.api import (
    REQUIRED,
    CanDrive,
    Measurement,
    Motor,
    MotorState,
    Options,
    Shared,
    adaptation,
    read_settings,
    text,
    whole,
)

STATUS, COMMAND = 0x180, 0x200
OFF, ON, MOVE, STOP = range(4)
BIT_RATE_SWITCH = 1
STEPS = 65536
_STATUS = Struct("<BBBxHiixx")
_COMMAND = Struct("<BBxxiIII")
_STATES = (MotorState.DISABLED, MotorState.ENABLED, MotorState.FAULT)


class FdController:
    """The template's drive, whose frames are joined to long ones and split again."""

    def __init__(self, inner):
        self._inner = inner

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def receive(self, data, now_ns):
        node = can_id_of(data) - COMMAND
        code, number, target, *limits = _COMMAND.unpack(data_of(data))
        self._inner.receive(pack(0x400 + node), now_ns)
        if code in (MOVE, STOP):
            speed, faster, slower = (one.to_bytes(4, "little") for one in limits)
            self._inner.receive(pack(0x300 + node, speed), now_ns)
            self._inner.receive(pack(0x380 + node, faster + slower), now_ns)
        order = bytes((code, number, 0, 0)) + target.to_bytes(4, "little", signed=True)
        self._inner.receive(pack(COMMAND + node, order), now_ns)

    def take_output(self):
        frames = self._inner.take_output()
        return [
            pack_fd(can_id_of(status), data_of(status) + data_of(estimate) + bytes(2))
            for status, estimate in zip(frames[::2], frames[1::2], strict=True)
        ]


@controller(api=1)
def drive(settings, context):
    return FdController(emulated.build({"watchdog_s": 0.0, **settings}, context))


class FdHardware:
    def __init__(self, bus, node, runtime):
        self.users = 0
        self.node, self.number, self.status = node, 0, None
        self.drive = CanDrive(bus, node, self, runtime=runtime, fd=True)
        self.label = self.drive.label
        self._life = self.drive.expect("status", 0.05)
        self.drive.handle(STATUS + node, self._on_status)

    @property
    def is_closed(self):
        return self.drive.is_closed

    def close(self):
        self.drive.close(at_rest=True)

    def _on_status(self, data, time_ns):
        state, number, _, _, position, velocity = _STATUS.unpack(data)
        self.status = (time_ns, state, number, position, velocity)
        self._life.came(time_ns)

    def packed(self, code, target=0, limits=(0, 0, 0)):
        self.number = (self.number + 1) % 256
        return COMMAND + self.node, _COMMAND.pack(code, self.number, target, *limits)

    def obey(self, code, target=0, limits=(0, 0, 0)):
        def send():
            can_id, data = self.packed(code, target, limits)
            self.drive.command(can_id, data, flags=BIT_RATE_SWITCH)

        self.drive.exchange(send, lambda: self.status[2] == self.number, 0.2, "its number")


class FdMotor(Motor):
    def __init__(self, hardware, model, *, name=None, on_close=None):
        drive = hardware.drive
        super().__init__(
            name=name,
            model=model,
            runtime=drive.runtime,
            physical=drive.physical,
            on_close=on_close,
        )
        self._hardware = hardware
        self._steps = STEPS * model.gear_ratio / tau

    def _connect(self):
        hardware = self._hardware
        hardware.drive.connect(lambda: hardware.status is not None, lambda: None, 3.0, "status")
        hardware.drive.check()

    def _latest(self):
        if self._hardware.status is None:
            return None
        time_ns, state, _, position, velocity = self._hardware.status
        return Measurement(time_ns, _STATES[state], position / self._steps, velocity / self._steps)

    def _enable(self):
        self._hardware.obey(ON)

    def _disable(self):
        self._hardware.obey(OFF)

    def _command(self, motion):
        limits = (motion.velocity, motion.acceleration, motion.deceleration)
        size = abs(self._steps)
        self._hardware.obey(
            MOVE, round(motion.target * self._steps), [int(one * size) for one in limits]
        )

    def _stop(self):
        size = int(self._physical.stop_deceleration(self.model.deceleration) * abs(self._steps))
        can_id, data = self._hardware.packed(STOP, 0, (size, size, size))
        self._hardware.drive.stop_command(can_id, data, flags=BIT_RATE_SWITCH)


@dataclass(frozen=True, slots=True, kw_only=True)
class FdTable(Options):
    node_id: int = whole(REQUIRED, 0, 63, "", "Its node-ID.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


_SHARED = Shared("drive")


@adaptation(api=1)
def build(bus, settings, model, runtime):
    own = read_settings(FdTable, settings)
    hardware = _SHARED.get(
        bus, own.node_id, lambda: FdHardware(bus, own.node_id, runtime), lambda _: True
    )
    return FdMotor(hardware, model, name=own.name, on_close=lambda: _SHARED.give_back(hardware))
