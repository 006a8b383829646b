"""Texts that somebody else wrote, whatever is in them: how they are encoded, TOML, JSON."""

from __future__ import annotations

import codecs
import json
import tomllib
from pathlib import Path
from typing import Any, Protocol

from calib.errors import FAULTS

__all__ = ["MEND_TOML", "decoded", "inside", "read_json", "read_text", "read_toml", "writable"]

# By the marks that such texts begin with; UTF-16's is the beginning of UTF-32's.
_ENCODINGS = {
    codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
}  # fmt: skip


# Of a file that is not valid TOML.
MEND_TOML = "correct that line; names with other characters than A-Z a-z 0-9 _ - stand in quotes"


def decoded(raw: bytes, errors: str = "strict") -> str:
    """Return a text without its byte-order mark: in UTF-8, unless the mark says otherwise.

    Raises
    ------
    UnicodeDecodeError
        If it is not so encoded, unless `errors`, as of `bytes.decode`, says what to do then.
    """
    marked = (name for mark, name in _ENCODINGS.items() if raw.startswith(mark))
    return raw.decode(next(marked, "utf-8-sig"), errors)


def writable(name: str) -> str:
    """Return a name of a file that may be in no encoding as one that a text can hold."""
    return name.encode("utf-8", "backslashreplace").decode()


class _Readable(Protocol):
    def read_bytes(self) -> bytes: ...


def read_text(path: _Readable) -> str:
    """Return the text of a file as `decoded` does, with the line ends of Unix."""
    return decoded(path.read_bytes()).replace("\r\n", "\n")


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file; errors of `read_text` and `tomllib` come out as such."""
    return tomllib.loads(read_text(path))


def read_json(path: Path) -> dict[str, Any]:
    """Return a JSON object; empty where the file is missing or damaged."""
    try:
        return inside(json.loads(read_text(path)))
    except FAULTS:
        return {}


def inside(document: Any, *keys: str) -> dict[str, Any]:
    """Return the object below some keys of a document; empty where there is none."""
    for key in keys:
        document = document.get(key) if isinstance(document, dict) else None
    return document if isinstance(document, dict) else {}
