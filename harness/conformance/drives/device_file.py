"""The EDS of a drive, read by canopen: what the drive promises of its dictionary."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final, final

import canopen
from canopen.objectdictionary import ODVariable, datatypes

from motorhil.frozen import frozen
from motorhil.harness.conformance.clause import NotApplicable

_LAST_TYPE: Final = 0x0FFF  # indices of data types
_WHOLE: Final = (*datatypes.SIGNED_TYPES, *datatypes.UNSIGNED_TYPES)
_TEXTS: Final = (datatypes.VISIBLE_STRING, datatypes.OCTET_STRING)

_SENT: Final = ("ro", "rw", "rwr", "const")  # access types of what a TPDO may map


@final
@frozen
class StatedObject:
    """An object as the EDS states it.

    Attributes:
        index, subindex: its place.
        name: its name.
        access: "ro", "wo", "const", or another one, by which it can be read and written.
        size: the number of its bytes; 0: it is not a whole number.
        is_signed: it is a whole number with a sign.
        is_text: it is a text.
        sent_bits: the number of bits in a TPDO; 0: the EDS does not let a TPDO map it.
        low, high: LowLimit and HighLimit; None: not stated.
    """

    index: int
    subindex: int
    name: str
    access: str
    size: int
    is_signed: bool
    is_text: bool
    sent_bits: int
    low: int | None
    high: int | None


@final
@frozen
class DeviceFile:
    """An EDS.

    Attributes:
        objects: all objects but domains, which can be of any size.
        granularity: the number of bits on whose multiples a PDO maps objects; 0: it maps none.
        dummies: the data types that an RPDO maps to fill space.
    """

    objects: tuple[StatedObject, ...]
    granularity: int
    dummies: tuple[int, ...]


def read_file(path: Path, node_id: int) -> DeviceFile:
    """Return the EDS in a file.

    Raises:
        NotApplicable: canopen cannot read it.
    """
    try:
        read = canopen.import_od(str(path), node_id)
    except Exception as error:  # canopen's errors have no base
        raise NotApplicable(f"canopen cannot read {path.name}: {error}") from None
    types = tuple(index for index in read if index <= _LAST_TYPE)
    granularity = read.device_information.granularity or 0
    return DeviceFile(tuple(_objects(read)), granularity, types)


def _sent_bits(one: ODVariable) -> int:
    if not one.pdo_mappable or one.access_type not in _SENT:
        return 0
    if one.data_type == datatypes.BOOLEAN:
        return 1
    return len(one) if one.data_type in (*_WHOLE, *datatypes.FLOAT_TYPES) else 0


def _objects(read: canopen.ObjectDictionary) -> Iterator[StatedObject]:
    for entry in read.values():
        for one in (entry,) if isinstance(entry, ODVariable) else entry.values():
            kind, is_whole = one.data_type, one.data_type in _WHOLE
            if one.index > _LAST_TYPE and kind != datatypes.DOMAIN:
                yield StatedObject(
                    *(one.index, one.subindex, one.name, one.access_type),
                    size=-(-len(one) // 8) if is_whole else 0,
                    is_signed=kind in datatypes.SIGNED_TYPES,
                    is_text=kind in _TEXTS,
                    sent_bits=_sent_bits(one),
                    low=one.min,
                    high=one.max,
                )
