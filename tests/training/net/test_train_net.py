"""Train a minimal version of topoloc's own network: it learns, resumes, and exports a
valid network."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tiny_world import path_pose, render, room, write_stereo_recording
from topoloc.features.network_files import NetworkInfo
from topoloc.recordings.camera_files import read_camera_json
from topoloc_training.net import teacher as teaching, train as training
from topoloc_training.net.network import TopolocNet
from topoloc_training.net.pairs import Pair, find_pairs
from topoloc_training.net.teacher import learn
from topoloc_training.net.train import TrainNet, train
from topoloc_training.net.views import Shares, draw_sample
from topoloc_training.networks.edgepoint2 import EdgePoint2
from topoloc_training.networks.export import export
from topoloc_training.networks.exported import freeze_norms, load_exported

PLAIN = Shares(pairs=0.0, walls=0.0, slants=0.0)


@pytest.fixture(scope="module")
def teacher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("teacher") / "teacher.onnx"
    export(EdgePoint2("s64").eval(), path, {"topoloc_network": "edgepoint2-s64"})
    return path


@pytest.fixture(scope="module")
def config(teacher: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainNet:
    folder = tmp_path_factory.mktemp("pictures")
    generator = np.random.default_rng(0)
    for i, size in enumerate(((400, 640), (360, 640), (600, 960))):
        noise = generator.integers(0, 256, (size[0] // 16, size[1] // 16)).astype(np.uint8)
        cv2.imwrite(
            str(folder / f"{i}.png"), cv2.resize(noise, size[::-1], interpolation=cv2.INTER_CUBIC)
        )
    return TrainNet(teacher, [str(folder)], batch=1, steps=4)


def test_training_resumes_after_a_stop(
    config: TrainNet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(training, "_LOG_EVERY", 2)
    monkeypatch.setattr(training, "_SAVE_EVERY", 2)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train(replace(config, out=whole))
    stopped_after_two_steps = iter([0.0, 0.0, 0.0, 0.0, 1e9])

    class Clock:
        @staticmethod
        def monotonic() -> float:
            return next(stopped_after_two_steps, 1e9)

    with monkeypatch.context() as patch:
        patch.setattr(training, "time", Clock)
        train(replace(config, out=parts, minutes=1.0))
    assert 0 < torch.load(parts / "state.pt", weights_only=True)["step"] < 4
    train(replace(config, out=parts))
    states = [torch.load(folder / "state.pt", weights_only=True) for folder in (whole, parts)]
    assert [state["step"] for state in states] == [4, 4]
    for name, value in states[0]["network"].items():
        torch.testing.assert_close(value, states[1]["network"][name], rtol=1e-4, atol=1e-5)
    lines = [json.loads(line) for line in (whole / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4]
    again = [json.loads(line) for line in (parts / "log.jsonl").read_text().splitlines()]
    assert again[-1]["rate"] == pytest.approx(lines[-1]["rate"])
    assert NetworkInfo.of_file(whole / "topoloc-net.onnx").name == "topoloc-net"


def test_the_network_comes_nearer_to_its_teacher(config: TrainNet, tmp_path: Path):
    lessons = learn(config.pictures, config.teacher, tmp_path)
    sample = draw_sample(lessons, [], [], PLAIN, np.random.default_rng(0))
    torch.manual_seed(0)
    network = TopolocNet().train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=5e-3)
    parts = []
    for _ in range(12):
        parts.append(training._step(network, [sample]))
        optimizer.zero_grad()
        sum(parts[-1]).backward()
        optimizer.step()
    first, last = ([float(part.detach()) for part in step] for step in (parts[0], parts[-1]))
    assert last[0] < 0.7 * first[0]
    assert last[2] < 0.5 * first[2]
    assert last[4] < 0.8 * first[4]


def test_training_begins_with_matching_weights_of_an_earlier_state(
    config: TrainNet, tmp_path: Path
):
    torch.manual_seed(7)
    earlier = TopolocNet().state_dict()
    earlier["lateral.bias"] = torch.zeros(3)
    torch.save({"average": earlier}, tmp_path / "earlier.pt")
    network, average, _, step = training._begin(
        replace(config, out=tmp_path, start=tmp_path / "earlier.pt")
    )
    assert step == 0
    for begun in (network.state_dict(), average.state_dict()):
        assert torch.equal(begun["fusion.layer.0.weight"], earlier["fusion.layer.0.weight"])
        assert begun["lateral.bias"].shape == (64,)


def test_training_begins_with_an_exported_network(tmp_path: Path):
    torch.manual_seed(3)
    before, after = TopolocNet().eval(), TopolocNet().eval()
    for norm in (module for module in before.modules() if isinstance(module, torch.nn.BatchNorm2d)):
        torch.nn.init.uniform_(norm.weight, 0.5, 1.5)
        torch.nn.init.uniform_(norm.running_mean, -0.2, 0.2)
    export(before, tmp_path / "before.onnx", {"topoloc_network": "topoloc-net"})
    load_exported(after, tmp_path / "before.onnx")
    picture = torch.rand(1, 1, 64, 96)
    with torch.no_grad():
        for was, now in zip(before(picture), after(picture), strict=True):
            torch.testing.assert_close(now, was, rtol=1e-3, atol=1e-4)
        freeze_norms(after.train())
        torch.testing.assert_close(after(picture)[1], before(picture)[1], rtol=1e-3, atol=1e-4)
    export(EdgePoint2("s64").eval(), tmp_path / "other.onnx", {"topoloc_network": "edgepoint2-s64"})
    with pytest.raises(ValueError, match="another network"):
        load_exported(after, tmp_path / "other.onnx")


def test_virtual_views_are_trained_only_with_each_other(config: TrainNet, tmp_path: Path):
    lessons = learn(config.pictures, config.teacher, tmp_path)
    pixels = (
        np.stack(np.meshgrid(np.arange(200, 420.0), np.arange(80, 260.0)), axis=-1)
        .reshape(-1, 2)
        .astype(np.float32)
    )
    pair = (0, 1, Pair(lessons.paths[0], lessons.paths[1], pixels, pixels))
    shares = Shares(pairs=0.0, walls=1.0, slants=0.0)
    sample = draw_sample(lessons, [], [pair], shares, np.random.default_rng(0))
    assert not sample.is_taught
    assert not sample.inside.any()
    of_teacher, to_teacher, across, score, place = (
        float(part.detach()) for part in training._step(TopolocNet(), [sample])
    )
    assert of_teacher == to_teacher == score == place == 0.0
    assert across > 1.0


def test_scores_are_trained_on_pixels_that_the_teacher_saw(config: TrainNet, tmp_path: Path):
    lessons = learn(config.pictures, config.teacher, tmp_path)
    sample = draw_sample(lessons, [], [], PLAIN, np.random.default_rng(3))
    assert sample.inside[0].all()
    assert not sample.inside[1].any()
    learned = (sample.scores[0] * 255).round().astype(np.uint8)
    height, width = learned.shape
    places = [
        (picture, y, x)
        for picture in range(3)
        for y in range(teaching.HEIGHT - height + 1)
        for x in range(teaching.WIDTH - width + 1)
        if np.array_equal(lessons.scores[picture, y, x : x + 8], learned[0, :8])
    ]
    assert any(
        np.array_equal(lessons.scores[p, y : y + height, x : x + width], learned)
        for p, y, x in places
    )


def test_a_teacher_runs_once_per_image(
    config: TrainNet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    lessons = learn(config.pictures, config.teacher, tmp_path)
    assert lessons.pictures.shape == (3, teaching.HEIGHT, teaching.WIDTH)
    pixels = np.array([[100.0, 50.0], [321.5, 200.25]])
    found = lessons.described(1, pixels)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    x, y = (np.round((pixels[0] + 0.5) / 4 - 0.5)).astype(int)
    stored = lessons.descriptors[1][:, y, x].astype(float)
    assert found[0] @ stored / np.linalg.norm(stored) > 0.98
    monkeypatch.setattr(teaching, "load_onnxruntime", None)
    assert np.array_equal(learn(config.pictures, config.teacher, tmp_path).scores, lessons.scores)


def test_pairs_are_the_same_points_of_a_place(tmp_path: Path):
    day = write_stereo_recording(tmp_path / "day", indices=[0.0, 1.0, 2.0])
    camera = read_camera_json(day / "camera.json").camera
    other = tmp_path / "other"
    (other / "images").mkdir(parents=True)
    (other / "camera.json").write_text((day / "camera.json").read_text())
    for name in ("times.txt", "truth.tum"):
        (other / name).write_text("")
    pose = path_pose(1.5)
    cv2.imwrite(str(other / "images" / "000000.png"), render(room(), pose, camera)[0])
    quaternion = np.roll(pose.quat_wxyz(), -1)
    (other / "times.txt").write_text("0.0\n")
    (other / "truth.tum").write_text(
        "0.0 " + " ".join(f"{v:.9f}" for v in (*pose.translation, *quaternion)) + "\n"
    )
    pairs = find_pairs(str(day), str(other))
    assert len(pairs) == 3
    for pair in pairs:
        first, second = (
            cv2.imread(path, cv2.IMREAD_GRAYSCALE).astype(float) for path in (pair.day, pair.other)
        )
        assert len(pair.day_px) > 1000
        x, y = np.round(pair.day_px).astype(int).T
        u, v = np.round(pair.other_px).astype(int).T
        apart = np.abs(first[y, x] - second[v, u])
        shuffled = np.abs(first[y, x] - np.roll(second[v, u], 777))
        assert np.median(apart) < 0.25 * np.median(shuffled)
