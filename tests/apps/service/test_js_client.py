"""Test the JavaScript client: its tests under Node against a service, its types and its package."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from running_service import ROOT, SIGNED_TOKEN, Running, running

from in_browser import chromium
from schemas import SCHEMA

CLIENT = ROOT / "clients" / "js"
TYPES = (CLIENT / "index.d.ts").read_text(encoding="utf-8")


def _run(program: str, *args: object, **environment: str) -> str:
    path = shutil.which(program)
    if path is None:
        pytest.skip(f"{program} is not installed")
    done = subprocess.run(
        [path, *map(str, args)],
        cwd=CLIENT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_it_queries_a_service(open_service: Running, view: Path, camera: str):
    printed = _run(
        "node",
        "--experimental-websocket",
        "--test",
        "--test-reporter=tap",
        CLIENT / "test" / "client.test.mjs",
        TOPOLOC_URL=open_service.url,
        TOPOLOC_TOKEN=SIGNED_TOKEN,
        TOPOLOC_IMAGE=str(view),
        TOPOLOC_CAMERA=camera,
    )
    assert "# pass 10\n" in printed


def test_its_tests_name_the_command_that_starts_a_service():
    npm = shutil.which("npm") or pytest.skip("npm is not installed")
    done = subprocess.run([npm, "test"], cwd=CLIENT, capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert "pytest tests/apps/service/test_js_client.py" in done.stdout + done.stderr


_IN_A_PAGE = """async ([url, token, base64]) => {
  const { TopolocClient } = await import("/clients/js/index.js");
  const client = new TopolocClient(url, { token });
  const image = await (await fetch(`data:image/png;base64,${base64}`)).blob();
  const stream = await client.stream("earth", { camera: "map" });
  const states = [(await stream.next(image)).state, (await stream.next(image)).state];
  await stream.close();
  const refused = await client.map("nowhere").catch((one) => [one.status, one.requestId.length]);
  return [await client.maps(), states[0], states.length, refused];
}"""


def test_a_page_of_another_origin_sends_a_token(maps: Path, site: str, view: Path, tmp_path: Path):
    (tmp_path / "token").write_text(SIGNED_TOKEN)
    options = ("--token-file", tmp_path / "token", "--allow-origin", site)
    image = base64.b64encode(view.read_bytes()).decode()
    with chromium() as browser, running(maps / "earth.topo", *options) as service:
        page = browser.new_page()
        page.goto(f"{site}/examples/webxr/")
        answers = page.evaluate(_IN_A_PAGE, [service.url, SIGNED_TOKEN, image])
    assert answers == [["earth"], "localized", 2, [404, 32]]


def _keys(interface: str) -> set[str]:
    (body,) = re.findall(rf"^export interface {interface}\b[^{{]*{{$(.*?)^}}", TYPES, re.M | re.S)
    return set(re.findall(r"^  (\w+)\??:", body, re.M))


def test_its_types_have_the_keys_of_the_schema():
    shared, (found, refused) = (
        SCHEMA["properties"],
        (SCHEMA[kind]["properties"] for kind in ("then", "else")),
    )
    assert _keys("Query") | {"localized"} == set(shared)
    assert _keys("Localized") == set(found) | {"localized"}
    assert _keys("NotLocalized") | {"world_from_cam"} == set(refused) | {"localized"}
    (named,) = re.findall(r"^export type Reason = (.*);$", TYPES, re.M)
    assert set(re.findall(r'"(\w+)"', named)) == set(refused["reason"]["enum"])


_PROGRAM = """import {{ TopolocClient, type Result }} from "{client}";
const client = new TopolocClient("http://127.0.0.1:8571", {{ token: "t" }});
export async function run(image: Blob): Promise<string> {{
  const result: Result = await client.localize("lab", image, {{ camera: "map", maxMs: 200 }});
  const stream = await client.stream("lab", {{ transport: "http" }});
  const next = await stream.next(image, {{ tNs: 5n }});
  const placed = await client.geopose(image, {{ size: [640, 400] }});
  const height: number | string = placed.localized ? placed.geopose.position.h : placed.reason;
  const x = next.localized ? next.world_from_cam.translation[0] : 0;
  return result.localized ? `${{x + result.probability}}` : `${{height}} ${{result.reason}}`;
}}
{wrong}
"""


@pytest.mark.parametrize(
    ("wrong", "fault"),
    [
        ("", ""),
        ('client.localize("lab", 5);', "not assignable"),
        ('client.maps().then((names) => names[0].probability);', "probability"),
        ('client.localize("lab", new Blob([]), { max_ms: 5 });', "max_ms"),
        ('client.localize("lab", new Blob([])).then((r) => r.world_from_cam);', "world_from_cam"),
    ],
)  # fmt: skip
def test_a_typed_program_compiles_and_a_wrong_one_does_not(tmp_path: Path, wrong: str, fault: str):
    program = tmp_path / "program.ts"
    program.write_text(_PROGRAM.format(client=CLIENT / "index.js", wrong=wrong))
    options = ("--noEmit", "--strict", "--target", "es2022", "--module", "nodenext")
    path = shutil.which("tsc")
    if path is None:
        pytest.skip("TypeScript is not installed")
    done = subprocess.run([path, *options, program], capture_output=True, text=True, timeout=120)
    assert (done.returncode == 0) == (fault == ""), done.stdout
    assert fault in done.stdout


def test_the_package_holds_its_files_alone(tmp_path: Path):
    packed = json.loads(_run("npm", "pack", "--dry-run", "--json", npm_config_cache=str(tmp_path)))
    names = {one["path"] for one in packed[0]["files"]}
    assert names == {"package.json", "index.js", "index.d.ts", "README.md", "LICENSE"}
    facts = json.loads((CLIENT / "package.json").read_text(encoding="utf-8"))
    assert "dependencies" not in facts
