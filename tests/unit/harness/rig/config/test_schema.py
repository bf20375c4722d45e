"""The editors' JSON Schema agrees with the reader of rig files."""

import tomllib
from dataclasses import fields
from pathlib import Path

import jsonschema
import pytest
from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil.emulators.cia402 import settings as drive_settings
from motorhil.emulators.cia402.settings import CATALOGUE, CyclicTable, SwitchesTable
from motorhil.emulators.controller import SettingError
from motorhil.emulators.plant.nonlinear import EXTRAS
from motorhil.emulators.settings.protection import ProtectionTable
from motorhil.emulators.settings.tables import OscillatorTable
from motorhil.harness.plugins import ADAPTATIONS, installed
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.schema import rig_schema
from motorhil.harness.rig.reading import installed_plugins
from motorhil.motorapi.model import MotorModel
from motorhil.settings import declaration
from tests.support.motors.software_rigs import two
from tests.unit.harness.rig.config.test_rig_file import (
    GOOD,
    LINE_EDITS,
    REFUSALS,
    WITHOUT_BUS,
    edited,
    mistake_in,
    unescaped,
)

SCHEMA = rig_schema()
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
DEFS = SCHEMA["$defs"]
CONTROLLER = jsonschema.Draft202012Validator({"$defs": DEFS, "$ref": "#/$defs/controller"})

# Errors that need the whole file, or the installed plugins, and not only a schema.
BEYOND_STRUCTURE = (
    "there is no ",
    "already",
    "no such file",
    "whole number of nanoseconds",
    "unknown controller kind",
    "unknown adaptation",
    "is not after from_s",
    "cannot be printed",
)


def is_accepted(text):
    return VALIDATOR.is_valid(tomllib.loads(text))


def test_schema_is_a_valid_json_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize(
    ("keys", "accepted"),
    [
        ("", True),
        ("ppm = -50", True),
        ("ppm_max = 100\nphase_max_s = 0.001", True),
        ("ppm_max = 100\nphase_s = 0.001", True),
        ("ppm = 1\nppm_max = 1", False),
        ("phase_s = 0\nphase_max_s = 0.001", False),
        ("jitter_s = 0.001", True),
        ("jitter_s = -0.001", False),
    ],
)
def test_schema_accepts_the_same_oscillators_as_a_drive(keys, accepted):
    text = GOOD.replace("node_id = 1", f"node_id = 1\n[controller.left.oscillator]\n{keys}", 1)
    assert is_accepted(text) is accepted


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", ""),
        ("channels = 2", "channels = 5"),
        ("channel = 1", "channel = 0"),
        ("current_per_volt_a_v = 0.8", ""),
        ("current_per_volt_a_v = 0.8", "current_per_volt_a_v = 0"),
        ("bandwidth_rad_s = 60.0", ""),
        ("bandwidth_rad_s = 60.0", "bandwidth_rad_s = 0"),
        ("friction_feedforward_a", "friction"),
    ],
)
def test_schema_checks_a_central_servo_as_its_readers_do(old, new):
    text = f"[rig]\n[bus.can0]\nbitrate_bit_s = 500_000\n{two()}"
    assert is_accepted(text.replace(old, new, 1) if old else text) is not bool(old)


@pytest.mark.parametrize("adaptation", sorted(installed(ADAPTATIONS)))
def test_schema_requires_a_bus_if_the_adaptation_needs_one(adaptation):
    motor = {"adaptation": adaptation, "model": "wheel.toml"}
    needs_bus = installed_plugins().needs_bus(adaptation)
    assert VALIDATOR.is_valid({"motor": {"m": motor}}) is not needs_bus
    servo = {"current_per_volt_a_v": 0.8, "gains": {"kp_a_rad": 1.0}}
    own = {"software": servo, "mit": {"drive": "dm4310"}, "robstride": {"drive": "rs01"}}.get(
        adaptation, {}
    )
    kinds = getattr(installed(ADAPTATIONS)[adaptation].load(), "bus_kinds", ("can",))
    if "can" in kinds:
        bus, place = {"can0": {"bitrate_bit_s": 500_000}}, {"bus": "can0", "node_id": 1}
    else:
        bus, place = {"rs485": {"kind": "modbus_rtu"}}, {"bus": "rs485", "unit": 1}
    placed = {"bus": bus, "motor": {"m": {**motor, **own, **place}}}
    assert VALIDATOR.is_valid(placed) is needs_bus


def test_schema_checks_rigs_without_a_bus_as_the_reader_does():
    assert is_accepted(WITHOUT_BUS)
    assert not is_accepted("")
    assert not is_accepted(WITHOUT_BUS + '[controller.c]\nkind = "io"\nbus = "can0"\n')


def test_schema_has_the_keys_of_a_motor_model(tmp_path):
    limits = dict.fromkeys((field.name for field in fields(MotorModel)), 1.0)
    limits.update(name="wheel", position_min=-1.0, requires_referencing=True)
    limits["increments_per_unit"] = None  # follows from gear and encoder
    for kind in ("rotary", "linear"):
        limits["kind"] = next(k for k in type(MotorModel.__dataclass_fields__["kind"].default))
        limits["kind"] = type(limits["kind"])(kind)
        MotorModel(**limits).save(tmp_path / "model.toml")
        written = tomllib.loads((tmp_path / "model.toml").read_text())
        assert set(written) <= set(DEFS["motor_model"]["properties"])


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_schema_accepts_every_example(path):
    table = tomllib.loads(path.read_text())
    if "motor" in table:  # a rig; the others are motor models
        VALIDATOR.validate(table)
    else:
        VALIDATOR.evolve(schema={**DEFS["motor_model"], "$defs": DEFS}).validate(table)


def test_schema_accepts_a_rig_that_the_reader_accepts():
    assert is_accepted(GOOD)


@pytest.mark.parametrize(("old", "new", "told"), REFUSALS)
def test_schema_refuses_what_the_reader_refuses(old, new, told):
    if "not TOML" in told:
        return
    beyond = any(words in told for words in BEYOND_STRUCTURE)
    assert is_accepted(GOOD.replace(unescaped(old), unescaped(new), 1)) is beyond


# Kinds unknown to the schema, and no model's keys: only a builder could refuse them.
FOREIGN = (
    GOOD.replace('kind = "cia402"', 'kind = "io"')
    .replace('adaptation = "cia402"', 'adaptation = "servo"')
    .replace('[motor.left.model]\nname = "wheel"', "model = {}")
)


@given(LINE_EDITS)
def test_schema_accepts_any_rig_that_the_reader_accepts(edits):
    text = edited(edits, FOREIGN)
    if mistake_in(text) is None:
        VALIDATOR.validate(tomllib.loads(text))


LISTS = (["pp"], ["pp", "pp"], ["vl"], ["stray_emcy"], ["stray_emcy"] * 2, [], [1])
NUMBERS = (0, 1, -1, 0.5, 3, 24, 90, 1000, 1001, 35464, 65536, 1e9, 1e300)
ODD = st.sampled_from([*LISTS, *NUMBERS, "", "x", "fault", True, False, {}])


def odd_table(keys):
    return st.dictionaries(st.sampled_from([*keys, "none_such"]), ODD, max_size=3)


QUIRK_KEYS = [key for quirk in CATALOGUE for key in quirk.parameters]
TABLES = st.one_of(
    st.tuples(st.just("plant"), odd_table(EXTRAS)),
    st.tuples(st.just("switches"), odd_table(declaration(SwitchesTable).keys)),
    st.tuples(st.just("protection"), odd_table(declaration(ProtectionTable).keys)),
    st.tuples(st.just("cyclic"), odd_table(declaration(CyclicTable).keys)),
    st.tuples(st.just("oscillator"), odd_table(declaration(OscillatorTable).keys)),
    st.tuples(
        st.just("quirks"),
        st.dictionaries(
            st.sampled_from([quirk.name for quirk in CATALOGUE]),
            ODD | odd_table(QUIRK_KEYS),
            max_size=2,
        ),
    ),
    st.tuples(
        st.sampled_from(
            ["nonvolatile_memory", "node_id_by_lss", "supported_modes", "quirks", "switches"]
        ),
        ODD,
    ),
)
# A schema cannot compare one number with another, or with the plant.
BETWEEN_NUMBERS = (
    *("is not below", "is not above", "is above the maximum", "do not fit 32 bits"),
    *(
        "does not go with",
        "needs a thermal model",
        "does nothing without",
        "beyond the plant's",
    ),
    *("the plant does not model this quantity", "too fast for steps", "has no effect, because"),
)


@example(("quirks", ["stray_emcy"] * 2))
@example(("supported_modes", ["pp", "pp"]))
@example(("cyclic", {"sync_lost_code": 1000}))
@example(("cyclic", {"sync_lost_code": 1000, "sync_lost_periods": 0}))
@example(("protection", {"sto_error_code": 35464}))
@example(("switches", {"index_rad": 1, "index_pulse": False}))
@given(TABLES)
def test_schema_and_drive_accept_the_same_tables(table):
    key, value = table
    drive = {"node_id": 3, key: value}
    accepted = CONTROLLER.is_valid({"kind": "cia402", "bus": "can0", **drive})
    try:
        drive_settings.read_settings(drive, Path())
        refused = ""
    except SettingError as error:
        refused = str(error)
    event("refused" if refused else "accepted")
    is_between = any(text in refused for text in BETWEEN_NUMBERS)
    assert accepted == (not refused) or (accepted and is_between), refused
