"""Description of a device, independent of the file format."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from motorhil.emulators.canopen.object_dictionary import (
    ObjectDictionary,
    Value,
    Variable,
    zero,
)

_IDENTITY: Final = 0x1018


@final
@dataclass(frozen=True, slots=True)
class VariableDescription:
    """The description of one sub-index in a file, at `line`; `default` None: not stated.

    `follows_node_id`: the default is an offset to $NODEID.
    """

    index: int
    subindex: int
    name: str
    data_type: int
    access: str
    pdo_mappable: bool
    limits: tuple[int | None, int | None]
    default: Value | None
    line: int
    follows_node_id: bool = False

    def variable(self) -> Variable:
        """Return a new variable as described."""
        variable = Variable(
            *(self.index, self.subindex, self.data_type, self.name, self.access),
            *(self.pdo_mappable, self.limits, self.default),
        )
        variable.follows_node_id = self.follows_node_id
        return variable


@final
class DeviceDescription:
    """The description of a device in an EDS or DCF, for one node-ID.

    Attributes:
        path: the file.
        vendor_name, product_name, order_code: [DeviceInfo]; "" if not stated.
        vendor_number, product_number, revision_number: [DeviceInfo]; 0 if not stated.
        node_id: the value of $NODEID.
        supports_lss: [DeviceInfo] LSS_Supported.
        objects: every sub-index, by index and sub-index.
        dummies: data types an RPDO may map as dummies.
        warnings: (path, line, text) of everything that was repaired or left out.
    """

    def __init__(self, path: Path, node_id: int) -> None:
        self.path = path
        self.node_id = node_id
        self.vendor_name = ""
        self.product_name = ""
        self.order_code = ""
        self.vendor_number = 0
        self.product_number = 0
        self.revision_number = 0
        self.supports_lss = False
        self.objects: tuple[VariableDescription, ...] = ()
        self.dummies: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7)
        self.warnings: tuple[tuple[Path, int, str], ...] = ()
        self._pattern: ObjectDictionary | None = None  # of `objects`, which are final by then

    def dictionary(self) -> ObjectDictionary:
        """Return a new object dictionary; `Variable.has_default` marks values stated in the file.

        If 1018h states no identity, that of [DeviceInfo] is used.
        """
        if self._pattern is None:
            self._pattern = ObjectDictionary()
            for description in self.objects:
                self._pattern.add(description.variable())
        od = ObjectDictionary(self._pattern)
        od.dummies = self.dummies
        od.node_id = self.node_id
        od.supports_lss = self.supports_lss
        numbers = (self.vendor_number, self.product_number, self.revision_number)
        for subindex, number in enumerate(numbers, start=1):
            variable = od.get(_IDENTITY, subindex)
            if variable is not None and not variable.has_default and number:
                variable.set_default(number)
        return od

    def supplied(self, od: ObjectDictionary, but: Collection[tuple[int, int]]) -> list[str]:
        """Report the power-on values that the device supplies because the file states none.

        Args:
            od: the dictionary of the built device.
            but: places whose values the rig states; [DeviceInfo] states those of 1018h.

        Returns:
            One line; [] if the file states all values.
        """
        values = []
        for one in self.objects:
            variable = od.get(one.index, one.subindex)
            if variable is None or one.default is not None or one.index == _IDENTITY:
                continue
            is_zero = variable.default == zero(variable.data_type)
            if not is_zero and (one.index, one.subindex) not in but:
                place = f"{one.index:04X}h" + (f":{one.subindex}" if one.subindex else "")
                values.append(f"{place} = {variable.default!r}")
        if not values:
            return []
        text = f"{self.path.name} states no power-on value of these objects"
        return [f"{text}; used: {', '.join(values)}; set others in the rig: objects"]
