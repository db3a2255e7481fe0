"""What is read whole is a file, and no larger than anybody can mean."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from tolnet import model
from tolnet.model import Complaint, InputError
from tolnet.model.bounded_reading import (
    ALWAYS_UNPACKED,
    HEAD,
    LARGEST_PROBLEM,
    MOST_INFLATION,
    check_inflation,
    read_whole,
    text_of,
)
from tolnet.model.errors import MOST_COMPLAINTS, Remainder

OPENING = 'schema = "tolnet.problem/1"\n[plant]\nA = [[0.5]]\nQ = [[1.0]]\n'
SENSOR = "[[sensors]]\nC = [[1.0]]\nR = [[1.0]]\n"


def a_pipe(folder: Path) -> Path:
    os.mkfifo(folder / "pipe")
    return folder / "pipe"


def a_socket(folder: Path) -> Path:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(folder / "s"))
    return folder / "s"


def a_circle(folder: Path) -> Path:
    (folder / "a").symlink_to("b")
    (folder / "b").symlink_to("a")
    return folder / "a"


def a_hole(folder: Path) -> Path:
    with (folder / "hole").open("wb") as file:
        file.truncate(2**40)
    return folder / "hole"


NO_FILES: list[tuple[Callable[[Path], Path], str]] = [
    (a_pipe, "is a pipe; a file was expected"),
    (a_socket, "is a socket; a file was expected"),
    (lambda _: Path("/dev/zero"), "is a device; a file was expected"),
    (lambda folder: folder, "is a directory; a file was expected"),
    (a_circle, "cannot be read: Too many levels of symbolic links"),
    (a_hole, "is 1024 GiB long; at most 128 MiB were expected"),
    (lambda folder: folder / "none", "does not exist"),
    (lambda folder: folder / "a\0b", "cannot be read: embedded null byte"),
]


@pytest.mark.parametrize(("make", "message"), NO_FILES, ids=[message[:16] for _, message in NO_FILES])
def test_what_is_no_file_is_not_opened(tmp_path, make, message):
    path = make(tmp_path)
    with pytest.raises(InputError, match=message):
        read_whole(path, LARGEST_PROBLEM)
    with pytest.raises(InputError, match=message) as caught:
        model.load(path)
    assert caught.value.source == str(path)


def test_a_link_to_a_file_is_a_file(tmp_path):
    (tmp_path / "file").write_bytes(b"x" * (HEAD + 1))
    (tmp_path / "link").symlink_to("file")
    assert read_whole(tmp_path / "link", HEAD + 1) == b"x" * (HEAD + 1)
    with pytest.raises(InputError, match="at most 128 KiB were expected"):
        read_whole(tmp_path / "link", HEAD)


def test_a_look_may_end_the_reading(tmp_path):
    (tmp_path / "file").write_bytes(b"x" * (HEAD + 1))
    seen: list[tuple[int, int]] = []
    read_whole(tmp_path / "file", HEAD + 1, lambda head, size: seen.append((len(head), size)))
    assert seen == [(HEAD, HEAD + 1)]


def test_a_file_without_a_size_is_bounded_too():
    assert Path("/proc/self/maps").stat().st_size == 0
    with pytest.raises(InputError, match="is larger than 16 bytes"):
        read_whole("/proc/self/maps", 16)


def test_inflation():
    check_inflation(ALWAYS_UNPACKED, 1)
    check_inflation(MOST_INFLATION * ALWAYS_UNPACKED, ALWAYS_UNPACKED)
    with pytest.raises(InputError, match=r"would unpack 1 bytes to 64 MiB, more than 100 times as much"):
        check_inflation(ALWAYS_UNPACKED + 1, 1)
    with pytest.raises(InputError, match="store it without compression"):
        check_inflation(MOST_INFLATION * ALWAYS_UNPACKED + 1, ALWAYS_UNPACKED)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_text(encoding):
    assert text_of("süd\r\n".encode(encoding)) == "süd\r\n"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (OPENING.encode("utf-16"), "is text in UTF-16; save it in UTF-8"),
        (OPENING.replace("\n", "\r").encode(), "ends its lines with carriage returns alone"),
        (b"a = 1\nname = '\xe9'", "is no text: line 2 holds bytes that are not UTF-8"),
        (bytes(1000), "is no text: it holds zero bytes"),
        (b"[" + b"a." * 2000 + b"a]", "is nested too deeply to be read"),
        (b"x = " + b"[" * 2000 + b"]" * 2000, "is nested too deeply to be read"),
        (b"x = " + b"{a=" * 2000 + b"1" + b"}" * 2000, "is nested too deeply to be read"),
    ],
)
def test_texts_that_are_no_problem_file(tmp_path, data, message):
    (tmp_path / "p.toml").write_bytes(data)
    with pytest.raises(InputError, match=message):
        model.load(tmp_path / "p.toml")


def told(folder: Path, text: str) -> list[Complaint]:
    (folder / "p.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        model.load_problem(folder / "p.toml")
    return list(caught.value.complaints)


def test_of_a_long_file_the_beginning_is_judged_first(tmp_path):
    keys = "".join(f"k{i} = 1\n" for i in range(50_000))
    for text in (keys + OPENING, OPENING.replace("A =", keys + "A =")):
        found = told(tmp_path, text)
        assert [c.key.removeprefix("plant.") for c in found[:-1]] == [f"k{i}" for i in range(MOST_COMPLAINTS)]
        assert "more complaints up to line" in found[-1].message
        assert f"the rest of its {len(text):,} bytes was not judged" in found[-1].message


def test_wrong_sensors_in_the_beginning_of_a_long_file(tmp_path):
    network = "[network]\nnodes = 9000\nedges = []\n"
    found = told(tmp_path, OPENING + network + SENSOR.replace("R = [[1.0]]", "R = [[-1.0]]") * 9000)
    assert [c.key for c in found[:-1]] == [f"sensors[{k}].R" for k in range(MOST_COMPLAINTS)]
    assert found[0].message == "is not positive definite: [0][0] is -1.0"


@pytest.mark.parametrize("table", [SENSOR, SENSOR.replace("C = [[1.0]]", "C = [\n[1.0]\n]")])
def test_a_long_file_that_is_right_is_read(tmp_path, table):
    """Wherever the beginning ends: not what is cut off it is judged."""
    N = 2 * HEAD // len(table)
    (tmp_path / "p.toml").write_text(f"{OPENING}[network]\nnodes = {N}\nedges = []\n{table * N}", encoding="utf-8")
    assert model.load(tmp_path / "p.toml").N == N


def test_what_is_wrong_late_in_a_long_file_is_told(tmp_path):
    N = 2 * HEAD // len(SENSOR)
    network = f"[network]\nnodes = {N}\nedges = []\n"
    late = SENSOR + "r = 1\n"
    found = told(tmp_path, OPENING + network + SENSOR * (N - 1) + late)
    assert [(c.key, c.message) for c in found] == [
        (f"sensors[{N - 1}].r", "is no known key; the nearest is 'R'"),
    ]


def test_late_entries_of_long_lists_are_judged():
    sensor = {"C": [[1.0]], "R": [[1.0]]}
    problem = {"schema": "tolnet.problem/1", "plant": {"A": [[0.5]], "Q": [[1.0]]}, "sensors": [sensor] * 3000}
    network = {"nodes": 3000, "edges": [], "positions": [[0.0, 1.0]] * 2999 + [["x", 1.0]]}
    with pytest.raises(InputError, match=r"network\.positions is not a rectangular .* it holds 'x'"):
        model.parse({**problem, "network": network})
    links = [{"from": 0, "to": 1, "matrix_noise": 0.1}] * 2500 + [{"from": 0, "to": 1, "noise": 1}]
    with pytest.raises(InputError) as caught:
        model.parse({**problem, "network": {"nodes": 3000, "edges": []}, "channel": {"links": links}})
    assert [c.key for c in caught.value.complaints] == ["channel.links[2500].noise"]


def test_an_error_carries_twenty_complaints_and_a_count():
    each = [Complaint(f"k{i}", "is wrong") for i in range(MOST_COMPLAINTS + 2)]
    error = InputError(each)
    assert list(error.complaints[:-1]) == each[:MOST_COMPLAINTS]
    assert str(error.complaints[-1]) == "has 2 more complaints"
    assert InputError(error.complaints).complaints == error.complaints
    assert list(InputError(each[:-1]).complaints) == each[:-1]
    assert str(InputError([*each, Remainder("", "", 1000)]).complaints[-1]) == "has 1,002 more complaints"


def test_long_words_are_quoted_short():
    with pytest.raises(InputError) as caught:
        model.parse({"x" * 10**6: 1, "\x1b[31m": 1})
    assert len(str(caught.value)) < 1000
    assert "\x1b" not in str(caught.value)
