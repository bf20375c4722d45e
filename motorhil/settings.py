"""Settings declared once, as typed classes.

A class of settings is a frozen dataclass. Each field is declared with its kind, limits and unit:

    @frozen(kw_only=True)
    class Timing:
        # the docstring describes the table

        boot_up_s: float = number(0.3, 0, 3600, "s", "From power-on to the boot-up message.")

`read` checks a table and makes an object of the class; `schema` makes the JSON Schema of the class.
Relations between keys are declared as `RULES`. The rest is checked in `__post_init__`, which raises
SettingError.

This module is below the islands: beside `motorhil.frozen` it imports the standard library only.
"""

import difflib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, field, fields
from enum import Enum
from functools import cache
from typing import Any, Final, Protocol, TypeVar, final

from motorhil.frozen import frozen

BARE_KEY: Final = re.compile(r"[A-Za-z0-9_-]+")
REQUIRED: Final[Any] = MISSING
"""The default of a key that a table must have."""
KEY_PARTS_MAX: Final = 100
"""The number of parts of a dotted key: `tomllib` takes quadratic time for more."""
_KEY_PART: Final = r"""(?:"[^"\n]*"|'[^'\n]*'|(?<![\w-])[\w-]+)"""
_DEEP_KEY: Final = re.compile(rf"{_KEY_PART}(?:[ \t]*\.[ \t]*{_KEY_PART}){{{KEY_PARTS_MAX}}}")
_SHOWN_MAX: Final = 60
INTEGER_MAX: Final = 2**63 - 1  # TOML 1.0, "Integer": 64-bit signed is what all must accept
_KEY: Final = "setting"
_UNIT: Final = "{u}"
_SLIPS: Final = {  # what values in the unit on the left are often written in, and its size
    "s": (("ms", 1e-3), ("µs", 1e-6)),
    "ms": (("s", 1e3), ("µs", 1e-3)),
    "bit/s": (("kbit/s", 1e3), ("Mbit/s", 1e6)),
    "rad": (("degrees", math.pi / 180.0),),
    "rad/s": (("rpm", math.pi / 30.0), ("degrees/s", math.pi / 180.0)),
    "rad/s²": (("rpm/s", math.pi / 30.0), ("degrees/s²", math.pi / 180.0)),
    "m": (("mm", 1e-3),),
    "m/s": (("mm/s", 1e-3),),
    "m/s²": (("mm/s²", 1e-3),),
    "H": (("mH", 1e-3), ("µH", 1e-6)),
    "ohm": (("mohm", 1e-3),),
    "F": (("µF", 1e-6),),
    "A": (("mA", 1e-3),),
    "V": (("mV", 1e-3),),
    "N·m": (("mN·m", 1e-3),),
    "N·m/A": (("mN·m/A", 1e-3),),
    "kg·m²": (("g·cm²", 1e-7), ("kg·cm²", 1e-4)),
}

KeyPath = tuple[str | int, ...]
"""The keys down to a value; items of lists are counted from 0."""
Schema = dict[str, Any]
T = TypeVar("T")


def parse_toml(text: str) -> dict[str, object]:
    """Return the values of a TOML document, in a time that grows with its size.

    Raises:
        RecursionError: it is nested too deeply, or a key has more than KEY_PARTS_MAX parts.
        ValueError: it is not TOML (tomllib.TOMLDecodeError), or a number has over 4300 digits.
    """
    if _DEEP_KEY.search(text):
        raise RecursionError(f"a key has more than {KEY_PARTS_MAX} parts")
    return tomllib.loads(text)


@final
class SettingError(Exception):
    """A value in a table of settings is wrong; the reader of the file adds file and line.

    Attributes:
        path: the keys down to the value.
        message: the problem, with value, limit and unit.
        remedy: what to write instead.
    """

    def __init__(self, path: KeyPath, message: str, remedy: str = "") -> None:
        self.path = path
        self.message = message
        self.remedy = remedy
        text = f"{dotted(path)}: {message}" if path else message
        super().__init__(f"{text}; {remedy}" if remedy else text)

    def below(self, path: KeyPath) -> "SettingError":
        """Return the same error for a value in the table at `path`."""
        whole_path = (*path, *self.path)
        remedy = _header(whole_path) if self.remedy == _header(self.path) else self.remedy
        return SettingError(whole_path, self.message, remedy)


@final
@frozen
class Doubt:
    """A value in a table that is permitted, but hardly meant.

    Attributes:
        path: the keys down to the value.
        message: the value, with its unit.
        remedy: the usual range, and the likely mistake.
    """

    path: KeyPath
    message: str
    remedy: str


def slip(value: float, unit: str, low: float, high: float) -> str:
    """Return the likely mistake in a value outside `low` to `high` [unit], or an empty text."""
    for written, factor in _SLIPS.get(unit, ()):
        meant = value * factor
        if low <= abs(meant) <= high:
            text = f"{meant:.0f}" if meant == round(meant) else f"{meant:.6g}"
            return f"if it is in {written}, write {text}"
    return ""


class Kind(Protocol):
    """A kind of value."""

    def read(self, value: object, path: KeyPath) -> Any:
        """Return the value as the class of settings holds it; raise SettingError."""

    def schema(self) -> Schema:
        """Return its JSON Schema."""

    def example(self) -> str:
        """Return a value as a person writes it, or an empty text."""


@final
@frozen
class Key:
    """The declaration of one key.

    Attributes:
        kind: the kind of its value.
        doc: its description, one sentence or two.
        name: the key in the table if it differs from the field; `{u}` stands for rad or m.
        of_linear: the key for linear motors, if `{u}` does not suffice.
    """

    kind: Kind
    doc: str
    name: str = ""
    of_linear: str = ""

    def name_for(self, field_name: str, unit: str) -> str:
        """Return the key in a table of a motor with positions in this unit."""
        name = self.of_linear if unit == "m" and self.of_linear else self.name or field_name
        return name.replace(_UNIT, unit or "rad")

    def has_unit(self) -> bool:
        """Return True if the key differs between rotary and linear motors."""
        return _UNIT in self.name or bool(self.of_linear)


@final
@frozen
class Number:
    """A number from `low` to `high`, both included.

    Attributes:
        unit: of the value, for messages.
        is_whole: only integers.
        above: the number must be greater than `low`.
        not_zero: 0 is refused.
        word: a text that is allowed, too.
        may_be_inf, or_none: infinity, or None in an object, is allowed, too.
        plausible: the usual magnitudes; others, except 0, are permitted but doubtful (`doubts`).
        plausible_m: those of a linear motor, if the unit depends on the kind of motor.
    """

    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    is_whole: bool = False
    above: bool = False
    not_zero: bool = False
    word: str = ""
    may_be_inf: bool = False
    or_none: bool = False
    shown: str = ""
    plausible: tuple[float, float] | None = None
    plausible_m: tuple[float, float] | None = None

    def doubt(self, value: object, path: KeyPath, unit: str = "") -> "Doubt | None":
        """Return the doubt about a number that is permitted but not plausible, or None."""
        usual = self.plausible_m if unit == "m" and self.plausible_m else self.plausible
        if usual is None or isinstance(value, bool) or not isinstance(value, int | float):
            return None
        low, high = usual
        if value == 0 or low <= abs(value) <= high or not math.isfinite(value):
            return None
        own = self.unit.replace(_UNIT, unit or "rad")
        text = f"{value:g}{f' {own}' if own else ''} is implausible"
        remedy = f"usual: {_bound(low)} to {_bound(high)}{f' {own}' if own else ''}"
        likely = slip(value, own, low, high)
        return Doubt(path, text, f"{remedy}; {likely}" if likely else remedy)

    def read(self, value: object, path: KeyPath) -> float | str | None:
        """Return the number, or the word."""
        if (self.word and value == self.word) or (self.or_none and value is None):
            return self.word or None
        if self.may_be_inf and value == math.inf:
            return math.inf
        wanted = int if self.is_whole else int | float
        if isinstance(value, bool) or not isinstance(value, wanted):
            noun = "an integer" if self.is_whole else "a number"
            noun += f" [{self.unit}]" if self.unit else ""
            raise _wrong_type(path, noun, value, self, f"allowed: {self.limits()}")
        number: float = value
        if isinstance(number, int) and abs(number) > INTEGER_MAX:
            raise SettingError(path, "is an integer of more than 64 bits", "write a shorter one")
        unit = f" {self.unit}" if self.unit else ""
        if isinstance(number, float) and not math.isfinite(number):
            raise SettingError(path, f"must be finite ({value})", f"allowed: {self.limits()}")
        is_low = number < self.low or (self.above and number == self.low)
        if is_low or number > self.high or (self.not_zero and number == 0):
            message = f"{shown(value)}{unit} is out of range"
            raise SettingError(path, message, f"allowed: {self.limits()}")
        return number if self.is_whole else float(number)

    def limits(self) -> str:
        """Return the limits in words."""
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.low) and math.isinf(self.high) and not self.not_zero:
            return "any finite number" + (f" [{self.unit}]" if self.unit else "")
        if math.isinf(self.low):
            return "any number but 0" if self.not_zero else f"up to {_bound(self.high)}{unit}"
        if math.isinf(self.high):
            return (
                f"more than {_bound(self.low)}{unit}"
                if self.above
                else f"{_bound(self.low)}{unit} or more"
            )
        to = "more than {}, up to {}" if self.above else "{} to {}"
        return to.format(_bound(self.low), _bound(self.high)) + unit

    def schema(self) -> Schema:
        """Return its JSON Schema."""
        found: Schema = {"type": "integer" if self.is_whole else "number"}
        if not math.isinf(self.low):
            found["exclusiveMinimum" if self.above else "minimum"] = self.low
        if not math.isinf(self.high):
            found["maximum"] = self.high
        if self.not_zero:
            found["not"] = {"const": 0}
        return {"oneOf": [found, {"const": self.word}]} if self.word else found

    def example(self) -> str:
        """Return a number, and the word."""
        return f'{self.shown or 1}, or "{self.word}"' if self.word else self.shown


@final
@frozen
class Flag:
    """True or false."""

    def read(self, value: object, path: KeyPath) -> bool:
        """Return the value."""
        if not isinstance(value, bool):
            raise _wrong_type(path, "true or false", value, self)
        return value

    def schema(self) -> Schema:
        """Return its JSON Schema."""
        return {"type": "boolean"}

    def example(self) -> str:
        """Return true."""
        return "true"


@final
@frozen
class Text:
    """A text that is not empty; `words`, if any, are all there are, and `noun` names them."""

    words: tuple[str, ...] = ()
    noun: str = "value"
    shown: str = ""
    is_printable: bool = False

    def read(self, value: object, path: KeyPath) -> str:
        """Return the text."""
        if not isinstance(value, str):
            raise _wrong_type(path, "a string", value, self)
        if not value:
            raise SettingError(path, "is empty", _write(path, self))
        if self.words and value not in self.words:
            known = listed(self.words)
            message = f'unknown {self.noun} "{value}" (known: {known})'
            raise SettingError(path, message, nearest(value, self.words))
        if self.is_printable and not value.isprintable():
            message = "contains a character that cannot be printed"
            raise SettingError(path, message, "write one line of text")
        return value

    def schema(self) -> Schema:
        """Return its JSON Schema."""
        return {"enum": list(self.words)} if self.words else {"type": "string", "minLength": 1}

    def example(self) -> str:
        """Return the words, or an example."""
        return " or ".join(f'"{word}"' for word in self.words[:4]) if self.words else self.shown


@final
@frozen
class Member:
    """A member of an enumeration by its value, a word."""

    of: type[Enum]
    noun: str

    def _text(self) -> Text:
        return Text(tuple(one.value for one in self.of), self.noun)

    def read(self, value: object, path: KeyPath) -> Enum:
        """Return the member."""
        return value if isinstance(value, self.of) else self.of(self._text().read(value, path))

    def schema(self) -> Schema:
        """Return its JSON Schema."""
        return self._text().schema()

    def example(self) -> str:
        """Return the words."""
        return self._text().example()


@final
@frozen
class HexBytes:
    """1 to `longest` bytes, written in hex; `must_change`: not all of them 0."""

    longest: int
    must_change: bool = False

    def read(self, value: object, path: KeyPath) -> bytes:
        """Return the bytes."""
        text = Text(shown='"00 FF"').read(value, path)
        remedy = f'write hex bytes, first byte first: {path[-1]} = "00 FF"'
        try:
            data = bytes.fromhex(text)
        except ValueError:
            raise SettingError(path, f'not hex bytes ("{text}")', remedy) from None
        if not data or len(data) > self.longest or (self.must_change and not any(data)):
            change = ", and change a bit" if self.must_change else ""
            raise SettingError(path, f"must be 1 to {self.longest} bytes{change}", remedy)
        return data

    def schema(self) -> Schema:
        """Return its JSON Schema."""
        byte = "[0-9A-Fa-f]{2}"
        found = {"type": "string", "pattern": rf"^\s*({byte}\s*){{1,{self.longest}}}$"}
        return {**found, "not": {"pattern": r"^[0\s]*$"}} if self.must_change else found

    def example(self) -> str:
        """Return two bytes."""
        return '"00 FF"'


@final
@frozen
class Items:
    """A list; at least `least` items, at most `most`, none of them twice if `unique`."""

    item: Kind
    least: int = 0
    most: int | None = None
    unique: bool = True
    shown: str = ""

    def read(self, value: object, path: KeyPath) -> tuple[Any, ...]:
        """Return the items in order."""
        if isinstance(self.item, TableOf):
            value = as_tables(value, path)
        if not isinstance(value, list | tuple):
            raise _wrong_type(path, "a list", value, self)
        if len(value) < self.least:
            raise SettingError(
                path, "is empty" if not value else "is too short", _write(path, self)
            )
        if self.most is not None and len(value) > self.most:
            raise SettingError(path, f"has more than {self.most} items", _write(path, self))
        found: list[Any] = []
        for index, item in enumerate(value):
            one = self.item.read(item, (*path, index))
            if self.unique and one in found:
                raise SettingError((*path, index), f"{shown(item)} is there twice", "take one out")
            found.append(one)
        return tuple(found)

    def schema(self) -> Schema:
        """Return its JSON Schema."""
        found: Schema = {"type": "array", "items": self.item.schema()}
        if self.least:
            found["minItems"] = self.least
        if self.most is not None:
            found["maxItems"] = self.most
        return {**found, "uniqueItems": True} if self.unique else found

    def example(self) -> str:
        """Return a list."""
        example = self.item.example()
        return self.shown or (f"[{example}]" if example else "")


@final
@frozen
class TableOf:
    """A table of its own: of a class of settings, or of a declaration."""

    of: "type | Declaration"

    def read(self, value: object, path: KeyPath, unit: str = "") -> Any:
        """Return an object of the class, or what is given of the declaration."""
        if isinstance(self.of, Declaration):
            return given(self.of, value, path, unit=unit)
        return read(self.of, value, path, unit=unit)

    def schema(self) -> Schema:
        """Return a reference; `with_definitions` gives it a name."""
        return {"$ref": declaration(self.of)}

    def example(self) -> str:
        """Return nothing: a table is written with a header."""
        return ""


@final
@frozen
class TablesByKey:
    """A table of values by key; each key matches `pattern` if there is one."""

    item: Kind
    pattern: str = ""
    problem: str = "is not a name"
    remedy: str = "use a letter, then letters, digits, - and _ only"

    def read(self, value: object, path: KeyPath) -> dict[str, Any]:
        """Return the values by key."""
        found = {}
        for key, item in as_table(value, path).items():
            if self.pattern and not re.fullmatch(self.pattern, key):
                raise SettingError((*path, key), self.problem, self.remedy)
            found[key] = self.item.read(item, (*path, key))
        return found

    def schema(self) -> Schema:
        """Return its JSON Schema."""
        names = {"propertyNames": {"pattern": f"^({self.pattern})$"}} if self.pattern else {}
        return {"type": "object", **names, "additionalProperties": self.item.schema()}

    def example(self) -> str:
        """Return nothing: a table is written with a header."""
        return ""


@final
@frozen
class Rule:
    """A relation between keys: if it applies, some keys are refused or required.

    Attributes:
        key: the key that decides, by its value or its default.
        values: the values for which the rule applies; empty: it applies if the key is given.
        otherwise: the rule applies for all other values instead.
        refused: keys that must then be absent.
        required: keys of which then one must be there.
        message: the problem with a key that is refused.
        remedy: what to do instead.
    """

    key: str
    values: tuple[object, ...] = ()
    otherwise: bool = False
    refused: tuple[str, ...] = ()
    required: tuple[str, ...] = ()
    message: str = "does not belong here"
    remedy: str = "take it out"

    def check(self, table: Mapping[str, object], default: object, path: KeyPath) -> None:
        """Raise SettingError if the table breaks the rule; `default` is that of the key."""
        if not self._applies(table, default):
            return
        for key in self.refused:
            if key in table:
                raise SettingError((*path, key), self.message, self.remedy)
        if self.required and not any(key in table for key in self.required):
            raise SettingError((*path, self.required[0]), "is missing", self.remedy)

    def _applies(self, table: Mapping[str, object], default: object) -> bool:
        if not self.values:
            return (self.key in table) is not self.otherwise
        return (table.get(self.key, default) in self.values) is not self.otherwise

    def schema(self, default: object) -> Schema:
        """Return its JSON Schema; `default` is that of the key."""
        condition: Schema = {"properties": {self.key: {"enum": list(self.values)}}}
        if not self.values:
            condition = {"required": [self.key]}
        elif default not in self.values:
            condition["required"] = [self.key]
        then: Schema = {}
        if self.refused:
            then["properties"] = dict.fromkeys(self.refused, False)
        if len(self.required) == 1:
            then["required"] = list(self.required)
        elif self.required:
            then["anyOf"] = [{"required": [key]} for key in self.required]
        return {"if": condition, "else" if self.otherwise else "then": then}


@final
@frozen
class Declaration:
    """The keys of a table, and their relations.

    Attributes:
        name: of the table, in the JSON Schema.
        doc: its description.
        keys: the keys by field.
        defaults: the defaults by field; a field without one is required.
        rules: the relations between keys.
        extra: a JSON Schema of what `__post_init__` checks besides.
    """

    name: str
    doc: str
    keys: Mapping[str, Key]
    defaults: Mapping[str, object] = field(default_factory=dict)
    rules: tuple[Rule, ...] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)

    def names(self, unit: str = "") -> dict[str, str]:
        """Return the field of each key, for positions in this unit."""
        return {key.name_for(name, unit): name for name, key in self.keys.items()}


@cache
def _declared(of: type) -> Declaration:
    keys, defaults = {}, {}
    for one in fields(of):
        if _KEY in one.metadata:
            keys[one.name] = one.metadata[_KEY]
            if one.default is not MISSING:
                defaults[one.name] = one.default
            elif one.default_factory is not MISSING:
                defaults[one.name] = None
    rules, extra = getattr(of, "RULES", ()), getattr(of, "SCHEMA", {})
    doc = (of.__doc__ or "").partition("\n\n")[0]
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", of.__name__.removesuffix("Table")).lower()
    return Declaration(name, " ".join(doc.split()), keys, defaults, rules, extra)


def declaration(of: "type | Declaration") -> Declaration:
    """Return the declaration of a class of settings."""
    return of if isinstance(of, Declaration) else _declared(of)


def given(
    of: "type | Declaration", table: object, path: KeyPath = (), *, unit: str = ""
) -> dict[str, Any]:
    """Return the values that a table gives, by field.

    Args:
        of: the declaration.
        table: the table.
        path: the keys down to it, for errors.
        unit: of positions, "rad" or "m", if keys depend on it.

    Raises:
        SettingError: a key is unknown or missing, or a value is wrong.
    """
    try:
        return _given(declaration(of), as_table(table, path), path, unit)
    except SettingError as error:
        message, remedy = (one.replace(_UNIT, unit) for one in (error.message, error.remedy))
        raise SettingError(error.path, message, remedy) from None


def _given(
    declared: Declaration, values: Mapping[str, object], path: KeyPath, unit: str
) -> dict[str, Any]:
    names = declared.names(unit)
    refuse_unknown(values, tuple(names), path)
    found = {}
    for name, one in names.items():
        kind = declared.keys[one].kind
        if name in values and isinstance(kind, TableOf):
            found[one] = kind.read(values[name], (*path, name), unit)
        elif name in values:
            found[one] = kind.read(values[name], (*path, name))
        elif one not in declared.defaults:
            raise SettingError((*path, name), "is missing", _write((*path, name), kind))
    for rule in declared.rules:
        rule.check(values, declared.defaults.get(rule.key), path)
    return found


def read(of: type[T], table: object, path: KeyPath = (), *, unit: str = "") -> T:
    """Return the settings that a table gives, as an object of the class.

    Args, and errors: as of `given`.
    """
    found = given(of, table, path, unit=unit)
    try:
        return of(**found)
    except SettingError as error:
        raise error.below(path) from None


def doubts(
    of: "type | Declaration", values: Mapping[str, object], path: KeyPath = (), *, unit: str = ""
) -> list[Doubt]:
    """Return the doubts about the values of a table that `read` accepts; unknown keys have none.

    Args: as of `given`.
    """
    declared, found = declaration(of), []
    for name, one in declared.names(unit).items():
        if name in values:
            found += _doubts(declared.keys[one].kind, values[name], (*path, name), unit)
    return found


def _doubts(kind: Kind, value: object, path: KeyPath, unit: str) -> list[Doubt]:
    if isinstance(kind, Number):
        doubt = kind.doubt(value, path, unit)
        return [] if doubt is None else [doubt]
    if isinstance(kind, TableOf) and isinstance(value, Mapping):
        return doubts(kind.of, value, path, unit=unit)
    items: Iterable[tuple[str | int, object]] = ()
    if isinstance(kind, Items) and isinstance(value, list | tuple):
        items = enumerate(value)
    elif isinstance(kind, TablesByKey) and isinstance(value, Mapping):
        items = value.items()
    else:
        return []
    return [one for key, item in items for one in _doubts(kind.item, item, (*path, key), unit)]


def check(settings: object) -> None:
    """Check the values of an object that was not made by `read`.

    Raises:
        SettingError: a value is wrong.
    """
    declared = declaration(type(settings))
    for name, key in declared.keys.items():
        value = getattr(settings, name)
        if isinstance(key.kind, TableOf):
            continue  # checked when it was made
        default = declared.defaults.get(name, MISSING)
        if value != default or isinstance(value, bool) is not isinstance(
            default, bool
        ):  # 1 is True
            key.kind.read(value, (name,))


def schema(of: "type | Declaration") -> Schema:
    """Return the JSON Schema of one table; the tables in it are declarations still."""
    declared = declaration(of)
    properties: Schema = {}
    for name, key in declared.keys.items():
        for unit in ("rad", "m") if key.has_unit() else ("",):
            own = key.kind.schema()
            unit_text = getattr(key.kind, "unit", "").replace(_UNIT, unit)
            own["description"] = f"{key.doc} [{unit_text}]" if unit_text else key.doc
            default = declared.defaults.get(name)
            if default is not None:
                plain = default.value if isinstance(default, Enum) else default
                own["default"] = list(plain) if isinstance(plain, tuple) else plain
            properties[key.name_for(name, unit)] = own
    required = [
        key.name_for(name, "")
        for name, key in declared.keys.items()
        if name not in declared.defaults and not key.has_unit()
    ]
    rules = [rule.schema(declared.defaults.get(rule.key)) for rule in declared.rules] + [
        dict(one) for one in [declared.extra] if one
    ]
    return {
        "type": "object",
        "description": declared.doc,
        "additionalProperties": False,
        **({"required": required} if required else {}),
        "properties": properties,
        **({"allOf": rules} if rules else {}),
    }


def with_definitions(root: Schema) -> Schema:
    """Return a JSON Schema with a definition of each declaration that it refers to."""
    definitions: Schema = {}
    names: dict[int, str] = {}

    def resolved(part: Any) -> Any:
        if isinstance(part, dict):
            return {key: resolved(value) for key, value in part.items()}
        if isinstance(part, list):
            return [resolved(value) for value in part]
        if not isinstance(part, Declaration):
            return part
        if id(part) not in names:
            names[id(part)] = name = part.name + ("_" if part.name in definitions else "")
            definitions[name] = {}
            definitions[name] = resolved(schema(part))
        return f"#/$defs/{names[id(part)]}"

    return {**resolved(root), "$defs": definitions}


def number(
    default: float | None,
    low: float = -math.inf,
    high: float = math.inf,
    unit: str = "",
    doc: str = "",
    *,
    name: str = "",
    example: str = "",
    **own: Any,
) -> Any:
    """Declare a number; `own` are further attributes of `Number`, or `of_linear`."""
    of_linear = own.pop("of_linear", "")
    kind = Number(low, high, unit, shown=example, **own)
    return setting(default, kind, doc, name=name, of_linear=of_linear)


def positive(
    default: float | None,
    unit: str,
    doc: str,
    plausible: tuple[float, float] | None = None,
    *,
    most: float = math.inf,
    **own: Any,
) -> Any:
    """Declare a number above 0, up to `most`; `own` as in `number`."""
    return number(default, 0, most, unit, doc, above=True, plausible=plausible, **own)


def amount(
    default: float | None,
    unit: str,
    doc: str,
    plausible: tuple[float, float] | None = None,
    *,
    most: float = math.inf,
    **own: Any,
) -> Any:
    """Declare a number of 0 or more, up to `most`; `own` as in `number`."""
    return number(default, 0, most, unit, doc, plausible=plausible, **own)


def whole(
    default: int | None,
    low: int,
    high: int,
    unit: str = "",
    doc: str = "",
    *,
    example: str = "",
    plausible: tuple[float, float] | None = None,
) -> Any:
    """Declare a whole number."""
    kind = Number(low, high, unit, is_whole=True, shown=example, plausible=plausible)
    return setting(default, kind, doc)


def flag(default: bool, doc: str) -> Any:
    """Declare a truth value."""
    return setting(default, Flag(), doc)


def text(default: str | None, doc: str, *, example: str = "") -> Any:
    """Declare a text."""
    return setting(default, Text(shown=example), doc)


def word(default: str | None, words: Iterable[str], noun: str, doc: str) -> Any:
    """Declare one of several words; `noun` names what they are."""
    return setting(default, Text(tuple(words), noun), doc)


def table(of: "type | Declaration", doc: str) -> Any:
    """Declare a table of its own; absent, it is empty."""
    factory = dict if isinstance(of, Declaration) else of
    return field(default_factory=factory, metadata={_KEY: Key(TableOf(of), doc)})


def setting(default: object, kind: Kind, doc: str, *, name: str = "", of_linear: str = "") -> Any:
    """Declare a key of any kind; REQUIRED as default: the table must have it."""
    key = Key(kind, doc, name, of_linear)
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata={_KEY: key})
    return field(default=default, metadata={_KEY: key})


def as_table(value: object, path: KeyPath) -> Mapping[str, object]:
    """Return the value if it is a table; raise SettingError."""
    if not isinstance(value, Mapping):
        message = f"must be a table, but is {kind_of(value)} ({shown(value)})"
        raise SettingError(path, message, _header(path))
    return value


def as_tables(value: object, path: KeyPath) -> list[Mapping[str, object]]:
    """Return the value if it is an array of tables; raise SettingError."""
    remedy = f"write [[{dotted(path)}]]"
    if not isinstance(value, list | tuple):
        message = f"must be an array of tables, but is {kind_of(value)} ({shown(value)})"
        raise SettingError(path, message, remedy)
    for index, item in enumerate(value):
        if not isinstance(item, Mapping):
            raise SettingError((*path, index), f"must be a table ({shown(item)})", remedy)
    return list(value)


def refuse_unknown(
    table: Mapping[str, object], known: Sequence[str], path: KeyPath = (), what: str = "key"
) -> None:
    """Raise SettingError for the first key that is not known, with the nearest known one."""
    for key in table:
        if key not in known:
            message = f"unknown {what} (known: {listed(known)})"
            raise SettingError((*path, key), message, nearest(key, known))


def _bound(limit: float) -> str:
    short = f"{limit:g}"
    is_short = isinstance(limit, float) and float(short) == limit
    return short if is_short else shown(limit)


def _header(path: KeyPath) -> str:
    return f"write [{dotted(path)}]"


def _write(path: KeyPath, kind: Kind) -> str:
    key, example = path[-1], kind.example()
    if not example and isinstance(kind, Number):
        return f"write {key}, {kind.limits()}"
    if not example:
        return _header(path) if isinstance(kind, TableOf) else ""
    return f"write {example}" if isinstance(key, int) else f"write {key} = {example}"


def _wrong_type(
    path: KeyPath, wanted: str, value: object, kind: Kind, remedy: str = ""
) -> SettingError:
    message = f"must be {wanted}, but is {kind_of(value)} ({shown(value)})"
    has_example = kind.example() or not remedy
    return SettingError(path, message, _write(path, kind) if has_example else remedy)


def dotted(path: KeyPath) -> str:
    """Return the path as people write it: keys joined by dots, list items in brackets."""
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
        else:
            quoted = key if BARE_KEY.fullmatch(key) else repr(key)
            text += f".{quoted}" if text else quoted
    return text


def listed(names: Iterable[str]) -> str:
    """Return the names separated by commas, or "none"."""
    return ", ".join(names) or "none"


def nearest(name: str, known: Sequence[str]) -> str:
    """Return a remedy: the known name most similar to `name`, or to remove it."""
    if not known:
        return "take it out"
    for candidate in known:  # a missing unit is the likeliest mistake
        if candidate.startswith(f"{name}_"):
            return f"did you mean {candidate}?"
    found = difflib.get_close_matches(name.lower(), [k.lower() for k in known], 1, 0.6)
    for candidate in known:
        if found and candidate.lower() == found[0]:
            return f"did you mean {candidate}?"
    return "take it out, or use one of these"


def kind_of(value: object) -> str:
    """Return TOML's word for the type of this value, with its article."""
    if isinstance(value, bool):
        return "a boolean"
    for kind, name in _KINDS:
        if isinstance(value, kind):
            return name
    return "a date or time"


_KINDS: Final = (
    (str, "a string"),
    (int, "an integer"),
    (float, "a float"),
    (dict, "a table"),
    (list, "an array"),
)


def shown(value: object) -> str:
    """Return a value as TOML writes it, shortened."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict | list):
        return "1 entry" if len(value) == 1 else f"{len(value)} entries"
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= _SHOWN_MAX else text[: _SHOWN_MAX - 3] + "..."
