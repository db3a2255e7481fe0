"""Mutation testing of certificates/check.py: make one small fault at a time and see whether the tests notice.

    python scripts/mutate_checker.py [--jobs 2] [--limit SECONDS] [--function NAME] [--among FILE] [--survivors FILE]

The checker decides what people rely on, so its tests are tested too. Each mutant is compiled from a changed syntax
tree and put in the place of the checker in a forked process, which runs the tests of tests/certificates in turn
until one fails. What survives is printed; docs/decisions/0012-mutants-of-the-checker.md explains each survivor.

Messages and the command line are left out: the tests of processes watch those. So are limits of time and memory: at
worst they decline what is true.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import itertools
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

SYMMETRIC_IN_LOOKS = {"_congruence", "_contains", "full", "zip", "_scaled"}
NOT_MUTATED = {
    *("watched", "_line", "_shown", "main"),  # what people see, not what is decided
    *("Clock", "_fits"),  # what is declined
}
OPPOSITE: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Add,),
    ast.Div: (ast.Mult,),
    ast.FloorDiv: (ast.Mult,),
    ast.Pow: (ast.Mult,),
    ast.LShift: (ast.RShift,),
    ast.RShift: (ast.LShift,),
    ast.BitOr: (ast.BitAnd,),
    ast.BitAnd: (ast.BitOr,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
}


Route = tuple[tuple[str, int | None], ...]  # from the root of a syntax tree to a node
Change = Callable[[Any], None]


@dataclass(frozen=True)
class Mutant:
    """One fault: where it is in the syntax tree, what it is, and how to make it."""

    function: str
    fault: str
    path: Route
    change: Change

    def __str__(self) -> str:
        return f"{self.function}: {self.fault}"

    def tree(self, source: str) -> ast.Module:
        """The syntax tree that has the fault."""
        tree = ast.parse(source)
        self.change(_at(tree, self.path))
        return ast.fix_missing_locations(tree)


def mutants(source: str) -> Iterator[Mutant]:
    """Every fault of the kinds below, one at a time."""
    tree = ast.parse(source)
    for path, node in _walk(tree, ()):
        if isinstance(tree.body[path[0][1] or 0] if path else None, ast.Assign):
            continue  # a limit, or another constant of the module
        for fault, change in _faults(node):
            yield Mutant(_function(tree, path), f"{fault}: {ast.unparse(node)[:90]!r}", path, change)


def _walk(node: ast.AST, path: Route) -> Iterator[tuple[Route, ast.AST]]:
    """The nodes worth a fault: no messages, annotations or docstrings."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name in NOT_MUTATED:
        return
    if isinstance(node, ast.Expr) and ast.unparse(node) == "Clock.check()":
        return
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return  # zip(..., strict=True) only guards what has been checked before
    if isinstance(node, ast.JoinedStr | ast.Raise | ast.Import | ast.ImportFrom):
        if isinstance(node, ast.Raise):
            yield path, node
        return
    yield path, node
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list"):
            continue
        if isinstance(value, ast.AST):
            yield from _walk(value, (*path, (field, None)))
        elif isinstance(value, list):
            for i, part in enumerate(value):
                if isinstance(part, ast.AST):
                    yield from _walk(part, (*path, (field, i)))


def _function(tree: ast.AST, path: Route) -> str:
    """The innermost function or class around it."""
    name = "module"
    for step in path:
        tree = _at(tree, (step,))
        name = getattr(tree, "name", None) or name
    return name


def _at(tree: ast.AST, path: Route) -> ast.AST:
    for field, i in path:
        value = getattr(tree, field)
        tree = value if i is None else value[i]
    return tree


def _setting(field: str, value: Callable[[Any], Any]) -> Change:
    def change(node: Any) -> None:
        setattr(node, field, value(node))

    return change


def _faults(node: ast.AST) -> Iterator[tuple[str, Change]]:
    if isinstance(node, ast.Compare):
        for i, operator in enumerate(node.ops):
            for other in OPPOSITE.get(type(operator), ()):
                yield f"{other.__name__}", _setting("ops", lambda n, i=i, o=other: [*n.ops[:i], o(), *n.ops[i + 1 :]])
    if isinstance(node, ast.BinOp | ast.BoolOp):
        for other in OPPOSITE.get(type(node.op), ()):
            yield f"{other.__name__}", _setting("op", lambda _, o=other: o())
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub | ast.Div | ast.LShift | ast.MatMult):
        yield "operands swapped", _swap("left", "right")
    if isinstance(node, ast.BinOp) and not isinstance(node.op, ast.BitOr):
        yield "one operand alone", _become(lambda n: n.left)
    if isinstance(node, ast.BoolOp):
        for i in range(len(node.values)):
            yield (
                f"without condition {i}",
                _become(
                    lambda n, i=i: (
                        ast.BoolOp(n.op, rest) if len(rest := [*n.values[:i], *n.values[i + 1 :]]) > 1 else rest[0]
                    )
                ),
            )
    if isinstance(node, ast.UnaryOp):
        yield "without its sign", _become(lambda n: n.operand)
    if isinstance(node, ast.Constant) and type(node.value) is int:
        yield "one more", _setting("value", lambda n: n.value + 1)
        yield "one less", _setting("value", lambda n: n.value - 1)
    if isinstance(node, ast.Constant) and type(node.value) is bool:
        yield "the other", _setting("value", lambda n: not n.value)
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        yield "always", _setting("test", lambda _: ast.Constant(True))
        yield "never", _setting("test", lambda _: ast.Constant(False))
    if isinstance(node, ast.comprehension) and node.ifs:
        yield "without its filter", _setting("ifs", lambda _: [])
    if isinstance(node, ast.Raise) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield "dropped", _become(lambda _: ast.Pass())
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in SYMMETRIC_IN_LOOKS:
        yield "arguments swapped", _setting("args", lambda n: [n.args[1], n.args[0], *n.args[2:]])
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        if node.func.id in ("abs", "min", "max", "sorted", "round"):
            yield f"without {node.func.id}", _become(lambda n: n.args[0] if len(n.args) == 1 else n.args[-1])
        if node.func.id in ("min", "max", "all", "any"):
            other = {"min": "max", "max": "min", "all": "any", "any": "all"}[node.func.id]
            yield other, _setting("func", lambda _, o=other: ast.Name(o, ast.Load()))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "by":
        yield (
            "factors swapped",
            _become(lambda n: ast.Call(ast.Attribute(n.args[0], "by", ast.Load()), [n.func.value], [])),
        )
    if isinstance(node, ast.Attribute) and node.attr == "T" and isinstance(node.ctx, ast.Load):
        yield "not transposed", _become(lambda n: n.value)
    if isinstance(node, ast.AugAssign):
        yield "no longer added", _become(lambda n: ast.Assign([n.target], n.value))


def _swap(a: str, b: str) -> Change:
    def change(node: Any) -> None:
        x, y = getattr(node, a), getattr(node, b)
        setattr(node, a, y)
        setattr(node, b, x)

    return change


def _become(other: Callable[[Any], ast.AST]) -> Change:
    """The node turns into another one, in its place."""

    def change(node: Any) -> None:
        replacement = other(node)
        node.__class__ = replacement.__class__
        fields = dict(replacement.__dict__)
        node.__dict__.clear()
        node.__dict__.update(fields)

    return change


# ---- The tests, as plain calls ----


# Of many cases of one kind, every so many: enough to notice a fault, and much quicker.
STRIDE = {
    "test_designed_alterations": 2,
    "test_random_alterations": 10,
    "test_intervals_are_as_narrow_as_the_proof_allows_and_no_narrower": 4,
    "test_random_networks_on_both_sides": 5,
    "test_nothing_but_a_refusal_or_a_finding_comes_out": 3,
    "test_no_alteration_is_accepted_unless_it_is_true": 4,
    "test_the_rate_that_a_proof_reaches": 3,
    "test_the_margin_that_switching_reaches": 4,
    "test_the_contraction_of_the_centre_that_performance_needs": 2,
}
NEED_A_PROCESS = {
    "test_it_runs_as_a_plain_file",
    "test_it_imports_the_standard_library_only",
    "test_memory_stays_near_the_size_of_the_file",
    "test_messages_of_hostile_files_are_plain_text",
    "test_the_source_has_no_means_to_run_what_it_reads",
    # of the clock, which waits
    "test_too_many_sets_of_links_are_not_checked",
    "test_too_many_steps_are_not_checked",
    "test_many_scenarios_are_not_checked_for_ever",
    "test_every_claim_counts_against_the_same_time",
    "test_a_wide_tilt_takes_little_memory",
    "test_a_window_beyond_all_means_is_declined",
}


def battery() -> list[tuple[str, Callable[[], None]]]:
    """The tests of the checker that need no process."""
    import pytest
    from tests.certificates import (
        test_alterations,
        test_check,
        test_columns,
        test_hostile,
        test_observability,
        test_soundness,
        test_thresholds,
    )

    calls: list[tuple[str, Callable[[], None]]] = []
    modules = (
        *(test_check, test_soundness, test_columns, test_thresholds, test_hostile, test_alterations),
        test_observability,
    )
    for module in modules:
        for name, function in inspect.getmembers(module, inspect.isfunction):
            if not name.startswith("test_") or name in NEED_A_PROCESS:
                continue
            names = set(inspect.signature(function).parameters)
            marks = [mark for mark in getattr(function, "pytestmark", []) if mark.name == "parametrize"]
            for values in list(itertools.product(*(mark.args[1] for mark in marks)))[:: STRIDE.get(name, 1)]:
                arguments: dict[str, Any] = {}
                for mark, value in zip(marks, values, strict=True):
                    several = not isinstance(mark.args[0], str)
                    arguments |= dict(zip(mark.args[0], value, strict=True)) if several else {mark.args[0]: value}
                calls.append((f"{name}{list(arguments.values())}", _call(pytest, function, arguments, names)))
    return calls


def _call(
    pytest: Any, function: Callable[..., None], arguments: dict[str, Any], names: set[str]
) -> Callable[[], None]:
    def call() -> None:
        with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
            extra = {"tmp_path": Path(folder), "monkeypatch": patch}
            function(**arguments, **{key: value for key, value in extra.items() if key in names})

    return call


def install(mutant: Mutant, module: ModuleType) -> None:
    """Put the mutant in the place of the checker, and of every name that the tests took from it."""
    before = dict(vars(module))
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    exec(compile(mutant.tree(source), str(module.__file__), "exec"), vars(module))
    for other in list(sys.modules.values()):
        if getattr(other, "__name__", "").startswith("tests.certificates"):
            for name, value in list(vars(other).items()):
                if name in before and value is before[name]:
                    setattr(other, name, vars(module)[name])


def forked(mutant: Mutant, module: ModuleType, tests: list[tuple[str, Callable[[], None]]], limit: int) -> int:
    """A process that runs the tests on the mutant until one fails; it ends with 0 if none does."""
    child = os.fork()
    if child == 0:
        failed = 1
        try:
            with Path(os.devnull).open("w") as nowhere:
                os.dup2(nowhere.fileno(), 1)
                os.dup2(nowhere.fileno(), 2)
            signal.setitimer(signal.ITIMER_VIRTUAL, limit)  # of its own time, however busy the machine is
            install(mutant, module)
            for _, call in tests:
                call()
            failed = 0
        finally:
            os._exit(failed)
    return child


def main() -> int:
    """Make every mutant, run the tests on each, print the survivors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--limit", type=int, default=60, metavar="SECONDS", help="a mutant that takes longer is noticed"
    )
    parser.add_argument("--function", action="append", help="only the mutants of this function (may be repeated)")
    parser.add_argument(
        "--among", type=Path, help="only the mutants that this file names: the survivors of another run"
    )
    parser.add_argument("--sample", type=int, default=0, help="only so many mutants, at random")
    parser.add_argument("--survivors", type=Path, help="write the survivors here, a line each")
    options = parser.parse_args()

    import warnings

    from tests.certificates.examples import certificates

    from tolnet.certificates import check as module

    warnings.simplefilter("error")
    certificates()
    tests = battery()
    started, seconds = time.monotonic(), dict[str, float]()
    for name, call in tests:
        begun = time.process_time()
        call()
        seconds[name] = time.process_time() - begun
    tests.sort(key=lambda test: seconds[test[0]])
    print(f"{len(tests)} tests, {time.monotonic() - started:.0f} s on the checker as it is", flush=True)

    found = list(mutants(Path(str(module.__file__)).read_text(encoding="utf-8")))
    found = [mutant for mutant in found if not options.function or mutant.function in options.function]
    if options.among:
        named = set(options.among.read_text(encoding="utf-8").splitlines())
        found = [mutant for mutant in found if str(mutant) in named]
    if options.sample:
        found = random.Random(0).sample(found, min(options.sample, len(found)))
    slow = 0
    waiting, running, alive = list(reversed(found)), dict[int, Mutant](), list[Mutant]()
    while waiting or running:
        while waiting and len(running) < options.jobs:
            mutant = waiting.pop()
            running[forked(mutant, module, tests, options.limit)] = mutant
        child, status = os.wait()
        mutant = running.pop(child)
        slow += os.WIFSIGNALED(status)
        if status == 0:
            alive.append(mutant)
            print(f"survives: {mutant}", flush=True)
        done = len(found) - len(waiting) - len(running)
        if done % 50 == 0:
            print(f"{done} of {len(found)}, {len(alive)} survive, {time.monotonic() - started:.0f} s", flush=True)
    print(f"{len(found)} mutants, {len(found) - len(alive)} noticed ({slow} by their time), {len(alive)} survive")
    if options.survivors:
        lines = sorted(map(str, alive))
        options.survivors.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
