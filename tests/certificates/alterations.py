"""Designed and random alterations of a certificate. Each is a changed copy."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterator
from typing import Any

from tests.reference.certificates import BLOCKS, Document

Path = tuple[str | int, ...]


def leaves(thing: Any, path: Path = ()) -> Iterator[Path]:
    """The paths of everything in the document that holds nothing else."""
    if isinstance(thing, dict | list) and thing:
        for key, part in thing.items() if isinstance(thing, dict) else enumerate(thing):
            yield from leaves(part, (*path, key))
    else:
        yield path


def branches(thing: Any, path: Path = ()) -> Iterator[Path]:
    """The paths of everything in the document."""
    yield path
    if isinstance(thing, dict | list):
        for key, part in thing.items() if isinstance(thing, dict) else enumerate(thing):
            yield from branches(part, (*path, key))


def get(document: Document, path: Path) -> Any:
    """What lies at the path."""
    thing: Any = document
    for key in path:
        thing = thing[key]
    return thing


def put(document: Document, path: Path, value: Any) -> Document:
    """A copy with this value there."""
    document = copy.deepcopy(document)
    get(document, path[:-1])[path[-1]] = value
    return document


def numbers(document: Document) -> list[Path]:
    """The paths of the texts of numbers that are not empty."""
    used = [path for path in leaves(document) if path[0] in ("data", "claims")]
    return [path for path in used if isinstance(get(document, path), str) and "0x" in get(document, path)]


def words_at(change: Callable[[list[float]], list[float]]) -> Callable[[str], str]:
    """A change of the numbers of a text."""
    return lambda text: " ".join(float(x).hex() for x in change([float.fromhex(word) for word in text.split()]))


OF_NUMBERS: dict[str, Callable[[str], str]] = {
    "a sign": words_at(lambda x: [-x[0], *x[1:]]),
    "the last sign": words_at(lambda x: [*x[:-1], -x[-1]]),
    "every sign": words_at(lambda x: [-y for y in x]),
    "zero": words_at(lambda x: [0.0 * y for y in x]),
    "eight times": words_at(lambda x: [8 * x[0], *x[1:]]),
    "an eighth": words_at(lambda x: [x[0] / 8, *x[1:]]),
    "one more": words_at(lambda x: [*x[:-1], x[-1] + 1]),
    "reversed": words_at(lambda x: x[::-1]),
    "a number too few": words_at(lambda x: x[:-1]),
    "a number too many": words_at(lambda x: [*x, 1.0]),
    "no number": lambda text: text.replace("0x", "0y", 1),
    "infinite": lambda text: "inf " + " ".join(text.split()[1:]) if " " in text else "inf",
    "decimal": lambda text: " ".join(["0.5", *text.split()[1:]]),
    "two spaces": lambda text: text.replace(" ", "  ") + " ",
}


def designed(document: Document) -> Iterator[tuple[str, Document]]:
    """What someone would try who wants a certificate to say more than it proves."""
    claim = document["claims"][0]
    evidence = "proof" if "proof" in claim else "witness"
    here: Path = ("claims", 0)
    for kind, change in OF_NUMBERS.items():
        seen = set()
        for path in numbers(document):
            place = tuple("#" if isinstance(key, int) else key for key in path)
            if place not in seen:  # the first of every list
                seen.add(place)
                yield f"{kind} in {path}", put(document, path, change(get(document, path)))
    for path in branches(document):
        value = get(document, path)
        if isinstance(value, list) and len(value) > 1 and path != ("claims",) and path[0] in ("data", "claims"):
            yield f"one too few in {path}", put(document, path, value[:-1])
            yield f"twice the first in {path}", put(document, path, [value[0], value[0], *value[2:]])
            yield f"exchanged in {path}", put(document, path, [value[1], value[0], *value[2:]])
        if isinstance(value, dict) and path and path[0] in ("data", "claims"):
            yield f"unknown key in {path}", put(document, (*path, "note"), "true for every network")
            for key in value:
                kind = "less" if path[2:3] == ("scenarios",) else "no key"
                yield f"{kind} {key} in {path}", put(document, path, {k: v for k, v in value.items() if k != key})
    for margin in (claim["margin"], 0.0, 0.5, 0.999999, 1.0, -1.0, 1e-300, True, None, "0.1", [0.1]):
        yield f"margin {margin!r}", put(document, (*here, "margin"), margin)
    for verdict in ("proved", "refuted", "undecided", "valid", None):
        yield f"verdict {verdict}", put(document, (*here, "verdict"), verdict)
    swapped = copy.deepcopy(document)
    other = swapped["claims"][0]
    other["witness" if evidence == "proof" else "proof"] = other.pop(evidence)
    other["verdict"] = "refuted" if evidence == "proof" else "proved"
    yield "verdict flipped", swapped
    for name in ("schur-stability", "decay-rate", "switching", "performance", "observability", "nonsense"):
        yield f"the claim {name}", put(document, (*here, "claim"), name)
    for said in (
        "The network is safe.",
        claim["statement"] + " ",
        claim["statement"].replace(BLOCKS["network"], BLOCKS["F"]),
        claim["statement"].replace("inside", "outside"),
    ):
        yield f"statement {said!r}", put(document, (*here, "statement"), said)
    yield "a reason", put(document, (*here, "reason"), "and it will stay so")
    if "block" in claim:
        for block in ("F", "network", "whole", None):
            said = claim["statement"].replace(BLOCKS[claim["block"]], BLOCKS.get(str(block), ""))
            yield f"block {block}", put(put(document, (*here, "block"), block), (*here, "statement"), said)
    if "rate" in claim:
        for factor in (0.9, 0.5, 1e-3, -1.0, 0.0):
            rate = factor * float.fromhex(claim["rate"])
            said = claim["statement"].replace(repr(float.fromhex(claim["rate"])), repr(rate))
            yield f"rate {rate}", put(put(document, (*here, "rate"), rate.hex()), (*here, "statement"), said)
    if "method" in claim[evidence]:
        for method in ("primal", "dual", "power", "full", "lyapunov", "blocks", None, ["full"]):
            yield f"method {method}", put(document, (*here, evidence, "method"), method)
    if "drop" in claim:
        for drop in (0, 1, 2, 3, 10, -1, True, 1.0):
            said = claim["statement"].replace(f"at most {claim['drop']}", f"at most {drop}")
            yield f"drop {drop}", put(put(document, (*here, "drop"), drop), (*here, "statement"), said)
    if claim["claim"] == "performance":
        yield from _narrowed(document, claim)
    for key in ("power",):
        if key in claim[evidence]:
            for value in (0, 1, 2, 3, 4, 65, 2.0, True):
                yield f"{key} {value}", put(document, (*here, evidence, key), value)
    for i, heard in enumerate(document["data"]["neighbours"]):
        for changed in (heard[::-1], [*heard, heard[-1]], [l for l in heard if l != i], [*heard, 99], [-1, *heard]):
            yield f"node {i} hears {changed}", put(document, ("data", "neighbours", i), changed)
    for key in ("n", "nodes"):
        for value in (0, 1, 2, 3, 4, 10**15, True, 2.0, "2"):
            yield f"{key} {value!r}", put(document, ("data", key), value)
    for value in (True, False, None, 0):
        yield f"directed {value!r}", put(document, ("data", "directed"), value)
    yield "no centre", put(document, ("data", "centre"), None)
    yield from _unmixed(document)
    yield "told twice", {**document, "claims": [*document["claims"], *copy.deepcopy(document["claims"])]}


def _unmixed(document: Document) -> Iterator[tuple[str, Document]]:
    """Weights that no longer sum to one, in `data` and in scenarios: every condition becomes easier to meet."""
    rows: list[Path] = [("data", "weights", k) for k in range(len(document["data"]["weights"]))]
    for i, scenario in enumerate(document["claims"][0].get("scenarios", [])):
        where: Path = ("claims", 0, "scenarios", i, "weights")
        rows += [(*where, k) for k in range(len(scenario.get("weights", [])))]
    for path in rows:
        for factor in (0.0, 0.5, 1 - 1e-6, 1 - 1e-13):
            smaller = words_at(lambda x, factor=factor: [factor * y for y in x])
            yield f"columns times {factor} in {path}", put(document, path, smaller(get(document, path)))


def _narrowed(document: Document, claim: Document) -> Iterator[tuple[str, Document]]:
    """Intervals that promise more."""
    for path in [("nodes", 0), ("centre",), ("network",)]:
        low, high = map(float.fromhex, get(claim, path).split())
        for a, b in ((0.5 * (low + high), high), (low, 0.5 * (low + high)), (high, low), (0.9 * low, 0.95 * low)):
            narrow = put(document, ("claims", 0, *path), f"{a.hex()} {b.hex()}")
            if path == ("network",):
                said = claim["statement"].replace(f"[{low!r}, {high!r}]", f"[{a!r}, {b!r}]")
                narrow = put(narrow, ("claims", 0, "statement"), said)
            yield f"{path} narrowed to {a}, {b}", narrow
        yield f"{path} widened", put(document, ("claims", 0, *path), f"{(low / 2).hex()} {(high * 2).hex()}")


def at_random(document: Document, rng: random.Random) -> Document:
    """One alteration, or a few, somewhere."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        document = _one_at_random(document, rng)
    return document


def _one_at_random(document: Document, rng: random.Random) -> Document:
    paths = numbers(document)
    if rng.random() < 0.7 and paths:
        path = rng.choice(paths)
        return put(document, path, _other_text(get(document, path), rng))
    path = rng.choice([path for path in branches(document) if path])
    value = get(document, path)
    if rng.random() < 0.3:  # something from elsewhere in the document
        return put(document, path, copy.deepcopy(get(document, rng.choice(list(branches(document))))))
    if isinstance(value, list) and value:
        changed = list(value)
        rng.choice((rng.shuffle, lambda x: x.pop(), lambda x: x.append(x[0]), lambda x: x.reverse()))(changed)
        return put(document, path, changed)
    if isinstance(value, dict) and value:
        key = rng.choice(list(value))
        return put(document, path, {k: v for k, v in value.items() if k != key})
    if isinstance(value, bool) or value is None:
        return put(document, path, rng.choice((True, False, None, 0, 1, [], {}, "0x1.0000000000000p+0")))
    if isinstance(value, int | float):
        return put(document, path, rng.choice((value + 1, value - 1, -value, value / 2, value * 2, int(value))))
    if isinstance(value, str) and value:
        return put(document, path, _other_text(value, rng))
    return put(document, path, rng.choice((None, "0x0.0p+0", [], 0)))


def _other_text(text: str, rng: random.Random) -> str:
    kind = rng.randrange(6)
    at = rng.randrange(len(text))
    if kind == 0:  # a character for another
        return text[:at] + rng.choice("0123456789abcdef") + text[at + 1 :]
    if kind == 1:  # gone
        return text[:at] + text[at + 1 :]
    words = text.split(" ")
    i = rng.randrange(len(words))
    if kind == 2:
        words[i] = words[i][1:] if words[i].startswith("-") else "-" + words[i]
    elif kind == 3:
        j = rng.randrange(len(words))
        words[i], words[j] = words[j], words[i]
    else:
        try:
            value = float.fromhex(words[i])
            words[i] = (value * 2.0 ** rng.randint(-9, 9) if kind == 4 else value * (1 + rng.gauss(0, 0.2))).hex()
        except (ValueError, OverflowError):
            words[i] = rng.choice(words)
    return " ".join(words)
