"""CPU time, wall time and peak memory of calls and of whole processes, and the table that compares them."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Measurement:
    """One line of a comparison. CPU seconds count all threads; `scale` says by how much a sample was multiplied."""

    name: str
    cpu: float
    wall: float
    peak_bytes: int
    scale: float = 1.0

    def scaled(self, factor: float) -> Measurement:
        """What `factor` times as many calls would take; memory as measured."""
        return replace(self, cpu=self.cpu * factor, wall=self.wall * factor, scale=self.scale * factor)


def measure(name: str, call: Callable[[], object], repeats: int = 5) -> Measurement:
    """Median CPU and wall seconds of `repeats` calls after a first one, whose allocations give the peak memory."""
    tracemalloc.start()
    call()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    cpu, wall = [], []
    for _ in range(repeats):
        cpu_before, wall_before = time.process_time(), time.perf_counter()
        call()
        cpu.append(time.process_time() - cpu_before)
        wall.append(time.perf_counter() - wall_before)
    return Measurement(name, statistics.median(cpu), statistics.median(wall), peak)


_LAUNCHER = """
import json, resource, subprocess, sys
subprocess.run([sys.executable, *sys.argv[1:]], check=True, stdout=subprocess.DEVNULL)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)]))
"""  # a small process of its own: a child's peak counts what its parent held when it was started


def measure_process(name: str, arguments: Sequence[str], repeats: int = 5) -> Measurement:
    """Median CPU and wall seconds of `python ARGUMENTS` as a whole process, and its largest resident size."""
    cpu, wall, peak = [], [], 0
    for _ in range(repeats):
        before = time.perf_counter()
        command = [sys.executable, "-S", "-c", _LAUNCHER, *arguments]
        seconds, resident = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        wall.append(time.perf_counter() - before)
        cpu.append(seconds)
        peak = max(peak, resident)
    return Measurement(name, statistics.median(cpu), statistics.median(wall), peak)


def show(title: str, lines: Sequence[Measurement]) -> None:
    """Print measurements, with each one's CPU time as a multiple of the first's."""
    print(f"\n{title}")
    print(f"  {'':<44}{'CPU':>12}{'wall':>12}{'peak':>11}{'ratio':>10}")
    for line in lines:
        ratio = line.cpu / lines[0].cpu
        note = f"   (a sample, times {line.scale:g})" if line.scale != 1 else ""
        print(
            f"  {line.name:<44}{line.cpu:>10.4g} s{line.wall:>10.4g} s{line.peak_bytes / 2**20:>8.1f} MB"
            f"{ratio:>9.3g}x{note}"
        )
