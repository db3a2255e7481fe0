"""Certificates as files: how they are written, and compared with what a problem and a table say."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tolnet.certificates.deployed import Deployed
from tolnet.certificates.verdicts import Verdict

SCHEMA = "tolnet.certificate/1"


def certificate_json(
    opening: Mapping[str, Any], data: Mapping[str, Any], verdicts: Sequence[Verdict]
) -> Iterator[str]:
    """The document in pieces, a line a node; `opening` holds the keys that open every document."""
    yield "{\n"
    for key, value in opening.items():
        yield f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)},\n"
    yield '  "data": {\n'
    yield from _members(data, "    ")
    yield '  },\n  "claims": ['
    for i, verdict in enumerate(verdicts):
        yield ("," if i else "") + "\n    {\n"
        yield from _members(verdict.entry(), "      ")
        yield "    }"
    yield "\n  ]\n}\n"


def _members(value: Mapping[str, Any], margin: str) -> Iterator[str]:
    """The members of an object, one a line; lists and objects that are long are spread over lines too."""
    last = len(value) - 1
    for i, (key, item) in enumerate(value.items()):
        comma = "" if i == last else ","
        if isinstance(item, Mapping) and len(item) > 0:
            yield f"{margin}{json.dumps(key)}: {{\n"
            yield from _members(item, margin + "  ")
            yield f"{margin}}}{comma}\n"
        elif isinstance(item, list) and len(item) > 1:
            yield f"{margin}{json.dumps(key)}: [\n"
            for j, entry in enumerate(item):
                yield f"{margin}  {json.dumps(entry, allow_nan=False)}{'' if j == len(item) - 1 else ','}\n"
            yield f"{margin}]{comma}\n"
        else:
            yield f"{margin}{json.dumps(key)}: {json.dumps(item, allow_nan=False)}{comma}\n"


OF_PROBLEM = ("n", "nodes", "A", "process", "C", "noise", "directed", "neighbours")
OF_TABLE = ("weights", "gains")


def differences(stated: Mapping[str, Any], deployed: Deployed, keys: Sequence[str]) -> list[str]:
    """Where the `data` of a certificate are other numbers than those of a deployment, key by key and node by node.

    Both are compared as exact numbers: texts that read back to the same doubles are the same.
    """
    return data_differences(stated, deployed.data(), keys)


def data_differences(stated: Mapping[str, Any], own: Mapping[str, Any], keys: Sequence[str]) -> list[str]:
    """The same, of two `data`."""
    found = []
    for key in keys:
        if not _same(stated.get(key), own[key]):
            found.append(f"{key}{_where(stated.get(key), own[key])}")
    return found


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, str) and isinstance(b, str):
        return a == b or _numbers(a) == _numbers(b)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    return type(a) is type(b) and a == b


def _numbers(text: str) -> list[float]:
    return [float.fromhex(word) for word in text.split(" ")] if text else []


def _where(a: Any, b: Any) -> str:
    """The first entry of two lists that differ, in brackets."""
    if not (isinstance(a, list) and isinstance(b, list)):
        return ""
    if len(a) != len(b):
        return f" (of {len(a)} nodes instead of {len(b)})"
    wrong = [k for k, pair in enumerate(zip(a, b, strict=True)) if not _same(*pair)]
    more = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
    return f"[{wrong[0]}]{more}"
