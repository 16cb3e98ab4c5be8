"""Check that a query compiles nothing after the warm-up, and that threads sharing a localizer get
equal results."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from built_corridor import WIDE, built_corridor, seen_ahead, seen_on_the_way_back
from built_room import unseen_views
from tiny_world import CAMERA

_BOTH = """
import json, sys
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from topoloc import Camera, Localization, Localizer, TopoMetricMap
from topoloc.compiled import KERNELS

map_file, pictures, cameras = sys.argv[1], np.load(sys.argv[2]), json.loads(sys.argv[3])
queries = [(pictures[name], Camera.from_json(camera)) for name, camera in cameras.items()]

def bytes_of(result):
    if isinstance(result, Localization):
        return result.world_from_cam.rotation.tobytes() + result.world_from_cam.translation.tobytes() + result.covariance.tobytes()
    return result.reason.encode()
"""  # noqa: E501
_WARM = """
from topoloc import warm_up
answers, localize = [], Localizer.localize
Localizer.localize = lambda self, *query: answers.append(localize(self, *query))
steps = []
warm_up(lambda *step: steps.append(step))
Localizer.localize = localize
assert [isinstance(answer, Localization) for answer in answers] == [True, True, False], answers
assert np.allclose(answers[0].world_from_cam.translation, [0.1, 0.0, 0.0], atol=2e-3)
assert steps == [("compiling", number, 7) for number in range(8)]
compiled = {kernel: len(kernel.signatures) for kernel in KERNELS}
for picture, camera in queries:
    localizer = Localizer(TopoMetricMap.load(map_file))
    localizer.localize(picture, camera)
    localizer.localize(picture, None)
print([kernel.__name__ for kernel in KERNELS if len(kernel.signatures) > compiled.get(kernel, 0)])
"""
_SHARED = """
alone = [bytes_of(Localizer(TopoMetricMap.load(map_file)).localize(*query)) for query in queries]
shared = Localizer(TopoMetricMap.load(map_file))
with ThreadPoolExecutor(6) as threads:
    together = list(threads.map(lambda query: bytes_of(shared.localize(*query)), queries * 3))
print(sum(len(answer) > 100 for answer in alone), together == alone * 3)
"""


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, str]:
    """Return files of a map with virtual views, of its images, images in reverse direction, and
    out-of-map images, with their cameras."""
    folder = tmp_path_factory.mktemp("asked")
    pictures = {f"ahead{k}": picture for k, (picture, _) in enumerate(seen_ahead()[:2])}
    pictures |= {f"back{k}": picture for k, (picture, _) in enumerate(seen_on_the_way_back()[:2])}
    pictures |= {f"elsewhere{k}": picture for k, (picture, _) in enumerate(unseen_views()[:1])}
    cameras = {
        name: (CAMERA if name.startswith("elsewhere") else WIDE).to_json() for name in pictures
    }
    built_corridor().save(folder / "corridor.topo")
    np.savez(folder / "pictures.npz", **pictures)
    return str(folder / "corridor.topo"), str(folder / "pictures.npz"), json.dumps(cameras)


def _in_a_process_of_its_own(code: str, asked: tuple[str, str, str]) -> str:
    done = subprocess.run(
        [sys.executable, "-c", _BOTH + code, *asked], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.strip()


def test_nothing_is_left_to_compile(asked: tuple[str, str, str]):
    assert _in_a_process_of_its_own(_WARM, asked) == "[]"


def test_a_shared_localizer_gives_the_bytes_of_one_alone(asked: tuple[str, str, str]):
    assert _in_a_process_of_its_own(_SHARED, asked) == "4 True"
