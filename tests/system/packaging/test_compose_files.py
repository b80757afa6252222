"""The compose file says of every service what it must, and .env.example knows every variable."""

import json
import os
import re
import shutil
import subprocess
import tomllib

import pytest
import yaml
from builders.common import REPOSITORY
from builders.compose import PUBLISHED, compose_commands

from sonarpost.cli.deployment.config_files import configuration_type, example_files
from sonarpost.config import load, overridden_keys, service_packages
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.compressor.config import CompressorConfig

COMPOSE = REPOSITORY / "docker-compose.yml"
TEXT = COMPOSE.read_text()
FILE = yaml.safe_load(TEXT)
BLOCKS = FILE["services"]
PLATFORMS = ("uuv", "vessel", "shore", "sim")


def variables(text):
    """Return the variables of a compose file and what each has by default."""
    return dict(re.findall(r"\$\{([A-Z_]+):?-?([^}]*)\}", text))


def configured(platform):
    return tomllib.loads(example_files()[platform].read_text())


def test_every_service_of_the_chain_runs_with_its_platforms_file():
    for service in service_packages():
        platform, name = BLOCKS[service]["command"]
        assert name == service
        assert BLOCKS[service]["profiles"] == [platform]
        assert service in configured(platform)


def test_two_c2_share_a_database_and_no_store():
    [address] = set(re.findall(r"SONARPOST_\w+__DATABASE: \"(\S+)\"", TEXT))
    assert address.startswith("postgresql://sonarpost:${DATABASE_PASSWORD:-}@database/")
    for name, volume in (("c2-first", "shore-state"), ("c2-second", "shore-second-state")):
        assert f"{volume}:/var/lib/sonarpost/state" in BLOCKS[name]["volumes"]
    for name in ("database", "c2-first", "c2-second", "console-shore-ha"):
        assert BLOCKS[name]["profiles"] == ["shore-ha"]
        assert "shore" in BLOCKS[name]["networks"]


def test_networks_of_platforms_lead_nowhere_and_only_routers_meet():
    inside = {name for name, network in FILE["networks"].items() if network == {"internal": True}}
    assert inside == {"uuv", "uuv-line", "vessel", "vessel-line", "shore", "sim"}
    assert [n for n, block in BLOCKS.items() if "link" in block.get("networks", ())] == [
        "router-vessel",
        "router-shore",
    ]
    consoles = ("console", "console-shore", "console-shore-ha")
    assert {name for name, block in BLOCKS.items() if "ports" in block} == {"router-shore", *consoles}
    for name in consoles:
        # Pages are served to this host only, unless the environment names another address.
        [port] = BLOCKS[name]["ports"]
        assert re.fullmatch(r"\$\{\w+:-127\.0\.0\.1:\d+\}:8470", port), name
    assert set(PUBLISHED) == {name for name in variables(TEXT) if name.endswith("_PUBLISH")}, "free ports in the tests"
    vehicle = [set(block["networks"]) for block in BLOCKS.values() if "uuv" in block.get("profiles", ())]
    assert len(vehicle) >= 4
    assert set.union(*vehicle) == {"uuv", "uuv-line"}


def test_modem_services_mount_the_acoustic_key_that_their_configuration_names():
    mounted = {name for name, block in BLOCKS.items() if "/var/lib/sonarpost/acoustic:ro" in str(block.get("volumes"))}
    assert mounted == {"uuv_modem", "op_modem"}
    for service, platform in (("uuv_modem", "uuv"), ("op_modem", "vessel")):
        assert f"{platform}-acoustic:/var/lib/sonarpost/acoustic:ro" in BLOCKS[service]["volumes"]
        assert f"{platform}-acoustic:/var/lib/sonarpost/acoustic/{platform}" in BLOCKS["pki"]["volumes"]
        written = configured(platform)["platform"]
        assert written["acoustic_auth"] == "key"
        assert written["acoustic_key_file"] == "/var/lib/sonarpost/acoustic/acoustic.key"
    assert "/var/lib/sonarpost/acoustic/uuv" in (REPOSITORY / "Dockerfile").read_text()


def test_the_routers_of_the_files_in_config_get_endpoints_that_other_containers_reach():
    """The files listen on the loopback address."""
    with_file = {name: str(b) for name, b in BLOCKS.items() if "/etc/sonarpost/router-" in str(b.get("command"))}
    assert set(with_file) == {"router-uuv", "router-sim"}
    assert all("'--listen', 'tcp/router:7447'" in block for block in with_file.values())
    options = re.findall(r"^#(\w+)_ROUTER_OPTIONS=(.*)$", (REPOSITORY / ".env.example").read_text(), flags=re.MULTILINE)
    assert {name for name, text in options if "--listen tcp/router:7447" in text} == {"SHORE", "VESSEL"}


def settings():
    """Yield service, table, key and value of each variable of the services' environments."""
    for service, block in BLOCKS.items():
        for name, value in (block.get("environment") or {}).items():
            if found := re.fullmatch(r"SONARPOST_([A-Z0-9_]+?)__(\w+)", name):
                yield service, found[1].lower(), found[2].lower(), str(value)


def test_every_variable_is_in_the_example_with_its_default():
    example = (REPOSITORY / ".env.example").read_text()
    known = dict(re.findall(r"^#?([A-Z_]+)=(.*?)(?:[ ]+#.*)?$", example, flags=re.MULTILINE))
    used = variables(TEXT) | variables((REPOSITORY / "docker-compose.modem.yml").read_text())
    assert set(known) - set(used) == {"COMPOSE_FILE"}
    assert set(used) <= set(known)
    # Other values are examples, marked in the comment.
    same = {name for name, default in used.items() if known[name].strip() == default}
    assert {"SONARPOST_IMAGE", "ROUTER_IMAGE", "SHORE_PUBLISH", "SERVICE_MEMORY"} <= same
    # A variable that overrides a key is empty by default; the example shows the value of the file in `config`.
    overriding = set()
    for service, table, key, value in settings():
        if (found := re.fullmatch(r"\$\{(\w+):-\}", value)) and table != "router":
            overriding.add(found[1])
            platform, name = BLOCKS[service]["command"]
            tables = load(example_files()[platform], name, configuration_type(name), {})
            default = getattr(tables[table != "platform"], key)
            shown = json.dumps(list(default)) if isinstance(default, tuple) else str(default)
            assert shown == known[found[1]].strip(), found[1]
    assert len(overriding) == 16


def test_only_keys_of_the_containers_networks_are_always_set():
    always = {f"{table}.{key}" for _, table, key, value in settings() if not re.fullmatch(r"\$\{\w+:-\}", value)}
    # A key of this list is not taken from config/*.toml.
    own = "platform.router platform.id uuv_modem.port op_modem.port c2.database"
    assert always == {*own.split(), "console.host", "console.insecure"}


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


def test_edited_configuration_holds_unless_env_overrides_it(tmp_path):
    file = tmp_path / "uuv.toml"
    file.write_text(EDITED)
    shutil.copyfile(COMPOSE, tmp_path / "docker-compose.yml")
    for command in compose_commands():
        for text, expected in (
            ("", ("uuv-7", "debug", "vq", 300, 3)),
            ("CODEC=emb\nBUDGET_BYTES=\nUUV_ID=uuv-9\nMAX_CONTACTS=5\n", ("uuv-9", "debug", "emb", 300, 5)),
        ):
            (tmp_path / ".env").write_text(text)
            services = compose_config(command, tmp_path, "--profile", "uuv")["services"]
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


def test_the_dockerfile_and_the_compose_file_name_the_same_base():
    [base] = re.findall(r"^ARG BASE=(\S+)$", (REPOSITORY / "Dockerfile").read_text(), flags=re.MULTILINE)
    assert variables(TEXT)["SONARPOST_BASE"] == base
    assert not base.endswith((":latest", "debian"))
    assert re.search(r":\d+\.\d+\.\d+$", variables(TEXT)["ROUTER_IMAGE"])


def compose_config(command, folder, *options):
    """Return the configuration that Compose reads from files in a folder, and that it gives no warning about."""
    environment = {"PATH": os.environ["PATH"], "HOME": str(folder)}
    done = subprocess.run(
        [*command, *options, "config"], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "level=warning" not in done.stderr
    return yaml.safe_load(done.stdout)


@pytest.mark.parametrize("files", [["docker-compose.yml"], ["docker-compose.yml", "docker-compose.modem.yml"]])
def test_compose_accepts_the_files(files, tmp_path):
    for name in files:
        shutil.copyfile(REPOSITORY / name, tmp_path / name)
    options = [option for file in files for option in ("-f", file)]
    options += [option for profile in (*PLATFORMS, "shore-ha") for option in ("--profile", profile)]
    for command in compose_commands():
        services = compose_config(command, tmp_path, *options)["services"]
        routers = {"router-uuv", "router-vessel", "router-shore"}
        assert set(services) >= {*service_packages(), *routers, "pki", "database", "c2-second"}
