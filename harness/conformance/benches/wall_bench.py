"""A bench in wall time, on buses outside this process.

    motorhil conform --adaptation cia402 --rig bench.toml --on can0=vcan0

The rig file describes the motors and their controllers. The controllers exist already and are not
emulated. Such a bench can only observe what its motors report, and cannot disturb them; clauses
that need more are not applicable. The drives stay on between two clauses. Therefore each motor is
left as a clause expects it: at position 0, disabled, without a fault.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Never, Self, final

from motorhil.harness.conformance.bench import Ability, Announced, Lost, Stated
from motorhil.harness.conformance.benches.rig_bench import SECOND_USER, physical_name
from motorhil.harness.conformance.clause import NotApplicable
from motorhil.harness.recording.sources import Kind, PlaceError, open_bus, parse_place
from motorhil.harness.rig.config.buses import host_and_port
from motorhil.harness.rig.config.conformance import Facts
from motorhil.harness.rig.config.rig_file import RigDescription
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.names import Named
from motorhil.harness.rig.plugins import RigPlugins
from motorhil.harness.rig.reading import read_models
from motorhil.motorapi import ControlMode, LinkError, Motor, MotorError, MotorModel
from motorhil.motorapi.runtime.byte_streams import SerialLine, TcpLine
from motorhil.motorapi.runtime.wall import WallRuntime, close_process_runtime, process_runtime
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema

if TYPE_CHECKING:
    import can

_INTERFACES: Final = {Kind.SOCKETCAN: "socketcan", Kind.HUB: "emulated"}
_MODBUS_PORT: Final = 502
_RETURN_S: Final = 20.0


def places_in(texts: Sequence[str], rig: RigDescription) -> dict[str, str]:
    """Return the place of each bus of the motors under test, from `--on [BUS=]WHERE`.

    Raises:
        RigError: an option names no free bus, or a bus has no place.
    """
    under_test = [rig.motors[name].bus for name in rig.conformance.motors]
    return places_of(texts, [bus for bus in dict.fromkeys(under_test) if bus is not None], rig)


def places_of(texts: Sequence[str], buses: Sequence[str], rig: RigDescription) -> dict[str, str]:
    """Return the place of each of these buses, from `--on [BUS=]WHERE`.

    Raises:
        RigError: an option names another bus, or a bus has no place.
    """
    found: dict[str, str] = {}
    for text in texts:
        name, equals, where = text.partition("=")
        if not equals and len(buses) == 1:
            name, where = buses[0], text
        if name not in buses or not where or name in found:
            known = ", ".join(buses) or "none"
            raise RigError(
                f"--on {text}",
                f"is not a free bus of the motors under test ({known})",
                f"write --on {buses[0] if buses else 'BUS'}=WHERE",
            )
        found[name] = where
    for bus in buses:
        if bus not in found:
            raise RigError(
                rig.source.path, f"no place is given for bus {bus}", f"add --on {bus}=WHERE"
            )
    return found


@final
class WallBench:
    """Motors of a rig on real buses; a context manager that leaves the motors at rest.

    Args:
        description: from `rig_bench.bench_description`.
        places: from `places_in`.
        seed: the seed of all random numbers of the clauses.
        record: an MCAP file for all frames; `afresh` begins a new record.

    Raises:
        RigError: a bus cannot be opened.
    """

    def __init__(
        self,
        description: RigDescription,
        places: Mapping[str, str],
        seed: int,
        *,
        record: Path | None = None,
    ) -> None:
        self.facts: Facts = description.conformance
        self.seed = seed
        self._description = description
        self._places = places
        self._record = record
        self._plugins = RigPlugins(description)
        self._models = read_models(description)
        self._switch_on()

    def _switch_on(self) -> None:
        self._in_use: list[Motor] = []
        with ExitStack() as cleanup:
            self._writer: TraceWriter | None = None
            if self._record is not None:
                self._writer = cleanup.enter_context(TraceWriter(self._record))
            self._links = {bus: self._opened(bus, cleanup) for bus in self._places}
            cleanup.callback(close_process_runtime)  # closed first: it reads the links
            for bus in self._places:
                self._listen(bus)
            self._cleanup = cleanup.pop_all()
        self._motors: Mapping[str, Motor] = Named("motor", self._description.motors, self._motor)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._cleanup:
            self._leave_motors()

    def afresh(self) -> None:
        """Leave the motors, and open them again."""
        self.__exit__()
        self._switch_on()

    # --- motors under test ----------------------------------------------------------------

    @property
    def runtime(self) -> WallRuntime:
        """The runtime in which a clause waits."""
        return process_runtime()

    @property
    def abilities(self) -> Sequence[Ability]:
        """The abilities of this bench."""
        able = [Ability.AFRESH, Ability.SEVERAL_USERS, Ability.SOLE_USER, Ability.ONE_PROGRAM]
        if len(self.facts.motors) > 1:
            able.append(Ability.SECOND_MOTOR)
        return tuple(one for one in Ability if one in able)

    @property
    def motor(self) -> Motor:
        """The motor under test."""
        return self._motors[self.facts.motors[0]]

    @property
    def motors(self) -> Sequence[Motor]:
        """All motors under test."""
        return tuple(self._motors[name] for name in self.facts.motors)

    def another_user_of(self, motor: Motor) -> Motor:
        """Return another logical motor on the same physical motor."""
        return self._motors[f"{physical_name(motor)}-{SECOND_USER}"]

    # --- abilities that this bench does not have -------------------------------------------

    def true_position(self, motor: Motor) -> float:
        """Raise NotApplicable."""
        _refuse(Ability.TRUTH)

    def load(self, motor: Motor, torque_n_m: float) -> None:
        """Raise NotApplicable."""
        _refuse(Ability.LOAD)

    def fail(self, motor: Motor, code: int | None = None) -> int:
        """Raise NotApplicable."""
        _refuse(Ability.FAULT)

    def cut(self, motor: Motor) -> AbstractContextManager[Lost]:
        """Raise NotApplicable."""
        _refuse(Ability.CUT)

    def silence_host(
        self, *, skip: int = 0, limit: int | None = None
    ) -> AbstractContextManager[Lost]:
        """Raise NotApplicable."""
        _refuse(Ability.SILENCE_HOST)

    def lose_answers_of(
        self, motor: Motor, *, skip: int = 0, limit: int | None = None
    ) -> AbstractContextManager[Lost]:
        """Raise NotApplicable."""
        _refuse(Ability.LOSE)

    def delay_answers_of(
        self, motor: Motor, delay_s: float, *, skip: int = 0, limit: int | None = None
    ) -> AbstractContextManager[Lost]:
        """Raise NotApplicable."""
        _refuse(Ability.LATE)

    def identifiers(self) -> AbstractContextManager[Sequence[int]]:
        """Raise NotApplicable."""
        _refuse(Ability.ONE_KIND)

    def lose_identifier(self, identifier: int) -> AbstractContextManager[Lost]:
        """Raise NotApplicable."""
        _refuse(Ability.ONE_KIND)

    def strike(
        self, motor: Motor | None, times: int, *, skip: int = 0
    ) -> AbstractContextManager[Lost]:
        """Raise NotApplicable."""
        _refuse(Ability.BUS_ERRORS)

    def noise(self, bit_error_rate: float) -> AbstractContextManager[Lost]:
        """Raise NotApplicable."""
        _refuse(Ability.BUS_ERRORS)

    def stop_sync(self) -> AbstractContextManager[Lost]:
        """Raise NotApplicable."""
        _refuse(Ability.STOP_SYNC)

    def clock(self) -> AbstractContextManager[Sequence[int]]:
        """Raise NotApplicable: the bench does not record the bus."""
        _refuse(Ability.CLOCK)

    def another_clock(self, period_s: float) -> AbstractContextManager[None]:
        """Raise NotApplicable: nothing else may send on a bus with power."""
        _refuse(Ability.CLOCK)

    def stop_from_elsewhere(self, motor: Motor) -> None:
        """Raise NotApplicable: nothing else may send on a bus with power."""
        _refuse(Ability.OTHER_PROGRAM)

    def restart(self, motor: Motor) -> None:
        """Raise NotApplicable."""
        _refuse(Ability.RESTART)

    def commands_to(self, motor: Motor) -> AbstractContextManager[Sequence[str]]:
        """Raise NotApplicable."""
        _refuse(Ability.TRAFFIC)

    def apart(self) -> None:
        """Raise NotApplicable: a program has its own process here."""
        _refuse(Ability.SECOND_PROGRAM)

    def killed_after(self, motor: Motor, messages: int) -> AbstractContextManager[Lost]:
        """Raise NotApplicable: a program has its own process here."""
        _refuse(Ability.SECOND_PROGRAM)

    def owners_of(self, motor: Motor) -> AbstractContextManager[Sequence[Announced]]:
        """Raise NotApplicable."""
        _refuse(Ability.OWNERS)

    def stated(self, of_drive: bool = False) -> Stated | None:
        """Raise NotApplicable."""
        _refuse(Ability.SETTINGS)

    @property
    def link(self) -> Never:
        """Raise NotApplicable."""
        _refuse(Ability.SETTINGS)

    def build(self, settings: Mapping[str, object], model: MotorModel | None = None) -> Motor:
        """Raise NotApplicable: a mistake of it may send on a bus with power."""
        _refuse(Ability.SETTINGS)

    def altered(
        self, motor: Mapping[str, object], drive: Mapping[str, object]
    ) -> AbstractContextManager[None]:
        """Raise NotApplicable."""
        _refuse(Ability.SETTINGS)

    def refusal(self, motor: Motor, name: str, value: float) -> str:
        """Raise NotApplicable."""
        _refuse(Ability.SETTINGS)

    def told(self, motor: Motor) -> Sequence[str]:
        """Raise NotApplicable."""
        _refuse(Ability.SETTINGS)

    # --- helpers --------------------------------------------------------------------------

    def _motor(self, name: str) -> Motor:
        motor, close, _ = self._plugins.motor(
            name, self._models[name], self.runtime, self._links.__getitem__
        )
        self._cleanup.callback(close)
        self._in_use.append(motor)
        return motor

    def _leave_motors(self) -> None:
        """Leave the used motors at 0, at rest and without power, as far as they obey."""
        for motor in self._in_use:
            for action in (_without_fault, self._at_zero, Motor.disable):
                with suppress(MotorError):  # may be the defect that the clause has found
                    action(motor)

    def _at_zero(self, motor: Motor) -> None:
        if abs(motor.position()) > self.facts.window:
            motor.enable()
            motor.set_control_mode(ControlMode.SETPOINT)
            motor.set_setpoint(0.0)
            motor.start()
            motor.wait_until_done(_RETURN_S)

    def _opened(self, bus: str, cleanup: ExitStack) -> "can.BusABC | TcpLine | SerialLine":
        described, where = self._description.buses[bus], self._places[bus]
        try:
            if not described.is_line:
                opened = bus_at(bus, where, fd=described.data_bitrate_bit_s is not None)
                cleanup.callback(opened.shutdown)
                return opened
            line = self._line_at(bus, where)
        except LinkError as error:
            raise RigError(f"--on {bus}={where}", str(error)) from None
        cleanup.callback(line.close)
        return line

    def _line_at(self, bus: str, where: str) -> TcpLine | SerialLine:
        described = self._description.buses[bus]
        if described.kind == "modbus_tcp":
            end = host_and_port(where) or host_and_port(f"{where}:{_MODBUS_PORT}")
            if end is None:
                raise RigError(
                    f"--on {bus}={where}", "is no address of a gateway", "write HOST:PORT"
                )
            return TcpLine(*end, runtime=self.runtime)
        return SerialLine(
            where,
            baud_bit_s=described.bitrate_bit_s,
            parity=described.parity,
            stop_bits=described.stop_bits,
            runtime=self.runtime,
        )

    def _listen(self, bus: str) -> None:
        """Record the frames of a CAN bus; lines are not recorded."""
        writer, link = self._writer, self._links[bus]
        if writer is not None and not isinstance(link, TcpLine | SerialLine):
            record_bus(writer, self.runtime, bus, link)


def record_bus(writer: TraceWriter, runtime: WallRuntime, bus: str, link: "can.BusABC") -> None:
    """Record all frames of a CAN bus from now on."""
    from can import CanProtocol

    channel = writer.channel(f"/can/{bus}", Schema.of(CAN_FRAME))
    received = writer.source(channel, "", Direction.RECEIVED)
    sent = writer.source(channel, "host", Direction.TRANSMITTED)

    def record_frame(frame: bytes, time_ns: int, transmitted: bool) -> None:
        writer.can_frame(sent if transmitted else received, time_ns, frame)

    runtime.listen(link, record_frame, fd=link.protocol is not CanProtocol.CAN_20)


def _without_fault(motor: Motor) -> None:
    if motor.fault() is not None:
        motor.reset_fault()


def bus_at(bus: str, where: str, *, fd: bool = False) -> "can.BusABC":
    """Open the CAN bus at a place; `fd`: for CAN FD.

    Raises:
        RigError: it cannot be opened.
    """
    try:
        place = parse_place(f"{bus}={where}")
        interface = _INTERFACES.get(place.kind, place.interface)
        return open_bus(replace(place, interface=interface), {"fd": True} if fd else {})
    except PlaceError as error:
        text = str(error).removeprefix(f"--on {bus}={where}: ")
        raise RigError(f"--on {bus}={where}", text) from None


def _refuse(ability: Ability) -> Never:
    raise NotApplicable(f"the bench cannot {ability.value}")
