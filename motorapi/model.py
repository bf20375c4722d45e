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
from dataclasses import dataclass, fields
from difflib import get_close_matches
from enum import Enum
from math import isfinite, tau
from pathlib import Path
from typing import Final, Self, final

from motorhil.motorapi.commands import ControlVariable, as_number, given
from motorhil.motorapi.errors import FileError, UsageError


@final
class MotionKind(Enum):
    """The kind of motion, which determines the unit U of position: rad or m."""

    ROTARY = "rotary"
    LINEAR = "linear"


_UNIT: Final = {MotionKind.ROTARY: "rad", MotionKind.LINEAR: "m"}
_TOLERANCE: Final = {MotionKind.ROTARY: 0.01, MotionKind.LINEAR: 0.0001}
_NUMBER_KEYS: Final = {
    "velocity_max": "velocity_max_{u}_s",
    "acceleration_max": "acceleration_max_{u}_s2",
    "deceleration_max": "deceleration_max_{u}_s2",
    "jerk_max": "jerk_max_{u}_s3",
    "torque_max": "torque_max_n_m",
    "current_max": "current_max_a",
    "position_min": "position_min_{u}",
    "position_max": "position_max_{u}",
    "position_tolerance": "position_tolerance_{u}",
    "gear_ratio": "gear_ratio",
    "encoder_increments_rev": "encoder_increments_rev",
    "increments_per_unit": "increments_per_{u}",
    "velocity_unit": "velocity_unit_{u}_s",
    "acceleration_unit": "acceleration_unit_{u}_s2",
}
_REQUIRED: Final = ("velocity_max", "acceleration_max")
_INTEGER_MAX: Final = 2**63 - 1
_FILE_REMEDY: Final = "name a motor model, a TOML file"
_TOML_REMEDY: Final = "a line reads key = value, as in velocity_max_rad_s = 6.0"
_SIGNED: Final = ("position_min", "position_max", "gear_ratio", "increments_per_unit")
_NOT_ZERO: Final = ("gear_ratio", "increments_per_unit")
_OF_LINEAR: Final = {"torque_max": "force_max_n", "gear_ratio": "motor_turns_per_m"}
_SAME: Final = 1e-6
"""The permitted relative deviation of increments from gear and encoder, for rounded models."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MotorModel:
    """The motor model (paper, 3.2): limits and units, immutable, shared between copies.

    U is rad or m, depending on `kind`. None means: no limit, or unknown.

    Raises:
        UsageError: a number is not finite, a limit is not > 0, a range is empty, or the name is not
            text.
    """

    name: str
    kind: MotionKind = MotionKind.ROTARY
    velocity_max: float  # [U/s]
    acceleration_max: float  # [U/s²]
    deceleration_max: float | None = None  # [U/s²]; None: as acceleration_max
    jerk_max: float | None = None  # [U/s³]
    torque_max: float | None = None  # [N·m], linear: [N]
    current_max: float | None = None  # [A]
    position_min: float | None = None  # [U]
    position_max: float | None = None  # [U]
    position_tolerance: float | None = None  # [U]; see start_tolerance
    gear_ratio: float | None = None  # motor turns per turn of the output (linear: per m), signed
    encoder_increments_rev: float | None = None  # per turn of the motor
    increments_per_unit: float | None = None  # position increments of the drive per U, signed
    velocity_unit: float | None = None  # value of 1 in the drive's velocity objects [U/s]
    acceleration_unit: float | None = None  # value of 1 in its acceleration objects [U/s²]
    requires_referencing: bool = False

    def __post_init__(self) -> None:
        if not _is_name(self.name):
            raise UsageError(f"motor model: its name is {self.name!r}, not printable text")
        for field in _NUMBER_KEYS:
            problem = _problem(field, getattr(self, field))
            if problem:
                raise UsageError(f"motor model {self.name}: {field} {problem}")
        if _is_empty(self.position_min, self.position_max):
            raise UsageError(f"motor model {self.name}: position_min is not below position_max")
        made = _increments(self.kind, self.gear_ratio, self.encoder_increments_rev)
        if self.increments_per_unit is None:
            object.__setattr__(self, "increments_per_unit", made)
        elif _differ(self.increments_per_unit, made):
            raise UsageError(
                f"motor model {self.name}: increments_per_unit is "
                f"{self.increments_per_unit:g}, but gear_ratio and encoder_increments_rev give "
                f"{made:g}"
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
            text = Path(path).read_text(encoding="utf-8-sig")
            table = tomllib.loads(text)
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
        reader = _Reader(table, path, line_of)
        kind = reader.kind()
        keys = _keys(kind)
        reader.refuse_unknown(keys)
        values = {field: reader.number(key, field) for key, field in keys.items()}
        for field in _REQUIRED:
            if values[field] is None:
                key = _key_of(field, kind)
                raise reader.error(key, "is missing", "every motor needs this limit: add it")
        if _is_empty(values["position_min"], values["position_max"]):
            key = _key_of("position_min", kind)
            raise reader.error(key, "is not below position_max", "exchange or correct them")
        made = _increments(kind, values["gear_ratio"], values["encoder_increments_rev"])
        if _differ(values["increments_per_unit"], made):
            key = _key_of("increments_per_unit", kind)
            problem = f"is not {made:.10g}, the value from gear and encoder_increments_rev"
            raise reader.error(key, problem, "leave it out, or correct one of them")
        name = reader.text("name", default_name)
        referencing = reader.flag("requires_referencing")
        velocity, acceleration = values.pop("velocity_max"), values.pop("acceleration_max")
        assert velocity is not None
        assert acceleration is not None
        return cls(
            name=name,
            kind=kind,
            velocity_max=velocity,
            acceleration_max=acceleration,
            requires_referencing=referencing,
            **values,
        )

    def save(self, path: str | Path) -> None:
        """Write the model to the TOML file `path`; `load` returns an equal one."""
        lines = [f"name = {_quoted(self.name)}", f"kind = {_quoted(self.kind.value)}"]
        for field in fields(self):
            if field.name in _NUMBER_KEYS:
                value = getattr(self, field.name)
                if value is not None:
                    lines.append(f"{_key_of(field.name, self.kind)} = {float(value)!r}")
        if self.requires_referencing:
            lines.append("requires_referencing = true")
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


@final
class _Reader:
    """Reader of one table, key by key; every error names file, line, key and remedy."""

    def __init__(
        self, table: Mapping[str, object], path: str, line_of: Callable[[str], int | None]
    ) -> None:
        self._table = table
        self._path = path
        self._line_of = line_of

    def error(self, key: str, problem: str, remedy: str) -> FileError:
        line = self._line_of(key) if key in self._table else None
        name = key if key.isprintable() else repr(key)
        return FileError(path=self._path, line=line, key=name, problem=problem, remedy=remedy)

    def kind(self) -> MotionKind:
        word = self.text("kind", MotionKind.ROTARY.value)
        for kind in MotionKind:
            if kind.value == word:
                return kind
        raise self.error("kind", f"{word!r} is not a kind of motor", 'write "rotary" or "linear"')

    def refuse_unknown(self, number_keys: Mapping[str, str]) -> None:
        known = ("name", "kind", *number_keys, "requires_referencing")
        for key in self._table:
            if key not in known:
                near = get_close_matches(key, known, n=1)
                remedy = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
                raise self.error(key, "unknown key of a motor model", remedy)

    def number(self, key: str, field: str) -> float | None:
        value = self._table.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, f"{value!r} is not a number", "write a number, without a unit")
        if isinstance(value, int) and abs(value) > _INTEGER_MAX:
            raise self.error(key, "is an integer of more than 64 bits", "write a shorter one")
        problem = _problem(field, float(value))
        if problem:
            raise self.error(key, problem, "correct it, or leave the key out")
        return float(value)

    def text(self, key: str, default: str) -> str:
        value = self._table.get(key, default)
        if not isinstance(value, str) or not value:
            raise self.error(key, f"{value!r} is not a text", 'write it in quotes, as in "wheel"')
        if not _is_name(value):
            raise self.error(key, f"{value!r} cannot be printed", "use letters, digits and spaces")
        return value

    def flag(self, key: str) -> bool:
        value = self._table.get(key, False)
        if not isinstance(value, bool):
            raise self.error(key, f"{value!r} is not a truth value", "write true or false")
        return value


def _key_of(field: str, kind: MotionKind) -> str:
    if kind is MotionKind.LINEAR and field in _OF_LINEAR:
        return _OF_LINEAR[field]
    return _NUMBER_KEYS[field].format(u=_UNIT[kind])


def _keys(kind: MotionKind) -> dict[str, str]:
    return {_key_of(field, kind): field for field in _NUMBER_KEYS}


def _problem(field: str, value: float | None) -> str:
    """Return the problem of a number in words, or ""."""
    if value is None:
        return ""
    number = as_number(value)
    if not isfinite(number):
        return f"is {value}, not a finite number"
    if field in _NOT_ZERO and number == 0.0:
        return "is 0"
    if field not in _SIGNED and number <= 0.0:
        return f"is {number:g}, not > 0"
    return ""


def _is_name(text: object) -> bool:
    return isinstance(text, str) and bool(text) and text.isprintable()


def _is_empty(low: float | None, high: float | None) -> bool:
    return low is not None and high is not None and not low < high


def _increments(kind: MotionKind, gear: float | None, encoder: float | None) -> float | None:
    """Return the position increments per U from gear and encoder; None if one is unknown."""
    if gear is None or encoder is None:
        return None
    return gear * encoder / (tau if kind is MotionKind.ROTARY else 1.0)


def _differ(given: float | None, made: float | None) -> bool:
    if given is None or made is None:
        return False
    return abs(given - made) > _SAME * abs(made)


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
