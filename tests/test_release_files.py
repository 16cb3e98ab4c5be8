"""Test the files for a code host and an index: workflows call existing targets, forms are complete,
and links lead to the repository."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from email.message import Message
from pathlib import Path
from typing import Any

import pytest
import yaml

from topoloc.apps.cli import COMMANDS

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def _read(path: Path) -> dict[Any, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_jobs_call_targets_commands_and_extras_that_exist(path: Path):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([\w-]+)(?: [\w-]+)*:", makefile, re.MULTILINE))
    jobs = _read(path)["jobs"].values()
    lines = [step["run"] for job in jobs for step in job["steps"] if "run" in step]
    assert lines
    for line in lines:
        program, *words = line.split()
        if program == "make":
            assert words[0] in targets
        elif program == "topoloc":
            assert words[0] in COMMANDS
        else:
            extras = re.search(r"-m pip install '\.\[(\w+)\]'", line)
            assert extras, line
            assert extras[1] in PROJECT["optional-dependencies"]


def test_jobs_cover_each_system_and_version():
    jobs = [job for path in WORKFLOWS for job in _read(path)["jobs"].values()]
    grids = [job["strategy"]["matrix"] for job in jobs if "strategy" in job]
    pairs = {(system, one) for grid in grids for system in grid["os"] for one in grid["python"]}
    versions = {"3.11", "3.12", "3.13", "3.14"}
    systems = {"ubuntu-24.04", "ubuntu-24.04-arm", "macos-15", "windows-2025"}
    assert pairs == {(system, one) for system in systems for one in versions}
    prefix = "Programming Language :: Python :: 3."
    named = {one[len(prefix) - 2 :] for one in PROJECT["classifiers"] if one.startswith(prefix)}
    assert named <= versions


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.name)
def test_forms_have_the_parts_that_a_host_requires(path: Path):
    form = _read(path)
    assert form["name"]
    assert form["description"]
    ids = [part["id"] for part in form["body"]]
    assert len(ids) == len(set(ids)) > 0
    assert all(part["attributes"]["label"] for part in form["body"])


REPOSITORY = "https://example.org/OWNER/topoloc"
NAMES = ("topoloc", "topoloc_worlds", "topoloc_training", "topoloc_paper")


def _release(*args: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "tools" / "release.py"), *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the four distributions, built for an index."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("a release is made from a checkout of git")
    folder = tmp_path_factory.mktemp("released")
    done = _release(REPOSITORY + "/", "--out", folder)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 2 * len(NAMES)
    return folder


def _metadata(folder: Path, name: str) -> list[Message]:
    """Return the metadata of a wheel and of a source distribution, as an index reads them."""
    (wheel,), (source,) = folder.glob(f"{name}-*.whl"), folder.glob(f"{name}-*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        (path,) = [one for one in archive.namelist() if one.endswith(".dist-info/METADATA")]
        texts = [archive.read(path)]
        assert any(one.endswith("/LICENSE") for one in archive.namelist())
    with tarfile.open(source) as archive:
        root = source.name.removesuffix(".tar.gz")
        info = archive.extractfile(f"{root}/PKG-INFO")
        assert info is not None
        texts.append(info.read())
        assert {f"{root}/LICENSE", f"{root}/README.md"} <= set(archive.getnames())
    return [message_from_bytes(text) for text in texts]


@pytest.mark.parametrize("name", NAMES)
def test_links_and_images_on_an_index_lead_to_the_repository(released: Path, name: str):
    for metadata in _metadata(released, name):
        version = metadata["Version"]
        urls = dict(line.split(", ") for line in metadata.get_all("Project-URL", []))
        assert urls["Homepage"] == REPOSITORY
        assert urls["Changelog"] == f"{REPOSITORY}/blob/v{version}/CHANGELOG.md"
        assert metadata["Description-Content-Type"] == "text/markdown"
        links = re.findall(r"(!?)\[[^\]]*\]\(([^)\s]+)\)", str(metadata.get_payload()))
        assert links
        for image, link in links:
            kind = "raw" if image else "blob"
            place = link.removeprefix(f"{REPOSITORY}/{kind}/v{version}/")
            assert place != link, link
            assert (ROOT / place.partition("#")[0]).is_file()


def test_images_of_the_readme_are_shown(released: Path):
    for metadata in _metadata(released, "topoloc"):
        images = re.findall(r"!\[[^\]]*\]\((\S+)\)", str(metadata.get_payload()))
        assert f"{REPOSITORY}/raw/v{metadata['Version']}/docs/images/lab_map.png" in images


@pytest.mark.parametrize("wrong", ["", "github.com/OWNER/topoloc", "https://github.com"])
def test_a_release_needs_an_address(wrong: str, tmp_path: Path):
    done = _release(wrong, "--out", tmp_path / "dist")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "is no address such as https://github.com/OWNER/topoloc" in done.stderr
    assert not (tmp_path / "dist").exists()


def test_all_distributions_and_the_citation_have_one_version():
    files = [ROOT / folder / "pyproject.toml" for folder in (".", "worlds", "training", "paper")]
    versions = {tomllib.loads(path.read_text("utf-8"))["project"]["version"] for path in files}
    assert versions == {_read(ROOT / "CITATION.cff")["version"]}
