"""Motor model: kind, limits and resolution, independent of the application.

A model is a TOML file of a few lines. Units are in the key names; a linear motor has m and N
instead of rad and N·m:

    name = "drive wheel"                 # default: the name of the file
    kind = "rotary"                      # or "linear"
    velocity_max_rad_s = 6.0             # only this key and the next are required
    acceleration_max_rad_s2 = 20.0
    deceleration_max_rad_s2 = 20.0       # default: as acceleration
    jerk_max_rad_s3 = 500.0
    torque_max_n_m = 12.0                # linear: force_max_n
    current_max_a = 4.0
    position_min_rad = -3.0              # for position commands; velocity, torque pass them
    position_max_rad = 3.0               # both by default: no limit
    position_tolerance_rad = 0.01        # permitted offset at the start of absolute trajectories
    gear_ratio = 66.0                    # motor turns per turn; < 0: reversing; motor_turns_per_m
    encoder_increments_rev = 2000        # of the encoder, per turn of the motor
    increments_per_rad = 21008.4524881   # of the drive's position; default: from the last two
    velocity_unit_rad_s = 0.001          # value of 1 in the drive's velocity objects
    acceleration_unit_rad_s2 = 0.01      # value of 1 in its acceleration objects
    requires_referencing = false         # true: absolute targets only after homing

If the drive itself knows its units (factor objects), they are not needed here. A drive with the
opposite direction of counting has increments < 0.
"""

import json
import tomllib
from collections.abc import Callable, Mapping
from enum import Enum
from math import tau
from numbers import Real
from pathlib import Path
from typing import Any, Final, Self, final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import ControlVariable, as_number, given
from motorhil.motorapi.errors import FileError, UsageError
from motorhil.settings import (
    REQUIRED,
    Member,
    Number,
    SettingError,
    Text,
    declaration,
    flag,
    number,
    parse_toml,
    setting,
)
from motorhil.settings import given as given_in


@final
class MotionKind(Enum):
    """The kind of motion, which determines the unit U of position: rad or m."""

    ROTARY = "rotary"
    LINEAR = "linear"


_UNIT: Final = {MotionKind.ROTARY: "rad", MotionKind.LINEAR: "m"}
_TOLERANCE: Final = {MotionKind.ROTARY: 0.01, MotionKind.LINEAR: 0.0001}
_FILE_REMEDY: Final = "name a motor model, a TOML file"
_CHARACTERS_MAX: Final = 16_000_000
_TOML_REMEDY: Final = "a line reads key = value, as in velocity_max_rad_s = 6.0"
_SAME: Final = 1e-6
"""The permitted relative deviation of increments from gear and encoder, for rounded models."""


def _limit(
    name: str, unit: str, doc: str, default: float | None = None, of_linear: str = "", **own: Any
) -> Any:
    return number(default, 0, unit=unit, doc=doc, name=name, of_linear=of_linear, above=True, **own)


def _ratio(name: str, doc: str, of_linear: str = "", **own: Any) -> Any:
    return number(None, doc=doc, name=name, of_linear=of_linear, not_zero=True, **own)


@final
@frozen(kw_only=True, repr=False)
class MotorModel:
    """The motor model (paper, 3.2): limits and units, immutable, shared between copies.

    U is rad or m, depending on `kind`. None means: no limit, or unknown.

    Raises:
        UsageError: a number is not finite, a limit is not > 0, a range is empty, or the name is not
            text.
    """

    name: str = setting(
        "motor", Text(is_printable=True, shown='"wheel"'), "Name in messages; absent: the file's."
    )
    kind: MotionKind = setting(
        MotionKind.ROTARY, Member(MotionKind, "kind of motor"), "Rotary or linear."
    )
    velocity_max: float = _limit(
        "velocity_max_{u}_s",
        "{u}/s",
        "Velocity limit.",
        REQUIRED,
        plausible=(1e-3, 2e3),
        plausible_m=(1e-5, 50.0),
    )
    acceleration_max: float = _limit(
        "acceleration_max_{u}_s2",
        "{u}/s²",
        "Acceleration limit.",
        REQUIRED,
        plausible=(1e-3, 1e6),
        plausible_m=(1e-4, 1e3),
    )
    deceleration_max: float | None = _limit(
        "deceleration_max_{u}_s2",
        "{u}/s²",
        "Deceleration limit; absent: as acceleration.",
        plausible=(1e-3, 1e6),
        plausible_m=(1e-4, 1e3),
    )
    jerk_max: float | None = _limit(
        "jerk_max_{u}_s3",
        "{u}/s³",
        "Jerk limit; absent: none.",
        plausible=(1e-3, 1e9),
        plausible_m=(1e-4, 1e6),
    )
    torque_max: float | None = _limit(
        "torque_max_n_m",
        "",
        "Torque limit [N·m], or force limit [N].",
        of_linear="force_max_n",
        plausible=(1e-5, 1e5),
        plausible_m=(1e-3, 1e6),
    )
    current_max: float | None = _limit(
        "current_max_a", "A", "Current limit.", plausible=(0.01, 1e3)
    )
    position_min: float | None = number(
        None,
        unit="{u}",
        doc="Lower limit of commanded positions.",
        name="position_min_{u}",
        plausible=(1e-7, 1e6),
        plausible_m=(1e-9, 1e4),
    )
    position_max: float | None = number(
        None,
        unit="{u}",
        doc="Upper limit of commanded positions.",
        name="position_max_{u}",
        plausible=(1e-7, 1e6),
        plausible_m=(1e-9, 1e4),
    )
    position_tolerance: float | None = _limit(
        "position_tolerance_{u}",
        "{u}",
        "Distance at which an absolute trajectory may start.",
        plausible=(1e-7, 7.0),
        plausible_m=(1e-9, 0.5),
    )
    gear_ratio: float | None = _ratio(
        "gear_ratio",
        "Motor turns per turn (per m); below 0: reversing.",
        "motor_turns_per_m",
        plausible=(0.01, 1e4),
        plausible_m=(0.1, 1e5),
    )
    encoder_increments_rev: float | None = _limit(
        "encoder_increments_rev",
        "",
        "Increments of the encoder per motor turn.",
        plausible=(4, 1 << 27),
    )
    increments_per_unit: float | None = _ratio(
        "increments_per_{u}",
        "Position increments of the drive; absent: of gear and encoder.",
        plausible=(0.1, 1e12),
        plausible_m=(1.0, 1e12),
    )
    velocity_unit: float | None = _limit(
        "velocity_unit_{u}_s",
        "{u}/s",
        "Velocity that 1 means in the drive's objects.",
        plausible=(1e-12, 100.0),
        plausible_m=(1e-13, 1.0),
    )
    acceleration_unit: float | None = _limit(
        "acceleration_unit_{u}_s2",
        "{u}/s²",
        "Acceleration that 1 means in its objects.",
        plausible=(1e-12, 1e4),
        plausible_m=(1e-13, 100.0),
    )
    requires_referencing: bool = flag(False, "Absolute targets only after homing.")

    def __post_init__(self) -> None:
        try:
            self._check()
        except SettingError as error:
            name = self.name
            if not isinstance(name, str) or not name.isprintable():
                name = repr(name)
            raise UsageError(f"motor model {name}: {error}") from error
        if self.increments_per_unit is None:
            made = _increments(self.kind, self.gear_ratio, self.encoder_increments_rev)
            object.__setattr__(self, "increments_per_unit", made)

    def _check(self) -> None:
        declared = declaration(MotorModel)
        for name, key in declared.keys.items():
            value = getattr(self, name)
            if isinstance(key.kind, Number) and isinstance(value, Real):
                value = as_number(value)  # of numpy, too
            if value is not None or name not in declared.defaults:
                found = key.kind.read(value, (name,))
                if isinstance(found, MotionKind):  # of its word, too
                    object.__setattr__(self, name, found)
        low, high = self.position_min, self.position_max
        if low is not None and high is not None and not low < high:
            message = f"{low:g} is not below position_max, {high:g}"
            raise SettingError(("position_min",), message, "exchange or correct them")
        given, made = self.increments_per_unit, None
        if given is not None:
            made = _increments(self.kind, self.gear_ratio, self.encoder_increments_rev)
        if given is not None and made is not None and abs(given - made) > _SAME * abs(made):
            raise SettingError(
                ("increments_per_unit",),
                f"is not {made:.10g}, which gear_ratio and encoder_increments_rev make",
                "leave it out, or correct one of them",
            )

    def __repr__(self) -> str:
        return given(self)

    @property
    def unit(self) -> str:
        """The unit U of position: "rad" or "m"."""
        return _UNIT[self.kind]

    def unit_of(self, variable: ControlVariable) -> str:
        """Return the unit of a control variable of this motor ("rad/s")."""
        if variable is ControlVariable.POSITION:
            return self.unit
        if variable is ControlVariable.VELOCITY:
            return f"{self.unit}/s"
        if variable is ControlVariable.CURRENT:
            return "A"
        return "N·m" if self.kind is MotionKind.ROTARY else "N"

    @property
    def deceleration(self) -> float:
        """The limit while slowing down [U/s²]."""
        return self.acceleration_max if self.deceleration_max is None else self.deceleration_max

    @property
    def resolution(self) -> float | None:
        """The smallest change of position that the drive can count [U], or None if unknown."""
        increments = self.increments_per_unit
        return None if increments is None else 1.0 / abs(increments)

    @property
    def start_tolerance(self) -> float:
        """The permitted offset between motor and start of an absolute trajectory [U].

        `position_tolerance`, or by default 0.01 rad (0.1 mm).
        """
        if self.position_tolerance is not None:
            return self.position_tolerance
        return _TOLERANCE[self.kind]

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the model of a TOML file.

        Raises:
            FileError: the file does not exist or is not TOML, or a key or value is invalid.
        """
        text, line = "", None
        try:
            with Path(path).open(encoding="utf-8-sig") as file:  # a device may have no end
                text = file.read(_CHARACTERS_MAX + 1)
            if len(text) > _CHARACTERS_MAX:
                raise ValueError(f"more than {_CHARACTERS_MAX // 1_000_000} MB, so it is no model")
            table = parse_toml(text)
        except tomllib.TOMLDecodeError as error:
            problem, remedy = f"not TOML: {error}", _TOML_REMEDY
            line = _line_in(str(error))
        except UnicodeDecodeError:
            problem, remedy = "cannot be read: not UTF-8", _FILE_REMEDY
        except RecursionError:
            problem, remedy = "not TOML: nested too deeply", _TOML_REMEDY
        except (OSError, ValueError, TypeError) as error:  # not a path, or an endless number
            problem = f"cannot be read: {getattr(error, 'strerror', None) or error}"
            remedy = _FILE_REMEDY
        else:
            return cls.from_table(
                table,
                path=str(path),
                line_of=lambda key: _line_of(text, key),
                default_name=Path(path).stem,
            )
        raise FileError(path=str(path), line=line, key=None, problem=problem, remedy=remedy)

    @classmethod
    def from_table(
        cls,
        table: Mapping[str, object],
        *,
        path: str,
        line_of: Callable[[str], int | None] = lambda key: None,
        default_name: str = "motor",
    ) -> Self:
        """Return the model in a table from `path`, a model file or part of another file.

        Args:
            table: keys as in a model file.
            path: the file that errors name.
            line_of: returns the line of a key (None: unknown).
            default_name: the name of the model, if the table has none.

        Raises:
            FileError: a key or value is invalid.
        """
        unit = _UNIT[MotionKind.LINEAR if table.get("kind") == "linear" else MotionKind.ROTARY]
        try:
            values = {"name": default_name, **given_in(cls, table, unit=unit)}
            return cls(**values)
        except SettingError as error:
            key, problem, remedy = str(error.path[0]), error.message, error.remedy
        except UsageError as error:
            cause = error.__cause__
            assert isinstance(cause, SettingError)
            key = _key_of(str(cause.path[0]), unit)
            problem, remedy = cause.message, cause.remedy
        raise FileError(
            path=path,
            line=line_of(key) if key in table else None,
            key=key if key.isprintable() else repr(key),
            problem=problem,
            remedy=remedy,
        )

    def save(self, path: str | Path) -> None:
        """Write the model to the TOML file `path`; `load` returns an equal one."""
        lines = [f"name = {_quoted(self.name)}", f"kind = {_quoted(self.kind.value)}"]
        for name, key in declaration(MotorModel).keys.items():
            value = getattr(self, name)
            if isinstance(key.kind, Number) and value is not None:
                lines.append(f"{key.name_for(name, self.unit)} = {float(value)!r}")
        if self.requires_referencing:
            lines.append("requires_referencing = true")
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _key_of(field: str, unit: str) -> str:
    return declaration(MotorModel).keys[field].name_for(field, unit)


def _increments(kind: MotionKind, gear: float | None, encoder: float | None) -> float | None:
    """Return the position increments per U from gear and encoder; None if one is unknown."""
    if gear is None or encoder is None:
        return None
    return gear * encoder / (tau if kind is MotionKind.ROTARY else 1.0)


def _line_of(text: str, key: str) -> int | None:
    """Return the line, from 1, of the first value of `key`: tomllib does not report lines."""
    lines = text.splitlines()
    for count in range(1, len(lines) + 1):
        try:
            if key in tomllib.loads("\n".join(lines[:count])):
                return count
        except tomllib.TOMLDecodeError:
            continue  # within a value of several lines
    return None


def _line_in(message: str) -> int | None:
    """Return the line in a message of tomllib: "... (at line 3, column 5)"."""
    _, found, rest = message.rpartition("at line ")
    number = rest.split(",")[0]
    return int(number) if found and number.isdigit() else None


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
