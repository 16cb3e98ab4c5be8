"""The files that a code host reads: workflows call what exists, forms have their parts."""

from __future__ import annotations

import re
import tomllib
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
    systems = {system.split("-")[0] for job in jobs for system in job["strategy"]["matrix"]["os"]}
    versions = {one for job in jobs for one in job["strategy"]["matrix"]["python"]}
    assert systems == {"ubuntu", "macos", "windows"}
    assert versions == {"3.11", "3.12", "3.13", "3.14"}
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
