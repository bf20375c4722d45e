"""A bench that is an emulated rig in virtual time: it can do everything, and see everything."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Final, Self, final

from emulators.media.can_frame import can_id_of, data_of, pack
from emulators.media.fault_rule import FrameError
from emulators.media.faults import FaultKind, FaultRule
from emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from harness.conformance.bench import Lost
from harness.conformance.capability import Ability
from harness.conformance.clause import NotApplicable
from harness.conformance.facts import Facts
from harness.rig import Rig
from harness.rig_faults import HOST
from harness.rig_file import RigDescription
from harness.settings import RigError
from harness.sharing.evidence import commanded_node
from harness.virtual_time import VirtualRuntime
from motorapi import Motor

SECOND_USER: Final = "another"
_FAULT_NS: Final = 50_000_000
"""How long the cause of a fault is there that goes by itself."""
_CANOPEN: Final = ("cia402", "cia401")
"""Kinds of controllers that go by SYNC and NMT, and whose commands the bench can tell."""
_SYNC: Final = 0x080
_FOR_NOBODY: Final = 0x7FF
_LAST_BIT: Final = 0.02
_MODBUS_WRITES: Final = (0x05, 0x06, 0x0F, 0x10, 0x16, 0x17)


class TimeIsUp(BaseException):
    """A clause has taken too long in the rig's time; no adaptation may catch it."""


def bench_description(rig: RigDescription, adaptation: str | None) -> RigDescription:
    """The rig with its motors under test of that adaptation, and each a second time, for others.

    Raises:
        RigError: there is nothing to test in it.
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
    """Those of that adaptation, else the members of the first group, else all."""
    if not rig.motors:
        raise RigError(rig.source.path, "has no motor to test", "add a [motor.NAME]")
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
        seed: of all chance.
        record: an MCAP file for everything that happens; after `afresh` it begins anew.
        limit_s: after so much of the rig's time `TimeIsUp` ends whatever waits [s].
    """

    def __init__(
        self,
        description: RigDescription,
        seed: int,
        *,
        record: Path | None = None,
        limit_s: float = 120.0,
    ) -> None:
        self._description = description
        self._record = record
        self._limit_s = limit_s
        self._rules = 0
        self.seed = seed
        self.facts: Facts = description.conformance
        self._switch_on()

    def _switch_on(self) -> None:
        self.rig = Rig(self._description, seed=self.seed, record=self._record)
        self.rig.world.queue.alarm(self._time_is_up).set(round(self._limit_s * 1e9))

    def _time_is_up(self, now_ns: int) -> None:
        raise TimeIsUp(f"it still waits after {self._limit_s:g} s of the rig's time")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.rig.close()

    def afresh(self) -> None:
        """Everything went off and is on again: `motors` are new ones, unused."""
        self.rig.close()
        self._switch_on()

    # --- what is under test ---------------------------------------------------------------

    @property
    def runtime(self) -> VirtualRuntime:
        """Where a clause waits."""
        return self.rig.runtime

    @cached_property
    def abilities(self) -> Sequence[Ability]:
        """What an emulated rig can do to these motors."""
        able = {Ability.AFRESH, Ability.SEVERAL_USERS}
        if len(self.facts.motors) > 1:
            able.add(Ability.SECOND_MOTOR)
        first = self._description.motors[self.facts.motors[0]]
        if first.adaptation == "ideal":
            able |= {Ability.TRUTH, Ability.FAULT}
        elif "position_rad" in self._truth(self.motor):
            able.add(Ability.TRUTH)
        if first.controller is not None:
            able |= {Ability.LOAD, Ability.FAULT, Ability.LOSE}
            able |= {Ability.CUT, Ability.SILENCE_HOST}
            kind = self._description.controllers[first.controller].kind
            if kind in _CANOPEN or self._is_on_a_line(self.motor):
                able.add(Ability.TRAFFIC)
            if not self._is_on_a_line(self.motor):
                able.add(Ability.BUS_ERRORS)
            if kind in _CANOPEN:
                able |= {Ability.STOP_SYNC, Ability.RESTART}
        return tuple(one for one in Ability if one in able)

    @property
    def motor(self) -> Motor:
        """The motor under test."""
        return self.rig.motors[self.facts.motors[0]]

    @property
    def motors(self) -> Sequence[Motor]:
        """All motors under test."""
        return tuple(self.rig.motors[name] for name in self.facts.motors)

    def another_user_of(self, motor: Motor) -> Motor:
        """Another logical motor on the same physical motor."""
        return self.rig.motors[f"{physical_name(motor)}-{SECOND_USER}"]

    # --- what can be seen and done ----------------------------------------------------------

    def true_position(self, motor: Motor) -> float:
        """Where its plant is now [rad]; an ideal motor is where it says."""
        truth = self._truth(motor)
        return truth["position_rad"] if truth else motor.position()

    def load(self, motor: Motor, torque_n_m: float) -> None:
        """This torque acts on it from now on."""
        self._stimulate(motor, "load_torque_n_m", torque_n_m)

    def fail(self, motor: Motor) -> int:
        """Its drive has a fault of this code; its cause is gone, or will be in a moment."""
        facts = self.facts
        if self._description.motors[physical_name(motor)].adaptation == "ideal":
            motor.hardware.inject_fault(facts.fault_code)  # type: ignore[attr-defined]
            return facts.fault_code
        value = facts.fault_code if facts.fault_value is None else facts.fault_value
        self._stimulate(motor, facts.fault_stimulus, value)
        over = facts.fault_over_value
        if over is not None:
            ending = self.rig.world.queue.alarm(
                lambda now_ns: self._stimulate(motor, facts.fault_stimulus, over)
            )
            ending.set(self.runtime.now_ns() + _FAULT_NS)
        return facts.fault_code

    @contextmanager
    def cut(self, motor: Motor) -> Iterator[Lost]:
        """Within it its drive is off the bus, with power; yields how often that took effect."""
        rule = FaultRule("", FaultKind.CUT, ports=(self._controller(motor),))
        with self._rule(motor, rule) as lost:
            yield lost

    @contextmanager
    def silence_host(self, *, skip: int = 0, limit: int | None = None) -> Iterator[Lost]:
        """Within it what the host sends, after so many frames and so often, reaches nobody."""
        rule = FaultRule("", FaultKind.DROP, sender=HOST, skip=skip, limit=limit)
        with self._rule(self.motor, rule) as lost:
            yield lost

    @contextmanager
    def lose_answers_of(
        self, motor: Motor, *, skip: int = 0, limit: int | None = None
    ) -> Iterator[Lost]:
        """Within it what its drive sends, after so many frames and so often, is lost."""
        sender = self._controller(motor)
        rule = FaultRule("", FaultKind.DROP, sender=sender, skip=skip, limit=limit)
        with self._rule(motor, rule) as lost:
            yield lost

    @contextmanager
    def strike(self, motor: Motor | None, times: int, *, skip: int = 0) -> Iterator[Lost]:
        """Within it so many attempts to send, of its drive or (None) the host, are destroyed."""
        sender = HOST if motor is None else self._controller(motor)
        rule = FaultRule(
            "", FaultKind.ERROR, sender=sender, error=FrameError.BIT, skip=skip, limit=times
        )
        struck = self.motor if motor is None else motor
        with self._rule(struck, rule) as lost:
            if (
                motor is None and not skip
            ):  # it may have nothing to say just now; this is for nobody
                self.rig.bus(self._bus(struck)).transmit(pack(_FOR_NOBODY))
            yield lost

    @contextmanager
    def noise(self, bit_error_rate: float) -> Iterator[Lost]:
        """Within it so many of the bits on the bus are wrong.

        The last one of a frame more often: then all but the sender have heard it, and hear it again
        (ISO 11898-1), which by that rate alone nobody would live to see.
        """
        noise = FaultRule("", FaultKind.NOISE, bit_error_rate=bit_error_rate)
        last = FaultRule("", FaultKind.DUPLICATE, probability=_LAST_BIT)
        with self._rule(self.motor, noise) as lost, self._rule(self.motor, last):
            yield lost

    @contextmanager
    def stop_sync(self) -> Iterator[Lost]:
        """Within it SYNC (CiA 301) reaches nobody."""
        rule = FaultRule("", FaultKind.DROP, identifier=_SYNC)
        with self._rule(self.motor, rule) as lost:
            yield lost

    def restart(self, motor: Motor) -> None:
        """Its drive begins anew, as if its power had failed: NMT reset node, by somebody else."""
        node = self._description.controllers[self._controller(motor)].node_id
        if node is None:
            raise NotApplicable(f"{motor.name}: its controller has no node-ID to be reset by")
        port = self.rig.world.add_host(self._bus(motor), "bench", lambda *_: None)
        port.send(pack(0, bytes((0x81, node))))

    @contextmanager
    def commands_to(self, motor: Motor) -> Iterator[list[str]]:
        """Within it whatever a host sends to its drive that may move or change it is noted."""
        seen: list[str] = []
        bus = self._bus(motor)
        address = self._description.controllers[self._controller(motor)].node_id
        head = 6 if self._description.buses[bus].kind == "modbus_tcp" else 0
        listening = [True]

        def on_frame(where: str, _time_ns: int, sender: str, frame: bytes) -> None:
            if listening and where == bus and sender.startswith(HOST):
                can_id = can_id_of(frame)
                if commanded_node(can_id, data_of(frame)) in (0, address):
                    seen.append(f"{can_id:03X}h")

        def on_adu(
            where: str, _now: int, _first: int, _last: int, sender: str, adu: bytes, _: bool
        ) -> None:
            unit, function = adu[head : head + 2]
            is_to_it = where == bus and sender.startswith(HOST) and unit == address
            if listening and is_to_it and function in _MODBUS_WRITES:
                seen.append(f"function {function:02X}h")

        self.rig.world.tap_frames(on_frame)
        self.rig.world.tap_lines(on_adu)
        try:
            yield seen
        finally:
            listening.clear()

    # --- inside ---------------------------------------------------------------------------

    def _controller(self, motor: Motor) -> str:
        controller = self._description.motors[physical_name(motor)].controller
        if controller is None:
            raise NotApplicable(f"{motor.name} is on no emulated controller")
        return controller

    def _bus(self, motor: Motor) -> str:
        return self._description.controllers[self._controller(motor)].bus

    def _is_on_a_line(self, motor: Motor) -> bool:
        return self._description.buses[self._bus(motor)].is_line

    def _prefix(self, motor: Motor) -> str:
        """What stands before the names of a channel's stimuli and of its truth."""
        channel = self._description.motors[physical_name(motor)].settings.get("channel", 1)
        return "" if channel == 1 else f"channel_{channel}_"

    def _truth(self, motor: Motor) -> Mapping[str, float]:
        """Its controller's snapshot, without the channel's prefix; empty if it has none."""
        described = self._description.motors[physical_name(motor)]
        if described.controller is None:
            return {}
        prefix = self._prefix(motor)
        truth = self.rig.controllers[described.controller].snapshot()
        return {name.removeprefix(prefix): truth[name] for name in truth if name.startswith(prefix)}

    def _stimulate(self, motor: Motor, name: str, value: float) -> None:
        try:
            self.rig.controllers[self._controller(motor)].stimulate(
                f"{self._prefix(motor)}{name}", value
            )
        except ValueError as error:
            raise NotApplicable(f"its controller cannot be stimulated so: {error}") from None

    @contextmanager
    def _rule(self, motor: Motor, wanted: FaultRule) -> Iterator[Lost]:
        """Such a fault is on the motor's bus; on a line all that it says is lost."""
        self._rules += 1
        name, bus = f"conformance {self._rules}", self._bus(motor)
        rule: FaultRule | SerialFaultRule = replace(wanted, name=name)
        if self._is_on_a_line(motor):
            unit = self._description.controllers[self._controller(motor)].node_id
            rule = SerialFaultRule(
                name,
                SerialFaultKind.LOSE,
                sender=wanted.sender,
                unit=unit,
                skip=wanted.skip,
                limit=wanted.limit,
            )
        self.rig.faults.inject(bus, rule)
        try:
            yield lambda: self.rig.faults.fired().get(name, 0)
        finally:
            self.rig.faults.lift(bus, name)


def physical_name(motor: Motor) -> str:
    """What the rig calls the physical motor."""
    return motor.name.removesuffix(f"-{SECOND_USER}")
