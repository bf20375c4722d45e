"""The host's table of objects against an EDS, which was written without it."""

from configparser import ConfigParser

import pytest

from motorhil.motorapi.adaptations.cia402.objects import OBJECTS
from tests.support.checkout import CHECKOUT

TYPES = {"i8": 2, "i16": 3, "i32": 4, "u8": 5, "u16": 6, "u32": 7, "string": 9}  # CiA 306
ELSEWHERE = {"vl_target_velocity", "position_demand_internal_value", "digital_outputs"}
EDS = ConfigParser(interpolation=None)
EDS.read(CHECKOUT / "emulators" / "eds" / "motorhil_cia402.eds")


@pytest.mark.parametrize("name", sorted(set(OBJECTS.by_name) - ELSEWHERE))
def test_named_object_is_in_the_eds_with_its_type(name):
    index, subindex, kind = OBJECTS.by_name[name]
    section = f"{index:04X}sub{subindex:X}"
    if section not in EDS:
        assert subindex == 0
        section = f"{index:04X}"
    assert int(EDS[section]["DataType"], 16) == TYPES[kind]
