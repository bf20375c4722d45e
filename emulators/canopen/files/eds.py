"""Reader of EDS and DCF files (CiA 306) with repairs and warnings.

`read_eds` returns a `DeviceDescription`, which makes any number of object dictionaries. In a DCF a
ParameterValue overrides the DefaultValue. Hexadecimal numbers of signed types are two's complement.
$NODEID is the requested node-ID. A DCF for another node ([DeviceComissioning] NodeID) is moved to
the requested one: its identifiers of the pre-defined connection set follow, as $NODEID would. A
TPDO or EMCY with another identifier would collide between the two nodes: that is an `EdsError`. The
sections define the objects; lists and counts that disagree cause a warning. Every repair and
omission causes a warning with file and line. A file without a plain meaning is refused with one
line.

Files in the field are hand-edited, merged and saved by old editors. These defects are repaired with
a warning: a text encoding other than UTF-8, an unresolved merge whose two sides mean the same, a
key or section given twice with one meaning, a missing bracket, stray lines, comments behind a
value. If two relevant statements contradict each other, the intended meaning is unknown: that is an
`EdsError`.

Every function for values (CiA 306, 4.5) returns the value and a remark. A remark other than ""
names a repair.
"""

import re
from pathlib import Path
from typing import Final, final

from motorhil.emulators.canopen.codes import INVALID, predefined_bases
from motorhil.emulators.canopen.files.device_description import (
    DeviceDescription,
    VariableDescription,
)
from motorhil.emulators.canopen.object_dictionary import (
    DataType,
    Value,
    decode,
    integer_range,
    is_integer,
    is_signed,
    length_bits,
)

EdsWarning = tuple[Path, int, str]
_Line = tuple[int, str]

_ENDS: Final = re.compile(r"\r\n|\n|\r")
_SECTION: Final = re.compile(r"\[([^\]]*)(\]?)\s*(.*)")
_TAIL_COMMENT: Final = re.compile(r"(?<!\s)\s+(;|//).*$")
_SHOWN: Final = 80  # characters of a value in a message
_OBJECT_SECTION: Final = re.compile(r"[0-9a-f]{4}(sub[0-9a-f]{1,2})?")
_VALUES: Final = re.compile(r"[0-9a-f]{4}value")
# The keys whose values the reader uses, by their lower-case name.
_OBJECT_KEYS: Final = (
    "ObjectType",
    "DataType",
    "AccessType",
    "DefaultValue",
    "ParameterValue",
    "LowLimit",
    "HighLimit",
    "PDOMapping",
    "CompactSubObj",
)
_IDENTITY_KEYS: Final = (
    "VendorName",
    "VendorNumber",
    "ProductName",
    "ProductNumber",
    "RevisionNumber",
    "OrderCode",
)
_SPELLING: Final = {key.lower(): key for key in _OBJECT_KEYS + _IDENTITY_KEYS}
_OBJECT_NAMES: Final = frozenset(key.lower() for key in _OBJECT_KEYS)
_IDENTITY_NAMES: Final = frozenset(key.lower() for key in _IDENTITY_KEYS)

_NODE_ID: Final = re.compile(r"\$node_?id", re.IGNORECASE)
_COMMENT: Final = re.compile(r"(?<!\s)\s*(;|//|/\*|#|\().*$")
_HEX: Final = re.compile(r"([+-]?)0x([0-9a-f]+)", re.IGNORECASE)
_HEX_WITH_H: Final = re.compile(r"([+-]?)([0-9a-f]+)h", re.IGNORECASE)
_DECIMAL: Final = re.compile(r"[+-]?[0-9]+")
_WHOLE_REAL: Final = re.compile(r"([+-]?[0-9]+)[.,]0*")
_WORDS: Final = {"true": 1, "false": 0, "yes": 1, "no": 0}

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

_FILES_KEPT: Final = 16
_COB_ID: Final = 0x7FF
_TRANSMITTED: Final = ((0x1014, 0x1014), (0x1800, 0x19FF))  # EMCY and TPDOs: one sender each
_NODE_ID_MAX: Final = 127
_COMMISSIONING: Final = ("devicecomissioning", "devicecommissioning")  # CiA 306's spelling first
_MAY_NAME_NODE_ID: Final = ("parametervalue", "defaultvalue", "lowlimit", "highlimit")


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
class Field:
    """The value of a key, and its line (1..)."""

    def __init__(self, text: str, line: int) -> None:
        self.text = text
        self.line = line


@final
class Section:
    """One [section]; `name` in lower case without spaces, keys in lower case."""

    def __init__(self, name: str, line: int) -> None:
        self.name = name
        self.line = line
        self.fields: dict[str, Field] = {}

    def get(self, key: str) -> Field | None:
        """Return the field with this lower-case key, or None if it is absent or empty."""
        field = self.fields.get(key)
        return field if field is not None and field.text else None

    def text(self, key: str) -> str:
        """Return the text of the key, or "" if it is absent."""
        field = self.fields.get(key)
        return "" if field is None else field.text


def matters(section: str, key: str) -> bool:
    """Return whether the reader uses this key; it ignores comments, lists and counts."""
    if _OBJECT_SECTION.fullmatch(section):
        return key in _OBJECT_NAMES
    if section == "deviceinfo":
        return key in _IDENTITY_NAMES
    return section == "dummyusage" or _VALUES.fullmatch(section) is not None


def read_file(path: Path) -> bytes:
    """Return the content of the file.

    Raises:
        EdsError: the file cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise EdsError(path, 0, f"cannot be read: {reason}", "check the path") from None


@final
class EdsText:
    """A file's sections by name, and the warnings about repairs."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path = path
        self.sections: dict[str, Section] = {}
        self.warnings: list[EdsWarning] = []
        lines = list(enumerate(_ENDS.split(self._decoded(data)), start=1))
        current = Section("", 0)
        for number, line in self._without_conflicts(lines):
            current = self._take(number, line, current)
        if not self.sections:
            raise EdsError(path, 0, "no [section] found", "give an EDS or DCF file")

    def warn(self, line: int, text: str) -> None:
        """Add a warning about something that was repaired or left out."""
        self.warnings.append((self.path, line, text))

    def _decoded(self, data: bytes) -> str:
        if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return data.decode("utf-16", "replace")
        if b"\0" in data:
            line = data[: data.index(b"\0")].count(b"\n") + 1
            raise EdsError(self.path, line, "contains a NUL byte", "give a text file: EDS or DCF")
        try:
            return data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = data[: error.start].count(b"\n") + 1
            self.warn(line, f"byte {data[error.start]:02X}h is not UTF-8; read as Windows-1252")
            return data.decode("cp1252", "replace")

    # --- unresolved merges

    def _without_conflicts(self, lines: list[_Line]) -> list[_Line]:
        """Return the lines without merge markers; if both sides mean the same, keep the first."""
        kept: list[_Line] = []
        section = ""
        position = 0
        while position < len(lines):
            number, line = lines[position]
            if line.startswith("<<<<<<<"):
                first, second, position = self._sides(lines, position)
                self._compare(number, section, first, second)
                kept += first
                section = _last_section(first, section)
                continue
            if line.startswith((">>>>>>>", "=======", "|||||||")):
                remedy = "resolve the merge, or delete the line"
                raise EdsError(self.path, number, "merge marker without a beginning", remedy)
            kept.append((number, line))
            section = _section_name(line) or section
            position += 1
        return kept

    def _sides(self, lines: list[_Line], start: int) -> tuple[list[_Line], list[_Line], int]:
        """Return both sides of the conflict that starts there, and the position after it."""
        sides: list[list[_Line]] = [[], [], []]  # ours, theirs, and their common ancestor (diff3)
        side = 0
        for position in range(start + 1, len(lines)):
            line = lines[position][1]
            if line.startswith(">>>>>>>") and side == 1:
                return sides[0], sides[1], position + 1
            if line.startswith("|||||||"):
                side = 2
            elif line.startswith("======="):
                side = 1
            elif line.startswith("<<<<<<<"):
                break
            else:
                sides[side].append(lines[position])
        remedy = "resolve the merge: keep one side"
        raise EdsError(self.path, lines[start][0], "merge conflict without an end", remedy)

    def _compare(self, line: int, section: str, first: list[_Line], second: list[_Line]) -> None:
        ours, theirs = _meaning(first, section), _meaning(second, section)
        same_place = _last_section(first, section) == _last_section(second, section)
        if ours == theirs and same_place:
            self.warn(line, "unresolved merge; both sides mean the same, the first was read")
            return
        remedy = "resolve the merge: keep one side and delete the marker lines"
        for name, key in [*ours, *theirs]:
            if ours.get((name, key)) != theirs.get((name, key)):
                text = f"unresolved merge; the sides differ in {_spelt(key)} in [{name}]"
                raise EdsError(self.path, line, text, remedy)
        raise EdsError(self.path, line, "unresolved merge; sides end in different sections", remedy)

    # --- lines

    def _take(self, number: int, line: str, current: Section) -> Section:
        """Parse the line and return the current section after it."""
        line = line.strip()
        if not line or line[0] == ";":
            return current
        if line[0] == "[":
            return self._open(number, line)
        key, equals, value = line.partition("=")
        if not equals:
            if line[0] not in "#/":
                self.warn(number, f"neither [section] nor key=value, left out: {line[:40]}")
            else:
                self.warn(number, "a comment starts with ';'; taken for one")
            return current
        name, value = key.strip().lower(), value.strip()
        if not current.name:
            self.warn(number, f"{key.strip()} stands before any [section], left out")
            return current
        comment = _TAIL_COMMENT.search(value)
        if comment is None and value.startswith((";", "//")):
            self.warn(number, f"the value of {key.strip()} is a comment; read as empty")
            value = ""
        elif comment is not None:
            value = value[: comment.start()]
            self.warn(number, f"a comment behind the value of {key.strip()}; read as {value!r}")
        self._put(current, name, Field(value, number))
        return current

    def _open(self, number: int, line: str) -> Section:
        match = _SECTION.match(line)
        assert match is not None
        if not match[2]:
            self.warn(number, f"{line[:40]} lacks its closing bracket")
        elif match[3] and match[3][0] != ";":
            self.warn(number, f"left out behind the section name: {match[3][:40]}")
        name = _section_name(line)
        if not name:
            raise EdsError(self.path, number, "section without a name", "name it or delete it")
        if name in self.sections:
            self.warn(number, f"[{match[1]}] again; it began in line {self.sections[name].line}")
            return self.sections[name]
        section = Section(name, number)
        self.sections[name] = section
        return section

    def _put(self, section: Section, key: str, field: Field) -> None:
        before = section.fields.get(key)
        if before is None or not before.text:
            section.fields[key] = field
            return
        same = before.text.lower() == field.text.lower() or not field.text
        if not same and matters(section.name, key):
            text = f"{_spelt(key)} in [{section.name}] is {field.text!r}, line {before.line} says"
            remedy = "keep one of the two lines"
            raise EdsError(self.path, field.line, f"{text} {before.text!r}", remedy)
        self.warn(
            field.line, f"{_spelt(key)} again, first in line {before.line}; the first one counts"
        )


def _spelt(key: str) -> str:
    return _SPELLING.get(key, key)


def _section_name(line: str) -> str:
    """Return the section that a line opens, in lower case without spaces, or ""."""
    match = _SECTION.match(line.strip())
    return "".join(match[1].lower().split()) if match else ""


def _last_section(lines: list[_Line], section: str) -> str:
    for _, line in lines:
        section = _section_name(line) or section
    return section


def _meaning(lines: list[_Line], section: str) -> dict[tuple[str, str], str]:
    """Return the relevant statements in the lines: (section, key) -> value."""
    said: dict[tuple[str, str], str] = {}
    for _, line in lines:
        opened = _section_name(line)
        if opened:
            section = opened
            continue
        key, equals, value = line.partition("=")
        name = key.strip().lower()
        if equals and line.strip()[0] != ";" and matters(section, name):
            said[section, name] = _TAIL_COMMENT.sub("", value).strip().lower()
    return said


def parse_integer(text: str, node_id: int) -> tuple[int, bool, str]:
    """Return the number, whether it was written in hexadecimal, and a remark.

    Raises:
        ValueError: the text is not a number; the message quotes it.
    """
    if _NODE_ID.search(text):
        return _with_node_id(text, node_id)
    remark = ""
    bare = text.strip().strip("\"'")
    cut = _COMMENT.sub("", bare)
    if cut != text.strip():
        remark = f"read as {cut}"
    if match := _HEX.fullmatch(cut):
        return int(match[1] + match[2], 16), True, remark
    if _DECIMAL.fullmatch(cut):
        return _decimal(cut, remark)
    if cut.lower() in _WORDS:
        return _WORDS[cut.lower()], False, f"read as {_WORDS[cut.lower()]}"
    if match := _HEX_WITH_H.fullmatch(cut):
        return int(match[1] + match[2], 16), True, f"read as 0x{match[2]}"
    if match := _WHOLE_REAL.fullmatch(cut):
        return int(match[1]), False, f"read as {match[1]}"
    raise ValueError(f"{text[:_SHOWN]!r} is no number")


def _decimal(text: str, remark: str) -> tuple[int, bool, str]:
    """Parse a decimal number, or an octal one with a leading 0 (CiA 306)."""
    digits = text.lstrip("+-")
    if len(digits) > 1 and digits[0] == "0" and digits.strip("0"):
        if set(digits) <= set("01234567"):
            value = int(text, 8)
            return value, False, f"a leading 0 means octal (CiA 306): read as {value}"
        return int(text), False, f"no octal number for all its leading 0: read as {int(text)}"
    return int(text), False, remark


def _with_node_id(text: str, node_id: int) -> tuple[int, bool, str]:
    """Parse $NODEID, $NODEID + number or number + $NODEID."""
    cut = _COMMENT.sub("", text.strip())
    rest = "".join(_NODE_ID.sub("", cut, count=1).split())
    if rest and not (rest[0] == "+" or rest[-1] == "+"):
        raise ValueError(f"{text[:_SHOWN]!r} is not $NODEID plus a number")
    rest = rest.strip("+")
    if not rest:
        return node_id, True, ""
    value, is_hex, remark = parse_integer(rest, node_id)
    if cut != text.strip():
        remark = f"read as {cut}"
    return value + node_id, is_hex, remark


def fit(value: int, data_type: int, is_hex: bool) -> tuple[int, str]:
    """Fit the number to the data type; hexadecimals of signed types are two's complement.

    Raises:
        ValueError: the number does not fit the data type.
    """
    low, high = integer_range(data_type)
    bits = length_bits(data_type)
    if low <= value <= high:
        return value, ""
    if is_signed(data_type):
        if 0 <= value < 1 << bits:
            signed = value - (1 << bits)
            return signed, "" if is_hex else f"{value} read as two's complement, {signed}"
        for width in (16, 24, 32, 64):
            if is_hex and value < 1 << width and low <= value - (1 << width) < 0:
                signed = value - (1 << width)
                return signed, f"{value:X}h has more than {bits} bits, read as {signed}"
    elif value < 0 and value >= -(1 << (bits - 1)) and bits > 1:
        unsigned = value + (1 << bits)
        return unsigned, f"{value} of an unsigned type, read as {unsigned}"
    raise ValueError(f"{value} does not fit {type_name(data_type)} ({low}..{high})")


def parse_value(text: str, data_type: int, node_id: int) -> tuple[Value, str]:
    """Return a DefaultValue or ParameterValue, and a remark.

    Raises:
        ValueError: the text is not a value of this data type.
    """
    if is_integer(data_type):
        number, is_hex, remark = parse_integer(text, node_id)
        try:
            value, fit_remark = fit(number, data_type, is_hex)
        except ValueError as error:
            raise ValueError(f"{text!r}: {error}") from None
        return value, remark or fit_remark
    if data_type in (DataType.REAL32, DataType.REAL64):
        return _real(text, data_type)
    if data_type in (DataType.OCTET_STRING, DataType.DOMAIN):
        digits = text[2:] if text[:2].lower() == "0x" else text
        try:
            return bytes.fromhex(digits), ""
        except ValueError:
            return text.encode("latin-1", "replace"), "not in hexadecimal; read as text"
    if data_type == DataType.UNICODE_STRING:
        return text.encode("utf-16-le"), ""
    return text.encode("latin-1", "replace"), ""


def _real(text: str, data_type: int) -> tuple[float, str]:
    """Parse a decimal fraction, or a bit pattern if all its hexadecimal digits are given."""
    size = length_bits(data_type) // 8
    match = _HEX.fullmatch(text)
    if match and len(match[2]) == 2 * size:
        value = decode(data_type, bytes.fromhex(match[2])[::-1])
        assert isinstance(value, float)
        return value, f"read as the bit pattern of {value:g}"
    if match:
        return float(int(match[1] + match[2], 16)), ""
    cut = _COMMENT.sub("", text)
    number = float(cut.replace(",", "."))
    return number, "" if cut == text and "," not in text else f"read as {number:g}"


def type_name(data_type: int) -> str:
    """Return the standard's name of a data type."""
    try:
        return DataType(data_type).name
    except ValueError:
        return f"data type {data_type:X}h"


_NO_FIELD: Final = Field("", 0)


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
        self._written_for = node_id  # the node of the file's identifiers
        self._moved: list[str] = []  # the objects whose identifiers follow the node-ID

    def is_pattern(self) -> bool:
        """Return whether another node-ID changes only values and limits that name it."""
        if self._said_with_node_id or any(name in self._text.sections for name in _COMMISSIONING):
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
        self._tell_moved()
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
        """Read the node that a DCF is written for."""
        for name in _COMMISSIONING:
            section = self._text.sections.get(name)
            if section is not None and section.get("nodeid") is not None:
                node_id = self._number(section, "nodeid", self._node_id)
                if 1 <= node_id <= _NODE_ID_MAX:
                    self._written_for = node_id

    def _tell_moved(self) -> None:
        """Warn that the file is used for another node than the one it is written for."""
        if self._written_for == self._node_id:
            return
        sections = [self._text.sections.get(name) for name in _COMMISSIONING]
        line = next(field.line for one in sections if one and (field := one.get("nodeid")))
        what = f"COB-IDs follow: {', '.join(self._moved)}" if self._moved else "no COB-ID follows"
        self._warn(line, f"written for node {self._written_for}, used for {self._node_id}; {what}")

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
        return field is not None and _NODE_ID.search(field.text) is not None

    def _moves(self, index: int, subindex: int, section: Section, default: Value | None) -> bool:
        """Return whether a value of a DCF follows the node-ID, although it does not name it.

        Raises:
            EdsError: two nodes with this file would transmit the same identifier.
        """
        written_for = self._written_for
        if written_for == self._node_id or not isinstance(default, int):
            return False
        usual = section.get("defaultvalue")
        if usual is not None and _NODE_ID.search(usual.text):
            return parse_integer(usual.text, written_for)[0] == default
        if (default & _COB_ID) - written_for in predefined_bases(index, subindex):
            return True
        is_sent = any(first <= index <= last for first, last in _TRANSMITTED)
        if is_sent and predefined_bases(index, subindex) and not default & INVALID:
            text = (
                f"{index:04X}h:{subindex:02X}h is {default & _COB_ID:03X}h, which does not follow"
            )
            raise EdsError(
                self._text.path,
                section.line,
                f"{text} the node-ID: written for node {written_for}, used for {self._node_id}",
                f"write $NODEID+0x{default - written_for:X}, or use the file for one node",
            )
        return False

    def _add(self, index: int, subindex: int, section: Section, object_type: int) -> None:
        if object_type in _DEFTYPE:
            return
        told = len(self._warnings)
        data_type = self._data_type(index, subindex, section, object_type)
        default = self._default(section, data_type)
        follows = self._follows_node_id(section)
        if not follows and self._moves(index, subindex, section, default):
            assert isinstance(default, int)
            default += self._node_id - self._written_for
            follows = True
            self._moved.append(f"{index:04X}h:{subindex:02X}h")
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
            follows,
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
