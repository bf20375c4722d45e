"""Elements that a page offers: inputs by the values that they take, kinds of faults of each bus."""

import pytest

from motorhil.emulators.cia402.drive import STIMULI
from motorhil.harness.hands.elements import elements_of, names_of, needed
from motorhil.harness.rig.config.faults import KINDS, LINE_FAULT_KINDS, FaultTable
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.rig import Rig
from motorhil.settings import parse_toml, read


@pytest.fixture
def elements():
    """Return a function that gives the elements of an example's rig."""

    def of(name):
        with Rig.open(EXAMPLES / f"{name}.toml") as rig:
            return elements_of(rig.description, rig.acts)

    return of


def kinds(controller):
    return {one["name"]: one["kind"] for one in controller["inputs"]}


def test_inputs_of_a_drive_are_known_by_their_values(elements):
    left, _ = elements("two_wheels")["controllers"]
    found = kinds(left)
    assert set(STIMULI) - set(found) == {"supply_v"}  # the plant has no source resistance
    assert found["load_torque_n_m"] == found["device_temperature_c"] == "number"
    assert found["fault"] == "code"
    assert found["power"] == found["sto"] == found["short_circuit"] == "toggle"
    assert found["home"] == found["negative_limit"] == "switch"


def test_range_of_the_load_is_twice_the_motor_torque(elements):
    left, _ = elements("two_wheels")["controllers"]
    load = next(one for one in left["inputs"] if one["name"] == "load_torque_n_m")
    assert load["high"] == pytest.approx(2 * 0.0259 * 8.0 * 66.0)
    assert (load["low"], load["rest"], load["unit"]) == (-load["high"], 0.0, "N·m")


def test_every_example_has_inputs(elements):
    for path in sorted(EXAMPLES.glob("*.toml")):
        if "[controller." in path.read_text():
            for one in elements(path.stem)["controllers"]:
                assert kinds(one)["load_torque_n_m"] == "number", one["name"]


def test_kinds_of_faults_depend_on_the_bus(elements):
    buses = {one["name"]: one for one in elements("four_protocols")["buses"]}
    found = {name: tuple(one["kind"] for one in bus["kinds"]) for name, bus in buses.items()}
    assert KINDS in found.values()
    assert LINE_FAULT_KINDS in found.values()


@pytest.mark.parametrize("is_line", [False, True])
def test_keys_of_each_kind_are_complete(is_line):
    for kind in LINE_FAULT_KINDS if is_line else KINDS:
        keys = parse_toml(f"keys = {{ {needed(kind, is_line, 'left')} }}")["keys"]
        assert read(FaultTable, {"bus": "b", "kind": kind, **keys}).kind == kind


def test_controller_without_names_has_no_inputs():
    class Odd:
        def stimulate(self, name, value, now_ns):
            raise self.error

    odd = Odd()
    for odd.error in (ValueError("no"), ZeroDivisionError()):
        assert names_of(odd) == []
    odd.error = ValueError("there is no such input; known: a, b_n_m")
    assert names_of(odd) == ["a", "b_n_m"]
