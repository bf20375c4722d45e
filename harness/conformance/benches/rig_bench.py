"""An emulated rig in virtual time as a bench, with all abilities."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self, final

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule, FrameError
from motorhil.emulators.can.frame import BRS, EFF_FLAG, can_id_of, data_of, pack, pack_fd
from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.emulators.simulation.ownership_notice import OwnershipNotice
from motorhil.harness.conformance.bench import Ability, Announced, Lost, Stated
from motorhil.harness.conformance.benches.programs import Programs
from motorhil.harness.conformance.clause import NotApplicable
from motorhil.harness.plugins import (
    ADAPTATIONS,
    CONTROLLERS,
    DECODERS,
    SETTINGS,
    installed,
    named,
)
from motorhil.harness.python_can.bus import EmulatedBus
from motorhil.harness.rig.config.buses import (
    ADDRESS_KEYS,
    MODBUS_TCP,
    SERIAL,
    BusDescription,
    address_key,
)
from motorhil.harness.rig.config.conformance import Facts
from motorhil.harness.rig.config.derived import with_timing
from motorhil.harness.rig.config.faults import HOST
from motorhil.harness.rig.config.rig_file import RigDescription
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.config.units import units_per_plant_rad
from motorhil.harness.rig.reading import read_models
from motorhil.harness.rig.rig import Rig
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi import Motor, MotorError, MotorModel, UsageError
from motorhil.motorapi.ownership.claim import LockAction
from motorhil.settings import declaration

if TYPE_CHECKING:  # a first verdict needs no decoder
    from motorhil.harness.conformance.benches.programs import Link
    from motorhil.harness.conformance.verdicts.observation import Observation
    from motorhil.traces.decoding.narrative import BusMessage

SECOND_USER: Final = "another"
_READER: Final = "reader"
_READ_PERIOD_S: Final = 0.02
_OTHERS: Final = "others"
_FAULT_NS: Final = 50_000_000
"""Time until the cause of a fault is gone [ns]."""
_CANOPEN: Final = ("cia402", "cia401")
"""Kinds of controllers that use SYNC and NMT, and whose commands the bench recognises."""
_SYNC: Final = 0x080
_SDO_ANSWER: Final = 0x580  # + node-ID
_UNUSED_ID: Final = 0x7FF
_LAST_BIT: Final = 0.02
_STOPS: Final = {  # commands of another program: by SDO to 6040h, halt; by the vendors' registers
    "cia402": bytes.fromhex("2B 40 60 00 0F 01 00 00"),
    "leadshine_pr": bytes.fromhex("06 60 02 00 40"),
    "oriental_az": bytes.fromhex("10 00 7C 00 02 04 00 00 00 20"),
    "dynamixel": bytes.fromhex("40 00 00"),  # torque off
    "dryve": bytes.fromhex("2B 0D 01 00 00 60 40 00 00 00 00 02 0F 01"),
}
_SDO_REQUEST: Final = 0x600  # + node-ID
_STOP_FRAMES: Final[Mapping[str, Callable[[int], bytes]]] = {  # the same, by frames of the vendors
    "mit": lambda node: pack(node, bytes.fromhex("FF FF FF FF FF FF FF FD")),  # leave motor mode
    "robstride": lambda node: pack(EFF_FLAG | 0x0400_4200 | node, bytes(8)),  # stop
    "rmd": lambda node: pack(0x140 + node, b"\x81" + bytes(7)),  # motor stop
    "vesc": lambda node: pack(EFF_FLAG | 0x0300 | node, bytes(4)),  # a speed of 0
    "moteus": lambda node: pack_fd(node, b"\1\0\0", BRS),  # mode 0, stopped
}
_STOP_FRAMES_AGAIN: Final[Mapping[str, Callable[[int], bytes]]] = {  # in every second stop
    "vesc": lambda node: pack(EFF_FLAG | 0x0800 | node, b"\0\0\x08\0\0\0\0"),  # in a packet
}
_SWITCHED: Final = (
    *("mit", "robstride", "rmd", "dynamixel", "moteus", "vesc"),
    *("leadshine_pr", "oriental_az"),
)
"""Kinds of controllers whose stimulus `power` switches all of them off and on."""
_POWER_S: Final = 0.05
"""Time without power of a restarted drive [s]."""
_MODBUS_WRITES: Final = (0x05, 0x06, 0x0F, 0x10, 0x16, 0x17)
_GATEWAY_WRITE: Final = bytes((0x2B, 0x0D, 1))  # CANopen objects through Modbus


def _merged(settings: Mapping[str, object], changes: Mapping[str, object]) -> dict[str, object]:
    """Return settings with these changes, also of tables in them."""
    made = dict(settings)
    for key, value in changes.items():
        before = made.get(key)
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            value = {**before, **value}
        made[key] = value
    return made


class TimeIsUp(BaseException):
    """A clause has taken too long in the rig's time; an adaptation must not catch this."""


def bench_description(rig: RigDescription, adaptation: str | None) -> RigDescription:
    """Return the rig with its motors under test, each of them twice for other users.

    The motors under test use `adaptation`, if it is given.

    Raises:
        RigError: the rig has no motors to test.
    """
    names = rig.conformance.motors or _under_test(rig, adaptation)
    motors = dict(rig.motors)
    for name in names:
        motor = rig.motors[name]
        if adaptation is not None:
            motor = replace(motor, adaptation=adaptation)
        settings = dict(motor.settings)
        if motor.controller is None and motor.bus is None:
            settings.setdefault("axis", name)
        motors[name] = replace(motor, settings=settings)
        second = f"{name}-{SECOND_USER}"
        motors[second] = replace(motors[name], name=second)
    return replace(rig, motors=motors, conformance=replace(rig.conformance, motors=names))


def _under_test(rig: RigDescription, adaptation: str | None) -> tuple[str, ...]:
    """Return the motors of that adaptation, else those of the first group, else two of all."""
    if not rig.motors:
        raise RigError(rig.source.path, "has no motors to test", "add a [motor.NAME]")
    of_kind = tuple(name for name, one in rig.motors.items() if one.adaptation == adaptation)
    if of_kind:
        return of_kind[:2]
    for group in rig.groups.values():
        return group.motors
    return tuple(rig.motors)[:2]


@final
class RigBench:
    """An open rig as a bench; a context manager that closes it.

    Args:
        description: from `bench_description`.
        seed: the seed of all random numbers.
        record: an MCAP file for all events; `afresh` begins a new record.
        is_observed: keep what a diagnosis needs, in `observation`.
        is_read: another program reads the positions of the motors under test all the time.
        is_apart: other users of the motors are of another program, as after `apart`.
        limit_s: the time limit in the rig's time, after which `TimeIsUp` ends all waits [s].

    The declared messages of other senders are sent.
    """

    def __init__(
        self,
        description: RigDescription,
        seed: int,
        *,
        record: Path | None = None,
        is_observed: bool = False,
        is_read: bool = False,
        is_apart: bool = False,
        limit_s: float = 120.0,
    ) -> None:
        self._readers: tuple[str, ...] = ()
        if is_read:
            motors = dict(description.motors)
            for one in description.conformance.motors:
                motors[f"{one}-{_READER}"] = replace(motors[one], name=f"{one}-{_READER}")
            self._readers = tuple(motors)[len(description.motors) :]
            description = replace(description, motors=motors)
        self._description = description
        self._record = record
        self._is_observed = is_observed
        self._is_apart = is_apart
        self._limit_s = limit_s
        self._rules = 0
        self._stops = 0
        self.seed = seed
        self.facts: Facts = description.conformance
        self._switch_on()

    def _switch_on(self) -> None:
        self._scales: dict[str, float] = {}
        record = self._record  # the doubts of a rig are read nowhere else
        self.rig: Rig = Rig(
            self._description, seed=self.seed, record=record, doubts=record is not None
        )
        self.rig.world.queue.alarm(self._time_is_up).set(round(self._limit_s * 1e9))
        self._told: list[str] = list(self.rig.notes)
        self.rig.world.tap_events(self._hear)

        self._programs = Programs(self.rig, _is_other) if self._is_apart else None
        self._motors = self.rig.motors if self._programs is None else self._programs.motors
        for bus in self._description.buses.values():
            self._send_messages(bus)
        for reader in self._readers:
            self.runtime.spawn(reader, partial(self._read, reader))

        self._is_used = False
        self.observation: Observation | None = self._observe() if self._is_observed else None

    def _hear(self, _time_ns: int, level: str, controller: str, text: str) -> None:
        self._told.append(f"{controller}: {level}: {text}")

    def _observe(self) -> "Observation":
        from motorhil.harness.conformance.verdicts.observation import Observation

        motors = {name: self._motors[name] for name in self.facts.motors}
        return Observation(self.rig, self._description, motors, self._seen_truth)

    def _send_messages(self, bus: BusDescription) -> None:
        """Send the declared messages of others from a node of their own, each with its period."""
        if not bus.messages:
            return
        others = self.rig.world.add_host(bus.name, _OTHERS, lambda *_: None)
        for one in bus.messages:
            can_id, data = one.can_id | (EFF_FLAG if one.extended else 0), bytes(one.length)
            rate = BRS if one.bit_rate_switch else 0
            frame = pack_fd(can_id, data, rate) if one.fd else pack(can_id, data)
            self.runtime.every(one.period_s, partial(others.send, frame))

    def _read(self, reader: str) -> None:
        """Read a motor's position as another program does, whatever the drive answers."""
        motor = self._motors[reader]
        while True:
            motor.runtime.wait_until(lambda: False, _READ_PERIOD_S)
            with suppress(MotorError):
                motor.position()

    @property
    def name(self) -> str:
        """The name of the bench, for reports."""
        return self._description.name

    def _seen_truth(self, motor: Motor) -> Mapping[str, float]:
        truth = dict(self._truth(motor))
        if "position_rad" in truth:
            try:
                scale = self._units_per_rad(motor)
            except (NotApplicable, AttributeError):  # no ratio, or no model before it is connected
                return truth
            truth["position"] = truth["position_rad"] * scale
            truth["velocity"] = truth["velocity_rad_s"] * scale
            truth["torque"] = truth.get("torque_n_m", 0.0) / scale
        return truth

    def _time_is_up(self, now_ns: int) -> None:
        raise TimeIsUp(f"still waiting after {self._limit_s:g} s of the rig's time")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._switch_off()

    def _switch_off(self) -> None:
        with closing(self.rig):
            if self._programs is not None:
                with closing(self._programs):
                    self.runtime.close()  # parties end while their motors are open

    def afresh(self) -> None:
        """Switch everything off and on again, unless all is new: `motors` are new and unused."""
        if self._is_used or self.runtime.now_ns() > 0:
            self._restart()

    def apart(self) -> None:
        """Switch everything off and on again; other users are of another program from now on."""
        self._is_apart = True
        self._restart()

    def _restart(self) -> None:
        self._switch_off()
        self._switch_on()

    # --- motors under test ----------------------------------------------------------------

    @property
    def runtime(self) -> VirtualRuntime:
        """The runtime in which a clause waits."""
        return self.rig.runtime

    @cached_property
    def abilities(self) -> Sequence[Ability]:
        """The abilities of an emulated rig for these motors."""
        able = {Ability.AFRESH, Ability.SEVERAL_USERS, Ability.SETTINGS}
        if self._programs is None:
            able.add(Ability.ONE_PROGRAM)
        if not self._readers:
            able.add(Ability.SOLE_USER)
        if len(self.facts.motors) > 1:
            able.add(Ability.SECOND_MOTOR)
        name = self.facts.motors[0]
        first, motor = self._description.motors[name], self._motors[name]  # not used by that
        if first.adaptation == "ideal":
            able |= {Ability.TRUTH, Ability.FAULT}
        elif "position_rad" in self._truth(motor):
            able.add(Ability.TRUTH)
        if first.controller is not None:
            able |= {Ability.LOAD, Ability.FAULT, Ability.LOSE}
            able |= {Ability.CUT, Ability.SILENCE_HOST, Ability.SECOND_PROGRAM}
            kind = self._description.controllers[first.controller].kind
            if kind in _CANOPEN or self._is_on_a_line(motor):
                able |= {Ability.TRAFFIC, Ability.LATE}
            if self._is_plain(motor) and kind not in installed(DECODERS):
                able.remove(Ability.TRAFFIC)
            if not self._is_on_a_line(motor):
                able |= {Ability.BUS_ERRORS, Ability.ONE_KIND, Ability.OWNERS}
            if kind in _CANOPEN:
                able |= {Ability.STOP_SYNC, Ability.CLOCK}
            if kind in _CANOPEN or kind in _SWITCHED:
                able.add(Ability.RESTART)
            if kind in _STOPS or kind in _STOP_FRAMES:
                able.add(Ability.OTHER_PROGRAM)
        return tuple(one for one in Ability if one in able)

    @property
    def motor(self) -> Motor:
        """The motor under test."""
        self._is_used = True
        return self._motors[self.facts.motors[0]]

    @property
    def motors(self) -> Sequence[Motor]:
        """All motors under test."""
        self._is_used = True
        return tuple(self._motors[name] for name in self.facts.motors)

    def another_user_of(self, motor: Motor) -> Motor:
        """Return another logical motor on the same physical motor."""
        self._is_used = True
        return self._motors[f"{physical_name(motor)}-{SECOND_USER}"]

    @contextmanager
    def killed_after(self, motor: Motor, messages: int) -> Iterator[Lost]:
        """Kill this motor's program in the block, once it has sent so many messages on its bus."""
        programs, bus = self._programs, self._bus(motor)
        assert programs is not None, "the bench must be apart()"
        port = programs.port(motor.name)
        sent, watches = 0, [True]

        def count(where: str, sender: str) -> None:
            nonlocal sent
            if watches and where == bus and sender == port:
                sent += 1
                if sent == messages:
                    programs.kill(motor.name)

        self.rig.world.tap_frames(lambda where, _now, sender, _frame: count(where, sender))
        self.rig.world.tap_lines(
            lambda where, _now, _first, _last, sender, _adu, _ok: count(where, sender)
        )
        try:
            if messages == 0:
                programs.kill(motor.name)
            yield lambda: sent
        finally:
            watches.clear()

    def stated(self, of_drive: bool = False) -> Stated | None:
        """Return the settings of the motor, or of its drive; None: they are not declared."""
        motor = self._description.motors[self.facts.motors[0]]
        if not of_drive:
            table = installed(SETTINGS[ADAPTATIONS]).get(motor.adaptation)
            values = self._settings()
        elif motor.controller is None:
            return None
        else:
            described = self._description.controllers[motor.controller]
            table = installed(SETTINGS[CONTROLLERS]).get(described.kind)
            values = dict(described.settings)
        if table is None:
            return None
        of: Any = table.load()  # a class of settings, or a declaration
        return Stated(declaration(of), values)

    @property
    def link(self) -> "Link | None":
        """The bus or line of the motor under test, or None."""
        bus = self._description.motors[self.facts.motors[0]].bus
        return None if bus is None else self._link_of(bus)

    def build(self, settings: Mapping[str, object], model: MotorModel | None = None) -> Motor:
        """Return a further motor in the place of the motor under test, with these settings."""
        self._is_used = True
        name = self.facts.motors[0]
        known = read_models(self._description)[name] if model is None else model
        build = named(ADAPTATIONS, self._description.motors[name].adaptation).load()
        runtime = self.runtime if self._programs is None else self._programs.runtime
        built: Motor = build(self.link, settings, known, runtime)
        return built

    def _settings(self) -> dict[str, object]:
        """Return the settings with which the motor under test is built."""
        motor = self._description.motors[self.facts.motors[0]]
        core = None if motor.controller is None else self.rig.controllers[motor.controller].core
        own, _ = with_timing(self._description, motor, core)
        settings = {"name": motor.name, **own}
        if motor.bus is not None and motor.node_id is not None:
            settings[address_key(self._description.buses[motor.bus])] = motor.node_id
        return settings

    @contextmanager
    def altered(self, motor: Mapping[str, object], drive: Mapping[str, object]) -> Iterator[None]:
        """Switch everything off, and on with these settings for the block."""
        before, name = self._description, self.facts.motors[0]
        motors, controllers = dict(before.motors), dict(before.controllers)
        address = motors[name].node_id
        for key in ADDRESS_KEYS:
            told = drive.get(key)
            address = told if isinstance(told, int) else address
        for one in (name, f"{name}-{SECOND_USER}", f"{name}-{_READER}"):
            if one not in motors:  # only some benches have a reader
                continue
            own = {**motors[one].settings, **motor}
            own = {key: own[key] for key in own if key not in ADDRESS_KEYS}
            motors[one] = replace(motors[one], node_id=address, settings=own)
        place = motors[name].controller
        if place is not None:
            settings = _merged(controllers[place].settings, drive)
            controllers[place] = replace(controllers[place], node_id=address, settings=settings)
        self._description = replace(before, motors=motors, controllers=controllers)
        try:
            self._restart()
            yield
        finally:
            self._description = before
            self._restart()

    def refusal(self, motor: Motor, name: str, value: float) -> str:
        """Set a physical input of the motor's drive; return the words of a refusal, or ""."""
        self._is_used = True
        try:
            self.rig.controllers[self._controller(motor)].stimulate(name, value)
        except ValueError as error:
            return str(error) or "refused without a word"
        return ""

    def told(self, motor: Motor) -> Sequence[str]:
        """Return what the motor's drive has told the rig's record."""
        own = f"{self._controller(motor)}: "
        return [text.removeprefix(own) for text in self._told if text.startswith(own)]

    # --- observations and actions ---------------------------------------------------------

    def true_position(self, motor: Motor) -> float:
        """Return the position of the motor's plant [U], or of an ideal motor."""
        truth = self._truth(motor)
        if not truth:
            return motor.position()
        return truth["position_rad"] * self._units_per_rad(motor)

    def load(self, motor: Motor, torque_n_m: float) -> None:
        """Apply this load torque [N·m], or force [N], from now on."""
        self._stimulate(motor, "load_torque_n_m", torque_n_m * self._units_per_rad(motor))

    def fail(self, motor: Motor, code: int | None = None) -> int:
        """Cause a short fault in the motor's drive; return its error code."""
        facts = self.facts
        wanted = facts.fault_code if code is None else code
        if self._description.motors[physical_name(motor)].adaptation == "ideal":
            motor.hardware.inject_fault(wanted)  # type: ignore[attr-defined]
            return wanted
        value = wanted if facts.fault_value is None else facts.fault_value
        self._stimulate(motor, facts.fault_stimulus, value)
        over = facts.fault_over_value
        if over is not None:
            ending = self.rig.world.queue.alarm(
                lambda now_ns: self._stimulate(motor, facts.fault_stimulus, over)
            )
            ending.set(self.runtime.now_ns() + _FAULT_NS)
        return wanted

    @contextmanager
    def cut(self, motor: Motor) -> Iterator[Lost]:
        """Cut the drive off the bus, with power, within the block; yield the count of effects."""
        rule = FaultRule("", FaultKind.CUT, ports=(self._controller(motor),))
        with self._rule(motor, rule) as lost:
            yield lost

    @contextmanager
    def silence_host(self, *, skip: int = 0, limit: int | None = None) -> Iterator[Lost]:
        """Drop the host's frames within the block, after `skip` frames and up to `limit`."""
        rule = FaultRule("", FaultKind.DROP, sender=HOST, skip=skip, limit=limit)
        with self._rule(self.motor, rule) as lost:
            yield lost

    @contextmanager
    def lose_answers_of(
        self, motor: Motor, *, skip: int = 0, limit: int | None = None
    ) -> Iterator[Lost]:
        """Drop the drive's frames within the block, after `skip` frames and up to `limit`."""
        sender = self._controller(motor)
        rule = FaultRule("", FaultKind.DROP, sender=sender, skip=skip, limit=limit)
        with self._rule(motor, rule) as lost:
            yield lost

    @contextmanager
    def delay_answers_of(
        self, motor: Motor, delay_s: float, *, skip: int = 0, limit: int | None = None
    ) -> Iterator[Lost]:
        """Delay the drive's answers, of a CANopen node those of SDO, within the block."""
        sender = self._controller(motor)
        node = self._description.controllers[sender].node_id
        identifier = None if self._is_on_a_line(motor) or node is None else _SDO_ANSWER + node
        rule = FaultRule(
            *("", FaultKind.DELAY, identifier),
            sender=sender,
            skip=skip,
            limit=limit,
            delay_ns=round(delay_s * 1e9),
        )
        with self._rule(motor, rule) as late:
            yield late

    @contextmanager
    def identifiers(self) -> Iterator[list[int]]:
        """Record the identifiers of all frames on the motor's bus in the block, each once."""
        seen: list[int] = []
        bus = self._bus(self.motor)

        def on_frame(where: str, _time_ns: int, _sender: str, frame: bytes) -> None:
            if where == bus and can_id_of(frame) not in seen:
                seen.append(can_id_of(frame))

        world = self.rig.world
        world.tap_frames(on_frame)
        try:
            yield seen
        finally:
            world.untap_frames(on_frame)

    @contextmanager
    def lose_identifier(self, identifier: int) -> Iterator[Lost]:
        """Drop all frames with this identifier on the motor's bus within the block."""
        rule = FaultRule("", FaultKind.DROP, identifier=identifier)
        with self._rule(self.motor, rule) as lost:
            yield lost

    @contextmanager
    def strike(self, motor: Motor | None, times: int, *, skip: int = 0) -> Iterator[Lost]:
        """Destroy transmission attempts of the drive, or of the host (None), in the block."""
        sender = HOST if motor is None else self._controller(motor)
        rule = FaultRule(
            "", FaultKind.ERROR, sender=sender, error=FrameError.BIT, skip=skip, limit=times
        )
        struck = self.motor if motor is None else motor
        with self._rule(struck, rule) as lost:
            if (
                motor is None and not skip
            ):  # the host may have nothing to send now; no node receives this
                link = self._link_of(self._bus(struck))
                assert isinstance(link, EmulatedBus)  # a line has no frames
                link.transmit(pack(_UNUSED_ID))
            yield lost

    @contextmanager
    def noise(self, bit_error_rate: float) -> Iterator[Lost]:
        """Corrupt bits on the bus at this error rate within the block.

        The last bit of a frame is corrupted more often. Then all nodes but the sender have received
        the frame, and receive it again (ISO 11898-1). At the given rate alone this would be too
        rare to test.
        """
        noise = FaultRule("", FaultKind.NOISE, bit_error_rate=bit_error_rate)
        last = FaultRule("", FaultKind.DUPLICATE, probability=_LAST_BIT)
        with self._rule(self.motor, noise) as lost, self._rule(self.motor, last):
            yield lost

    @contextmanager
    def stop_sync(self) -> Iterator[Lost]:
        """Drop all SYNC frames (CiA 301) within the block."""
        with self.lose_identifier(_SYNC) as lost:
            yield lost

    @contextmanager
    def clock(self) -> Iterator[list[int]]:
        """Record the times of the host's SYNC on the motor's bus in the block [ns]."""
        times_ns: list[int] = []
        bus = self._bus(self.motor)

        def on_frame(where: str, time_ns: int, sender: str, frame: bytes) -> None:
            if where == bus and can_id_of(frame) == _SYNC and sender.startswith(HOST):
                times_ns.append(time_ns)

        world = self.rig.world
        world.tap_frames(on_frame)
        try:
            yield times_ns
        finally:
            world.untap_frames(on_frame)

    @contextmanager
    def another_clock(self, period_s: float) -> Iterator[None]:
        """Let another node of the motor's bus produce SYNC with this period [s] in the block."""
        port = self.rig.world.add_host(self._bus(self.motor), "another", lambda *_: None)
        timer = self.runtime.every(period_s, lambda: port.send(pack(_SYNC)))
        try:
            yield
        finally:
            timer.cancel()

    def stop_from_elsewhere(self, motor: Motor) -> None:
        """Halt a CiA 402 drive by SDO, or stop a Modbus drive by its registers."""
        from motorhil.emulators.dynamixel.packets import Instruction, packet
        from motorhil.emulators.modbus.rtu import with_crc
        from motorhil.emulators.modbus.tcp import adu as adu_of

        described = self._description.controllers[self._controller(motor)]
        node = described.node_id or 0
        if described.kind in _STOP_FRAMES:
            port = self.rig.world.add_host(self._bus(motor), "another", lambda *_: None)
            self._stops += 1
            frames = {**_STOP_FRAMES, **({} if self._stops % 2 else _STOP_FRAMES_AGAIN)}
            port.send(frames[described.kind](node))
            return
        command = _STOPS[described.kind]
        if described.kind == "dynamixel":
            self.rig.line(self._bus(motor)).send(packet(node, Instruction.WRITE, command))
        elif self._description.buses[self._bus(motor)].kind == MODBUS_TCP:
            self.rig.line(self._bus(motor)).send(adu_of(0, node, command))
        elif self._is_on_a_line(motor):
            self.rig.line(self._bus(motor)).send(with_crc(bytes((node,)) + command))
        else:
            port = self.rig.world.add_host(self._bus(motor), "another", lambda *_: None)
            port.send(pack(_SDO_REQUEST + node, command))

    def restart(self, motor: Motor) -> None:
        """Restart the motor's drive by its supply, or by an NMT reset node from another host."""
        described = self._description.controllers[self._controller(motor)]
        if described.kind in _SWITCHED:
            self._stimulate(motor, "power", 0.0)
            on = self.rig.world.queue.alarm(lambda _: self._stimulate(motor, "power", 1.0))
            on.set(self.runtime.now_ns() + round(_POWER_S * 1e9))
            return
        node = described.node_id
        if node is None:
            raise NotApplicable(f"{motor.name}: its controller has no node-ID for an NMT reset")
        port = self.rig.world.add_host(self._bus(motor), "bench", lambda *_: None)
        port.send(pack(0, bytes((0x81, node))))

    @contextmanager
    def commands_to(self, motor: Motor) -> Iterator[list[str]]:
        """Record host commands to the motor's drive that may move or change it, in the block.

        If other users are of another program, those of the motor's own program. Messages that the
        host has sent before the block may still wait for the bus; they do not count.
        """
        from motorhil.harness.sharing_tests.bus_evidence import commanded_node

        seen: list[str] = []
        bus = self._bus(motor)
        address = self._description.controllers[self._controller(motor)].node_id
        kind = self._description.buses[bus].kind
        head = 6 if kind == MODBUS_TCP else 0
        describe = self._decoder(motor) if kind == SERIAL else None
        listening = [True]
        port = None if self._programs is None else self._programs.port(motor.name)
        before = self._link_of(bus, motor.name).pending()

        def is_host(sender: str) -> bool:
            nonlocal before
            is_own = sender.startswith(HOST) if port is None else sender == port
            is_late = is_own and before > 0
            before -= is_late
            return is_own and not is_late

        def on_frame(where: str, _time_ns: int, sender: str, frame: bytes) -> None:
            if listening and where == bus and is_host(sender):
                can_id = can_id_of(frame)
                if commanded_node(can_id, data_of(frame)) in (0, address):
                    seen.append(f"{can_id:03X}h")

        def on_adu(
            where: str, _now: int, _first: int, _last: int, sender: str, adu: bytes, _: bool
        ) -> None:
            if not listening or where != bus or not is_host(sender):
                return
            if describe is not None:
                message = describe(adu)
                if message is not None and "Write" in message.name:
                    seen.append(str(message))
                return
            unit, function = adu[head : head + 2]
            writes = function in _MODBUS_WRITES or adu[head + 1 : head + 4] == _GATEWAY_WRITE
            if unit == address and writes:
                seen.append(f"function {function:02X}h")

        self.rig.world.tap_frames(on_frame)
        self.rig.world.tap_lines(on_adu)
        try:
            yield seen
        finally:
            listening.clear()

    @contextmanager
    def owners_of(self, motor: Motor) -> Iterator[list[Announced]]:
        """Record what programs announce of the ownership of a motor, in the block."""
        told: list[Announced] = []
        described = self._description.motors[physical_name(motor)]
        node = self._description.controllers[self._controller(motor)].node_id or 0
        channel = described.settings.get("channel", 0)
        bus, resource = self._bus(motor), node | (channel if isinstance(channel, int) else 0) << 8
        listening = [True]

        def on_notice(where: str, _time_ns: int, sender: str, notice: OwnershipNotice) -> None:
            if listening and where == bus and notice.resource == resource:
                action = LockAction(notice.action)
                words = notice.owner, notice.purpose, sender
                told.append(Announced(action, notice.token, *words))

        self.rig.world.tap_ownership(on_notice)
        try:
            yield told
        finally:
            listening.clear()

    # --- helpers --------------------------------------------------------------------------

    def _link_of(self, bus: str, motor: str = "") -> "Link":
        """Return the connection by which the motors under test send on a bus or line.

        If there are two programs, that of this motor.
        """
        if self._programs is not None:
            return self._programs.link(bus, motor)
        return self.rig.line(bus) if self._description.buses[bus].is_line else self.rig.bus(bus)

    def _controller(self, motor: Motor) -> str:
        controller = self._description.motors[physical_name(motor)].controller
        if controller is None:
            raise NotApplicable(f"{motor.name} is not on an emulated controller")
        return controller

    def _bus(self, motor: Motor) -> str:
        return self._description.controllers[self._controller(motor)].bus

    def _is_on_a_line(self, motor: Motor) -> bool:
        return self._description.buses[self._bus(motor)].is_line

    def _is_plain(self, motor: Motor) -> bool:
        return self._description.buses[self._bus(motor)].kind == SERIAL

    def _decoder(self, motor: Motor) -> "Callable[[bytes], BusMessage | None]":
        """Return the decoder of the motor's drive."""
        described = self._description.controllers[self._controller(motor)]
        decode: Callable[[bytes], BusMessage | None] = installed(DECODERS)[described.kind].load()(
            described.node_id
        )
        return decode

    def _prefix(self, motor: Motor) -> str:
        """Return the prefix of the motor's channel in names of stimuli and true values."""
        channel = self._description.motors[physical_name(motor)].settings.get("channel", 1)
        return "" if channel == 1 else f"channel_{channel}_"

    def _truth(self, motor: Motor) -> Mapping[str, float]:
        """Return the true values of the motor's channel, without its prefix; may be empty."""
        described = self._description.motors[physical_name(motor)]
        if described.controller is None:
            return {}
        prefix = self._prefix(motor)
        truth = self.rig.controllers[described.controller].snapshot()
        if not prefix:
            return truth
        return {name.removeprefix(prefix): truth[name] for name in truth if name.startswith(prefix)}

    def _units_per_rad(self, motor: Motor) -> float:
        """Return the motor's units per radian of its plant [U/rad], as they were at power-on."""
        name = physical_name(motor)
        if name not in self._scales:
            core = self.rig.controllers[self._controller(motor)].core
            try:
                scale = units_per_plant_rad(self._description.motors[name], motor.model, core)
            except UsageError as error:
                raise NotApplicable(str(error)) from None
            self._scales[name] = scale
        return self._scales[name]

    def _stimulate(self, motor: Motor, name: str, value: float) -> None:
        try:
            self.rig.controllers[self._controller(motor)].stimulate(
                f"{self._prefix(motor)}{name}", value
            )
        except ValueError as error:
            raise NotApplicable(
                f"{motor.name}: its controller refuses this stimulus: {error}"
            ) from None

    @contextmanager
    def _rule(self, motor: Motor, wanted: FaultRule) -> Iterator[Lost]:
        """Inject this fault on the motor's bus; on a line, lose all messages of the sender.

        On a serial line, all of them: a unit's own could be told by its protocol only.
        """
        self._rules += 1
        name, bus = f"conformance {self._rules}", self._bus(motor)
        rule: FaultRule | SerialFaultRule = replace(wanted, name=name)
        if self._is_on_a_line(motor):
            unit = self._description.controllers[self._controller(motor)].node_id
            rule = SerialFaultRule(
                name,
                SerialFaultKind.DELAY if wanted.delay_ns else SerialFaultKind.LOSE,
                sender=wanted.sender,
                unit=None if self._is_plain(motor) else unit,
                skip=wanted.skip,
                limit=wanted.limit,
                delay_ns=wanted.delay_ns,
            )
        self.rig.faults.inject(bus, rule)
        try:
            yield lambda: self.rig.faults.fired().get(name, 0)
        finally:
            self.rig.faults.lift(bus, name)


def _is_other(name: str) -> bool:
    """Return whether a motor of this name is another user's."""
    return name.endswith((f"-{SECOND_USER}", f"-{_READER}"))


def physical_name(motor: Motor) -> str:
    """Return the rig's name of the physical motor."""
    return motor.name.removesuffix(f"-{SECOND_USER}")
