"""Files that are no certificates: one intact document, spoilt in every way that a file or a value can be."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable, Iterator
from typing import Any

from tests.certificates.alterations import Path, branches, get
from tests.reference.certificates import Document

MARK = "\x00here\x00"
"""Stands for raw JSON text, which `json.dumps` would not write."""

VALUES: dict[str, Any] = {
    "null": None,
    "true": True,
    "zero": 0,
    "minus one": -1,
    "a fraction": 0.5,
    "a large double": 1e308,
    "a large whole number": 10**15,
    "an empty text": "",
    "a word": "x",
    "NaN as a text": "nan",
    "infinity as texts": "inf -inf inf",
    "a number beyond doubles": "0x1.8p+5000",
    "one number": "0x1.0000000000000p+0",
    "spaces": " " * 10_000,
    "many numbers": " ".join(["0x1.0000000000000p+0"] * 5_000),
    "half a surrogate": "\ud800",
    "what a terminal obeys": "\x1b[2J[bold]\x07",
    "an empty list": [],
    "an empty object": {},
    "lists in lists": [[[]], [[None]]],
    "objects in objects": {"box": {"box": {"P": None}}},
    "many nulls": [None] * 3_000,
    "a list of texts": ["0x1.0000000000000p+0", "x", ""],
    "numbers in a list": [1, 2.5, -3],
}
RAW: dict[str, str] = {
    "NaN": "NaN",
    "minus infinity": "-Infinity",
    "a number too large": "1e999",
    "a thousand digits": "9" * 1_000,
    "a hundred thousand digits": "1" + "0" * 100_000,
    "lists 900 deep": "[" * 900 + "]" * 900,
    "lists 50,000 deep": "[" * 50_000 + "]" * 50_000,
    "objects 400 deep": '{"a":' * 400 + "1" + "}" * 400,
    "a key twice": '{"a": 1, "a": 2}',
    "a comma too many": "[1,]",
    "nothing": "",
}
FILES: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "cut off": lambda content, rng: content[: rng.randrange(len(content))],
    "empty": lambda content, rng: b"",
    "blank": lambda content, rng: b" \n" * 100,
    "with a mark of its order of bytes": lambda content, rng: b"\xef\xbb\xbf" + content,
    "in UTF-16": lambda content, rng: content.decode().encode("utf-16"),
    "in UTF-32": lambda content, rng: content.decode().encode("utf-32"),
    "with a byte that is no text": lambda content, rng: content.replace(b"proved", b"prov\xe9d"),
    "with a zero byte": lambda content, rng: content[:50] + b"\x00" + content[50:],
    "twice": lambda content, rng: content + content,
    "with more behind": lambda content, rng: content + b"\n}",
    "in a list": lambda content, rng: b"[" + content + b"]",
    "as a text": lambda content, rng: json.dumps(content.decode()).encode(),
    "all brackets": lambda content, rng: b"[" * 100_000,
    "noise": lambda content, rng: rng.randbytes(5_000),
}
HARMLESS = {("data", "centre"), ("data", "directed")}
"""Another value may be as good: a claim that needs no centre, a graph whose links run both ways."""


def places(document: Document) -> list[Path]:
    """Where a value matters to what is claimed."""
    found = (path for path in branches(document) if path and path[0] in ("data", "claims", "schema"))
    return [path for path in found if path[:2] not in HARMLESS and path[-1] != "margin"]


def spoilt(document: Document, rng: random.Random) -> tuple[str, bytes]:
    """What was done, and the file that came of it: never the document itself."""
    while True:
        kind = rng.random()
        if kind < 0.2:
            what = rng.choice(list(FILES))
            return f"the file {what}", FILES[what](json.dumps(document).encode(), rng)
        path = rng.choice(places(document))
        if kind < 0.4:
            what = rng.choice(list(RAW))
            content = json.dumps(_with(document, path, MARK)).replace(json.dumps(MARK), RAW[what])
            return f"{what} in {path}", content.encode()
        if kind < 0.85:
            what = rng.choice(list(VALUES))
            changed = _with(document, path, VALUES[what])
        else:
            what, changed = _other_shape(document, path, rng)
        if changed != document:
            return f"{what} in {path}", json.dumps(changed).encode()


def _with(document: Document, path: Path, value: Any) -> Document:
    changed = copy.deepcopy(document)
    get(changed, path[:-1])[path[-1]] = copy.deepcopy(value)
    return changed


def _other_shape(document: Document, path: Path, rng: random.Random) -> tuple[str, Document]:
    """Something too little, too much, or wrapped."""
    value = get(document, path)
    ways: list[tuple[str, Any]] = [("wrapped in a list", [value]), ("wrapped in an object", {"value": value})]
    if isinstance(value, dict):
        ways += [("a key more", {**value, "note": "true for every network"})]
        ways += [(f"no {key}", {k: v for k, v in value.items() if k != key}) for key in value]
    if isinstance(value, list) and path != ("claims",):
        ways += [("one more", [*value, value[-1] if value else None]), ("one less", value[:-1])]
    if isinstance(value, str) and " " in value:
        ways += [("one number less", value.rpartition(" ")[0]), ("one number more", f"{value} 0x0.0p+0")]
    what, other = rng.choice(ways)
    return what, _with(document, path, other)


def labels(document: Document) -> Iterator[tuple[str, Document]]:
    """What heads the document, as anything else: no claim rests on it."""
    for key in ("tolnet", "problem", "convention", "tau", "tolerance", "status"):
        for what, value in VALUES.items():
            yield f"{what} in {key}", {**document, key: value}
