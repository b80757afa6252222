"""The chain in containers, one story: it starts, carries images, is disturbed, stopped, upgraded, filled up.

Each test starts from the state in which the previous one left the chain, as in a deployment.
"""

import json
import os
import re
import subprocess

from builders.common import REPOSITORY
from builders.compose import KILL, LOG_IN, SERVICES, Project, compose_commands, docker, until

REACHES = """
import concurrent.futures, socket
def reach(target):
    try:
        socket.create_connection(target, timeout=3).close()
    except OSError as error:
        return f"no {{target[0]}} {{target[1]}} {{error}}"
    return f"reached {{target[0]}} {{target[1]}}"
with concurrent.futures.ThreadPoolExecutor(64) as pool:
    print(*pool.map(reach, {targets}), sep="\\n")
"""

ROGUE = """
import json, sys, zenoh
try:
    zenoh.open(zenoh.Config.from_json5(json.dumps({{
        "mode": "client", "connect": {{"endpoints": ["{endpoint}"], "timeout_ms": 3000}},
        "scouting": {{"multicast": {{"enabled": False}}}},
        "transport": {{"link": {{"tls": {{"root_ca_certificate": "/var/lib/sonarpost/tls/ca.pem"}}}}}},
    }})))
    print("let in")
except zenoh.ZError as error:
    print("refused", error)
"""


def wait_for_surveys(project, number):
    """Wait until so many surveys are dealt with and their contacts are with the compressor; how many contacts."""
    until(lambda: project.surveys_done() >= number, f"{number} surveys dealt with")
    return project.contacts()


def wait_ashore(project, number):
    """Wait until so many complete images are ashore; name to SHA-256."""
    until(lambda: project.images("c2")[1] >= number, f"{number} images ashore")
    images, complete = project.images("c2")
    assert complete == len(images) == number
    return images


def test_every_container_is_healthy_and_a_simulated_survey_arrives(project):
    project.wait_until_healthy()
    assert project.state("pki")["State"]["ExitCode"] == 0
    contacts = wait_for_surveys(project, 1)
    assert contacts >= 4  # as many mine-like objects as the simulator has put there
    ashore = wait_ashore(project, contacts)
    aboard, complete = project.images("decompressor")
    assert aboard == ashore
    assert complete == contacts


def test_commands_of_the_page_show_and_copy_the_images(project, tmp_path):
    page = (REPOSITORY / "docs" / "how-to" / "view-images.md").read_text()
    [commands] = re.findall(r"^```sh\n(docker-compose exec .*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert commands in (REPOSITORY / "docs" / "how-to" / "containers.md").read_text()
    text = commands.replace("docker-compose ", " ".join(compose_commands()[0]) + " ")
    text = text.replace(" exec ", " exec -T ").replace(" ./images", f" {tmp_path}/images")
    names = {"COMPOSE_PROJECT_NAME": project.name, "COMPOSE_FILE": ":".join(project.files)}
    environment = os.environ | project.environment | names
    command = ["bash", "-euc", text]
    done = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    count = len(project.images("c2")[0])
    assert f"{count} images" in done.stdout
    assert "folder /var/lib/sonarpost/images" in done.stderr
    assert len(list(tmp_path.glob("images/vessel-1/*.png"))) >= count


EFFECTIVE = """
import os, pathlib
from sonarpost.config import load
from sonarpost.services.compressor.config import CompressorConfig as Config
platform, table = load(pathlib.Path("/etc/sonarpost/uuv.toml"), "compressor", Config, os.environ)
print(platform.id, platform.log_level, table.codec, table.budget_bytes)
"""


def test_edited_configuration_holds_unless_a_variable_overrides_it(project, tmp_path):
    text = (REPOSITORY / "config" / "uuv.toml").read_text()
    for key, value in (("id", '"uuv-7"'), ("codec", '"vq"'), ("budget_bytes", "300")):
        text, count = re.subn(rf"^{key} = \S+", f"{key} = {value}", text, flags=re.MULTILINE)
        assert count == 1, key
    config = tmp_path / "config"
    config.mkdir(mode=0o755)
    (config / "uuv.toml").write_text(text)
    mount = tmp_path / "edited.yml"
    mount.write_text(f'services: {{ compressor: {{ volumes: ["{config}:/etc/sonarpost:ro"] }} }}\n')
    files = [*project.files, str(mount)]
    run = ["run", "--rm", "--no-deps", "-T", "compressor", "python", "-c"]
    edited = Project(project.name, project.environment, files)
    assert edited.compose(*run, EFFECTIVE).split() == ["uuv-7", "info", "vq", "300"]
    changed = Project(project.name, {**project.environment, "CODEC": "emb", "LOG_LEVEL": "debug"}, files)
    assert changed.compose(*run, EFFECTIVE).split() == ["uuv-7", "debug", "emb", "300"]
    # The running services log what the environment sets: here only what the containers' network needs.
    log = docker("logs", project.container("op_modem"))
    assert "Configuration overridden by environment" in log
    assert "platform.id" not in log


def test_people_see_the_contacts_on_both_consoles_after_logging_in(project):
    contacts = project.contacts()
    password = "not-a-real-password"
    for service, platform in (("console", "vessel"), ("console-shore", "shore")):
        add = ["user", "add", "anna", "--role", "operator", "--config", f"/etc/sonarpost/{platform}.toml"]
        add_user = ["sh", "-c", f"echo {password} | sonarpost console {' '.join(add)} --password-stdin"]
        docker("exec", project.container(service), *add_user)
        said = project.inside(service, LOG_IN.format(password=password))
        assert json.loads(said) == [contacts, 401], service


def test_no_container_has_more_rights_than_it_needs_and_the_image_no_key_and_no_compiler(project):
    for service in SERVICES:
        state = project.state(service)
        host = state["HostConfig"]
        assert host["ReadonlyRootfs"], service
        assert host["CapDrop"] == ["ALL"], service
        assert host["RestartPolicy"]["Name"] == "unless-stopped", service
        assert 0 < host["Memory"] <= 1 << 30, service
        assert state["Config"]["User"] == "10001:10001", service
    script = (
        "find / -xdev \\( -name '*.key' -o -name 'key.pem' -o -name 'gcc*' -o -name 'cc1' -o -name pip \\) "
        "-not -path '/proc/*' -not -path '/usr/share/*' -not -path '/var/lib/dpkg/*' 2>/dev/null; true"
    )
    assert docker("run", "--rm", project.environment["SONARPOST_IMAGE"], "sh", "-c", script) == ""


def test_the_vehicle_reaches_nothing_but_its_modems_line(project):
    others = ("router-vessel", "op_modem", "decompressor", "relay", "router-shore", "c2", "router-sim")
    targets = [(a, p) for s in others for a in project.addresses(s).values() for p in (7447, 7448)]
    # On the emulator's own address in the vessel's network, too.
    targets += [(project.addresses("acoustic_channel")["vessel-line"], 4002)]
    said = project.inside("uuv_modem", REACHES.format(targets=targets))
    assert "reached" not in said
    assert said.count("no ") == len(targets)
    assert "reached water 4001" in project.inside("uuv_modem", REACHES.format(targets=[("water", 4001)]))
    assert "reached" not in project.inside("atd_stub", REACHES.format(targets=[*targets, ("water", 4001)]))


def test_the_shore_lets_in_nobody_without_a_certificate(project):
    shore = project.addresses("router-shore")["link"]
    vessel = project.inside("router-vessel", REACHES.format(targets=[("router-shore", 7447), ("router-shore", 7448)]))
    # In the clear it listens in the shore's own network only.
    assert "no router-shore 7447" in vessel
    assert "reached router-shore 7448" in vessel
    # It even knows the fleet's authority.
    options = ["--network", f"{project.name}_link", "-v", f"{project.name}_vessel-tls:/var/lib/sonarpost/tls:ro"]
    for endpoint in (f"tls/{shore}:7448", f"tcp/{shore}:7448", "tls/router-shore:7448"):
        script = ROGUE.format(endpoint=endpoint)
        rogue = docker("run", "--rm", *options, project.environment["SONARPOST_IMAGE"], "python", "-c", script)
        assert rogue.startswith("refused"), endpoint


def test_killed_services_come_back_and_lose_nothing(project):
    project.survey(2)
    wait_for_surveys(project, 1)
    starts = {}
    for service in ("compressor", "decompressor", "relay", "c2", "router-vessel", "router-shore"):
        starts[service] = project.state(service)["RestartCount"]
        # The engine ends this look inside with the container.
        project.inside(service, KILL, check=False)
    contacts = wait_for_surveys(project, 2)
    ashore = wait_ashore(project, contacts)
    assert project.images("decompressor")[0] == ashore
    for service, count in starts.items():
        assert project.state(service)["RestartCount"] == count + 1, service


def test_a_cut_link_delays_and_loses_nothing(project):
    before = project.images("c2")[1]
    link, vessel = f"{project.name}_link", project.container("router-vessel")
    docker("network", "disconnect", link, vessel)
    try:
        project.survey(3)
        contacts = wait_for_surveys(project, 3)
        assert contacts > before
        until(lambda: project.images("decompressor")[1] == contacts, "all images aboard")
        assert project.images("c2")[1] == before
    finally:
        docker("network", "connect", "--alias", "router-vessel", link, vessel)
    ashore = wait_ashore(project, contacts)
    assert project.images("decompressor")[0] == ashore


def test_down_and_up_again_with_a_newer_image_loses_nothing(project):
    aboard, ashore = project.images("decompressor")[0], project.images("c2")[0]
    project.compose("down", "-t", "5")
    assert project.kept("vessel-images")[0] == aboard
    assert project.kept("shore-images")[0] == ashore
    image = project.environment["SONARPOST_IMAGE"]
    upgrade = f"{image}-next"
    # What a release changes: the image's identity.
    container = docker("create", image).strip()
    docker("commit", "--change", "LABEL release=next", container, upgrade)
    docker("rm", container)
    project.environment |= {"SONARPOST_IMAGE": upgrade, "VESSEL_IMAGES": "small-images"}
    project.compose("up", "-d", "--no-build")
    project.wait_until_healthy()
    assert project.state("c2")["Config"]["Labels"]["release"] == "next"
    assert project.images("c2")[0] == ashore
    # The same surveys are known, and not sent again.
    assert project.surveys_done() == 3


def test_a_full_disk_is_told_and_nothing_is_lost_by_it(project):
    before = project.images("c2")[1]
    ballast = "/var/lib/sonarpost/images/ballast"
    project.inside(
        "decompressor",
        f"import os\nwith open('{ballast}', 'wb', buffering=0) as f:\n"
        "    try:\n        while f.write(bytes(4096)) == 4096: pass\n    except OSError: pass",
    )
    project.survey(4)
    contacts = wait_for_surveys(project, 4)
    assert contacts > before
    until(lambda: project.health("decompressor").startswith("unhealthy: degraded"), "the full disk told")
    assert "No space left" in project.health("decompressor")
    assert project.images("c2")[1] == before
    project.inside("decompressor", f"import os; os.unlink('{ballast}')")
    wait_ashore(project, contacts)
    project.wait_until_healthy(("decompressor",))
