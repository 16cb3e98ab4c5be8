"""Test the search for weak regions of a map: from the map alone, without the node itself."""

from __future__ import annotations

import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tiny_world import write_stereo_recording
from topoloc import Localizer, TopoMetricMap, open_sequence
from topoloc.apps.cli import main
from topoloc.apps.quality.weak_regions import find_weak_regions
from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.node_localization import sample_evenly
from topoloc.lifelong.node_pruning import select_landmarks
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.mapping.topomap import TopoNode
from topoloc.recordings.frame import SequenceView

TURNED = Rigid3(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))


@pytest.fixture(scope="module")
def with_outpost(tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a map of the room and of one image of another place ten metres away."""
    folder = tmp_path_factory.mktemp("outpost")
    other = open_sequence(write_stereo_recording(folder / "other", seed=5, indices=[1.0]))
    far = SequenceView(other, [0], [Rigid3(np.eye(3), np.array([10.0, 0.0, 0.0]))])
    path = folder / "two.topo"
    build_map([open_sequence(tiny_recording), far], BuildConfig(other_kinds=())).save(path)
    return path


def test_a_node_does_not_support_itself(with_outpost: Path):
    with TopoMetricMap.load(with_outpost) as topomap:
        localizer, last = Localizer(topomap), topomap.nodes[-1]
        picture = QueryImage.of_features({topomap.kind: last.features}, last.camera)
        assert isinstance(localizer.localize_query(picture)[0], Localization)
        weak = find_weak_regions(localizer)
        assert isinstance(localizer.localize_query(picture)[0], Localization), (
            "the localizer itself still has all of its nodes"
        )
    *room, outpost = weak.nodes
    assert "not_held" in outpost.reasons
    assert outpost.answer is not None
    assert outpost.answer.num_inliers == 0
    assert all(node.answer is not None and node.answer.is_localized for node in room)
    assert weak.weakest[0] is outpost
    assert weak.parts[0].nodes == [outpost]
    assert (
        f"Walk again past (10.0, 0.0, 0.0) m, node {outpost.node_id}"
        in weak.suggest_next_recording()
    )


def test_neighbours_of_a_node_can_be_excluded(room_map: Path):
    with TopoMetricMap.load(room_map) as topomap:
        alone, beside, all_out = (
            find_weak_regions(Localizer(topomap), max_queries=3, beside=width)
            for width in (0.0, 3.0, 1e6)
        )
    inliers = [
        sum(node.answer.num_inliers for node in weak.queried_nodes if node.answer)
        for weak in (alone, beside, all_out)
    ]
    assert inliers[0] > inliers[1] > 0
    assert inliers[2] == 0


def _changed(
    topomap: TopoMetricMap, change: Callable[[list[TopoNode]], list[TopoNode]]
) -> TopoMetricMap:
    nodes = change(list(topomap.nodes))
    sessions = [replace(topomap.sessions[0], session_id=k, name=f"walk {k}") for k in range(2)]
    return replace(
        topomap.with_first_layer(nodes=nodes),
        summaries=[node.summary for node in nodes],
        sessions=sessions,
        repetitions=None,
    )


def test_few_landmarks_other_sessions_and_reverse_views(room_map: Path):
    def change(nodes: list[TopoNode]) -> list[TopoNode]:
        first, second, *rest = nodes
        few = select_landmarks(first, np.arange(40))
        rows = np.arange(len(second.features))
        nothing = np.zeros((len(rows), 3, 3)), np.zeros((len(rows), 3))
        seen = LandmarkStatistics.from_equations(
            1, rows, *nothing, np.full(len(rows), 3), np.where(rows % 2, 2, 0)
        )
        again = replace(second, session_statistics=[*second.session_statistics, seen])
        back = replace(
            first,
            summary=replace(
                first.summary,
                node_id=900,
                world_from_cam=first.summary.world_from_cam @ TURNED,
                session_id=1,
            ),
        )
        return [few, again, *rest, back]

    with TopoMetricMap.load(room_map) as topomap:
        changed = Localizer(_changed(topomap, change))
        weak = find_weak_regions(changed, max_queries=0, reach=0.05, stood_by=0.0)
        everywhere = find_weak_regions(changed, max_queries=0, reach=1e3)
    first, second, third, *_, back = weak.nodes
    assert weak.queried_nodes == []
    assert first.reasons == ("few_landmarks", "single_session")
    assert (second.seen_share, second.reasons) == (pytest.approx(0.5, abs=0.01), ("one_direction",))
    assert third.reasons == ("one_direction", "single_session")
    assert back.reasons == (), "the sums that it came with are of the other session"
    assert "few landmarks" in weak.suggest_next_recording()
    assert everywhere.count("one_direction") == 0


def test_the_queries_are_spread_over_the_map():
    assert sample_evenly(range(5), 9) == [0, 1, 2, 3, 4]
    assert sample_evenly(range(101), 3) == [0, 50, 100]
    assert sample_evenly(range(3), 0) == []


def test_the_command_prints_writes_and_draws(
    with_outpost: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    said, page = tmp_path / "said.json", tmp_path / "report.html"
    assert (
        main(
            [
                "evaluate",
                str(with_outpost),
                "--against-itself",
                "--json",
                str(said),
                "--report",
                str(page),
            ]
        )
        == 0
    )
    facts = json.loads(said.read_text())["against_itself"]
    printed = capsys.readouterr().out
    assert (
        f"{facts['num_nodes'] - 1} of {facts['num_nodes']} nodes, each asked without itself"
        in printed
    )
    assert facts["where_next"] in printed
    assert facts["weak"]["not_held"] == 1
    assert facts["parts"][0] == {
        "reason": "not_held",
        "centre": [10.0, 0.0, 0.0],
        "node_ids": [facts["nodes"][-1]["node_id"]],
    }
    html = page.read_text()
    assert not re.search(r"(?:src|href)=\"(?!data:image/(?:jpeg|webp);base64,|#)", html)
    body = html[html.index("<body>") : html.index("</html>")]
    ElementTree.fromstring(re.sub(r"(<img [^>]*)>", r"\1/>", body))
    assert "not localized without itself" in html
    again = tmp_path / "again.html"
    assert main(["evaluate", str(with_outpost), "--against-itself", "--report", str(again)]) == 0
    assert again.read_text() == html


def test_options_of_recordings_are_refused(
    room_map: Path, with_outpost: Path, queries: Path, tmp_path: Path, complaint: Callable[..., str]
):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    refused = complaint("evaluate", path, queries, "--against-itself", "--poses", "mm", status=2)
    assert "uses the map alone, without recordings, --poses" in refused
    assert "name the file of the tile" in complaint(
        "evaluate", _atlas(path, with_outpost, tmp_path), "--against-itself", status=2
    )
    assert "or --against-itself" in complaint("evaluate", path, status=2)
    before = path.read_bytes()
    assert "used twice" in complaint("evaluate", path, "--against-itself", "--json", path)
    assert path.read_bytes() == before


def _atlas(path: Path, other: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "atlas"
    assert main(["atlas", "create", str(folder), str(path), str(other)]) == 0
    return folder
