"""Identifiers that PDO, SYNC, TIME and EMCY may not use."""

import pytest

from motorhil.emulators.canopen.codes import is_restricted

RESTRICTED = (  # CiA 301, 7.3.5, restricted CAN-IDs
    *((0x000, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF)),
    (0x701, 0x7FF),
)


@pytest.mark.parametrize(("first", "last"), RESTRICTED)
def test_restricted_identifiers_are_those_of_the_standard(first, last):
    assert (is_restricted(first), is_restricted(last)) == (True, True)
    assert not first or not is_restricted(first - 1)
    assert last == 0x7FF or not is_restricted(last + 1)
