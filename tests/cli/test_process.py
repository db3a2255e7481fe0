"""The command line as a process: what it imports, and how it ends when its surroundings misbehave."""

from __future__ import annotations

import json
import os
import pty
import re
import resource
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from tests.cli.conftest import Tolnet

from tolnet import __version__, model
from tolnet.cli.console import Console

HEAVY = ["casadi", "cvxpy", "matplotlib", "networkx", "numba", "pandas"]
LISTS_HEAVY = f"""
import sys
import threading
from tolnet.cli import main
code = main(sys.argv[1:])
print(code, *[name for name in {HEAVY} if name in sys.modules], file=sys.stderr)
"""


def test_the_process_answers_as_the_function_does(process: Tolnet, tolnet: Tolnet, ring: Path):
    assert process("table", ring, "--json").out == tolnet("table", ring, "--json").out


def test_the_installed_command_is_this_one():
    command = Path(sys.executable).with_name("tolnet")
    ran = subprocess.run([str(command), "--version"], capture_output=True, text=True, check=True)
    assert ran.stdout == f"tolnet {__version__}\n"


@pytest.mark.parametrize("options", [[], ["--json", "--full"], ["-o", "t.h", "-o", "t.npz", "-o", "t.csv"]])
def test_a_table_imports_nothing_heavy(options: list[str], ring: Path, tmp_path: Path):
    ran = subprocess.run(
        [sys.executable, "-c", LISTS_HEAVY, "table", str(ring), *options],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert ran.stderr.split() == ["0"]


def test_help_imports_no_arrays():
    program = "import sys; from tolnet.cli import main; main(['--help']); print('numpy' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout.split()[-1] == "False"
    for command in ("example", "table", "validate", "diff", "performance", "diffusion", "simulate"):
        assert f" {command} " in ran.stdout


def test_a_table_takes_less_than_two_seconds_of_processor_time(process: Tolnet):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert process("table", "projectile").code == 0
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 2.0


def test_a_reader_that_leaves_early_is_no_error(ring: Path, tmp_path: Path):
    written = tmp_path / "t.json"
    command = [sys.executable, "-m", "tolnet", "table", str(ring), "--json", "--full", "-o", str(written)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0
    assert written.read_text().endswith("}\n")


def test_closed_streams_are_no_error(ring: Path):
    ran = subprocess.run(f'"{sys.executable}" -m tolnet table "{ring}" >&- 2>&-', shell=True, check=False)
    assert ran.returncode == 0


def test_an_encoding_without_our_letters_escapes_them(process: Tolnet, tmp_path: Path):
    path = tmp_path / "süd.toml"
    network = model.SensorNetwork(
        A=[[0.9]], B=[[1.0]], C=[[[1.0]]], R=[[[1.0]]], edges=[], name="süd", names=["Ω"],
        ambiguity=model.Ambiguity(0.1),
    )  # fmt: skip
    model.save(network, path)
    ran = process("table", path, env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert ran.code == 0
    assert "s\\xfcd: 1 node" in ran.out


def wait_until_arrays_are_imported(pid: int) -> None:
    """The process is then about to work for seconds."""
    for _ in range(600):
        if "scipy" in Path(f"/proc/{pid}/maps").read_text():
            return
        time.sleep(0.1)
    pytest.fail("the process never came to its work")


def test_an_interrupt_ends_with_130_and_leaves_no_file(tmp_path: Path):
    path = tmp_path / "many.toml"
    model.save(model.example("random", 60_000, 1), path)
    before = set(tmp_path.iterdir())
    command = [sys.executable, "-m", "tolnet", "table", str(path), "-o", str(tmp_path / "t.json")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        wait_until_arrays_are_imported(process.pid)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert "Traceback" not in err
    assert set(tmp_path.iterdir()) == before


def test_an_interrupt_within_executed_source_ends_with_130(tmp_path: Path):
    (tmp_path / "stopped.py").write_text(
        "import sys\nimport tolnet.cli.app\nfrom tolnet.cli import main\n"
        "def run(arguments):\n"
        "    exec('import os, signal; os.kill(os.getpid(), signal.SIGINT); [None for _ in range(1000)]')\n"
        "tolnet.cli.app.run = run\nsys.exit(main())\n"
    )
    ran = subprocess.run([sys.executable, "-m", "stopped"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr) == (130, "", "")


def test_a_full_disk_is_said(process: Tolnet, ring: Path):
    with Path("/dev/full").open("w") as full:
        ran = subprocess.run(
            [sys.executable, "-m", "tolnet", "table", str(ring)], stdout=full, stderr=subprocess.PIPE, text=True,
            check=False,
        )  # fmt: skip
    assert ran.returncode == 2
    assert ran.stderr == "error: No space left on device\n"


def test_a_bar_is_drawn_for_long_work_on_a_terminal(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tolnet.cli.console.PATIENCE", 0.0)
    monkeypatch.setenv("TERM", "xterm")
    reader, terminal = pty.openpty()
    with os.fdopen(terminal, "w") as stream, monkeypatch.context() as patched:
        patched.setattr(sys, "stderr", stream)
        with Console(json=True, quiet=False).progress("counting") as progress:
            progress(1, 4)
            drawn = b""
            while b"25%" not in drawn:
                assert select.select([reader], [], [], 30)[0], "no bar appeared"
                drawn += os.read(reader, 65536)
        assert b"counting" in drawn
    os.close(reader)


def test_lines_are_said_of_long_work_elsewhere(tmp_path: Path):
    """By the command, what is going on, how far it is, and the seconds; standard output stays clean."""
    file = tmp_path / "pair.toml"
    model.save(model.example("random", nodes=2, seed=1), file)
    program = "import sys; from tolnet.cli import console, main; console.EVERY = 0.02; main(sys.argv[1:])"
    arguments = ["certify", str(file), "--claims", "convergence"]
    ran, quiet = (
        subprocess.run([sys.executable, "-c", program, *arguments, how], capture_output=True, check=False, text=True)
        for how in ("--json", "--quiet")
    )
    assert json.loads(ran.stdout)["schema"] == "tolnet.certificate/1"
    lines = ran.stderr.splitlines()
    assert any(re.fullmatch(r"certify: convergence \d+ of 3 filters, \d+ s", line) for line in lines), lines
    assert all(re.fullmatch(r"certify: [^\x1b]+, \d+ s", line) for line in lines)
    assert (quiet.stdout, quiet.stderr) == ("", "")


def test_lines_come_ten_seconds_apart_whatever_is_going_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """The clock is the command's: work in many short parts is told of too."""
    waits = threading.Event()
    monkeypatch.setattr("tolnet.cli.console.EVERY", 0.05)
    console = Console(json=False, quiet=False)
    for part in range(10_000):
        with console.progress("parts", "pieces") as progress:
            progress(part, 10_000)
            waits.wait(0.001)
        if "pieces" in capsys.readouterr().err:
            return
    pytest.fail("nothing was said")


def test_no_bar_is_drawn_where_nobody_looks(ring: Path):
    program = "import sys; from tolnet.cli import console, main; console.PATIENCE = 0.0; main(sys.argv[1:])"
    ran = subprocess.run(
        [sys.executable, "-c", program, "table", str(ring), "--json"], capture_output=True, check=True
    )
    assert ran.stdout.startswith(b"{")
    assert ran.stderr == b""
