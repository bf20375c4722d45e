"""EDS and DCF files (CiA 306): read where the meaning is plain, refused in one line otherwise."""

from pathlib import Path
from typing import final

from emulators.canopen.object_dictionary import ObjectDictionary


@final
class EdsError(Exception):
    """A file cannot be read as an EDS. Facts: path, line (0: whole file), text, remedy."""

    def __init__(self, path: Path, line: int, text: str, remedy: str) -> None:
        self.path = path
        self.line = line
        self.text = text
        self.remedy = remedy
        place = f"{path}:{line}" if line else str(path)
        super().__init__(f"{place}: {text}; {remedy}")


@final
class DeviceDescription:
    """What an EDS or DCF says of a device, for one node-ID.

    Attributes:
        path: the file.
        vendor_name, product_name, order_code: [DeviceInfo]; "" where it says nothing.
        vendor_number, product_number, revision_number: [DeviceInfo]; 0 where it says nothing.
        node_id: what $NODEID stood for.
        warnings: (path, line, text) of everything that was repaired or left out.
    """

    path: Path
    vendor_name: str
    product_name: str
    order_code: str
    vendor_number: int
    product_number: int
    revision_number: int
    node_id: int
    warnings: tuple[tuple[Path, int, str], ...]

    def dictionary(self) -> ObjectDictionary:
        """A new object dictionary: `Variable.has_default` tells where the file states a value."""
        raise NotImplementedError


def read_eds(path: Path, node_id: int) -> DeviceDescription:
    """The file is read and repaired where its meaning is plain.

    Raises:
        EdsError: it cannot be read; names file, line and remedy.
    """
    raise NotImplementedError
