"""Every option that an adaptation or a drive declares is stated by a bench of the kit."""

import tomllib

import pytest

from motorhil.emulators.cia402.settings import CATALOGUE
from motorhil.harness.conformance.benches import variations
from motorhil.harness.plugins import ADAPTATIONS, CONTROLLERS, SETTINGS, installed
from motorhil.settings import TableOf, declaration
from tests.conformance import variants
from tests.conformance.drives import rigs
from tests.support.kit_benches import RIGS

SAME_FOR_ALL = ("plant", "servo", "oscillator", "initial_position_rad", "switches")
"""Tables of every drive with a motor, which one class reads: stated for one kind, all have them."""


def declared(of, path=()):
    """Yield the keys of a class of settings, those of its tables after a dot."""
    table = declaration(of)
    for name, field in table.names("rad").items():
        kind = table.keys[field].kind
        if isinstance(kind, TableOf):
            yield from declared(kind.of, (*path, name))
        elif name == "quirks":
            yield from (f"quirks.{one.name}" for one in CATALOGUE)
        else:
            yield ".".join((*path, name))


def given(values, path=()):
    """Yield the keys of a table of a rig, and the words of its lists."""
    for key, value in values.items():
        yield ".".join((*path, key))
        if isinstance(value, dict):
            yield from given(value, (*path, key))
        elif isinstance(value, list):
            yield from (".".join((*path, key, str(one))) for one in value)


def texts():
    """Yield the texts of all benches: of the kit, varied, and of drives."""
    for path in RIGS.glob("*.toml"):
        text = path.read_text()
        yield text
        for name in variations.applicable(text):
            yield variations.text_of(text, variations.VARIATIONS[name])
    for changes in variants.VARIANTS.values():
        yield variants.text_of(changes)
    yield from map(rigs.text_of, rigs.DRIVES.values())


@pytest.fixture(scope="module")
def stated():
    """Return the stated keys by kind of controller, and by adaptation."""
    found = {CONTROLLERS: {}, ADAPTATIONS: {}}
    for text in texts():
        rig = tomllib.loads(text)
        for group, table, kind in (
            (CONTROLLERS, "controller", "kind"),
            (ADAPTATIONS, "motor", "adaptation"),
        ):
            for one in rig.get(table, {}).values():
                one.pop("model", None) if table == "motor" else None
                found[group].setdefault(one[kind], set()).update(given(one))
    return found


_FILE = "a file"
NOT_STATED = {
    "name": "the motor's own in a rig",
    "node_id": "the controller's in a rig",
    "unit": "the controller's in a rig",
    "eds": _FILE,
    "nonvolatile_memory": _FILE,
    "node_id_by_lss": "LSS-02 takes the node-ID away and gives it again",
    "moteus rotor_to_output_ratio": "the model's gear ratio tells it, too",
    "moteus can_prefix": "the adaptation speaks to no other prefix",
    "moteus kp_n_m_rev": "the gains of the rig's servo",
    "moteus kd_n_m_s_rev": "the gains of the rig's servo",
    "vesc position_divider": "of other encoders, and the motor's position_turns then",
    "vesc voltage_min_v": "needs a DC link",
    "vesc voltage_max_v": "needs a DC link",
    "vesc temperature_max_c": "needs a thermal model",
    "dynamixel model": "the adaptation knows one",
    "software counter": "of nodes with CiA 406, by their file",
    "cia401 channel": "another spelling of channels",
    "cia401 objects": "the power-on values of a file",
    "leadshine_pr registers": "the power-on values of the drive",
}
"""Options that no bench states, and why; of one kind, or of all."""
GAINS = ("servo.current_k", "servo.position_k", "servo.velocity_", "servo.acceleration_f")
"""Gains of the emulated servo, in place of the tuned ones; without a standard."""


def missing(stated, group, name, of_all=()):
    keys = set(declared(installed(SETTINGS[group])[name].load()))
    keys -= stated[group].get(name, set()) | set(of_all)
    return {one for one in keys if one not in NOT_STATED and f"{name} {one}" not in NOT_STATED}


@pytest.mark.parametrize("name", sorted(installed(SETTINGS[ADAPTATIONS])))
def test_every_option_of_an_adaptation_is_stated(stated, name):
    assert missing(stated, ADAPTATIONS, name) == set()


@pytest.mark.parametrize("name", sorted(set(installed(SETTINGS[CONTROLLERS])) - {"recorded"}))
def test_every_option_of_a_drive_is_stated(stated, name):
    every = set().union(*stated[CONTROLLERS].values())
    shared = {one for one in every if one.startswith(SAME_FOR_ALL)}
    left = missing(stated, CONTROLLERS, name, shared)
    assert {one for one in left if not one.startswith(("amplifier.current_", *GAINS))} == set()


def test_exceptions_are_options_that_no_bench_states(stated):
    for key in NOT_STATED:
        kind, _, option = key.rpartition(" ")
        tables = [stated[group].get(kind, set()) for group in stated] if kind else []
        assert not any(option in table for table in tables), key
