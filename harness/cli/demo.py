"""`motorhil demo`: a six-wheel rover drives arc, crab and turn.

Meanwhile its mast looks at a fixed point. The application is `harness/examples/rover.py`. The rig
is `harness/examples/rover.toml`, or with `--rig` another one that has the same motors on other
hardware. This module adds progress, recording and result tables. With `--eds` the drives follow
vendors' EDS files, in the units that these imply. With `--mast modbus` two PR-mode drives on a
serial line replace the CAN drives of pan and tilt. `--two-processes` has a module of its own.
"""

import argparse
import json
import math
import os
import shlex
import sys
import time
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

from motorhil.harness.cli.main import FAILED, PASSED, WRONG_USAGE
from motorhil.harness.cli.options import add_seed, print_table
from motorhil.harness.rig.config.rig_file import Known, parse_rig
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import RigError, Source, refuse_source, with_table
from motorhil.harness.version import cores

if TYPE_CHECKING:
    from motorhil.harness.examples.rover import Move, Rover
    from motorhil.harness.rig.config.rig_file import RigDescription
    from motorhil.harness.rig.rig import Rig
    from motorhil.motorapi.motor import Motor

INCREMENTS_PER_TURN: Final = 2000  # of the motors in the demo's rigs
MASTS: Final = ("can", "modbus")
LINE: Final = "rs485"
_UNITS: Final = {"pan": 1, "tilt": 2}
_LINE_TABLE: Final = f"""
[bus.{LINE}]
kind = "modbus_rtu"
baud_bit_s = 115_200
parity = "N"
"""
_ON_CAN: Final = ("kind", "bus", "node_id", "adaptation", "servo_period_ms", "oscillator_ppm")
RIGS: Final = ("rover", "rocky8", "fido")
RIG: Final = EXAMPLES / "rover.toml"
POINT_M: Final = (6.0, 1.5, 0.4)
SAMPLE_NS: Final = 20_000_000
PEAK_WINDOW_NS: Final = 100_000_000
ERROR_MAX_RAD: Final = 0.002  # largest acceptable position error of a motor at the end


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `motorhil demo`."""
    parser.add_argument(
        "--rig",
        choices=RIGS,
        default=RIG.stem,
        help="the rover's hardware: drives on two buses (rover), drives on one bus (rocky8), "
        "plain I/O nodes with the servo on the host (fido); the application is the same "
        "(default rover)",
    )
    parser.add_argument(
        "--eds",
        action="append",
        type=Path,
        default=[],
        metavar="FILE",
        help="a vendor's EDS or DCF for the drives, instead of ours; several are assigned in turn",
    )
    parser.add_argument(
        "--mast",
        choices=MASTS,
        default=MASTS[0],
        help="pan and tilt on CAN like the other drives (can), or on a serial line (modbus)",
    )
    parser.add_argument(
        "--against",
        type=Path,
        metavar="FILE",
        help="a recording of this demo that replaces the drives (record: out/against.mcap)",
    )
    add_seed(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="the record (default out/demo.mcap)",
    )
    parser.add_argument("--realtime", action="store_true", help="run no faster than the wall clock")
    parser.add_argument(
        "--two-processes",
        action="store_true",
        help="instead: two programs share the pan motor in wall time, and one of them is killed",
    )


def run(options: argparse.Namespace) -> int:
    """Run the demo; return 0 if every motor arrived, 1 if one did not.

    Raises:
        RigError: an option or an EDS file cannot be used.
    """
    from motorhil.harness.rig.config.rig_file import read_rig
    from motorhil.harness.rig.reading import installed_plugins
    from motorhil.harness.rig.rig import Rig
    from motorhil.motorapi import MotorError
    from motorhil.traces.digest import digest

    if options.output is None:
        options.output = Path("out/demo.mcap" if options.against is None else "out/against.mcap")
    if options.two_processes:
        return _run_two(options)
    rig_file = EXAMPLES / f"{options.rig}.toml"
    known = installed_plugins()
    description = read_rig(rig_file, known)
    if options.mast == "modbus":
        description = with_modbus_mast(description, known)
    if options.eds:
        description = with_eds(description, options.eds, known)
    if options.against is not None:
        description = _against(description, options)
    _make_folder(options.output.parent)
    begun_s = time.perf_counter()
    rig = Rig(description, seed=options.seed, realtime=options.realtime, record=options.output)
    try:
        with rig:
            arrived = _drive(rig)
            if options.against is not None:
                arrived = _report_unanswered(rig) and arrived
            simulated_s = rig.runtime.now_ns() / 1e9
    except MotorError as error:  # the mast's party may raise it when the rig closes
        causes = _report_failure(error)
        if options.against is not None:
            _report_unanswered(rig, causes)
        print(f"the record so far: {options.output}", file=sys.stderr)
        print(f"again: {_repeat_command(options, rig.seed)}", file=sys.stderr)
        return FAILED
    spent_s = time.perf_counter() - begun_s
    print(
        f"\n{simulated_s:.1f} s simulated in {spent_s:.2f} s: "
        f"{simulated_s / spent_s:.1f} simulated seconds per second, {cores()}"
    )
    print(f"record {options.output}, digest {digest(options.output)} (seed {rig.seed})")
    if not arrived:
        print(
            f"motorhil demo: a motor's position error exceeds {ERROR_MAX_RAD} rad", file=sys.stderr
        )
        print(f"again: {_repeat_command(options, rig.seed)}", file=sys.stderr)
    return PASSED if arrived else FAILED


def _drive(rig: "Rig") -> bool:
    """Drive the manoeuvre and print its results; return True if it succeeded."""
    from motorhil.harness.examples.rover import Rover, manoeuvre

    for note in rig.notes:
        print(note, file=sys.stderr)
    peaks = _PeakFollowingError(rig)
    rover = Rover(rig.groups["wheels"], rig.groups["steering"], rig.groups["mast"])

    def report(text: str) -> None:
        print(f"{rig.runtime.now_ns() / 1e9:7.3f} s  {text}", file=sys.stderr, flush=True)

    manoeuvre(rover, rig.runtime, POINT_M, report)
    arrived = _print_motors(rig, rover, peaks)
    _print_buses(rig)
    _print_groups(rig, rover)
    return arrived


def _report_failure(error: BaseException | None) -> str:
    """Print the failure, its cause first; return all of it."""
    from motorhil.motorapi import MotorError

    causes = []
    while isinstance(error, MotorError):
        causes.append(str(error))
        error = error.__context__
    for cause in causes:
        print(f"motorhil demo: {cause}", file=sys.stderr)
    return " ".join(causes)


def _run_two(options: argparse.Namespace) -> int:
    """Run the demo with two programs; return its exit status."""
    from motorhil.harness.cli import demo_two_processes as two_processes

    others = options.rig != RIG.stem or options.mast != MASTS[0] or options.against is not None
    if others or options.eds or options.realtime:
        print("motorhil demo: --two-processes takes only --seed and -o", file=sys.stderr)
        return WRONG_USAGE
    _make_folder(options.output.parent)
    return two_processes.run(options.output, options.seed)


def _against(description: "RigDescription", options: argparse.Namespace) -> "RigDescription":
    """Return the rig with its drives replaced by a recording."""
    from motorhil.harness.replay.rig import with_recorded

    if not options.against.is_file():
        raise RigError(options.against, "no such recording", "make one: motorhil demo")
    refuse_source(options.against, options.output)
    return with_recorded(description, options.against)


def _report_unanswered(rig: "Rig", failure: str = "") -> bool:
    """Print what recorded drives could not answer; return True if they answered everything."""
    from motorhil.harness.replay.verdict import summary, unanswered

    for line in summary(rig, failure):
        print(f"motorhil demo: {line}", file=sys.stderr)
    return not unanswered(rig)


def _repeat_command(options: argparse.Namespace, seed: int) -> str:
    """Return the command that repeats this run."""
    words = ["motorhil", "demo", "--seed", str(seed), "-o", str(options.output)]
    if options.rig != RIG.stem:
        words += ["--rig", options.rig]
    if options.mast != MASTS[0]:
        words += ["--mast", options.mast]
    for file in options.eds:
        words += ["--eds", str(file)]
    if options.against is not None:
        words += ["--against", str(options.against)]
    return shlex.join([*words, "--realtime"] if options.realtime else words)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or str(error)
        raise RigError(folder, f"cannot be created: {reason}", "record elsewhere with -o") from None


@final
class _PeakFollowingError:
    """The largest following error of each motor [inc], sampled every 20 ms.

    The value is the drive's own, or the host's if the servo runs there.
    """

    def __init__(self, rig: "Rig") -> None:
        self._rig = rig
        self._peaks = dict.fromkeys(rig.motors, 0.0)
        self._motors = {name: _motors_of(rig, name) for name in rig.controllers}
        rig.world.tap_samples(SAMPLE_NS, self._sample)

    def _sample(self, now_ns: int, controller: str, truth: Mapping[str, float]) -> None:
        for name in self._motors[controller]:
            size = truth.get(_in_truth(self._rig, name, "following_error_inc"))
            if size is None:
                size = _reported_error_inc(self._rig.motors[name])
            self._peaks[name] = max(self._peaks[name], abs(size))

    def of(self, motor: str) -> float:
        """Return the peak so far [inc]."""
        return self._peaks[motor]


def _motors_of(rig: "Rig", controller: str) -> list[str]:
    motors = rig.description.motors.values()
    return [motor.name for motor in motors if motor.controller == controller]


def _in_truth(rig: "Rig", motor: str, key: str) -> str:
    """Return the controller's key for this motor; channels after the first have a prefix."""
    channel = rig.description.motors[motor].settings.get("channel", 1)
    return key if channel == 1 else f"channel_{channel}_{key}"


def _reported_error_inc(motor: "Motor") -> float:
    latest = motor.latest()
    if latest is None or latest.following_error is None:
        return 0.0
    return latest.following_error * (motor.model.increments_per_unit or 0.0)


def _reached_rad(rig: "Rig", motor: str) -> float:
    """Return the motor's true position [rad], or the reported one of a recorded drive."""
    controller = rig.description.motors[motor].controller
    assert controller is not None
    truth = rig.controllers[controller].snapshot().get(_in_truth(rig, motor, "position_rad"))
    if truth is not None:
        return truth
    latest = rig.motors[motor].latest()
    return math.nan if latest is None or latest.position is None else latest.position


def _print_motors(rig: "Rig", rover: "Rover", peaks: _PeakFollowingError) -> bool:
    """Print one line per motor; return True if all motors reached their targets."""
    last: dict[str, tuple[float, Move, int]] = {}
    for move in rover.moves:
        for place, motor in enumerate(move.group):
            last[motor.name] = (move.targets_rad[place], move, place)
    rows = []
    arrived = True
    for name in rig.motors:
        target_rad, move, place = last[name]
        reached_rad = _reached_rad(rig, name)
        error_rad = reached_rad - target_rad
        arrived = arrived and abs(error_rad) <= ERROR_MAX_RAD
        times = move.quality.times[place][1]
        took = "-"
        if times is not None and times.started_ns is not None and times.ended_ns is not None:
            took = f"{(times.ended_ns - times.started_ns) / 1e9:.3f}"
        rows.append(
            (
                name,
                f"{target_rad:.4f}",
                f"{reached_rad:.4f}",
                f"{error_rad * 1e3:+.3f}",
                took,
                f"{peaks.of(name):.0f}",
            )
        )
    head = ("motor", "target rad", "reached rad", "error mrad", "last move s", "peak follow. inc")
    print()
    print_table(head, rows)
    return arrived


def _print_buses(rig: "Rig") -> None:
    rows = []
    for name in rig.world.bus_names():
        statistics = rig.world.bus(name).statistics
        load = statistics.load(0, rig.runtime.now_ns())
        peak = statistics.peak_load(PEAK_WINDOW_NS)
        rows.append((name, f"{statistics.frames}", f"{load:.1%}", f"{peak:.1%}"))
    for name in rig.world.line_names():
        line = rig.world.serial_line(name)
        if line is not None:
            load = line.busy_ns / max(1, rig.runtime.now_ns())
            rows.append((name, f"{line.frames}", f"{load:.1%}", "-"))
    print()
    print_table(("bus", "frames", "load", "peak load in 100 ms"), rows)


def _print_groups(rig: "Rig", rover: "Rover") -> None:
    """Print per group the possible start skew and the largest actual one."""
    rows = []
    for name in rig.groups:
        moves = [move for move in rover.moves if move.group is rig.groups[name]]
        predicted = [move.capability.start_skew_s for move in moves]
        rows.append(
            (
                name,
                f"{len(moves)}",
                moves[0].capability.level.name,
                "no bound" if None in predicted else _largest_ms(predicted),
                _largest_ms([move.quality.start_skew_s for move in moves]),
                _largest_ms([move.quality.predicted_end_skew_s for move in moves]),
                _largest_ms([move.quality.end_skew_s for move in moves]),
            )
        )
    print()
    print_table(
        ("group", "moves", "start", "bound ms", "start skew ms", "rounding ms", "end skew ms"), rows
    )


def _largest_ms(values_s: Sequence[float | None]) -> str:
    """Return the largest known value [ms]; moves in which no motor had to move have none."""
    known = [value for value in values_s if value is not None]
    return f"{max(known) * 1e3:.3f}" if known else "-"


def with_eds(
    description: "RigDescription", files: Sequence[Path], known: Known
) -> "RigDescription":
    """Return the rig with these files assigned in turn to wheels, steering and mast.

    Drives and motor models get one set of units, whatever a file says: increments, and rpm of the
    motor. Most vendors mean rpm by limits such as 607Fh. The rig's text is changed accordingly,
    because a recording contains the text of the rig that ran.

    Raises:
        RigError: a file does not exist, or the rig has no drives.
    """
    path, text = description.source.path, description.source.text
    for file in files:
        if not file.is_file():
            raise RigError(file, "no such EDS file", "check the path given with --eds")
    if any(controller.kind != "cia402" for controller in description.controllers.values()):
        raise RigError(path, "has no drives", "use --eds with another --rig")
    kinds = list(dict.fromkeys(name.split("_")[0] for name in description.controllers))
    given = {kind: files[place % len(files)] for place, kind in enumerate(kinds)}
    unit_inc_s = INCREMENTS_PER_TURN / 60.0
    units = _inline(
        {
            "position_unit_inc": 1.0,
            "velocity_unit_inc_s": unit_inc_s,
            "acceleration_unit_inc_s2": unit_inc_s,
        }
    )
    for name in description.controllers:
        eds = os.path.relpath(given[name.split("_")[0]].absolute(), description.folder.absolute())
        lines = f"eds = {json.dumps(eds)}\nunits = {units}\n"
        text = with_table(text, f"controller.{name}", lines, ("eds", "units"))
    for name, motor in description.motors.items():
        model = _inline(_in_rpm(motor.model, unit_inc_s))
        text = with_table(text, f"motor.{name}", f"model = {model}\n", ("model",))
    return parse_rig(Source(path, text), known)


def _in_rpm(model: Path | Mapping[str, Any], unit_inc_s: float) -> dict[str, Any]:
    """Return the same motor model (a TOML table, hence Any) for a drive that counts in rpm."""
    table = tomllib.loads(model.read_text("utf-8")) if isinstance(model, Path) else dict(model)
    unit_rad_s = unit_inc_s / table["increments_per_rad"]
    return {**table, "velocity_unit_rad_s": unit_rad_s, "acceleration_unit_rad_s2": unit_rad_s}


def _inline(table: Mapping[str, Any]) -> str:
    """Return an inline TOML table of strings and numbers."""
    return "{ " + ", ".join(f"{key} = {json.dumps(value)}" for key, value in table.items()) + " }"


def with_modbus_mast(description: "RigDescription", known: Known) -> "RigDescription":
    """Return the rig with pan and tilt on a serial line; nothing else differs.

    The rig's text is changed accordingly, because a recording contains the text of the rig that
    ran.

    Raises:
        RigError: the rig has no such drives.
    """
    path, text = description.source.path, description.source.text
    for name, unit in _UNITS.items():
        controller = description.controllers.get(name)
        if controller is None or controller.kind != "cia402":
            problem = f"{name} is not a separate CiA 402 drive"
            raise RigError(path, problem, "use --mast with --rig rover")
        drive = f'kind = "leadshine_pr"\nbus = "{LINE}"\nunit = {unit}\n'
        text = with_table(text, f"controller.{name}", drive, _ON_CAN)
        text = with_table(text, f"motor.{name}", 'adaptation = "leadshine"\n', _ON_CAN)
    source = Source(path, text + _LINE_TABLE)
    return parse_rig(source, known)
