"""Check that damaged inputs of each kind are read, or refused in one line, without crash, hang or
huge memory. The harness finds each of these faults."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
from fuzzers.harness import Limits, run_fuzzers  # noqa: E402
from fuzzers.settings import QueryCameras  # noqa: E402
from topoloc.errors import CalibrationError  # noqa: E402
from topoloc.recordings.calibration import parse_calibration  # noqa: E402
from topoloc.retrieval.shared_vocabulary import shared_vocabulary  # noqa: E402

KINDS = ("maps", "undo", "manifests", "places", "recordings", "images", "settings")
KINDS += ("calibrations", "cameras")
NUM_INPUTS = 24  # of each kind
# Faults of a reader, by seed. The last input is refused correctly.
FAULTS = """
import os, signal, sys, time
sys.path.insert(0, {benchmarks!r})
from pathlib import Path
from fuzzers.harness import run_child
from topoloc.errors import MapError

def fail():
    raise KeyError("x")

def hang():
    while True:
        pass

def crash():
    os.kill(os.getpid(), signal.SIGSEGV)

def allocate():
    bytes(3_000_000_000)

def fill():
    blocks = [b"x" * 100_000_000 for _ in range(12)]

def refuse():
    raise MapError("one line")

class Faulty:
    def damage(self, whole, folder, rng):
        seed = int(folder.name)
        return "input", [fail, hang, crash, allocate, fill, refuse, list][seed]

run_child({{"faulty": Faulty()}}, sys.argv[1:])
"""


def _run(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(BENCHMARKS / "fuzz.py"), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_damaged_inputs_are_read_or_refused_in_one_line():
    done = _run("--inputs", NUM_INPUTS, "--processes", 1)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{NUM_INPUTS * len(KINDS)} inputs, 0 findings" in done.stdout
    rows = [line.split("|")[1:5] for line in done.stdout.splitlines() if line.startswith("| ")][1:]
    num_refused = Counter[str]()
    for kind, _, _, refused in rows:
        num_refused[kind.split(",")[0].strip()] += int(refused)
    kinds = "map,manifest,places,recording,image,settings,calibration,table,camera of a query"
    assert set(kinds.split(",")) <= num_refused.keys()
    assert all(num_refused[kind] > 0 for kind in kinds.split(","))
    assert num_refused.total() > 0.5 * NUM_INPUTS * len(KINDS)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
def test_each_fault_is_found_and_named(tmp_path: Path):
    script = tmp_path / "child.py"
    script.write_text(FAULTS.format(benchmarks=str(BENCHMARKS)))
    limits = Limits(processor_s=6.0, clock_s=60.0, memory_bytes=1_500_000_000)
    fuzzers = {"faulty": QueryCameras()}  # unused: the child has its own fuzzer of this name
    tally = run_fuzzers([sys.executable, str(script)], fuzzers, range(7), limits=limits)
    assert [(one.seed, one.outcome) for one in tally.findings] == [
        (0, "traceback"),
        (1, "hang"),
        (2, "crash"),
        (3, "memory"),
        (4, "memory"),
    ]
    assert tally.total == 7
    assert "KeyError: 'x'" in tally.findings[0].text
    assert f"exit status {-signal.SIGSEGV}" in tally.findings[2].text
    assert tally.counts["input"]["refused"] == tally.counts["input"]["ok"] == 1
    assert "| input | 5 | 1 | 1 | 1 | 0 | 0 | 2 |" in tally.table()
    assert "| faulty | 2 | 0 | 0 | 0 | 1 | 1 | 0 |" in tally.table()


def test_an_unknown_kind_is_wrong_usage():
    done = _run("mapps")
    assert done.returncode == 2
    assert "no such kind: mapps" in done.stderr
    assert ", ".join(KINDS) in done.stderr


@pytest.mark.parametrize("camera", ["1,\n2,3,x", "1\r,2", "1,2,3,4\u2028,5", "9" * 300 + ",1"])
def test_an_invalid_camera_is_quoted_in_one_line(camera: str):
    with pytest.raises(CalibrationError, match="neither a file nor four numbers") as refusal:
        parse_calibration(camera)
    assert len(str(refusal.value).splitlines()) == 1


def test_a_name_with_a_null_character_is_refused():
    with pytest.raises(CalibrationError, match="embedded null byte"):
        parse_calibration("a\0.json")


@pytest.mark.parametrize("name", ["x" * 300, "../vocabularies/surf", "a\0", "nothing"])
def test_a_vocabulary_is_found_by_its_name_alone(name: str):
    assert shared_vocabulary(name) is None
    assert shared_vocabulary("surf") is not None
