"""Map files made to deceive are refused in one line or answered from: no crash, no traceback, no
hang, no memory without end."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mutations import mutate

from built_corridor import WIDE, WalkAhead, seen_ahead
from topoloc.localization.map_facts.map_building import build_map

OPENING = Path(__file__).with_name("opening.py")
NUM_MUTATIONS = 37  # the first with each of _KINDS and flipped bits three times or more
NUM_SLOW_MUTATIONS = 100


@pytest.fixture(
    scope="module",
    params=[NUM_MUTATIONS, pytest.param(NUM_SLOW_MUTATIONS, marks=pytest.mark.slow)],
)
def opened(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[dict]:
    """Of the map itself and each mutation what a process that opened it said."""
    folder = tmp_path_factory.mktemp("hostile")
    topomap = build_map(WalkAhead(0, num_pairs=6))
    assert topomap.sides is not None
    topomap.save(folder / "corridor.topo")
    (picture, _), *_ = seen_ahead()
    np.save(folder / "picture.npy", picture)
    (folder / "camera.json").write_text(json.dumps(WIDE.to_json()))
    maps = [folder / f"{seed}.topo" for seed in range(request.param)]
    done = [mutate(folder / "corridor.topo", path, seed) for seed, path in enumerate(maps)]
    command = [
        sys.executable,
        str(OPENING),
        str(folder / "picture.npy"),
        str(folder / "camera.json"),
        str(folder / "corridor.topo"),
    ]
    run = subprocess.run(
        [*command, *map(str, maps)], capture_output=True, text=True, timeout=300, check=False
    )
    told = [json.loads(line) for line in run.stdout.splitlines()]
    assert run.returncode == 0, (
        f"{done[len(told) - 1] if told else 'the map itself'}: {run.returncode} {run.stderr[-2000:]}"  # noqa: E501
    )
    assert len(told) == request.param + 1
    return told


def test_the_map_itself_is_answered_from_and_whole(opened: list[dict]):
    assert opened[0]["outcome"] == ["Localization", "ok"]


def test_every_mutation_is_an_answer_or_an_error_of_one_line(opened: list[dict]):
    assert all("\n" not in text for told in opened for text in told["outcome"])
    refused = [
        told for told in opened[1:] if "Error" in told["outcome"][0] or told["outcome"][1] != "ok"
    ]
    assert len(refused) > 0.7 * (len(opened) - 1)


def test_none_takes_long_or_much(opened: list[dict]):
    assert max(told["seconds"] for told in opened[1:]) < 5.0
    assert max(told["rss_kb"] for told in opened) < 1_000_000
