"""Check that the files of deploy/ match the program and its image: options, port, user, paths.
docs/service.md names the schemas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tyro

from topoloc.apps.cli.queries.serve import Command

ROOT = Path(__file__).parents[3]
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")


def _documents(name: str) -> list[dict[str, Any]]:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed (with the extra docs)")
    return list(yaml.safe_load_all((ROOT / "deploy" / name).read_text(encoding="utf-8")))


def _check_arguments(arguments: list[str], token: str) -> None:
    command = tyro.cli(Command, args=arguments)
    assert command.maps == ("/maps",)
    assert command.behind_proxy
    assert command.token_file == token
    command._check_access()


def test_kubernetes():
    documents = {document["kind"]: document for document in _documents("kubernetes.yaml")}
    pod = documents["Deployment"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    _check_arguments(container["args"], "/run/token/token")
    mounts = {mount["mountPath"]: mount for mount in container["volumeMounts"]}
    assert {"/maps", "/run/token", "/tmp"} == set(mounts)
    assert mounts["/maps"]["readOnly"]
    assert {mount["name"] for mount in mounts.values()} == {
        volume["name"] for volume in pod["volumes"]
    }
    port = next(port for port in container["ports"] if port["name"] == "http")["containerPort"]
    assert f"EXPOSE {port}" in DOCKERFILE
    assert port == Command().port
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert container[probe]["httpGet"] == {"path": "/healthz", "port": "http"}
    user = pod["securityContext"]
    assert f"USER {user['runAsUser']}:{user['runAsGroup']}" in DOCKERFILE
    assert user["runAsNonRoot"]
    assert container["securityContext"]["readOnlyRootFilesystem"]
    assert not container["securityContext"]["allowPrivilegeEscalation"]
    assert set(container["resources"]) == {"requests", "limits"}
    labels = documents["Deployment"]["spec"]["template"]["metadata"]["labels"]
    assert (
        documents["Service"]["spec"]["selector"]
        == labels
        == documents["PodDisruptionBudget"]["spec"]["selector"]["matchLabels"]
    )
    assert (
        documents["HorizontalPodAutoscaler"]["spec"]["scaleTargetRef"]["name"]
        == documents["Deployment"]["metadata"]["name"]
    )


def test_compose():
    (document,) = _documents("compose.yaml")
    service = document["services"]["topoloc"]
    _check_arguments(service["command"], "/run/secrets/token")
    assert service["read_only"]
    assert f"USER {service['user']}" in DOCKERFILE
    assert [f"EXPOSE {port}" in DOCKERFILE for port in service["expose"]] == [True]
    assert f":{service['expose'][0]}/healthz" in service["healthcheck"]["test"][-1]
    assert (
        f"dynamic a topoloc {service['expose'][0]}" in document["configs"]["caddyfile"]["content"]
    )
    assert set(service["secrets"]) == set(document["secrets"])
    assert (ROOT / "deploy" / service["build"]["context"] / "Dockerfile").is_file()
