"""Reader of EDS and DCF files (CiA 306) with repairs and warnings.

`read_eds` returns a `DeviceDescription`, which makes any number of object dictionaries. In a DCF a
ParameterValue overrides the DefaultValue. Hexadecimal numbers of signed types are two's complement.
$NODEID is the requested node-ID. The sections define the objects; lists and counts that disagree
cause a warning. Every repair and omission causes a warning with file and line. A file without a
plain meaning is refused with one line.
"""

import re
from pathlib import Path
from typing import Final, final

from emulators.canopen.device_description import DeviceDescription as DeviceDescription
from emulators.canopen.device_description import VariableDescription
from emulators.canopen.eds_text import EdsError as EdsError
from emulators.canopen.eds_text import EdsText, Field, Section, read_file
from emulators.canopen.eds_values import fit, parse_integer, parse_value, type_name
from emulators.canopen.object_dictionary import DataType, Value, is_integer

_OBJECT: Final = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?")
_LISTS: Final = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_DEFTYPE: Final = (0, 5, 6)  # NULL, DEFTYPE, DEFSTRUCT: objects without a value
_DOMAIN: Final = 2
_VAR: Final = 7
_ARRAY: Final = 8
_RECORD: Final = 9
_ACCESS: Final = ("ro", "wo", "rw", "rwr", "rww", "const")
_ACCESS_WORDS: Final = {
    "r": "ro",
    "w": "wo",
    "readonly": "ro",
    "writeonly": "wo",
    "readwrite": "rw",
    "r/w": "rw",
    "rw/r": "rwr",
    "rw/w": "rww",
    "constant": "const",
    "c": "const",
}
_NO_FIELD: Final = Field("", 0)


_FILES_KEPT: Final = 16
_MAY_NAME_NODE_ID: Final = ("parametervalue", "defaultvalue", "lowlimit", "highlimit")


def read_eds(path: Path, node_id: int) -> DeviceDescription:
    """Read a file, repair it if its meaning is plain, and return the cached description.

    Raises:
        EdsError: the file cannot be read; names file, line and remedy.
    """
    path = Path(path)
    data = read_file(path)
    known = _known.get((path, data))
    if known is None:
        known = _File(EdsText(path, data))
        while len(_known) >= _FILES_KEPT:
            del _known[next(iter(_known))]
        _known[path, data] = known
    return known.description(node_id)


@final
class _File:
    """A parsed file for one or more node-IDs; drives of a kind share most of it."""

    def __init__(self, text: EdsText) -> None:
        self._text = text
        self._descriptions: dict[int, DeviceDescription] = {}
        self._pattern: _Reader | None = None  # holds what is the same for any node-ID

    def description(self, node_id: int) -> DeviceDescription:
        """Return the description for this node-ID."""
        description = self._descriptions.get(node_id)
        if description is None:
            pattern = self._pattern
            description = None if pattern is None else pattern.read_again(node_id)
            if description is None:
                reader = _Reader(self._text, node_id)
                description = reader.read()
                if reader.is_pattern():
                    self._pattern = reader
            self._descriptions[node_id] = description
        return description


_known: Final[dict[tuple[Path, bytes], _File]] = {}


@final
class _Reader:
    """A converter from the sections of one file to a description."""

    def __init__(self, text: EdsText, node_id: int) -> None:
        self._text = text
        self._node_id = node_id
        self._found: dict[int, VariableDescription] = {}
        self._warnings = list(text.warnings)
        self._description = DeviceDescription(text.path, node_id)
        self._with_node_id: list[tuple[int, int, Section, int]] = []  # _add's arguments
        self._said_with_node_id = False  # one caused a warning

    def is_pattern(self) -> bool:
        """Return whether another node-ID changes only values and limits that name it."""
        if self._said_with_node_id or "devicecommissioning" in self._text.sections:
            return False
        if "devicecomissioning" in self._text.sections:
            return False
        for section in self._text.sections.values():
            naming = [key for key, field in section.fields.items() if "$" in field.text]
            if naming and not all(key in _MAY_NAME_NODE_ID for key in naming):
                return False
            if naming and not any(section is known for _, _, known, _ in self._with_node_id):
                return False
        return True

    def read_again(self, node_id: int) -> DeviceDescription | None:
        """Return the description for another node-ID, after `read`; None on a warning."""
        other = _Reader(self._text, node_id)
        other._found = dict(self._found)
        for index, subindex, section, object_type in self._with_node_id:
            other._add(index, subindex, section, object_type)
        if other._said_with_node_id:
            return None
        mine, its = self._description, other._description
        its.vendor_name, its.vendor_number = mine.vendor_name, mine.vendor_number
        its.product_name, its.product_number = mine.product_name, mine.product_number
        its.order_code, its.revision_number = mine.order_code, mine.revision_number
        its.supports_lss = mine.supports_lss
        its.dummies, its.warnings = mine.dummies, mine.warnings
        its.objects = tuple(other._found[key] for key in sorted(other._found))
        return its

    def _warn(self, line: int, text: str) -> None:
        self._warnings.append((self._text.path, line, text))

    def read(self) -> DeviceDescription:
        description = self._description
        self._read_identity(description)
        self._read_dummies(description)
        self._check_commissioning()
        indices: dict[int, dict[int, Section]] = {}
        mains: dict[int, Section] = {}
        for name, section in self._text.sections.items():
            match = _OBJECT.fullmatch(name)
            if match is None:
                continue
            index = int(match[1], 16)
            if match[2] is None:
                mains[index] = section
            else:
                indices.setdefault(index, {})[int(match[2], 16)] = section
        for index in sorted({**mains, **indices}):
            self._read_object(index, mains.get(index), indices.get(index, {}))
        if not self._found:
            remedy = "give an EDS or DCF file with sections such as [1000]"
            raise EdsError(self._text.path, 0, "no objects found", remedy)
        self._check_lists(mains, indices)
        description.objects = tuple(self._found[key] for key in sorted(self._found))
        description.warnings = tuple(sorted(self._warnings, key=lambda warning: warning[1]))
        return description

    # --- other sections

    def _read_identity(self, description: DeviceDescription) -> None:
        section = self._text.sections.get("deviceinfo")
        if section is None:
            self._warn(1, "no [DeviceInfo]")
            return
        description.vendor_name = section.text("vendorname")
        description.product_name = section.text("productname")
        description.order_code = section.text("ordercode")
        description.vendor_number = self._number(section, "vendornumber", 0)
        description.product_number = self._number(section, "productnumber", 0)
        description.revision_number = self._number(section, "revisionnumber", 0)
        description.supports_lss = self._number(section, "lss_supported", 0) != 0

    def _read_dummies(self, description: DeviceDescription) -> None:
        section = self._text.sections.get("dummyusage")
        if section is None:
            return
        usable = []
        for data_type in DataType:
            if self._number(section, f"dummy{data_type:04x}", 0):
                usable.append(int(data_type))
        description.dummies = tuple(usable)

    def _check_commissioning(self) -> None:
        for name in ("devicecomissioning", "devicecommissioning"):
            section = self._text.sections.get(name)
            field = section.get("nodeid") if section else None
            if section is None or field is None:
                continue
            node_id = self._number(section, "nodeid", self._node_id)
            if node_id != self._node_id:
                text = f"written for node {node_id}, used for node {self._node_id}"
                self._warn(field.line, f"{text}: identifiers without $NODEID stay as they are")

    def _check_lists(self, mains: dict[int, Section], subs: dict[int, dict[int, Section]]) -> None:
        """Warn about lists of objects that are too long or too short; the sections decide."""
        for name in _LISTS:
            section = self._text.sections.get(name)
            if section is None:
                continue
            listed = 0
            for key, field in section.fields.items():
                if not key.isdigit() or not field.text:
                    continue
                listed += 1
                index = self._number(section, key, -1)
                if index not in mains and index not in subs:
                    self._warn(field.line, f"{field.text} is listed but not described")
            stated = section.get("supportedobjects")
            if stated and self._number(section, "supportedobjects", listed) != listed:
                text = f"SupportedObjects says {stated.text}, {listed} are listed"
                self._warn(stated.line, text)

    # --- objects

    def _read_object(self, index: int, main: Section | None, subs: dict[int, Section]) -> None:
        if main is None:
            line = min(section.line for section in subs.values())
            self._warn(line, f"sub-indices of {index:04X}h, which has no section of its own")
            main = Section(f"{index:04x}", line)
        object_type = self._number(main, "objecttype", _RECORD if subs else _VAR)
        if object_type in _DEFTYPE or index < 0x1000:
            return
        if self._number(main, "compactsubobj", 0):
            self._read_compact(index, main)
        elif not subs:
            if object_type in (_ARRAY, _RECORD):
                self._warn(main.line, f"{index:04X}h has no sub-index; left out")
            else:
                self._add(index, 0, main, object_type)
            return
        for subindex, section in sorted(subs.items()):
            self._add(index, subindex, section, self._number(section, "objecttype", _VAR))
        if index << 8 not in self._found:
            self._warn(main.line, f"{index:04X}h lacks sub-index 0; made up")
            self._add_count(index, max(subs), main.line)
        stated = main.get("subnumber")
        if stated and subs and self._number(main, "subnumber", 0) != len(subs):
            text = f"SubNumber of {index:04X}h says {stated.text}, {len(subs)} are described"
            self._warn(stated.line, text)

    def _read_compact(self, index: int, main: Section) -> None:
        """Read CompactSubObj: one description for sub-indices 1..n, names and values in lists."""
        count = self._number(main, "compactsubobj", 0)
        if not 1 <= count <= 254:
            raise self._error(main.fields["compactsubobj"], "is not 1..254", "correct the number")
        names = self._text.sections.get(f"{index:04x}name", Section("", 0))
        values = self._text.sections.get(f"{index:04x}value", Section("", 0))
        self._add_count(index, count, main.line)
        for subindex in range(1, count + 1):
            section = Section(main.name, main.line)
            section.fields = dict(main.fields)
            name = names.get(str(subindex))
            if name is not None:
                section.fields["parametername"] = name
            value = values.get(str(subindex))
            if value is not None:
                section.fields["parametervalue"] = value
            self._add(index, subindex, section, _VAR)

    def _add_count(self, index: int, count: int, line: int) -> None:
        name = "Highest sub-index supported"
        self._found[index << 8] = VariableDescription(
            index, 0, name, DataType.UNSIGNED8, "ro", False, (None, None), count, line
        )

    def _follows_node_id(self, section: Section) -> bool:
        field = section.get("parametervalue") or section.get("defaultvalue")
        return field is not None and "$nodeid" in field.text.lower()

    def _add(self, index: int, subindex: int, section: Section, object_type: int) -> None:
        if object_type in _DEFTYPE:
            return
        told = len(self._warnings)
        data_type = self._data_type(index, subindex, section, object_type)
        default = self._default(section, data_type)
        self._found[index << 8 | subindex] = VariableDescription(
            index,
            subindex,
            section.text("parametername"),
            data_type,
            self._access(section, subindex),
            self._number(section, "pdomapping", 0) != 0,
            self._limits(section, data_type, default),
            default,
            section.line,
            self._follows_node_id(section),
        )
        if any("$" in field.text for field in section.fields.values()):
            self._with_node_id.append((index, subindex, section, object_type))
            self._said_with_node_id = self._said_with_node_id or len(self._warnings) > told

    def _data_type(self, index: int, subindex: int, section: Section, object_type: int) -> int:
        field = section.get("datatype")
        if field is None:
            if object_type == _DOMAIN:
                return DataType.DOMAIN
            if subindex == 0 and section.name.endswith(("sub0", "sub00")):
                self._warn(section.line, "no DataType; sub-index 0 is an UNSIGNED8")
                return DataType.UNSIGNED8
            missing = f"{index:04X}h:{subindex:02X}h has no DataType"
            raise EdsError(self._text.path, section.line, missing, "add DataType=0x....")
        data_type = self._number(section, "datatype", 0)
        own_type = self._text.sections.get(f"{data_type:x}sub1")  # ranges of CANFestival
        if data_type > DataType.UNSIGNED64 and own_type is not None:
            data_type = self._number(own_type, "defaultvalue", 0)
        if type_name(data_type).startswith("data type"):
            self._warn(field.line, f"unknown data type {field.text}; read as DOMAIN")
            return DataType.DOMAIN
        return data_type

    def _access(self, section: Section, subindex: int) -> str:
        field = section.get("accesstype")
        if field is None:
            access = "rw" if subindex or "sub" not in section.name else "ro"
            self._warn(section.line, f"no AccessType; read as {access}")
            return access
        word = "".join(field.text.lower().replace("-", "").replace("_", "").split())
        if word in _ACCESS:
            return word
        if word in _ACCESS_WORDS:
            access = _ACCESS_WORDS[word]
            self._warn(field.line, f"AccessType {field.text!r} read as {access}")
            return access
        raise self._error(field, "is not an AccessType", f"write one of {', '.join(_ACCESS)}")

    def _default(self, section: Section, data_type: int) -> Value | None:
        for key in ("parametervalue", "defaultvalue"):
            field = section.get(key)
            if field is None:
                continue
            try:
                value, remark = parse_value(field.text, data_type, self._node_id)
            except ValueError as error:
                remedy = f"write a value of {type_name(data_type)}"
                raise EdsError(self._text.path, field.line, str(error), remedy) from None
            if remark:
                self._warn(field.line, f"{field.text!r}: {remark}")
            return value
        return None

    def _limits(
        self, section: Section, data_type: int, default: Value | None
    ) -> tuple[int | None, int | None]:
        """Return LowLimit and HighLimit; limits without a sensible meaning are left out."""
        if not is_integer(data_type):
            return None, None
        low = self._limit(section, "lowlimit", data_type)
        high = self._limit(section, "highlimit", data_type)
        line = section.fields.get("lowlimit", section.fields.get("highlimit", _NO_FIELD)).line
        if low is not None and high is not None and low > high:
            self._warn(line, f"limits {low}..{high} leave no value; left out")
            return None, None
        if isinstance(default, int) and (
            (low is not None and default < low) or (high is not None and default > high)
        ):
            if low == high == 0:
                self._warn(line, f"limits 0..0 with the value {default}; left out")
                return None, None
            self._warn(line, f"the value {default} lies outside its limits {low}..{high}")
        return low, high

    def _limit(self, section: Section, key: str, data_type: int) -> int | None:
        field = section.get(key)
        if field is None:
            return None
        try:
            number, is_hex, remark = parse_integer(field.text, self._node_id)
            limit, fit_remark = fit(number, data_type, is_hex)
        except ValueError as error:
            self._warn(field.line, f"{error}; this limit is left out")
            return None
        if remark or fit_remark:
            self._warn(field.line, f"{field.text!r}: {remark or fit_remark}")
        return limit

    # --- fields

    def _number(self, section: Section, key: str, otherwise: int) -> int:
        """Return the whole number of a key, or `otherwise` if it is absent."""
        field = section.get(key)
        if field is None:
            return otherwise
        try:
            number, _, remark = parse_integer(field.text, self._node_id)
        except ValueError as error:
            remedy = f"write a number behind {key}"
            raise EdsError(self._text.path, field.line, str(error), remedy) from None
        if remark:
            self._warn(field.line, f"{field.text!r}: {remark}")
        return number

    def _error(self, field: Field, text: str, remedy: str) -> EdsError:
        return EdsError(self._text.path, field.line, f"{field.text!r} {text}", remedy)
