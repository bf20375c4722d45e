"""The verb `identify`: the plant of a motor from its recording."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.cli.main import FAILED, PASSED
from motorhil.harness.cli.options import print_table, real
from motorhil.harness.identification.follower import LOOP_RAD_S
from motorhil.harness.identification.inverse_model import (
    Fit,
    Parameter,
    effort_error,
    fitted,
    friction_by_direction,
)
from motorhil.harness.identification.output_error import compared, refined
from motorhil.harness.identification.picture import page_of
from motorhil.harness.identification.plant_table import (
    BACKLASH,
    constant_told,
    plant_keys,
    table_of,
    unit_of,
)
from motorhil.harness.identification.resonance import Resonance, resonance_in
from motorhil.harness.identification.samples import (
    Reading,
    Samples,
    samples_in,
)
from motorhil.harness.rig.config.toml import RigError

_POOR: Final = 0.3
_HEAD: Final = ("parameter", "value", "unit", "deviation", "remark")
_EFFORTS: Final = {"rad": "torque", "m": "force"}
_BETTER: Final = 0.9  # of the effort that is left: below it, friction depends on the direction
_EPILOG: Final = """\
The model is effort = inertia * a + viscous * v + coulomb * sign(v) + offset, at the output. Least
squares give a start. An emulated drive with this plant then follows the recording, until it needs
the least effort beside the recorded one. A fit is judged by the effort that it explains, on this
recording and with --check on another one: position tracks its set-point whatever the plant is.
Exit status 1: the model explains too little.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `identify`."""
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="RECORDING", help="a recording")
    parser.add_argument("--motor", metavar="NAME", help="the motor; absent: the only one")
    parser.add_argument(
        "--check", type=Path, metavar="RECORDING", help="judge the model on this recording, too"
    )
    parser.add_argument(
        "--gear",
        type=float,
        default=1.0,
        metavar="N",
        help="motor turns per turn of the output, to tell values on the motor's side (default 1)",
    )
    parser.add_argument(
        "--rated",
        type=float,
        metavar="TORQUE",
        help="rated torque or force at the output [N m or N], in parts of which a drive tells "
        "6077h; absent: by 6076h and --gear, if the recording has 6076h",
    )
    parser.add_argument(
        "--rig",
        type=Path,
        metavar="RIG",
        help="a rig that knows the motor's place and units, if the recording has none",
    )
    parser.add_argument(
        "--inverse", action="store_true", help="only least squares, without an emulated drive"
    )
    parser.add_argument(
        "--loop",
        type=real(1.0, 1e4, "rad/s"),
        default=LOOP_RAD_S,
        metavar="RAD_S",
        help="natural frequency of the loop of the drive that follows; chirps need more "
        f"(default {LOOP_RAD_S:g})",
    )
    parser.add_argument(
        "--truth", action="store_true", help="use the true state of an emulated drive"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="write the plant's keys (TOML)"
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="PAGE",
        help="draw recorded against emulated efforts, of the --check if there is one (HTML)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(options: argparse.Namespace) -> int:
    """Identify the plant; return 0, or 1 if the model explains too little of the effort.

    Raises:
        RigError: the recording does not show the motor, or the file cannot be written.
    """
    if not options.gear > 0.0:
        raise RigError("--gear", f"{options.gear} is not above 0", "give motor turns per turn")
    if options.rated is not None and not options.rated > 0.0:
        raise RigError("--rated", f"{options.rated} is not above 0", "give N m or N")
    found = _found(options)
    if options.picture is not None:
        _write(options.picture, found.page(options.loop))
    if options.output is not None:
        text = table_of(found.fit, found.samples, options.gear, found.resonance)
        _write(options.output, text)
    if options.json:
        print(json.dumps(found.as_json(options.gear), indent=1))
    else:
        found.show()
    worst = max(found.fit.error, found.checked or 0.0)
    if worst > _POOR:
        print(
            f"motorhil identify: {found.samples.name}: {worst:.0%} of the effort is not explained;"
            f" expected at most {_POOR:.0%}; is another force at work?",
            file=sys.stderr,
        )
        return FAILED
    return PASSED


@final
@frozen
class _Found:
    """All that a recording shows of an axis.

    Attributes:
        samples: the recording.
        fit: the model.
        sides: frictions of each direction, if they explain the effort better.
        resonance: of an elastic coupling.
        judged: the recording that judges the fit.
        checked: the effort that the fit does not explain there; None: it is the same recording.
    """

    samples: Samples
    fit: Fit
    sides: dict[str, Parameter]
    resonance: Resonance
    judged: Samples
    checked: float | None

    def parameters(self) -> list[Parameter]:
        """Return the parameters of the model, then frictions of each direction."""
        return [*self.fit.parameters.values(), *self.sides.values()]

    def rows(self) -> list[tuple[str, ...]]:
        """Return a row of the table for each parameter."""
        return [_row(one, self.samples.unit) for one in self.parameters()]

    def verdict(self) -> str:
        """Return the effort that the model does not explain, as a text."""
        told = f"effort not explained: {self.fit.error:.1%}"
        return (
            told if self.checked is None else f"{told}; on the other recording {self.checked:.1%}"
        )

    def show(self) -> None:
        """Print the table and what else is known."""
        samples = self.samples
        rate = 1.0 / samples.period_s
        print(f"{samples.name}: {samples.duration_s:.1f} s at {rate:.0f} Hz, from {samples.source}")
        print_table(_HEAD, self.rows(), words=(0, 2, 4))
        known = (
            constant_told(self.samples.constant),
            self.resonance.told(),
            BACKLASH,
            self.verdict(),
        )
        print("\n".join(known))

    def page(self, loop: float) -> str:
        """Return the page with the picture (HTML), for this loop of the drive [rad/s]."""
        unit = self.samples.unit
        effort = f"{_EFFORTS[unit]} [{unit_of('offset', unit)}]"
        efforts = compared(self.judged, self.fit, loop)
        rows = [_HEAD, *self.rows()]
        return page_of(self.samples.name, self.verdict(), rows, efforts, effort)

    def as_json(self, gear: float) -> dict[str, object]:
        """Return the same for a machine."""
        samples, fit, resonance = self.samples, self.fit, self.resonance
        constant = samples.constant
        return {
            "motor": samples.name,
            "unit": samples.unit,
            "duration_s": samples.duration_s,
            "period_s": samples.period_s,
            "source": samples.source,
            "parameters": {
                one.name: {
                    "value": one.value,
                    "unit": unit_of(one.name, samples.unit),
                    "deviation": one.deviation,
                    "unseen": one.unseen or None,
                    "remedy": one.remedy or None,
                }
                for one in self.parameters()
            },
            "torque_constant": None if constant is None else constant._asdict(),
            "resonance": asdict(resonance) if resonance.is_seen else None,
            "no_resonance_below_hz": None if resonance.is_seen else resonance.seen_hz,
            "plant": plant_keys(fit, samples.unit, gear, resonance, constant),
            "effort_error": fit.error,
            "effort_error_of_check": self.checked,
            "condition": fit.condition,
        }


def _found(options: argparse.Namespace) -> _Found:
    samples = _samples(options, options.file, options.motor)
    fit = fitted(samples)
    if not options.inverse:
        fit = refined(samples, fit, options.loop)
    checked, judged = None, samples
    if options.check is not None:
        judged = _samples(options, options.check, samples.name)
        checked = (
            effort_error(fit, judged)
            if options.inverse
            else compared(judged, fit, options.loop).error()
        )
    resonance = resonance_in(samples, fit.parameters["inertia"].value)
    return _Found(samples, fit, _sides(fit, samples), resonance, judged, checked)


def _samples(options: argparse.Namespace, file: Path, motor: str | None) -> Samples:
    how = Reading(truth=options.truth, rated=options.rated, gear=options.gear, rig=options.rig)
    return samples_in(file, motor, how)


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text)
    except OSError as error:
        raise RigError(path, f"cannot be written: {error.strerror}", "name another file") from None


def _sides(fit: Fit, samples: Samples) -> dict[str, Parameter]:
    """Return the frictions of each direction, if they explain the effort better; else none."""
    sides, error = friction_by_direction(samples, fit.delay_s, fit.names)
    return sides if error < _BETTER * effort_error(fit, samples) else {}


def _row(one: Parameter, unit: str) -> tuple[str, ...]:
    remark = f"not seen: {one.unseen}; {one.remedy}" if one.unseen else ""
    return one.name, one.told, unit_of(one.name, unit), one.share_told, remark
