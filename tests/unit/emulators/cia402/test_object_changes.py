"""Kinds of written objects have one bit each.

The position limits once had the bit of the touch probe; every write to them set up the probe again.
"""

import pytest

from motorhil.emulators.canopen.codes import OK
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from motorhil.emulators.cia402.objects.changes import ObjectChange, ObjectChanges, watch


@pytest.mark.parametrize(("index", "subindex"), [(0x607C, 0), (0x607D, 1), (0x607D, 2)])
def test_position_limit_write_leaves_the_touch_probe_alone(index, subindex):
    od, changes = ObjectDictionary(), ObjectChanges()
    variable = od.add(Variable(index, subindex, DataType.INTEGER32))
    watch(od, changes)
    assert variable.write_integer(1000) == OK
    assert changes.pending == ObjectChange.POSITION_LIMITS
    assert not changes.pending & ObjectChange.TOUCH_PROBE


def test_object_changes_have_different_bits():
    values = [kind.value for kind in ObjectChange.__members__.values()]
    assert values == [1 << place for place in range(len(values))]
