"""Check that the Python client returns the results of a localizer."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from running_service import SIGNED_TOKEN, Running

from topoloc import AsyncClient, Camera, Client, Localization, Localizer, TopoMetricMap
from topoloc.errors import ServiceError
from topoloc.recordings.image_io import read_image


def test_results_are_those_of_a_localizer(service: Running, maps: Path, view: Path, camera: str):
    calibration, image = Camera.from_json(json.loads(camera)), read_image(view)
    with Client(service.url) as client, TopoMetricMap.load(maps / "room.topo") as topomap:
        assert client.maps() == ["damaged", "earth", "room"]
        assert client.map("room")["num_nodes"] == len(topomap.summaries)
        own = Localizer(topomap).localize(image, calibration)
        assert isinstance(own, Localization)
        for picture in (view, view.read_bytes(), image):
            result = client.localize("room", picture, calibration, prior=None, max_ms=10_000.0)
            assert isinstance(result, Localization)
            assert (
                result.world_from_cam.translation.tolist()
                == own.world_from_cam.translation.tolist()
            )
            assert np.allclose(
                result.world_from_cam.rotation, own.world_from_cam.rotation, atol=1e-12
            )
            assert (result.num_inliers, result.probability, result.provenance) == (
                own.num_inliers,
                own.probability,
                own.provenance,
            )
        near = client.localize("room", view, "map", prior=own.world_from_cam)
        assert isinstance(near, Localization)
        assert np.allclose(
            near.world_from_cam.translation, own.world_from_cam.translation, atol=0.02
        )
        assert client.explain("room", view, calibration)["tried"]


def test_all_maps_are_queried_and_a_damaged_one_is_named(service: Running, view: Path, camera: str):
    with Client(service.url) as client:
        answer = client.localize_everywhere(view, Camera.from_json(json.loads(camera)))
    assert {row["map"] for row in answer["answers"]} == {"earth", "room"}
    assert answer["localized"]
    assert answer["map"] is None, "both maps are of this place"
    (failed,) = answer["failed"]
    assert failed["map"] == "damaged"
    assert "damaged.topo is damaged" in failed["error"]


def test_the_same_in_an_event_loop(service: Running, view: Path, camera: str):
    async def ask() -> list[bool]:
        async with AsyncClient(service.url) as client:
            assert await client.maps() == ["damaged", "earth", "room"]
            calibration = Camera.from_json(json.loads(camera))
            results = await asyncio.gather(
                *(client.localize("room", view, calibration) for _ in range(5))
            )
            return [result.localized for result in results]

    assert asyncio.run(ask()) == [True] * 5


def test_a_scene_and_the_notes_of_a_map(open_service: Running):
    async def take_back(note_id: str) -> list[dict[str, Any]]:
        async with AsyncClient(open_service.url, SIGNED_TOKEN) as client:
            assert (await client.scene("earth"))["nodes"]
            other = await client.add_note("earth", "A window", (0.0, 0.0, 1.0))
            await client.remove_note("earth", note_id)
            left = await client.notes("earth")
            await client.remove_note("earth", other)
            return left

    with Client(open_service.url, SIGNED_TOKEN) as client:
        assert len(client.scene("earth")["nodes"]) == client.map("earth")["num_nodes"]
        note_id = client.add_note("earth", " A door ", np.array([0.5, 0.0, 2.0]))
        (note,) = client.notes("earth")
        assert (note["id"], note["text"]) == (note_id, "A door")
        assert np.allclose(note["position"], [0.5, 0.0, 2.0])
        assert [one["text"] for one in asyncio.run(take_back(note_id))] == ["A window"]
        assert client.notes("earth") == []
        with pytest.raises(ServiceError, match="404"):
            client.remove_note("earth", note_id)
        with pytest.raises(ServiceError, match="position"):
            client.add_note("earth", "A door", [0.0, 0.0])


def test_errors_are_one_line(service: Running, view: Path):
    with Client(service.url) as client:
        with pytest.raises(ServiceError, match="no map 'nowhere'") as refused:
            client.localize("nowhere", view)
        assert refused.value.status == 404
        with pytest.raises(ServiceError, match="not a picture"):
            client.localize("room", b"no picture")
        with pytest.raises(ServiceError, match=r"missing\.png"):
            client.localize("room", "missing.png")
    with (
        Client("http://127.0.0.1:9", timeout_s=5.0) as nobody,
        pytest.raises(ServiceError, match="no answer"),
    ):
        nobody.maps()
