"""Test the native routes over HTTP: results equal the command line's, and a replaced
map file is used."""

from __future__ import annotations

import json
import shutil
from importlib import resources
from pathlib import Path

import httpx
import jsonschema
import numpy as np
import pytest
from answers_compared import without_times
from running_service import running

from topoloc.apps.cli import main
from topoloc.localization.result import Localization, result_from_json
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.trajectory import Trajectory


def _printed(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    capsys.readouterr()
    assert main(["localize", *map(str, args), "--json", "-"]) == 0
    return capsys.readouterr().out.strip()


def test_the_answer_is_that_of_the_command_line(
    client: httpx.Client, maps: Path, queries: Path, camera: str, capsys: pytest.CaptureFixture[str]
):
    view = queries / "view03.png"
    answer = client.post(
        "/v1/maps/room/localize", files={"image": view.open("rb")}, data={"camera": camera}
    )
    assert answer.status_code == 200
    printed = _printed(capsys, maps / "room.topo", view, "--camera", queries / "camera.json")
    assert without_times(answer.text) == without_times(printed)
    jsonschema.validate(
        answer.json(),
        json.loads(
            resources.files("topoloc.localization").joinpath("result.schema.json").read_text()
        ),
    )


def test_forms_and_bare_pictures_are_answered_alike_and_near_the_truth(
    client: httpx.Client, queries: Path, view: Path, camera: str
):
    form = client.post(
        "/v1/maps/room/localize",
        files={"image": view.open("rb")},
        data={"camera": camera, "name": "view"},
    )
    bare = client.post(
        "/v1/maps/room/localize",
        params={"camera": camera, "name": "view"},
        content=view.read_bytes(),
        headers={"content-type": "image/png"},
    )
    assert without_times(form.text) == without_times(bare.text)
    result = result_from_json(form.text)
    assert isinstance(result, Localization)
    truth = Trajectory.read(queries / "truth.tum").world_from_cam[2]
    assert np.linalg.norm(result.world_from_cam.translation - truth.translation) < 0.05


@pytest.mark.parametrize("camera_says", ["map", "unknown", "exif", "colmap"])
def test_cameras_by_their_names(client: httpx.Client, view: Path, camera: str, camera_says: str):
    named = json.loads(camera)
    params = [named["fx"], named["fy"], named["cx"] + 0.5, named["cy"] + 0.5]
    text = (
        json.dumps({"model": "PINHOLE", "params": params})
        if camera_says == "colmap"
        else camera_says
    )
    answer = client.post(
        "/v1/maps/room/localize", files={"image": view.open("rb")}, data={"camera": text}
    ).json()
    assert answer["localized"]
    assert ("focal_length_px" in answer) == (camera_says in ("unknown", "exif"))
    if camera_says == "colmap":
        assert answer["camera"] == pytest.approx(named) if "baseline" not in named else True


def test_a_prior_and_a_time_limit_are_used(
    client: httpx.Client, queries: Path, view: Path, camera: str
):
    pose = Trajectory.read(queries / "truth.tum").world_from_cam[2]
    prior = json.dumps(
        {"translation": pose.translation.tolist(), "quat_wxyz": pose.quat_wxyz().tolist()}
    )
    answer = client.post(
        "/v1/maps/room/localize",
        files={"image": view.open("rb")},
        data={"camera": camera, "prior": prior, "max_ms": "500"},
    )
    assert answer.json()["localized"]
    assert "coarse" not in answer.json()["times_ms"]


def test_an_out_of_map_image_is_a_result(client: httpx.Client, camera: str, tmp_path: Path):
    import cv2

    noise = np.random.default_rng(3).integers(0, 255, (240, 320), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), cv2.GaussianBlur(noise, (0, 0), 2.0))
    answer = client.post(
        "/v1/maps/room/localize",
        files={"image": (tmp_path / "noise.png").open("rb")},
        data={"camera": camera},
    )
    assert answer.status_code == 200
    assert not answer.json()["localized"]
    assert answer.json()["reason"]


def test_maps_are_described(client: httpx.Client, maps: Path):
    assert client.get("/v1/maps").json() == {"maps": ["damaged", "earth", "room"]}
    described = client.get("/v1/maps/earth").json()
    with TopoMetricMap.load(maps / "earth.topo") as topomap:
        assert described["num_nodes"] == len(described["nodes"]) == len(topomap.summaries)
        assert described["georeference"] == topomap.georeference.to_json()  # pyright: ignore[reportOptionalMemberAccess]
        assert described["junctions"] == topomap.junctions
        folders = [Path(session.recording).parent for session in topomap.sessions]
    assert all(folder.is_absolute() for folder in folders)
    assert not [folder for folder in folders if str(folder) in json.dumps(described)]
    assert str(maps) not in json.dumps(described)
    with TopoMetricMap.load(maps / "earth.topo") as topomap:
        assert [session["name"] for session in described["sessions"]] == [
            session.name for session in topomap.sessions
        ]
    assert client.get("/capabilities").json()["maps"] == ["damaged", "earth", "room"]


def test_the_explanation_of_a_query(client: httpx.Client, view: Path, camera: str):
    as_json = client.post(
        "/v1/maps/room/explain", files={"image": view.open("rb")}, data={"camera": camera}
    )
    assert as_json.json()["tried"]
    page = client.post(
        "/v1/maps/room/explain",
        files={"image": view.open("rb")},
        data={"camera": camera},
        headers={"accept": "text/html"},
    )
    assert page.headers["content-type"].startswith("text/html")
    assert "What was tried" in page.text


def test_a_damaged_map_is_a_503_and_affects_no_other_map(
    client: httpx.Client, view: Path, camera: str
):
    data = {"camera": camera}
    damaged = client.post("/v1/maps/damaged/localize", files={"image": view.open("rb")}, data=data)
    assert damaged.status_code == 503
    assert "damaged" in damaged.json()["error"]
    assert "/" not in damaged.json()["error"]  # no folder of the service's machine
    assert client.post(
        "/v1/maps/room/localize", files={"image": view.open("rb")}, data=data
    ).json()["localized"]


def test_maps_that_cannot_be_opened_do_not_keep_others_from_an_answer(
    maps: Path, view: Path, camera: str, tmp_path: Path
):
    (tmp_path / "broken.topo").write_text("no map")
    with running(tmp_path) as service, service.client() as client:
        query = {"content": view.read_bytes(), "params": {"camera": camera}}
        query["headers"] = {"content-type": "image/png"}
        alone = client.post("/v1/localize", **query)
        assert alone.status_code == 503
        assert "broken" in alone.json()["error"]
        assert str(tmp_path) not in alone.text
        shutil.copy(maps / "earth.topo", tmp_path / "earth.topo")
        found = client.post("/v1/localize", **query).json()
        assert (found["localized"], found["map"]) == (True, "earth")
        assert [one["map"] for one in found["failed"]] == ["broken"]
        assert str(tmp_path) not in json.dumps(found)


def test_metrics_count_answers(client: httpx.Client, view: Path, camera: str):
    def localized() -> float:
        counted = 'topoloc_answers_total{map="room",outcome="localized"}'
        lines = client.get("/metrics").text.splitlines()
        return sum(float(line.split()[-1]) for line in lines if line.startswith(counted))

    before = localized()
    client.post("/v1/maps/room/localize", files={"image": view.open("rb")}, data={"camera": camera})
    assert localized() == before + 1


def test_a_map_replaced_on_disk_is_used_next(
    client: httpx.Client, maps: Path, view: Path, camera: str
):
    shutil.copy(maps / "room.topo", maps / "changing.topo")
    try:
        files = {"image": view.read_bytes()}
        first = client.post(
            "/v1/maps/changing/localize", files=files, data={"camera": camera}
        ).json()
        assert first["localized"]
        assert "geopose" not in first
        shutil.copy(maps / "earth.topo", maps / "next")
        (maps / "next").replace(maps / "changing.topo")
        second = client.post(
            "/v1/maps/changing/localize", files=files, data={"camera": camera}
        ).json()
        assert "geopose" in second
    finally:
        (maps / "changing.topo").unlink()
    assert (
        client.post("/v1/maps/changing/localize", files=files, data={"camera": camera}).status_code
        == 404
    )
