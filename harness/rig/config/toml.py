"""Reader of hand-written TOML files; errors name file, line, key and remedy.

A `Source` is the file: its values and their lines. A `Table` is one of its tables, read key by key.
It refuses unknown keys first, because a misspelt key explains a missing one. Reading ends at the
first error; RigError is always one line.

Line numbers of keys in a TOML text; tomllib reads the values.

A path is the keys down to a value. Array items and tables of an array of tables are counted from 0.
The text must be one that tomllib accepts, so nothing is checked here.

Changes of one table in a rig's text, which recordings contain; and tables as text.

Wording of keys, names and values in messages: short, one line.
"""

import json
import re
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, TypeVar, final

from motorhil.settings import (
    BARE_KEY,
    INTEGER_MAX,
    KeyPath,
    SettingError,
    as_table,
    as_tables,
    declaration,
    dotted,
    listed,
    nearest,
    parse_toml,
    read,
    refuse_unknown,
)

T = TypeVar("T")

_PLAIN_VALUE: Final = re.compile(r"[^,\]}#\n]+")  # number, boolean, date: ends before any of these
_SPACE: Final = re.compile(r"[ \t]*")
_SPACE_LINES_COMMENTS: Final = re.compile(r"(?:[ \t\n]|#[^\n]*)*")
_STRING: Final = {
    '"': re.compile(r'"(?:[^"\\]|\\.)*"'),
    "'": re.compile(r"'[^']*'"),
    # Up to two quotes may precede the three that close a multi-line string.
    '"""': re.compile(r'"""(?:[^"\\]|\\.|"{1,2}(?!"))*"{3,5}', re.DOTALL),
    "'''": re.compile(r"'''(?:[^']|'{1,2}(?!'))*'{3,5}"),
}


def key_lines(text: str) -> Mapping[KeyPath, int]:
    """Return the line, counted from 1, of every table, key and array item in a valid TOML text.

    A table with a header of its own is at that header. A table that is only implied (by a dotted
    key, or by the header of a table inside it) is where it is first implied. The root, `()`, is at
    line 1.
    """
    return _Locator(text.replace("\r\n", "\n")).run()


class _Locator:
    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._line = 1
        self._counted_to = 0
        self._lines: dict[KeyPath, int] = {(): 1}
        self._tables_in_array: dict[KeyPath, int] = {}

    def run(self) -> dict[KeyPath, int]:
        text = self._text
        table: KeyPath = ()
        self._skip(_SPACE_LINES_COMMENTS)
        while self._at < len(text):
            if text.startswith("[[", self._at):
                table = self._array_header()
            elif text[self._at] == "[":
                table = self._header()
            else:
                self._key_and_value(table)
            self._skip(_SPACE_LINES_COMMENTS)
        return self._lines

    def _header(self) -> KeyPath:
        line = self._here()
        self._at += 1
        *outer, last = self._dotted_key()
        self._at += 1
        path = (*self._resolve(outer, line), last)
        self._lines[path] = line  # its own header overrides where it was implied before
        return path

    def _array_header(self) -> KeyPath:
        line = self._here()
        self._at += 2
        *outer, last = self._dotted_key()
        self._at += 2
        array = (*self._resolve(outer, line), last)
        count = self._tables_in_array.get(array, 0)
        self._tables_in_array[array] = count + 1
        self._lines.setdefault(array, line)
        self._lines[(*array, count)] = line
        return (*array, count)

    def _resolve(self, keys: list[str], line: int) -> KeyPath:
        """Return the path of a header's outer keys; an array of tables means its last table."""
        path: KeyPath = ()
        for key in keys:
            path = (*path, key)
            self._lines.setdefault(path, line)
            count = self._tables_in_array.get(path)
            if count is not None:
                path = (*path, count - 1)
        return path

    def _key_and_value(self, table: KeyPath) -> None:
        line = self._here()
        path = table
        for key in self._dotted_key():
            path = (*path, key)
            self._lines.setdefault(path, line)
        self._at += 1  # the "="
        self._skip(_SPACE)
        self._value(path)

    def _dotted_key(self) -> list[str]:
        """Return the keys at this position, and move to the character that ends them."""
        keys = []
        while True:
            self._skip(_SPACE)
            quoted = self._text[self._at] in "\"'"
            start = self._at
            self._skip(_STRING[self._text[start]] if quoted else BARE_KEY)
            key = self._text[start : self._at]
            keys.append(tomllib.loads(f"key = {key}")["key"] if quoted else key)
            self._skip(_SPACE)
            if self._text[self._at] != ".":
                return keys
            self._at += 1

    def _value(self, path: KeyPath) -> None:
        text = self._text
        first = text[self._at]
        if first in "\"'":
            triple = text[self._at : self._at + 3]
            self._skip(_STRING[triple if triple == first * 3 else first])
        elif first == "[":
            self._array(path)
        elif first == "{":
            self._inline_table(path)
        else:
            self._skip(_PLAIN_VALUE)

    def _array(self, path: KeyPath) -> None:
        self._at += 1
        index = 0
        self._skip(_SPACE_LINES_COMMENTS)
        while self._text[self._at] != "]":
            item = (*path, index)
            self._lines[item] = self._here()
            self._value(item)
            index += 1
            self._end_of_item()
        self._at += 1

    def _inline_table(self, path: KeyPath) -> None:
        self._at += 1
        self._skip(_SPACE_LINES_COMMENTS)  # newlines and comments inside: TOML 1.1
        while self._text[self._at] != "}":
            self._key_and_value(path)
            self._end_of_item()
        self._at += 1

    def _end_of_item(self) -> None:
        self._skip(_SPACE_LINES_COMMENTS)
        if self._text[self._at] == ",":
            self._at += 1
            self._skip(_SPACE_LINES_COMMENTS)

    def _skip(self, pattern: re.Pattern[str]) -> None:
        found = pattern.match(self._text, self._at)
        if found is None:
            raise AssertionError(f"not TOML at character {self._at}")
        self._at = found.end()

    def _here(self) -> int:
        self._line += self._text.count("\n", self._counted_to, self._at)
        self._counted_to = self._at
        return self._line


def with_table(text: str, table: str, lines: str, without: Collection[str]) -> str:
    """Return the text with these lines in `[table]`, and without that table's keys `without`.

    The table must have a header of its own in the text, and each of its keys must be on one line.
    """
    head = f"[{table}]\n"
    before, found, rest = text.partition(head)
    assert found, f"no {head.strip()} in a file that is ours"
    end = re.search(r"^\[", rest, re.MULTILINE)
    body, behind = (rest[: end.start()], rest[end.start() :]) if end else (rest, "")
    kept = [
        line
        for line in body.splitlines(keepends=True)
        if line.partition("=")[0].strip() not in without
    ]
    return before + head + lines + "".join(kept) + behind


def written(header: str, keys: Iterable[tuple[str, object]]) -> str:
    """Return a table of an array of tables as lines of TOML."""
    lines = [f"[[{header}]]", *(f"{key} = {_written(value)}" for key, value in keys)]
    return "\n".join(lines) + "\n"


def _written(value: object) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_written, value))}]"
    return repr(value)


def replaced(settings: Mapping[str, object], path: KeyPath, value: object) -> dict[str, object]:
    """Return the settings with another value at `path`.

    Raises:
        SettingError: the path leads through a value that is no table.
    """
    key, *rest = path
    if not rest:
        return {**settings, str(key): value}
    inner = as_table(settings.get(str(key), {}), (key,))
    return {**settings, str(key): replaced(inner, tuple(rest), value)}


def a_kind_of(value: object) -> str:
    """Return Python's word for it, with its article: "None", "the class Motor", "a 'str'"."""
    if value is None:
        return "None"
    return (
        f"the class {value.__name__}" if isinstance(value, type) else f"a {type(value).__name__!r}"
    )


def one_line(text: str) -> str:
    """Return the text with every non-printable character as an escape."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


_REQUIRED: Final = object()
NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
SEED_MAX: Final = 2**32 - 1
_BYTES_MAX: Final = 16_000_000


class RigError(Exception):
    """The rig cannot be used as it is written; nothing was started.

    Attributes:
        file: the file with the error.
        line: line number from 1; None if the error has no line (the file is missing).
        key: keys down to the value, joined by dots; empty if the error has no key.
        message: the problem, with value, limit and unit.
        remedy: what to write or do instead.
    """

    def __init__(
        self,
        file: Path | str,
        message: str,
        remedy: str = "",
        *,
        line: int | None = None,
        key: str = "",
    ) -> None:
        self.file = file
        self.line = line
        self.key = key
        self.message = message
        self.remedy = remedy
        place = f"{file}:{line}" if line is not None else str(file)
        text = ": ".join(part for part in (place, key, message) if part)
        super().__init__(one_line(f"{text}; {remedy}" if remedy else text))


@final
class BrokenPluginError(RigError):
    """A plugin cannot be loaded, or it failed; its author has to fix it, not the rig's."""


def refuse_source(source: Path, target: Path) -> None:
    """Refuse to overwrite a recording while it is read.

    Raises:
        RigError: the target is the source, by whatever name.
    """
    with suppress(OSError):
        if target.samefile(source):
            raise RigError(target, "is the recording itself", "record elsewhere with -o")


@final
class Source:
    """A TOML file and the lines of its values.

    Attributes:
        path: the file; relative paths inside it start at its folder.
        text: its contents.
    """

    def __init__(self, path: Path, text: str) -> None:
        self.path = path
        self.text = text
        self._fragment: tuple[int, Path] | None = None  # its first line, and its file
        self._redirected: dict[KeyPath, KeyPath] = {}
        self._lines: Mapping[KeyPath, int] | None = None
        self._values: dict[str, object] | None = None

    def with_fragment(self, fragment: "Source") -> "Source":
        """Return this file with another one appended; errors name the file that they are in."""
        text = self.text if self.text.endswith("\n") or not self.text else self.text + "\n"
        whole = Source(self.path, text + fragment.text)
        whole._fragment = text.count("\n") + 1, fragment.path
        return whole

    @property
    def fragment(self) -> str:
        """The text that was appended; "": none."""
        if self._fragment is None:
            return ""
        return "".join(self.text.splitlines(keepends=True)[self._fragment[0] - 1 :])

    def redirect(self, path: KeyPath, to: KeyPath) -> None:
        """Let errors of the value at `path` name the line of the value at `to`."""
        self._redirected[path] = to

    def _place(self, line: int) -> tuple[Path, int]:
        """Return the file that has this line of the text, and the line in it."""
        if self._fragment is None or line < self._fragment[0]:
            return self.path, line
        return self._fragment[1], line - self._fragment[0] + 1

    def root(self) -> "Table":
        """Return the whole file as a table; it is parsed once.

        Raises:
            RigError: the text is not TOML.
        """
        if self._values is None:
            self._values = self._parsed()
        return Table(self, (), self._values)

    def _parsed(self) -> dict[str, object]:
        try:
            values = parse_toml(self.text)
            self._lines = key_lines(self.text)
            self._refuse_long_integers((), values)
        except tomllib.TOMLDecodeError as error:
            message, line = _syntax_error(str(error), self.text)
            path, line = self._place(line)
            raise RigError(path, f"not TOML: {message}", "see https://toml.io", line=line) from None
        except RecursionError:
            counts = [sum(map(line.count, "[{.")) for line in self.text.split("\n")]
            line = counts.index(max(counts)) + 1
            raise RigError(self.path, "nested too deeply", "flatten it", line=line) from None
        except ValueError as error:  # error of int() within tomllib: more than 4300 digits
            line = self.text.count("\n", 0, _longest_number_at(self.text)) + 1
            raise RigError(self.path, f"{error}", "shorten the number", line=line) from None
        return values

    def _refuse_long_integers(self, path: KeyPath, value: object) -> None:
        if isinstance(value, dict):
            for key, item in value.items():
                self._refuse_long_integers((*path, key), item)
        elif isinstance(value, list):
            for index, item in enumerate(value):
                self._refuse_long_integers((*path, index), item)
        elif isinstance(value, int) and abs(value) > INTEGER_MAX:
            raise self.error(path, "is an integer of more than 64 bits", "write a smaller one")

    def line(self, path: KeyPath) -> int:
        """Return the line of the value, or of the innermost existing table around it."""
        lines = self._lines or {}
        while path and path not in lines and path not in self._redirected:
            path = path[:-1]
        return lines.get(self._redirected.get(path, path), 1)

    def error(
        self, path: KeyPath, message: str, remedy: str = "", kind: type[RigError] = RigError
    ) -> RigError:
        """Return the RigError for the value at `path`."""
        file, line = self._place(self.line(path))
        return kind(file, message, remedy, line=line, key=dotted(path))

    @contextmanager
    def with_lines(self) -> Iterator[None]:
        """Raise a SettingError of the body as a RigError with its line."""
        try:
            yield
        except SettingError as error:
            raise self.error(error.path, error.message, error.remedy) from None

    def no_such(self, path: KeyPath, name: str, known: Sequence[str], what: str) -> RigError:
        """Return the RigError for a name at `path` that refers to nothing."""
        remedy = nearest(name, known)
        if not remedy.startswith("did"):
            remedy = f"name one of these, or add [{what}.{name}]"
        return self.error(path, f'there is no {what} "{name}" (known: {listed(known)})', remedy)


def read_source(path: Path, remedy: str) -> Source:
    """Return the file's contents as a Source.

    Raises:
        RigError: the file is missing (`remedy` says what to do), not readable, or not UTF-8.
    """
    try:
        with path.open("rb") as file:  # a device may have no end
            data = file.read(_BYTES_MAX + 1)
        if len(data) > _BYTES_MAX:
            what = f"has more than {_BYTES_MAX // 1_000_000} MB, so it is no rig"
            raise RigError(path, what, "name a rig file")
        return Source(path, data.decode("utf-8-sig"))
    except FileNotFoundError:
        raise RigError(path, "no such file", remedy) from None
    except IsADirectoryError:
        raise RigError(path, "is a folder, not a file", "name the TOML file in it") from None
    except OSError as error:
        raise RigError(path, f"cannot be read: {error.strerror or error}", remedy) from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        value = error.object[error.start]
        raise RigError(
            path, f"not UTF-8 (byte {value:02X}h)", "save it as UTF-8", line=line
        ) from None
    except ValueError as error:  # a path that no file can have
        raise RigError(path, f"cannot be read: {error}", remedy) from None


@final
class Table:
    """One table of a source, read key by key."""

    def __init__(self, source: Source, path: KeyPath, values: Mapping[str, object]) -> None:
        self.source = source
        self.path = path
        self.values = values

    def read(self, of: type[T], *, unit: str = "") -> T:
        """Return the table as an object of a class of settings (RigError)."""
        with self.source.with_lines():
            return read(of, self.values, self.path, unit=unit)

    def part(self, of: type[T]) -> T:
        """Return those keys that a class of settings declares; other keys are another's."""
        names = declaration(of).names()
        own = {key: value for key, value in self.values.items() if key in names}
        return Table(self.source, self.path, own).read(of)

    def refuse_unknown(self, known: Sequence[str], what: str = "key") -> None:
        """Raise RigError for the first key that is not `known`, suggesting the nearest."""
        with self.source.with_lines():
            refuse_unknown(self.values, known, self.path, what)

    def require(
        self, key: str, name: str, known: Sequence[str], what: str = "", index: int | None = None
    ) -> None:
        """Refuse a name that refers to nothing: the value of a key, or of its item `index`."""
        if name not in known:
            path = (*self.path, key) if index is None else (*self.path, key, index)
            raise self.source.no_such(path, name, known, what or key)

    def error(self, key: str, message: str, remedy: str = "") -> RigError:
        """Return the RigError for one of the table's keys."""
        return self.source.error((*self.path, key), message, remedy)

    def refuse_no_name(self, key: str) -> None:
        """Raise RigError for a key that is not a plain name; topics of the record contain it."""
        if not NAME.fullmatch(key):
            remedy = "use a letter, then letters, digits, - and _ only"
            raise self.error(key, "is not a name", remedy)

    def missing(self, key: str, remedy: str) -> RigError:
        """Return the RigError for a missing key, at the table's line."""
        return self.source.error((*self.path, key), "is missing", remedy)

    def has(self, key: str) -> bool:
        """Return True if the key is present."""
        return key in self.values

    def table(self, key: str) -> "Table":
        """Return a table, or an empty one if the key is absent."""
        path = (*self.path, key)
        with self.source.with_lines():
            return Table(self.source, path, as_table(self.values.get(key, {}), path))

    def listed_tables(self, key: str) -> "list[Table]":
        """Return the tables of an array of tables, or [] if the key is absent."""
        path = (*self.path, key)
        with self.source.with_lines():
            tables = as_tables(self.values.get(key, []), path)
        return [Table(self.source, (*path, index), item) for index, item in enumerate(tables)]


def _syntax_error(text: str, source: str) -> tuple[str, int]:
    """Split an error text of tomllib into its message and its line."""
    message, found, place = text.rpartition(" (at ")
    if not found:
        return text, 1
    words = place.rstrip(")").replace(",", "").split()
    if len(words) >= 2 and words[0] == "line" and words[1].isdigit():
        return message, int(words[1])
    return message, source.count("\n") + 1  # "at end of document"


def _longest_number_at(text: str) -> int:
    numbers = list(re.finditer(r"[0-9_]+", text))
    return max(numbers, key=lambda found: found.end() - found.start()).start() if numbers else 0
