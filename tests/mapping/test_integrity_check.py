"""Test `topoloc info --check`: it checks each byte and finds nodes that were moved together."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image as Pillow

from built_room import built_room
from topoloc.apps.cli import main
from topoloc.apps.viewer.document import create_document
from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.map_facts.contradictions import find_contradictions
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.topomap import TopoMetricMap


def test_a_whole_map_is_ok(saved: Path, capsys: pytest.CaptureFixture[str]):
    assert find_map_damage(saved) == []
    assert main(["info", str(saved), "--check"]) == 0
    assert "ok" in capsys.readouterr().out


def test_any_flipped_bit_is_found_or_does_no_harm(saved: Path):
    content, rng, found = saved.read_bytes(), np.random.default_rng(0), 0
    places = rng.integers(0, len(content), 60)
    for place in places:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        saved.write_bytes(flipped)
        try:
            harmed = find_map_damage(saved)
        except MapError:
            harmed = ["cannot be opened"]
        if harmed:
            found += 1
        else:  # an unused byte: the saved copy is unchanged
            TopoMetricMap.load(saved).save(saved)
            assert saved.read_bytes() == content
    assert found > 0.8 * len(places)


def test_damage_is_one_line_and_an_exit_status(saved: Path, capsys: pytest.CaptureFixture[str]):
    content = saved.read_bytes()
    place = content.index(TopoMetricMap.load(saved).nodes[1].template_image[:40]) + 20
    saved.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
    assert main(["info", str(saved)]) == 0
    assert main(["info", str(saved), "--check"]) == 1
    output = capsys.readouterr()
    assert "checksum of a row of node_templates" in output.out
    assert len(output.err.splitlines()) == 1


def test_nodes_that_were_moved_together_are_found(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    assert find_contradictions(topomap) == []
    moved = {1, 2}
    away = Rigid3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    nodes = [
        replace(
            node, summary=replace(node.summary, world_from_cam=away @ node.summary.world_from_cam)
        )
        if row in moved
        else node
        for row, node in enumerate(topomap.nodes)
    ]
    found = find_contradictions(
        replace(topomap.with_first_layer(nodes=nodes), summaries=[node.summary for node in nodes])
    )
    assert {contradiction.node_id for contradiction in found} == moved
    assert all(0.9 < contradiction.metres < 1.1 for contradiction in found)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_an_image_larger_than_its_camera_is_damage_of_its_node(saved: Path, kind: str):
    topomap, file = TopoMetricMap.load(saved), io.BytesIO()
    Pillow.new("L", (10_000, 9_000)).save(file, kind, quality=1)
    *nodes, last = topomap.nodes
    topomap.with_first_layer(nodes=[*nodes, replace(last, template=file.getvalue())]).save(saved)
    fault = f"node {last.summary.node_id} is damaged: its image is 10000x9000, more than 320x240"
    assert find_map_damage(saved) == [fault]
    with TopoMetricMap.load(saved) as damaged, pytest.raises(MapError, match=fault):
        create_document(damaged, "large")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_a_stored_image_is_never_turned_beyond_the_size_of_its_camera(saved: Path, kind: str):
    exif, file = Pillow.Exif(), io.BytesIO()
    exif[ExifTags.Base.Orientation] = 6  # a quarter turn
    Pillow.new("L", (320, 240)).save(file, kind, exif=exif)
    node = replace(TopoMetricMap.load(saved).nodes[0], template=file.getvalue())
    image = node.read_image()
    assert image is not None
    assert image.shape[:2] == (240, 320)
