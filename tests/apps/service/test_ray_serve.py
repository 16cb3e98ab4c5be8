"""Test the service as replicas of Ray Serve, on a cluster of this machine."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from answers_compared import without_times
from running_service import TOKEN
from websockets.sync.client import connect

from topoloc.apps.cluster.config import ReplicasConfig
from topoloc.apps.service.ray_serve import ProxyOptions, _create_deployment

Complaint = Callable[..., str]


def test_invalid_options_are_refused(maps: Path, complaint: Complaint):
    assert "--replicas belongs to --ray" in complaint("serve", maps, "--replicas", 2, status=2)
    assert "--port 0" in complaint("serve", maps, "--ray", "local", "--port", 0, status=2)
    for replicas in ("many", "3-", "4-2", "0"):
        assert "--replicas" in complaint(
            "serve", maps, "--ray", "local", "--replicas", replicas, status=2
        )


def test_replicas_come_and_go_between_the_least_and_the_most():
    serve = pytest.importorskip(
        "ray.serve", reason="Ray Serve is not installed (the extra cluster)"
    )
    front = ProxyOptions("127.0.0.1", 8571, num_answered=2, num_waiting=30)
    fixed = _create_deployment(serve, front, ReplicasConfig(least=3, most=3))
    assert (fixed.num_replicas, fixed.max_ongoing_requests) == (3, 32)
    scaled = _create_deployment(
        serve, front, ReplicasConfig(least=1, most=4, busy=1.5)
    )._deployment_config.autoscaling_config
    assert (scaled.min_replicas, scaled.max_replicas, scaled.target_ongoing_requests) == (1, 4, 3.0)


@contextmanager
def _on_ray(*args: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `topoloc serve --ray local` with these arguments, and yield its process and address."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    command = [
        sys.executable,
        "-m",
        "topoloc",
        "serve",
        *map(str, args),
        "--ray",
        "local",
        "--port",
        str(port),
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        said = process.stderr.readline()
        assert f"serves on http://127.0.0.1:{port}" in said, said + process.stderr.read()
        yield process, f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_replicas_answer_as_one_process_does(
    maps: Path, client: httpx.Client, view: Path, camera: str, tmp_path: Path
):
    pytest.importorskip("ray.serve", reason="Ray Serve is not installed (the extra cluster)")
    token = tmp_path / "token"
    token.write_text(TOKEN)
    asked = {"files": {"image": ("view.png", view.read_bytes())}, "data": {"camera": camera}}
    alone = client.post("/v1/maps/room/localize", **asked).text
    with _on_ray(maps, "--replicas", 2, "--token-file", token) as (process, url):
        with httpx.Client(base_url=url, timeout=60.0) as stranger:
            assert stranger.get("/healthz").status_code == 200
            assert stranger.get("/v1/maps").status_code == 401
        headers = {"Authorization": f"Bearer {TOKEN}"}
        with httpx.Client(base_url=url, timeout=60.0, headers=headers) as one:
            for _ in range(4):
                assert without_times(
                    one.post("/v1/maps/room/localize", **asked).text
                ) == without_times(alone)
            assert one.post(
                "/v1/maps/room/localize", files={"image": b"no picture"}
            ).status_code in (400, 415)
        address = url.replace("http", "ws") + "/v1/maps/room/sessions"
        with connect(address, additional_headers=headers) as stream:
            stream.send(json.dumps({"camera": json.loads(camera)}))
            stream.send(view.read_bytes())
            assert json.loads(stream.recv(timeout=60))["localized"]
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0


@pytest.mark.slow
def test_why_no_replica_begins(tmp_path: Path):
    pytest.importorskip("ray.serve", reason="Ray Serve is not installed (the extra cluster)")
    command = [
        sys.executable,
        "-m",
        "topoloc",
        "serve",
        str(tmp_path / "nothing.topo"),
        "--ray",
        "local",
        "--port",
        "8579",
    ]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 1
    assert (
        ended.stderr.splitlines()[-1]
        == f"error: no replica of the service began: {tmp_path}/nothing.topo: no such map"
    )
