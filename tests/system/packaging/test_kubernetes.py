"""Manifests of the shore site: published schemas, references between them, and the configuration that they hold."""

from __future__ import annotations

import json
import shutil
import subprocess

import pytest
import yaml
from builders.common import REPOSITORY

from sonarpost.config import load
from sonarpost.services.c2.config import C2Config
from sonarpost.services.console.config import ConsoleConfig

FOLDER = REPOSITORY / "packaging" / "kubernetes"


def documents(*paths):
    return [document for path in paths for document in yaml.safe_load_all(path.read_text())]


def name(manifest):
    return f"{manifest['kind']} {manifest['metadata']['name']}"


MERGE_KEYS = {"containers": "name", "env": "name", "volumeMounts": "mountPath", "volumes": "name"}


def merged(base, patch, field=""):
    """Apply a strategic merge patch as kustomize does, as far as these manifests use it."""
    if isinstance(base, dict) and isinstance(patch, dict):
        return base | {key: merged(base.get(key), value, key) for key, value in patch.items()}
    if isinstance(base, list) and field in MERGE_KEYS:
        entries = {entry[MERGE_KEYS[field]]: entry for entry in base}
        for entry in patch:
            key = entry[MERGE_KEYS[field]]
            if entry.get("$patch") == "delete":
                del entries[key]
            else:
                entries[key] = merged(entries.get(key), entry)
        return list(entries.values())
    return patch


def build(folder):
    """Return the manifests of a folder with a kustomization."""
    [kustomization] = documents(folder / "kustomization.yaml")
    assert set(kustomization) <= {"apiVersion", "kind", "resources", "patches"}
    manifests = {}
    for resource in kustomization["resources"]:
        path = folder / resource
        found = build(path) if path.is_dir() else documents(path)
        manifests |= {name(manifest): manifest for manifest in found}
    for patch in kustomization.get("patches", ()):
        for change in documents(folder / patch["path"]):
            manifests[name(change)] = merged(manifests[name(change)], change)
    return list(manifests.values())


@pytest.fixture(params=["base", "postgresql"])
def built(request):
    """Name and manifests of a variant."""
    return request.param, build(FOLDER / request.param)


def without_order(value):
    """Return a value as JSON with sorted keys and lists."""
    if isinstance(value, dict):
        return json.dumps({key: without_order(entry) for key, entry in value.items()}, sort_keys=True)
    return json.dumps(sorted(map(without_order, value))) if isinstance(value, list) else json.dumps(value)


def test_kustomize_builds_the_same_manifests(built):
    kubectl = shutil.which("kubectl")
    if kubectl is None:
        pytest.skip("kubectl is not installed")
    command = [kubectl, "kustomize", str(FOLDER / built[0])]
    text = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    assert without_order(list(yaml.safe_load_all(text))) == without_order(built[1])


def test_manifests_match_the_published_schema(built):
    validate = pytest.importorskip("kubernetes_validate").validate
    for manifest in built[1]:
        validate(manifest, "1.37", strict=True)


def pods(manifests):
    return [m["spec"]["template"] for m in manifests if m["kind"] in ("Deployment", "StatefulSet")]


def test_pods_have_what_they_refer_to(built):
    manifests = built[1]
    assert [len(pod["spec"]["containers"]) for pod in pods(manifests)] == [1, 2]
    specs = [m["spec"] for m in manifests if "spec" in m]
    claims = {claim["metadata"]["name"] for spec in specs for claim in spec.get("volumeClaimTemplates", ())}
    for pod in pods(manifests):
        volumes = {volume["name"] for volume in pod["spec"]["volumes"]} | claims
        for container in pod["spec"]["containers"]:
            assert {mount["name"] for mount in container["volumeMounts"]} <= volumes
            assert container["securityContext"]["readOnlyRootFilesystem"]
            assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
        assert pod["spec"]["securityContext"]["runAsUser"] == 10001
    names = {m["metadata"]["name"] for m in manifests}
    assert "sonarpost-shore" in names
    selectors = [m["spec"]["selector"] for m in manifests if m["kind"] == "Service"]
    selectors += [m["spec"]["selector"]["matchLabels"] for m in manifests if m["kind"] == "PodDisruptionBudget"]
    for selector in selectors:
        assert any(selector.items() <= pod["metadata"]["labels"].items() for pod in pods(manifests))


def test_variant_with_postgresql_has_two_c2_with_names_of_their_own(built, tmp_path):
    variant, manifests = built
    [shore] = [m["spec"] for m in manifests if m["kind"] == "StatefulSet"]
    claims = [claim["metadata"]["name"] for claim in shore["volumeClaimTemplates"]]
    assert (shore["replicas"], claims) == {
        "base": (1, ["state", "pictures"]),
        "postgresql": (2, ["state"]),
    }[variant]
    if variant == "base":
        return
    [text] = [m["data"]["shore.toml"] for m in manifests if m["kind"] == "ConfigMap"]
    path = tmp_path / "shore.toml"
    path.write_text(text)
    url = "postgresql://c2:secret@db.example.org/shore?sslrootcert=/etc/sonarpost/database/ca.pem"
    for container, model in zip(shore["template"]["spec"]["containers"], (C2Config, ConsoleConfig), strict=True):
        environment = {}
        for variable in container["env"]:
            source = variable["valueFrom"]
            is_name = source.get("fieldRef") == {"fieldPath": "metadata.name"}
            assert is_name or source == {"secretKeyRef": {"name": "sonarpost-database", "key": "url"}}
            environment[variable["name"]] = "sonarpost-shore-1" if is_name else url
        platform, config = load(path, container["name"], model, environment)
        assert (platform.id, config.database) == ("sonarpost-shore-1", url)
        mounts = {mount["mountPath"]: mount for mount in container["volumeMounts"]}
        assert "/etc/sonarpost/database" in mounts
        assert "/var/lib/sonarpost/pictures" not in mounts


def test_configuration_is_valid_and_names_the_router(tmp_path):
    manifests = build(FOLDER / "base")
    [text] = [m["data"]["shore.toml"] for m in manifests if m["kind"] == "ConfigMap"]
    path = tmp_path / "shore.toml"
    path.write_text(text)
    platform, _ = load(path, "c2", C2Config, {})
    _, console = load(path, "console", ConsoleConfig, {})
    assert console.out_dir.as_posix() == "/var/lib/sonarpost/pictures"
    services = {m["metadata"]["name"]: m["spec"]["ports"] for m in manifests if m["kind"] == "Service"}
    [endpoint] = platform.router
    name, port = endpoint.removeprefix("tcp/").split(":")
    assert int(port) in [entry["port"] for entry in services[name]]
