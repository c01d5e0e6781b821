"""The one exception that means "what the user gave cannot be used", and how what came is shown in a sentence."""

from __future__ import annotations

import reprlib
from typing import Any

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_SHORT.maxlong = 40
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 6
_SHORT.maxlevel = 3


class InputError(ValueError):
    """Bad input. The message is one sentence that names the file or argument, what was expected and what came.

    The command line prints the message alone and exits with code 2; a library caller sees a ``ValueError``.
    """


class EmptyModel(InputError):
    """What was trained came out empty: there may be another way to begin."""


def shown(value: Any) -> str:
    """``value`` as a sentence shows it: its repr, shortened, so that what came from a file cannot grow when it is told."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # a whole number of more digits than Python writes
        return f"a {type(value).__name__} of thousands of digits"


def printable(text: str) -> str:
    """``text`` with control characters (but line ends, returns and tabs) and lone surrogates as escapes: what files hold
    must not steer a terminal."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in "\n\r\t" else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    code = ord(character)
    # Spaces, marks and private letters of scripts are no danger: only what a terminal obeys or cannot encode is escaped.
    if code < 0x20 or 0x7F <= code < 0xA0 or 0xD800 <= code < 0xE000 or code in _DIRECTIONS:
        return character.encode("unicode_escape").decode("ascii")
    return character


_DIRECTIONS = {0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A), 0x2028, 0x2029}
"""Marks that turn the direction of writing, by which a name can be shown as another; and separators of lines."""
