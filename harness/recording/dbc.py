"""Signals in CAN messages, by a DBC file, which cantools reads (extra `dbc`)."""

import os
import re
from typing import TYPE_CHECKING, Final, final

from motorhil.traces.can_frame import EFF, EFF_MASK, ERR, RTR, fields
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.errors import TraceError
from motorhil.traces.files import unreadable
from motorhil.traces.layout import Signal

if TYPE_CHECKING:
    from cantools.database.can import Message

_TEXT_MAX: Final = 80
_SYNTAX: Final = re.compile(r"line \d+, column \d+")
_MARK: Final = ">>!<<"
"""How cantools marks the place of an error in its line."""


@final
class Dbc:
    """The messages of a DBC file, by identifier and format.

    Raises:
        TraceError: cantools is not installed, or the file cannot be read or used.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        name = os.fspath(path)
        try:
            import cantools
        except ImportError:
            remedy = "pip install 'motorhil[dbc]'"
            raise TraceError(name, "cannot be read without cantools", remedy=remedy) from None
        try:
            database = cantools.database.load_file(name, database_format="dbc")
        except OSError as error:
            raise unreadable(name, error) from error
        except (cantools.Error, ValueError, LookupError, RecursionError) as error:
            remedy = "correct the file, or leave it out"
            what = f"is not a usable DBC: {_told(error)}"
            raise TraceError(name, what, remedy=remedy) from error
        assert isinstance(database, cantools.database.can.Database)  # the format of a DBC
        self._messages: dict[int, Message] = {
            one.frame_id | (EFF if one.is_extended_frame else 0): one for one in database.messages
        }

    def __call__(self, _bus: str, frame: bytes) -> BusMessage | None:
        """Return the message in a frame; None for an identifier that the file does not have."""
        told = fields(frame)
        if told.can_id & (ERR | RTR):
            return None
        message = self._messages.get(told.can_id & (EFF | EFF_MASK))
        if message is None:
            return None
        import cantools

        try:
            values = message.decode(told.data, allow_truncated=True)
        except (cantools.Error, ValueError, LookupError) as error:
            return BusMessage(message.name, problem=_told(error))
        units = {signal.name: signal.unit or "" for signal in message.signals}
        signals = tuple(
            Signal(name, _plain(value), units.get(name, ""))
            for name, value in (values.items() if isinstance(values, dict) else ())
        )
        return BusMessage(message.name, signals)


def _told(error: Exception) -> str:
    """Return the message of cantools in short: of a wrong line, only where it is wrong."""
    text = " ".join(str(error).split())
    place, (_, mark, found) = _SYNTAX.search(text), text.partition(_MARK)
    if place is not None and mark:
        text = f"invalid syntax at {place[0]}: {found.rstrip(chr(34))}"
    return text if len(text) <= _TEXT_MAX else f"{text[:_TEXT_MAX]}..."


def _plain(value: object) -> int | float | str:
    """Return a number as it is; a named one by its name."""
    return value if isinstance(value, int | float | str) else str(value)
