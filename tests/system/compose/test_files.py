"""The compose file says of every service what it must, and .env.example knows every variable."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml
from builders.common import REPOSITORY

from sonarpost.config import SERVICES, ServiceConfig, load, overridden_keys
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.compressor.config import CompressorConfig

COMPOSE = REPOSITORY / "docker-compose.yml"
PLATFORMS = {"uuv": "uuv", "vessel": "vessel", "shore": "shore", "sim": "sim"}


def variables(text: str) -> dict[str, str]:
    """Return the variables of a compose file and what each has by default."""
    return dict(re.findall(r"\$\{([A-Z_]+):?-?([^}]*)\}", text))


def blocks() -> dict[str, str]:
    """Return the text of each service in the compose file."""
    text = re.sub(r"^ *#.*\n", "", COMPOSE.read_text(), flags=re.MULTILINE)
    services = text.split("\nservices:\n")[1].split("\nnetworks:\n")[0]
    parts = re.split(r"^  ([a-z_0-9-]+):\n", services, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def joins(block: str) -> str:
    """Return what a service's text says of networks."""
    return "".join(block.partition("networks:")[1:])


def test_every_service_of_the_chain_runs_with_its_platforms_file() -> None:
    for service in SERVICES:
        block = blocks()[service]
        [(platform, name)] = re.findall(r"command: \[(\w+), (\w+)\]", block)
        assert name == service
        assert f"profiles: [{PLATFORMS[platform]}]" in block
        written = tomllib.loads((REPOSITORY / "config" / f"{platform}.toml").read_text())
        assert service in written


def test_two_c2_share_a_database_and_no_store() -> None:
    first, second = blocks()["c2-first"], blocks()["c2-second"]
    [address] = set(re.findall(r"SONARPOST_\w+__DATABASE: \"(\S+)\"", COMPOSE.read_text()))
    assert address.startswith("postgresql://sonarpost:${DATABASE_PASSWORD:-}@database/")
    assert "- shore-state:/var/lib/sonarpost/state" in first
    assert "- shore-second-state:/var/lib/sonarpost/state" in second
    for name in ("database", "c2-first", "c2-second", "console-shore-ha"):
        assert "profiles: [shore-ha]" in blocks()[name]
        assert "shore" in joins(blocks()[name])


def test_networks_of_platforms_lead_nowhere_and_only_routers_meet() -> None:
    text = COMPOSE.read_text()
    networks = text.split("\nnetworks:\n")[1].split("\nvolumes:\n")[0]
    inside = re.findall(r"^  ([a-z-]+): \{ internal: true \}$", networks, flags=re.MULTILINE)
    assert set(inside) == {"uuv", "uuv-line", "vessel", "vessel-line", "shore", "sim"}
    on_link = [name for name, block in blocks().items() if re.search(r"\blink\b", joins(block))]
    assert on_link == ["router-vessel", "router-shore"]
    assert [name for name, block in blocks().items() if "ports:" in block] == [
        "console",
        "router-shore",
        "console-shore",
        "console-shore-ha",
    ]
    for name in ("console", "console-shore", "console-shore-ha"):
        # Pages are served to this host only, unless the environment names another address.
        assert re.search(r'ports: \["\$\{\w+:-127\.0\.0\.1:\d+\}:8470"\]', blocks()[name]), name
    for name, block in blocks().items():
        if "profiles: [uuv]" in block:
            assert joins(block), name
            assert not re.search("vessel|shore|link", joins(block)), name


def test_modem_services_mount_the_acoustic_key_that_their_configuration_names() -> None:
    for service, platform in (("uuv_modem", "uuv"), ("op_modem", "vessel"), ("decompressor", "vessel")):
        assert f"- {platform}-acoustic:/var/lib/sonarpost/acoustic:ro" in blocks()[service]
        assert f"- {platform}-acoustic:/var/lib/sonarpost/acoustic/{platform}\n" in blocks()["pki"]
        written = tomllib.loads((REPOSITORY / "config" / f"{platform}.toml").read_text())["platform"]
        assert written["acoustic_auth"] == "key"
        assert written["acoustic_key_file"] == "/var/lib/sonarpost/acoustic/acoustic.key"
    assert "/var/lib/sonarpost/acoustic/uuv" in (REPOSITORY / "Dockerfile").read_text()


def test_the_routers_of_the_files_in_config_get_endpoints_that_other_containers_reach() -> None:
    """The files listen on the loopback address."""
    with_file = {name: block for name, block in blocks().items() if "/etc/sonarpost/router-" in block}
    assert set(with_file) == {"router-uuv", "router-sim"}
    for block in with_file.values():
        assert '"--listen", "tcp/router:7447"' in block
    options = re.findall(r"^#(\w+)_ROUTER_OPTIONS=(.*)$", (REPOSITORY / ".env.example").read_text(), flags=re.MULTILINE)
    assert {name for name, text in options if "--listen tcp/router:7447" in text} == {"SHORE", "VESSEL"}


def test_the_own_router_has_a_name_of_its_own() -> None:
    text = (REPOSITORY / "packaging" / "images.sh").read_text()
    [built] = re.findall(r"^build --target router --tag \"(\S+)\"$", text, flags=re.MULTILINE)
    assert built == "$router"
    assert (
        text.index("own_router=sonarpost-router:")
        < text.index("router=$own_router")
        < text.index("build --target router")
    )


def test_every_variable_is_in_the_example_with_its_default() -> None:
    example = (REPOSITORY / ".env.example").read_text()
    known = dict(re.findall(r"^#?([A-Z_]+)=(.*?)(?:[ ]+#.*)?$", example, flags=re.MULTILINE))
    used = variables(COMPOSE.read_text()) | variables((REPOSITORY / "docker-compose.modem.yml").read_text())
    assert set(used) <= set(known)
    assert set(known) - set(used) == {"COMPOSE_FILE"}
    # Other values are examples, marked in the comment.
    same = {name for name, default in used.items() if known[name].strip() == default}
    assert {"SONARPOST_IMAGE", "ROUTER_IMAGE", "SHORE_PUBLISH", "SERVICE_MEMORY"} <= same
    # A variable that overrides a key is empty by default; the example shows the value of the file in `config`.
    for variable, (service, table, key) in overriding_variables().items():
        [platform] = re.findall(r"command: \[(\w+), ", blocks()[service])
        platform_table, own = load(
            REPOSITORY / "config" / f"{platform}.toml",
            service.removesuffix("-ha").removesuffix("-shore"),
            configuration_type(service),
            {},
        )
        value = getattr(platform_table if table == "platform" else own, key)
        shown = known[variable].strip()
        assert (json.dumps(list(value)) if isinstance(value, tuple) else str(value)) == shown, variable


def configuration_type(service: str) -> type[ServiceConfig]:
    name = service.removesuffix("-ha").removesuffix("-shore")
    module = importlib.import_module(f"sonarpost.services.{name}.config")
    found: type[ServiceConfig] = getattr(module, "".join(part.capitalize() for part in name.split("_")) + "Config")
    return found


def overriding_variables() -> dict[str, tuple[str, str, str]]:
    """Return the variables of .env that override a key: service, table and key of each."""
    text = COMPOSE.read_text()
    anchors = dict(re.findall(r"^x-(uuv|vessel|shore|platform): &\w+\n((?:  .*\n)+)", text, flags=re.MULTILINE))
    first_service = {"uuv": "atd_stub", "vessel": "relay", "shore": "c2", "platform": "relay"}
    parts = [*((first_service[name], body) for name, body in anchors.items()), *blocks().items()]
    found = {}
    for service, body in parts:
        for table, key, variable in re.findall(r"SONARPOST_([A-Z0-9_]+?)__(\w+): \$\{(\w+):-\}", body):
            found[variable] = (service, table.lower(), key.lower())
    return found


def test_only_keys_of_the_containers_networks_are_always_set() -> None:
    assert len(overriding_variables()) == 16
    settings = re.findall(r"SONARPOST_([A-Z0-9_]+__\w+): (.*)", COMPOSE.read_text())
    always = {name for name, value in settings if not re.fullmatch(r"\$\{\w+:-\}", value)}
    # CONTRIBUTING and containers.md: a key of this list is not taken from config/*.toml.
    assert always == {
        "PLATFORM__ROUTER",
        "UUV_MODEM__PORT",
        "OP_MODEM__PORT",
        "CONSOLE__HOST",
        "CONSOLE__INSECURE",
        "PLATFORM__ID",
        "C2__DATABASE",
        "CONSOLE__DATABASE",
    }
    page = (REPOSITORY / "docs" / "how-to" / "containers.md").read_text()
    for name in always:
        assert f"`{name.partition('__')[2].lower()}`" in page, name


EDITED = """
[platform]
id = "uuv-7"
log_level = "debug"
[compressor]
codec = "vq"
budget_bytes = 300
[atd_stub]
max_contacts = 3
"""


def test_edited_configuration_holds_unless_env_overrides_it(tmp_path: Path) -> None:
    file = tmp_path / "uuv.toml"
    file.write_text(EDITED)
    commands = compose_commands()
    if not commands:
        pytest.skip("neither `docker compose` nor docker-compose is installed")
    for command in commands:
        for text, expected in (
            ("", ("uuv-7", "debug", "vq", 300, 3)),
            ("CODEC=emb\nBUDGET_BYTES=\nUUV_ID=uuv-9\nMAX_CONTACTS=5\n", ("uuv-9", "debug", "emb", 300, 5)),
        ):
            (tmp_path / ".env").write_text(text)
            shutil.copyfile(COMPOSE, tmp_path / "docker-compose.yml")
            done = subprocess.run(
                [*command, "--profile", "uuv", "config"],
                cwd=tmp_path,
                env={"PATH": os.environ["PATH"], "HOME": str(tmp_path)},
                capture_output=True,
                text=True,
                timeout=400,
                check=True,
            )
            services = yaml.safe_load(done.stdout)["services"]
            environment = {
                service: {name: str(value or "") for name, value in services[service]["environment"].items()}
                for service in ("compressor", "atd_stub")
            }
            platform, compressor = load(file, "compressor", CompressorConfig, environment["compressor"])
            _, stub = load(file, "atd_stub", AtdStubConfig, environment["atd_stub"])
            values = (platform.id, platform.log_level, compressor.codec, compressor.budget_bytes, stub.max_contacts)
            assert values == expected
            keys = overridden_keys("compressor", environment["compressor"])
            assert ("compressor.codec" in keys) == bool(text)
            assert "compressor.budget_bytes" not in keys


def test_the_dockerfile_and_the_compose_file_name_the_same_base() -> None:
    [base] = re.findall(r"^ARG BASE=(\S+)$", (REPOSITORY / "Dockerfile").read_text(), flags=re.MULTILINE)
    assert variables(COMPOSE.read_text())["SONARPOST_BASE"] == base
    assert not base.endswith((":latest", "debian"))
    assert re.search(r":\d+\.\d+\.\d+$", variables(COMPOSE.read_text())["ROUTER_IMAGE"])


def compose_commands() -> list[list[str]]:
    found = []
    if shutil.which("docker"):
        version = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
        if version.returncode == 0:
            found.append(["docker", "compose"])
    if (path := shutil.which("docker-compose")) is not None:
        found.append([path])
    return found


@pytest.mark.parametrize("files", [["docker-compose.yml"], ["docker-compose.yml", "docker-compose.modem.yml"]])
def test_compose_accepts_the_files(files: list[str]) -> None:
    commands = compose_commands()
    if not commands:
        pytest.skip("neither `docker compose` nor docker-compose is installed")
    for command in commands:
        options = [option for file in files for option in ("-f", file)]
        profiles = [option for profile in (*PLATFORMS, "shore-ha") for option in ("--profile", profile)]
        done = subprocess.run(
            [*command, *options, *profiles, "config", "--services"],
            cwd=REPOSITORY,
            env={**os.environ, "COMPOSE_DISABLE_ENV_FILE": "1"},
            capture_output=True,
            text=True,
            timeout=400,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert set(done.stdout.split()) >= {
            *SERVICES,
            "router-uuv",
            "router-vessel",
            "router-shore",
            "pki",
            "database",
            "c2-second",
        }
        assert json.dumps(done.stderr).count("level=warning") == 0
