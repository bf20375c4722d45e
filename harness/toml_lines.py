"""Line numbers of keys in a TOML text; tomllib reads the values.

A path is the keys down to a value. Array items and tables of an array of tables are counted from 0.
The text must be one that tomllib accepts, so nothing is checked here.
"""

import re
import tomllib
from collections.abc import Mapping
from typing import Final

KeyPath = tuple[str | int, ...]

BARE_KEY: Final = re.compile(r"[A-Za-z0-9_-]+")
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
