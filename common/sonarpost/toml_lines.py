"""Line numbers of the keys of a TOML file, for error messages; `tomllib` does not report them."""

from __future__ import annotations

import re
import tomllib

_STRING = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}'  # multi-line basic, which can end with up to two more quotes
    r"|'''.*?'{3,5}"  # multi-line literal
    r'|"(?:[^"\\\n]|\\.)*"'  # basic
    r"|'[^'\n]*'",  # literal
    re.DOTALL,
)
_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)+")
_BARE_VALUE = re.compile(r"[^,\[\]{}#\n]+")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_SPACE = re.compile(r"[ \t]*")

KeyPath = tuple[str, ...]


def key_lines(text: str) -> dict[KeyPath, int]:
    """Return the first line of each table and key, from 1.

    Args:
        text: A TOML document that `tomllib` accepts.

    Returns:
        Lines by path; the elements of an array are named by their index: ("modems", "0", "address").
    """
    scanner = _Scanner(text)
    scanner.document()
    return scanner.lines


class _Scanner:
    """Scanner of a valid document."""

    def __init__(self, text: str) -> None:
        # As in tomllib.
        self._text = text.replace("\r\n", "\n")
        self._at = 0
        self._counted_to = 0
        self._line = 1
        self._elements: dict[KeyPath, int] = {}
        self.lines: dict[KeyPath, int] = {}

    def document(self) -> None:
        table: KeyPath = ()
        while self._skip_blank():
            if self._text[self._at] == "[":
                table = self._header()
            else:
                self._pair(table)

    def _skip_blank(self) -> bool:
        """Skip white space, line ends and comments; return whether anything follows."""
        if blank := _BLANK.match(self._text, self._at):
            self._at = blank.end()
        return self._at < len(self._text)

    def _header(self) -> KeyPath:
        line = self._line_here()
        brackets = 2 if self._text.startswith("[[", self._at) else 1
        self._at += brackets
        names = self._key()
        self._at += brackets
        if brackets == 2:
            table = (*self._in_elements(names[:-1]), names[-1])
            self._elements[table] = self._elements.get(table, -1) + 1
        table = self._in_elements(names)
        self._note(table, line)
        return table

    def _in_elements(self, names: KeyPath) -> KeyPath:
        """Return the path of a header, with the index of the last element after each array of tables."""
        path: KeyPath = ()
        for name in names:
            path = (*path, name)
            if path in self._elements:
                path = (*path, str(self._elements[path]))
        return path

    def _pair(self, table: KeyPath) -> None:
        line = self._line_here()
        path = table + self._key()
        self._note(path, line)
        self._at += 1  # the equals sign
        self._at = self._after_space()
        self._value(path)

    def _key(self) -> KeyPath:
        """Read a key, which can be dotted."""
        names: list[str] = []
        while True:
            self._at = self._after_space()
            names.append(self._name())
            self._at = self._after_space()
            if self._text[self._at] != ".":
                return tuple(names)
            self._at += 1

    def _name(self) -> str:
        found = _BARE_KEY.match(self._text, self._at) or _STRING.match(self._text, self._at)
        assert found is not None
        self._at = found.end()
        if found.group()[0] in "\"'":
            return str(tomllib.loads(f"name = {found.group()}")["name"])
        return found.group()

    def _value(self, path: KeyPath) -> None:
        if self._text[self._at] == "{":
            self._items("}", path)
        elif self._text[self._at] == "[":
            self._items("]", path)
        else:
            found = _STRING.match(self._text, self._at)
            if found is None:
                # A number, date (which can hold a space) or boolean ends with its line or at a bracket.
                found = _BARE_VALUE.match(self._text, self._at)
            assert found is not None
            self._at = found.end()

    def _items(self, closing: str, path: KeyPath) -> None:
        """Scan an array or an inline table."""
        self._at += 1
        element = 0
        while self._skip_blank() and self._text[self._at] != closing:
            if self._text[self._at] == ",":
                self._at += 1
                element += 1
            elif closing == "}":
                self._pair(path)
            else:
                self._note((*path, str(element)), self._line_here())
                self._value((*path, str(element)))
        self._at += 1

    def _note(self, path: KeyPath, line: int) -> None:
        # A dotted key also defines the tables before its last dot.
        for length in range(1, len(path) + 1):
            self.lines.setdefault(path[:length], line)

    def _after_space(self) -> int:
        found = _SPACE.match(self._text, self._at)
        assert found is not None
        return found.end()

    def _line_here(self) -> int:
        self._line += self._text.count("\n", self._counted_to, self._at)
        self._counted_to = self._at
        return self._line
