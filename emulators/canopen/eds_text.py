"""Line reader for EDS and DCF files: sections, keys, line numbers.

Files in the field are hand-edited, merged and saved by old editors. These defects are repaired with
a warning: a text encoding other than UTF-8, an unresolved merge whose two sides mean the same, a
key or section given twice with one meaning, a missing bracket, stray lines, comments behind a
value. If two relevant statements contradict each other, the intended meaning is unknown: that is an
`EdsError`.
"""

import re
from pathlib import Path
from typing import Final, final

EdsWarning = tuple[Path, int, str]
_Line = tuple[int, str]

_ENDS: Final = re.compile(r"\r\n|\n|\r")
_SECTION: Final = re.compile(r"\[([^\]]*)(\]?)\s*(.*)")
_TAIL_COMMENT: Final = re.compile(r"\s+(;|//).*$")
_OBJECT: Final = re.compile(r"[0-9a-f]{4}(sub[0-9a-f]{1,2})?")
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
    if _OBJECT.fullmatch(section):
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
