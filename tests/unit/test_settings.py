"""Declarations of settings: values, messages, defaults, rules and the JSON Schema."""

import math
from dataclasses import dataclass
from enum import Enum
from importlib.metadata import entry_points
from typing import ClassVar

import jsonschema
import pytest

from motorhil.harness.plugins import SETTINGS
from motorhil.harness.rig.config.schema import rig_schema
from motorhil.settings import (
    REQUIRED,
    Declaration,
    HexBytes,
    Items,
    Member,
    Number,
    Rule,
    SettingError,
    TableOf,
    TablesByKey,
    Text,
    amount,
    check,
    declaration,
    flag,
    given,
    number,
    positive,
    read,
    schema,
    setting,
    table,
    text,
    whole,
    with_definitions,
    word,
)


class Colour(Enum):
    """Colours."""

    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True, kw_only=True)
class InnerTable:
    """A part."""

    speed: float = number(REQUIRED, 0, doc="Speed.", name="speed_{u}_s", unit="{u}/s", above=True)


@dataclass(frozen=True, kw_only=True)
class OuterTable:
    """A whole."""

    count: int = whole(REQUIRED, 1, 10, "", "How many.", example="3")
    ratio: float = number(0.5, 0, 1.0, "", "A ratio.")
    delay_s: float | str = number(0.0, 0, 5.0, "s", "A delay.", word="never")
    is_on: bool = flag(False, "On.")
    name: str | None = text(None, "A name.", example='"left"')
    mode: str = word("fast", ("fast", "slow"), "mode", "A mode.")
    colour: Colour = setting(Colour.RED, Member(Colour, "colour"), "A colour.")
    data: bytes = setting(b"", HexBytes(2, must_change=True), "Bytes.")
    names: tuple[str, ...] = setting((), Items(Text(), shown='["a"]'), "Names.")
    inner: InnerTable | None = setting(None, TableOf(InnerTable), "Its part.")
    by_name: dict = setting({}, TablesByKey(Number(0, 1), "[a-z]+"), "By name.")

    RULES: ClassVar = (
        Rule("mode", ("slow",), required=("name",), remedy="name it"),
        Rule("is_on", (True,), otherwise=True, refused=("ratio",), message="is for what is on"),
    )


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({}, "t.count: is missing; write count = 3"),
        ({"count": 11}, "t.count: 11 is out of range; allowed: 1 to 10"),
        ({"count": 1.0}, "t.count: must be an integer, but is a float (1.0); write count = 3"),
        ({"count": True}, "t.count: must be an integer, but is a boolean (true); write count = 3"),
        ({"coun": 1}, "did you mean count?"),
        ({"count": 10**400}, "t.count: is an integer of more than 64 bits; write a shorter one"),
        ({"delay_s": -1}, "t.delay_s: -1 s is out of range; allowed: 0 to 5 s"),
        ({"delay_s": math.nan}, "t.delay_s: must be finite (nan); allowed: 0 to 5 s"),
        ({"delay_s": "ever"}, 'must be a number [s], but is a string ("ever"); write delay_s = 1,'),
        ({"is_on": 1}, "t.is_on: must be true or false, but is an integer (1)"),
        ({"name": ""}, 't.name: is empty; write name = "left"'),
        ({"mode": "fest"}, 't.mode: unknown mode "fest" (known: fast, slow); did you mean fast?'),
        ({"colour": "green"}, 't.colour: unknown colour "green" (known: red, blue)'),
        ({"data": "0g"}, 't.data: not hex bytes ("0g"); write hex bytes'),
        ({"data": "00 00"}, "t.data: must be 1 to 2 bytes, and change a bit"),
        ({"names": "a"}, 't.names: must be a list, but is a string ("a"); write names = ["a"]'),
        ({"names": ["a", "a"]}, 't.names[1]: "a" is there twice; take one out'),
        ({"inner": 3}, "t.inner: must be a table, but is an integer (3); write [t.inner]"),
        ({"inner": {}}, "t.inner.speed_rad_s: is missing; write speed_rad_s, more than 0 rad/s"),
        ({"inner": {"speed_rad_s": 0}}, "t.inner.speed_rad_s: 0 rad/s is out of range; allowed: "),
        ({"by_name": {"B": 1}}, "t.by_name.B: is not a name"),
        ({"by_name": {"b": 2}}, "t.by_name.b: 2 is out of range; allowed: 0 to 1"),
        ({"mode": "slow"}, "t.name: is missing; name it"),
        ({"ratio": 0.5}, "t.ratio: is for what is on; take it out"),
    ],
)
def test_wrong_value_is_refused_with_path_limit_and_remedy(values, told):
    table = {} if not values else {"count": 1, **values}
    with pytest.raises(SettingError) as caught:
        read(OuterTable, table, ("t",), unit="rad")
    assert told in str(caught.value)
    assert caught.value.remedy


def test_values_are_read_and_absent_ones_have_defaults():
    values = {"count": 2, "delay_s": "never", "colour": "blue", "data": "01"}
    values |= {"inner": {"speed_m_s": 3}, "by_name": {"a": 1}, "mode": "slow", "name": "x"}
    settings = read(OuterTable, values, unit="m")
    assert (settings.count, settings.delay_s, settings.colour) == (2, "never", Colour.BLUE)
    assert (settings.data, settings.inner, settings.ratio) == (b"\x01", InnerTable(speed=3.0), 0.5)
    assert isinstance(settings.inner.speed, float)
    assert set(given(OuterTable, {"count": 2})) == {"count"}


def test_short_forms_declare_the_numbers_that_they_name():
    assert positive(5.0, "ms", "Period.", (1.0, 50.0), most=1e3).metadata == (
        number(5.0, 0, 1e3, "ms", "Period.", above=True, plausible=(1.0, 50.0)).metadata
    )
    assert amount(None, "A", "Current.", word="none").metadata == (
        number(None, 0, unit="A", doc="Current.", word="none").metadata
    )


def test_error_of_an_inner_table_gets_the_outer_path_and_header():
    error = SettingError(("inner",), "must be a table", "write [inner]").below(("t", 0))
    assert str(error) == "t[0].inner: must be a table; write [t[0].inner]"


def test_checked_object_refuses_what_a_table_could_not_say():
    check(OuterTable(count=3))
    with pytest.raises(SettingError, match="count: 0 is out of range"):
        check(OuterTable(count=0))


@pytest.mark.parametrize(
    "values",
    [
        {"count": 1},
        {"count": 0},
        {"count": 1, "mode": "slow"},
        {"count": 1, "mode": "slow", "name": "x"},
        {"count": 1, "ratio": 0.5},
        {"count": 1, "ratio": 0.5, "is_on": True},
        {"count": 1, "data": "00"},
        {"count": 1, "names": ["a", "a"]},
        {"count": 1, "delay_s": "never"},
        {"count": 1, "inner": {"speed_rad_s": 0}},
        {"count": 1, "by_name": {"B": 1}},
        {"count": 1, "other": 1},
    ],
)
def test_schema_and_reader_accept_the_same_tables(values):
    whole_schema = with_definitions(schema(OuterTable))
    jsonschema.Draft202012Validator.check_schema(whole_schema)
    accepted = jsonschema.Draft202012Validator(whole_schema).is_valid(values)
    try:
        read(OuterTable, values, unit="rad")
    except SettingError:
        assert not accepted
    else:
        assert accepted


def _declarations(of: Declaration, found: dict[str, Declaration]) -> dict[str, Declaration]:
    found[of.name] = of
    for key in of.keys.values():
        kind = getattr(key.kind, "item", key.kind)
        if isinstance(kind, TableOf) and declaration(kind.of).name not in found:
            _declarations(declaration(kind.of), found)
    return found


def _all_tables() -> dict[str, Declaration]:
    found: dict[str, Declaration] = {}
    for group in SETTINGS.values():
        for point in entry_points(group=group):
            _declarations(declaration(point.load()), found)
    return found


SPELT = {"·": "_", "/": "_", "²": "2", "³": "3", "(": "", ")": "", "{u}": "rad"}


@pytest.mark.parametrize("of", _all_tables().values(), ids=lambda of: of.name)
def test_unit_of_every_number_is_the_end_of_its_key(of):
    for field, key in of.keys.items():
        unit = getattr(key.kind, "unit", "")
        for sign, letters in SPELT.items():
            unit = unit.replace(sign, letters)
        name = f"_{key.name_for(field, 'rad')}".removesuffix("_max")
        assert name.endswith(f"_{unit.lower()}" if unit else ""), field
        assert key.doc or of.name.startswith("quirk_")


def test_schema_of_rigs_names_no_definition_twice():
    assert not [name for name in rig_schema()["$defs"] if name.endswith("_")]


def test_table_with_defaults_may_be_absent():
    @dataclass(frozen=True, kw_only=True)
    class Whole:
        """A whole."""

        part: OuterTable = table(OuterTable, "Its part.")

    assert "part" not in given(Whole, {})
