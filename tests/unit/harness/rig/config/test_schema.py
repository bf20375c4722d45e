"""The editors' JSON Schema agrees with the reader of rig files."""

import json
import tomllib
from dataclasses import fields
from pathlib import Path

import jsonschema
import pytest
from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil import harness
from motorhil.emulators.can.fault_rules import FaultKind
from motorhil.emulators.cia401 import settings as node_settings
from motorhil.emulators.cia402 import settings as drive_settings
from motorhil.emulators.cia402.settings import CATALOGUE, SWITCH_KEYS
from motorhil.emulators.controller import SettingError
from motorhil.emulators.modbus import drive as modbus_drive
from motorhil.emulators.plant.dc_motor import RANGES, MotorPlant
from motorhil.emulators.plant.nonlinear import EXTRAS, NO_EXTRAS
from motorhil.emulators.plant.nonlinear import RANGES as EXTRAS_RANGES
from motorhil.emulators.plant.presets import PRESETS
from motorhil.emulators.settings.protection import (
    DEFAULT_PROTECTION,
    PROTECTION_KEYS,
    STO_ERROR,
    STO_REACTIONS,
    TEMPERATURE_RANGE_C,
    VOLTAGE_RANGE_V,
)
from motorhil.emulators.settings.tables import JITTER_MAX_S, OSCILLATOR_KEYS, PHASE_MAX_S, PPM_MAX
from motorhil.harness.plugins import ADAPTATIONS, installed
from motorhil.harness.rig.config import buses as rig_buses
from motorhil.harness.rig.config import buses as rig_nodes
from motorhil.harness.rig.config import faults as rig_faults
from motorhil.harness.rig.config import faults as rig_line_faults
from motorhil.harness.rig.config import rig_file
from motorhil.harness.rig.config import stimuli as rig_stimuli
from motorhil.harness.rig.config.conformance import CONFORMANCE_KEYS, NOTHING_DECLARED, Capability
from motorhil.harness.rig.config.derived import ASKED
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.rig import installed_plugins
from motorhil.motorapi.adaptations.cia402.settings import HwOptions
from motorhil.motorapi.adaptations.host_servo import motor as software
from motorhil.motorapi.adaptations.host_servo.settings import IoOptions
from motorhil.motorapi.adaptations.ideal import motor as ideal
from motorhil.motorapi.model import MotorModel
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

SCHEMA = json.loads((Path(harness.__file__).parent / "rig.schema.json").read_text())
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


def test_schema_has_the_keys_of_the_readers():
    assert tuple(SCHEMA["properties"]) == rig_file.TOP_KEYS
    assert tuple(DEFS["rig"]["properties"]) == rig_file.RIG_KEYS
    assert tuple(DEFS["bus"]["properties"]) == rig_buses.BUS_KEYS
    assert tuple(DEFS["group"]["properties"]) == rig_file.GROUP_KEYS
    fault = DEFS["fault"]["properties"]
    assert tuple(fault) == (*rig_faults.FAULT_KEYS, *rig_line_faults.LINE_KEYS)
    assert tuple(DEFS["stimulus"]["properties"]) == rig_stimuli.STIMULUS_KEYS
    conformance = DEFS["conformance"]["properties"]
    assert tuple(conformance) == CONFORMANCE_KEYS
    assert conformance["claims"]["items"]["enum"] == [one.key for one in Capability]
    assert list(conformance["without"]["properties"]) == [one.key for one in Capability]
    assert conformance["fault_code"]["default"] == NOTHING_DECLARED.fault_code
    kinds = [kind.value for kind in FaultKind]
    kinds += [kind for kind in rig_line_faults.LINE_FAULT_KINDS if kind not in kinds]
    assert fault["kind"]["enum"] == kinds
    assert tuple(DEFS["node"]["properties"]) == rig_nodes.NODE_KEYS
    assert DEFS["node"]["properties"]["queue"]["enum"] == list(rig_nodes.QUEUES)
    assert fault["error"]["enum"] == list(rig_faults.ERRORS)
    assert fault["level"]["enum"] == list(rig_faults.LEVELS)
    bus = DEFS["bus"]["properties"]
    assert bus["kind"]["enum"] == list(rig_buses.BUS_KINDS)
    assert bus["parity"]["enum"] == list(rig_buses.PARITIES)


def test_schema_has_the_keys_of_a_cia402_drive():
    drive = DEFS["cia402"]["properties"]
    assert set(drive) == {"kind", "bus", *drive_settings._KEYS}
    assert set(drive["timing"]["properties"]) == set(drive_settings._TIMING_KEYS)
    assert set(drive["units"]["properties"]) == set(drive_settings._UNIT_KEYS)
    listed, tabled = drive["quirks"]["oneOf"]
    assert listed["items"]["enum"] == [quirk.name for quirk in CATALOGUE]
    assert tuple(tabled["properties"]) == tuple(quirk.name for quirk in CATALOGUE)
    for quirk in CATALOGUE:
        parameters = tabled["properties"][quirk.name]["oneOf"][1]["properties"]
        assert {key: one["default"] for key, one in parameters.items()} == quirk.parameters
    protection = drive["protection"]["properties"]
    assert tuple(protection) == PROTECTION_KEYS
    assert protection["sto"]["enum"] == list(STO_REACTIONS)
    assert protection["sto_error_code"]["default"] == STO_ERROR
    assert protection["i2t_warning"]["default"] == DEFAULT_PROTECTION.i2t_warning
    for key in ("over_voltage_v", "under_voltage_v"):
        assert (protection[key]["minimum"], protection[key]["maximum"]) == VOLTAGE_RANGE_V
    for key in (key for key in PROTECTION_KEYS if "temperature" in key):
        assert protection[key]["default"] == getattr(DEFAULT_PROTECTION, key)
        limits = (protection[key]["minimum"], protection[key]["maximum"])
        assert limits == TEMPERATURE_RANGE_C
    assert tuple(drive["switches"]["properties"]) == SWITCH_KEYS
    assert drive["plant"] == {"$ref": "#/$defs/plant"}
    assert drive["supported_modes"]["items"]["enum"] == list(drive_settings.EMULATED_MODES)


def test_schema_has_the_keys_of_a_plant():
    plant = DEFS["plant"]["properties"]
    linear = [field.name for field in fields(MotorPlant) if field.name != "extras"]
    assert set(plant) == {"preset", "from_motor_model", *linear, *EXTRAS}
    for name, limits in (*RANGES.items(), *EXTRAS_RANGES.items()):
        assert (plant[name]["minimum"], plant[name]["maximum"]) == limits
    for name in EXTRAS:
        assert plant[name]["default"] == getattr(NO_EXTRAS, name)
    assert plant["preset"]["examples"] == list(PRESETS)


def test_schema_has_the_keys_of_an_oscillator():
    clock = DEFS["oscillator"]["properties"]
    assert tuple(clock) == OSCILLATOR_KEYS
    assert (clock["ppm"]["minimum"], clock["ppm"]["maximum"]) == (-PPM_MAX, PPM_MAX)
    assert (clock["ppm_max"]["minimum"], clock["ppm_max"]["maximum"]) == (0, PPM_MAX)
    for key in ("phase_s", "phase_max_s"):
        assert (clock[key]["minimum"], clock[key]["maximum"]) == (0, PHASE_MAX_S)
    assert (clock["jitter_s"]["minimum"], clock["jitter_s"]["maximum"]) == (0, JITTER_MAX_S)
    for kind in ("cia401", "cia402"):
        assert DEFS[kind]["properties"]["oscillator"] == {"$ref": "#/$defs/oscillator"}


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


def test_schema_has_the_keys_of_an_io_node():
    node = DEFS["cia401"]["properties"]
    assert set(node) == {"kind", "bus", *node_settings.KEYS}
    assert set(node["timing"]["properties"]) == set(node_settings.TIMING_KEYS)
    channel = node["channel"]["additionalProperties"]["properties"]
    assert set(channel) == set(node_settings.CHANNEL_KEYS)
    assert set(DEFS["amplifier"]["properties"]) == set(node_settings.AMPLIFIER_KEYS)
    for table in (node, channel):
        assert table["plant"] == {"$ref": "#/$defs/plant"}
        assert table["amplifier"] == {"$ref": "#/$defs/amplifier"}
    assert node["channels"]["maximum"] == node_settings.CHANNELS_MAX


def test_schema_has_the_keys_of_a_software_motor():
    motor = DEFS["software_motor"]["properties"]
    own = {"channel", "current_per_volt_a_v", "gains", *software._TORQUE.values()}
    in_units = {key.format(u=u) for key in software._SETTINGS.values() for u in ("rad", "m")}
    options = {field.name for field in fields(IoOptions)}
    common = {"adaptation", "controller", "bus", "node_id", "model"}
    assert set(motor) == common | own | in_units | options
    for field in fields(IoOptions):
        assert motor[field.name].get("default") == field.default
    gains = {key.format(u=u) for key in software._GAINS.values() for u in ("rad", "m")}
    assert set(motor["gains"]["properties"]) == {software._BANDWIDTH, *gains}


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


def test_schema_has_the_keys_of_a_cia402_motor():
    common = {"adaptation", "controller", "bus", "node_id", "model"}
    own = {field.name for field in fields(HwOptions)} | {ASKED}  # which the rig removes
    assert set(DEFS["cia402_motor"]["properties"]) == common | own
    for field in fields(HwOptions):
        assert DEFS["cia402_motor"]["properties"][field.name].get("default") == field.default


def test_schema_has_the_keys_of_an_ideal_motor():
    own = {"axis", *(key for keys in ideal._KEYS.values() for key in keys)}
    assert set(DEFS["ideal_motor"]["properties"]) == {"adaptation", "model", *own}


@pytest.mark.parametrize("adaptation", sorted(installed(ADAPTATIONS)))
def test_schema_requires_a_bus_if_the_adaptation_needs_one(adaptation):
    motor = {"adaptation": adaptation, "model": "wheel.toml"}
    needs_bus = installed_plugins().needs_bus(adaptation)
    assert VALIDATOR.is_valid({"motor": {"m": motor}}) is not needs_bus
    servo = {"current_per_volt_a_v": 0.8, "gains": {"kp_a_rad": 1.0}}
    own = servo if adaptation == "software" else {}
    kinds = getattr(installed(ADAPTATIONS)[adaptation].load(), "bus_kinds", ("can",))
    if "can" in kinds:
        bus, place = {"can0": {"bitrate_bit_s": 500_000}}, {"bus": "can0", "node_id": 1}
    else:
        bus, place = {"rs485": {"kind": "modbus_rtu"}}, {"bus": "rs485", "unit": 1}
    placed = {"bus": bus, "motor": {"m": {**motor, **own, **place}}}
    assert VALIDATOR.is_valid(placed) is needs_bus


@pytest.mark.parametrize("kind", ["leadshine_pr", "oriental_az"])
def test_schema_has_the_keys_of_the_modbus_drives(kind):
    drive = DEFS[kind]["properties"]
    own = {"trigger_auto_clear"} if kind == "oriental_az" else set()
    assert set(drive) == {"kind", "bus", *modbus_drive.KEYS, *own}
    assert tuple(drive["timing"]["properties"]) == modbus_drive.TIMING_KEYS
    assert tuple(drive["switches"]["properties"]) == modbus_drive.SWITCH_KEYS
    assert drive["plant"] == {"$ref": "#/$defs/plant"}


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
        assert set(written) <= set(DEFS["model"]["properties"])


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_schema_accepts_every_example(path):
    table = tomllib.loads(path.read_text())
    if "motor" in table:  # a rig; the others are motor models
        VALIDATOR.validate(table)
    else:
        VALIDATOR.evolve(schema={**DEFS["model"], "$defs": DEFS}).validate(table)


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
    st.tuples(st.just("switches"), odd_table(SWITCH_KEYS)),
    st.tuples(st.just("protection"), odd_table(PROTECTION_KEYS)),
    st.tuples(st.just("cyclic"), odd_table(drive_settings._CYCLIC_KEYS)),
    st.tuples(st.just("oscillator"), odd_table(OSCILLATOR_KEYS)),
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
