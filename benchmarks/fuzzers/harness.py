"""Read damaged inputs in child processes with limits of time and memory, and count the outcomes.

A child reads many inputs in a row, of all chosen kinds in turn, and prints one line of JSON for
each. If it ends too early, the next input is the one that ended it, and another child continues
behind it.
"""

from __future__ import annotations

import json
import os
import resource
import select
import shutil
import signal
import subprocess
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

import numpy as np

from topoloc.errors import TopolocError

Read = Callable[[], None]
OUTCOMES = ("ok", "refused", "traceback", "hang", "crash", "memory")
FINDINGS = OUTCOMES[2:]


@dataclass(frozen=True)
class Limits:
    """Limits of one input: seconds of the processor, seconds on the clock, bytes of memory."""

    processor_s: float = 30.0
    clock_s: float = 150.0
    memory_bytes: int = 1_500_000_000


class Fuzzer(Protocol):
    """Damages and reads one kind of input."""

    def make(self, folder: Path) -> None:
        """Write undamaged inputs into a folder."""
        ...

    def check(self, whole: Path) -> None:
        """Read all undamaged inputs. Raises an error if one is refused."""
        ...

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """Write a damaged input into an empty folder. Return its kind and its reader. The same
        numbers give the same input."""
        ...


@dataclass(frozen=True)
class Finding:
    """An input that was neither read nor refused in one line."""

    seed: int
    kind: str
    outcome: str
    text: str

    def __str__(self) -> str:
        return f"{self.kind}, seed {self.seed}: {self.outcome}: {self.text}"


@dataclass
class Tally:
    """Counts of outcomes by kind of input, the most seconds and megabytes, and all findings."""

    counts: dict[str, Counter[str]] = field(default_factory=dict)
    most_s: dict[str, float] = field(default_factory=dict)
    most_mb: dict[str, float] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    def add(self, row: dict) -> None:
        """Count an input."""
        kind = row["kind"]
        self.counts.setdefault(kind, Counter())[row["outcome"]] += 1
        self.most_s[kind] = max(self.most_s.get(kind, 0.0), row.get("seconds", 0.0))
        self.most_mb[kind] = max(self.most_mb.get(kind, 0.0), row.get("mb", 0.0))
        if row["outcome"] in FINDINGS:
            finding = Finding(row["seed"], kind, row["outcome"], row.get("text", ""))
            self.findings.append(finding)
            print(finding, flush=True)

    @property
    def total(self) -> int:
        """Return the number of inputs."""
        return sum(counts.total() for counts in self.counts.values())

    def table(self) -> str:
        """Return the counts as a table of Markdown."""
        rows = [f"| input | number | {' | '.join(OUTCOMES)} | most s | most MB |"]
        rows.append("|---" * (len(OUTCOMES) + 4) + "|")
        for kind, counts in sorted(self.counts.items()):
            numbers = [counts.total(), *(counts[outcome] for outcome in OUTCOMES)]
            most = f"{self.most_s[kind]:.1f} | {self.most_mb[kind]:.0f}"
            rows.append(f"| {kind} | {' | '.join(f'{n:,}' for n in numbers)} | {most} |")
        return "\n".join(rows)


def run_fuzzers(
    command: Sequence[str],
    fuzzers: Mapping[str, Fuzzer],
    seeds: range,
    processes: int = 1,
    batch: int = 1000,
    limits: Limits | None = None,
) -> Tally:
    """Read the inputs of these seeds of each kind.

    `command` starts a child. The folder of undamaged inputs, the first number, the end and the
    limits are added to it. Input `number` is that of kind `number % n` and seed `number // n`.
    """
    tally, limits, names = Tally(), limits or Limits(), list(fuzzers)
    numbers = range(seeds.start * len(names), seeds.stop * len(names))
    with TemporaryDirectory(prefix="fuzz-") as folder, ThreadPoolExecutor(processes) as pool:
        whole = Path(folder) / "whole"
        for name, fuzzer in fuzzers.items():
            (whole / name).mkdir(parents=True)
            fuzzer.make(whole / name)
            fuzzer.check(whole / name)

        def run(start: int) -> list[dict]:
            part = range(start, min(start + batch, numbers.stop))
            return list(_run_children([*command, str(whole)], part, limits))

        for rows in pool.map(run, range(numbers.start, numbers.stop, batch)):
            for row in rows:
                seed, kind = divmod(row["number"], len(names))
                tally.add({"kind": names[kind]} | row | {"seed": seed})
    return tally


def _run_children(words: Sequence[str], numbers: range, limits: Limits) -> Iterator[dict]:
    at = numbers.start
    while at < numbers.stop:
        for row in _run_child([*words, str(at), str(numbers.stop)], at, limits):
            yield row
            at += 1


def _run_child(command: Sequence[str], first: int, limits: Limits) -> Iterator[dict]:
    """Yield a line for each input of a child, also for the one that ended it."""
    with TemporaryDirectory(prefix="fuzz-child-") as folder:
        words = [*command, f"{limits.processor_s:g}", str(limits.memory_bytes)]
        with (
            open(Path(folder) / "errors", "w+") as errors,
            subprocess.Popen(
                words,
                stdout=subprocess.PIPE,
                stderr=errors,
                env=os.environ | {"TMPDIR": folder, "OPENBLAS_NUM_THREADS": "1"},
                start_new_session=True,
            ) as child,
        ):
            is_late, at = False, first
            for line in _lines(child, limits.clock_s):
                if line is None:
                    is_late = True
                    os.killpg(child.pid, signal.SIGKILL)
                elif (row := json.loads(line)).get("end"):
                    return
                else:
                    yield row | {"number": at}
                    at += 1
            status = child.wait()
            errors.seek(0)
            said = " ".join(errors.read()[-600:].split())
        is_late = is_late or status == -signal.SIGPROF
        outcome = "hang" if is_late else "memory" if "MemoryError" in said else "crash"
        yield {"number": at, "outcome": outcome, "text": f"exit status {status}: {said}"}


def _lines(child: subprocess.Popen[bytes], clock_s: float) -> Iterator[bytes | None]:
    """Yield the lines of a child until it ends; None if one takes too long."""
    assert child.stdout is not None
    left, descriptor = b"", child.stdout.fileno()
    while True:
        if not select.select([descriptor], [], [], clock_s)[0]:
            yield None
            return
        data = os.read(descriptor, 1_000_000)
        *lines, left = (left + data).split(b"\n")
        yield from lines
        if not data:
            return


def run_child(fuzzers: Mapping[str, Fuzzer], arguments: Sequence[str]) -> None:
    """Read inputs in this process, and print a line for each. `arguments` are those that
    `run_fuzzers` adds.

    The process is ended by SIGPROF if one takes more than its seconds of the processor.
    """
    whole, first, end, processor_s, memory_bytes = arguments
    limits = Limits(processor_s=float(processor_s), memory_bytes=int(memory_bytes))
    names = list(fuzzers)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_DATA, (limits.memory_bytes,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with TemporaryDirectory() as parent:
        for number in range(int(first), int(end)):
            folder, (seed, kind) = Path(parent) / str(number), divmod(number, len(names))
            folder.mkdir()
            name, rng = names[kind], np.random.default_rng(seed)
            label, read = fuzzers[name].damage(Path(whole) / name, folder, rng)
            start = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, limits.processor_s)
            row = {"kind": label} | _outcome_of(read, limits)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            print(json.dumps(row | {"seconds": time.process_time() - start}), flush=True)
            shutil.rmtree(folder, ignore_errors=True)
    print(json.dumps({"end": True}), flush=True)


def _outcome_of(read: Read, limits: Limits) -> dict:
    _forget_peak()
    text, outcome = "", "ok"
    try:
        read()
    except TopolocError as error:
        text, outcome = str(error), "refused"
        if "\n" in text:
            text, outcome = f"an error of several lines: {error!r}"[:300], "traceback"
    except MemoryError as error:
        text, outcome = _place_of(error), "memory"
    except Exception as error:  # what nobody expects is what is sought
        text, outcome = _place_of(error), "traceback"
    mb = _peak_mb()
    if outcome in ("ok", "refused") and mb > limits.memory_bytes / 1.5e6:
        text, outcome = f"{mb:.0f} MB: {text}", "memory"
    return {"outcome": outcome, "mb": mb, "text": text[:600]}


def _place_of(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [
        f"{Path(one.filename).name}:{one.lineno}" for one in frames if "topoloc" in one.filename
    ]
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]} at {' '.join(ours[-3:])}"


def _forget_peak() -> None:
    """Let the kernel count the most memory from now on."""
    with suppress(OSError):  # else the peak is that of all inputs of this process
        Path("/proc/self/clear_refs").write_text("5")


def _peak_mb() -> float:
    """Return the most memory that this process has held. `getrusage` would count what its parent
    held when it was started."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(fields["VmHWM"].split()[0]) / 1e3
