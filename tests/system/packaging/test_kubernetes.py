"""Manifests of the shore site: their fields, references between them, and the configuration that they hold."""

import json
import re
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


def name_of(manifest):
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
        manifests |= {name_of(manifest): manifest for manifest in found}
    for patch in kustomization.get("patches", ()):
        for change in documents(folder / patch["path"]):
            manifests[name_of(change)] = merged(manifests[name_of(change)], change)
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


# The fields of the Kubernetes interface that the manifests use: `!` marks a required one, `*` stands for any name, and
# a value names a pattern of `PATTERNS`, or the values of an enumeration.
SCHEMAS = yaml.safe_load("""
x-selector: &selector {matchLabels!: &labels {"*": str}}
x-meta: &meta {name!: name, labels: *labels}
x-probe: &probe
  {tcpSocket: {port!: name}, exec: {command!: [str]},
   initialDelaySeconds: int, periodSeconds: int, timeoutSeconds: int, failureThreshold: int}
x-container: &container
  {name!: name, image!: str, command: [str], args: [str], ports: [{name!: name, containerPort!: int}],
   env: [{name!: variable, valueFrom!: {fieldRef: {fieldPath!: str}, secretKeyRef: {name!: name, key!: str}}}],
   securityContext!: {allowPrivilegeEscalation!: bool, readOnlyRootFilesystem!: bool, capabilities!: {drop!: [str]}},
   resources!: {requests!: &amounts {cpu: quantity, memory: quantity}, limits!: *amounts},
   readinessProbe: *probe, livenessProbe!: *probe,
   volumeMounts!: [{name!: name, mountPath!: path, subPath: str, readOnly: bool}]}
x-pod: &pod
  {automountServiceAccountToken!: bool, terminationGracePeriodSeconds: int, containers!: [*container],
   securityContext!: {runAsUser!: int, runAsGroup!: int, fsGroup!: int, runAsNonRoot!: bool,
     seccompProfile!: {type!: RuntimeDefault}},
   affinity: {podAntiAffinity: {preferredDuringSchedulingIgnoredDuringExecution:
     [{weight!: int, podAffinityTerm!: {topologyKey!: str, labelSelector!: *selector}}]}},
   volumes: [{name!: name, secret: {secretName!: name, defaultMode: int}, configMap: {name!: name},
     emptyDir: {medium: Memory, sizeLimit: quantity}}]}
x-template: &template {metadata!: {labels!: *labels}, spec!: *pod}
ConfigMap: {apiVersion!: v1, data!: {"*": str}}
Deployment:
  apiVersion!: apps/v1
  spec!: {replicas: int, strategy: {type!: Recreate|RollingUpdate}, selector!: *selector, template!: *template}
StatefulSet:
  apiVersion!: apps/v1
  spec!: {serviceName!: name, replicas: int, podManagementPolicy: OrderedReady|Parallel, selector!: *selector,
    template!: *template, volumeClaimTemplates: [{metadata!: *meta, spec!:
      {accessModes!: [ReadWriteOnce], resources!: {requests!: {storage!: quantity}}}}]}
Service:
  apiVersion!: v1
  spec!: {type: ClusterIP|NodePort|LoadBalancer, clusterIP: None, selector!: *labels,
    ports!: [{name!: name, port!: int, targetPort: name}]}
NetworkPolicy:
  apiVersion!: networking.k8s.io/v1
  spec!: {podSelector!: *selector, policyTypes!: [Ingress|Egress],
    ingress: [{ports: [{port!: int}], from: [{podSelector: *selector}]}]}
PodDisruptionBudget: {apiVersion!: policy/v1, spec!: {maxUnavailable!: int, selector!: *selector}}
""")
PATTERNS = {
    "str": ".+",
    "name": "[a-z0-9]([a-z0-9.-]*[a-z0-9])?",
    "path": "/[A-Za-z0-9./_-]+",
    "quantity": "[1-9][0-9]*(m|Mi|Gi)",
    "variable": "SONARPOST_[A-Z0-9_]+",
}


def mismatches(value, schema, place):
    """Yield the places at which a value does not match a schema."""
    if isinstance(schema, dict) and isinstance(value, dict):
        known = {name.rstrip("!"): inner for name, inner in schema.items()}
        yield from (f"{place}.{name[:-1]}: missing" for name in schema if name.endswith("!") and name[:-1] not in value)
        for name, inner in value.items():
            if name in known or "*" in known:
                yield from mismatches(inner, known.get(name, known.get("*")), f"{place}.{name}")
            else:
                yield f"{place}.{name}: unknown"
    elif isinstance(schema, list) and isinstance(value, list):
        for number, entry in enumerate(value):
            yield from mismatches(entry, schema[0], f"{place}[{number}]")
    elif isinstance(schema, (dict, list)):
        yield f"{place}: {value!r}"
    elif schema in ("int", "bool"):
        if type(value).__name__ != schema:
            yield f"{place}: {value!r}"
    elif not isinstance(value, str) or not re.fullmatch(PATTERNS.get(schema, schema), value, re.DOTALL):
        yield f"{place}: {value!r}"


def defects(manifest):
    schema = {"kind!": manifest["kind"], "metadata!": SCHEMAS["x-meta"], **SCHEMAS[manifest["kind"]]}
    return list(mismatches(manifest, schema, manifest["kind"]))


def test_manifests_have_the_fields_of_their_kinds(built):
    assert {place for manifest in built[1] for place in defects(manifest)} == set()


def workloads(manifests):
    return {m["metadata"]["name"]: m["spec"] for m in manifests if m["kind"] in ("Deployment", "StatefulSet")}


def test_references_between_manifests_resolve(built):
    variant, manifests = built
    secrets = {"sonarpost-shore-tls"} | ({"sonarpost-database"} if variant == "postgresql" else set())
    config_maps = {m["metadata"]["name"]: m["data"] for m in manifests if m["kind"] == "ConfigMap"}
    services = {m["metadata"]["name"]: m["spec"] for m in manifests if m["kind"] == "Service"}
    labels = {}
    for name, spec in workloads(manifests).items():
        labels[name] = spec["template"]["metadata"]["labels"]
        assert spec["selector"]["matchLabels"] == labels[name]
        assert spec.get("serviceName", "sonarpost-router") in services
        pod = spec["template"]["spec"]
        claims = {claim["metadata"]["name"] for claim in spec.get("volumeClaimTemplates", ())}
        volumes = {volume["name"]: volume for volume in pod["volumes"]}
        mounts = [mount for container in pod["containers"] for mount in container["volumeMounts"]]
        assert {mount["name"] for mount in mounts} == volumes.keys() | claims, "all volumes exist and are used"
        for mount in mounts:
            source = volumes.get(mount["name"], {})
            if "configMap" in source:
                assert mount["subPath"] in config_maps[source["configMap"]["name"]]
        named = {volume["secret"]["secretName"] for volume in volumes.values() if "secret" in volume}
        keys = [variable["valueFrom"] for c in pod["containers"] for variable in c.get("env", ())]
        assert named | {key["secretKeyRef"]["name"] for key in keys if "secretKeyRef" in key} <= secrets
        for container in pod["containers"]:
            ports = {port["name"] for port in container.get("ports", ())}
            probes = [container[probe] for probe in ("livenessProbe", "readinessProbe") if probe in container]
            assert {probe["tcpSocket"]["port"] for probe in probes if "tcpSocket" in probe} <= ports
    for name, service in services.items():
        [target] = [w for w, found in labels.items() if service["selector"].items() <= found.items()]
        containers = workloads(manifests)[target]["template"]["spec"]["containers"]
        ports = {port["name"]: port["containerPort"] for c in containers for port in c.get("ports", ())}
        for port in service["ports"]:
            assert "targetPort" not in port or ports[port["targetPort"]] == port["port"], name
    for manifest in manifests:
        selected = manifest.get("spec", {}).get(
            "podSelector" if manifest["kind"] == "NetworkPolicy" else "selector", {}
        )
        wanted = selected.get("matchLabels", selected)
        assert not wanted or any(wanted.items() <= found.items() for found in labels.values()), name_of(manifest)
    assert {"sonarpost-router", "sonarpost-shore"} == set(labels)


def test_pods_agree_with_the_compose_file(built):
    compose = yaml.safe_load((REPOSITORY / "docker-compose.yml").read_text())["services"]
    image = compose["c2"]["image"].removeprefix("${SONARPOST_IMAGE:-").removesuffix("}")
    found = workloads(built[1])
    for spec in found.values():
        pod = spec["template"]["spec"]
        user = pod["securityContext"]
        assert f"{user['runAsUser']}:{user['runAsGroup']}" == compose["c2"]["user"]
        assert user["runAsNonRoot"]
        for container in pod["containers"]:
            assert container["image"] == image
            assert container["securityContext"]["readOnlyRootFilesystem"]
            assert not container["securityContext"]["allowPrivilegeEscalation"]
            assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
    containers = found["sonarpost-shore"]["template"]["spec"]["containers"]
    for container, service in zip(containers, ("c2", "console-shore"), strict=True):
        assert container["args"] == compose[service]["command"]
        mounts = {mount["mountPath"]: mount.get("readOnly", False) for mount in container["volumeMounts"]}
        for volume in compose[service]["volumes"]:
            place = re.sub(r"^\$\{[^}]*\}|^[^:]*", "", volume).removeprefix(":")
            path, _, mode = place.partition(":")
            if path == "/etc/sonarpost":
                assert mounts["/etc/sonarpost/shore.toml"]
            elif built[0] == "base" or not path.endswith("/images"):
                assert mounts[path] == (mode == "ro"), volume
    [router] = found["sonarpost-router"]["template"]["spec"]["containers"]
    [published] = compose["router-shore"]["ports"]
    assert int(published.rpartition(":")[2]) in {port["containerPort"] for port in router["ports"]}


def test_variant_with_postgresql_has_two_c2_with_names_of_their_own(built, tmp_path):
    variant, manifests = built
    [shore] = [m["spec"] for m in manifests if m["kind"] == "StatefulSet"]
    claims = [claim["metadata"]["name"] for claim in shore["volumeClaimTemplates"]]
    assert (shore["replicas"], claims) == {"base": (1, ["state", "images"]), "postgresql": (2, ["state"])}[variant]
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
        assert platform.id == "sonarpost-shore-1"
        mounts = {mount["mountPath"]: mount for mount in container["volumeMounts"]}
        assert "/var/lib/sonarpost/images" not in mounts
        if isinstance(config, C2Config):
            assert config.database == url
            assert "/etc/sonarpost/database" in mounts


def test_configuration_is_valid_and_names_the_router(tmp_path):
    manifests = build(FOLDER / "base")
    [text] = [m["data"]["shore.toml"] for m in manifests if m["kind"] == "ConfigMap"]
    path = tmp_path / "shore.toml"
    path.write_text(text)
    platform, _ = load(path, "c2", C2Config, {})
    load(path, "console", ConsoleConfig, {})
    services = {m["metadata"]["name"]: m["spec"]["ports"] for m in manifests if m["kind"] == "Service"}
    [endpoint] = platform.router
    name, port = endpoint.removeprefix("tcp/").split(":")
    assert int(port) in [entry["port"] for entry in services[name]]
