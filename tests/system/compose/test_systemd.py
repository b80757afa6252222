"""The units of `sonarpost install-units` under systemd, in a container with systemd as process 1.

The package comes from the image of the services. Its folder belongs to root, and the user of the services has no home.
"""

import json
import os
import re
import subprocess

import pytest
from builders.chain import snippet
from builders.compose import docker, until

from sonarpost.sonar.image_files import write_png

DOCKERFILE = """
FROM {image}
USER root
RUN apt-get update -q && apt-get install -q -y --no-install-recommends systemd util-linux && apt-get clean
ENTRYPOINT []
# A host with the first version of control groups has none that systemd accepts.
CMD ["sh", "-c", "grep -q ' /sys/fs/cgroup cgroup2 ' /proc/mounts || mount -t cgroup2 none /sys/fs/cgroup; \\
exec /lib/systemd/systemd --show-status=no"]
"""
SETTINGS = ("ActiveState", "StatusText", "NRestarts", "Result", "MainPID", "ExecMainStatus")
EMULATOR = "sonarpost modem-emulator --modems 2 --tcp 4001 4002 --time-scale 20"


class Host:
    """A container with systemd and the package."""

    def __init__(self, container):
        self.container = container

    def run(self, command, *, check=True):
        return docker("exec", "--workdir", "/root", self.container, "sh", "-c", command, check=check)

    def show(self, unit):
        text = self.run(f"systemctl show {unit} --property {','.join(SETTINGS)}")
        return dict(line.split("=", 1) for line in text.splitlines())

    def wait_for(self, unit, **wanted):
        """Wait until properties of a unit match regular expressions; return them."""

        def matches():
            found = self.show(unit)
            return all(re.search(pattern, found[name]) for name, pattern in wanted.items())

        try:
            until(matches, f"{unit}: {wanted}")
        except pytest.fail.Exception:
            print(self.show(unit), self.journal(unit)[-3000:])
            raise
        return self.show(unit)

    def journal(self, unit):
        return self.run(f"journalctl --no-pager --output cat --unit {unit}")

    def install(self, platform, *options):
        """Install the units and run the commands that this prints, as a person would paste them."""
        printed = self.run(f"sonarpost install-units {platform} --user sonar {' '.join(options)}")
        commands = [line.strip() for line in printed.partition("Next, as root:\n")[2].splitlines()]
        assert commands[-2:] == [f"systemctl enable --now sonarpost-{platform}.target", "systemctl status 'sonarpost*'"]
        for command in commands[:-1]:
            self.run(command)


@pytest.fixture(scope="module")
def host():
    project = os.environ.get("SONARPOST_COMPOSE_PROJECT")
    if project is None:
        pytest.skip("starts containers: `make test-compose` runs it")
    image = f"{os.environ['SONARPOST_IMAGE']}-systemd"
    text = DOCKERFILE.format(image=os.environ["SONARPOST_IMAGE"])
    build = ["docker", "build", "--quiet", "--tag", image, "-"]
    done = subprocess.run(build, input=text, text=True, capture_output=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"no image with systemd: {done.stderr[-300:]}")
    label = f"com.docker.compose.project={project}"
    # systemd mounts file systems for its units; it needs no further privileges.
    options = ["--cap-add=SYS_ADMIN", "--security-opt=seccomp=unconfined", "--security-opt=apparmor=unconfined"]
    options += ["--cgroupns", "private", "--tmpfs", "/run", "--tmpfs", "/tmp", "--env", "container=docker"]
    container = docker("run", "--detach", "--label", label, *options, image).strip()
    started = Host(container)
    try:
        state = ""
        for _ in range(60):
            state = started.run("systemctl is-system-running --wait 2>/dev/null", check=False).strip()
            if state in ("running", "degraded"):
                break
            if docker("inspect", "--format", "{{.State.Running}}", container).strip() != "true":
                pytest.skip(f"systemd does not run in a container here: {docker('logs', container)[-300:]}")
        assert state in ("running", "degraded"), state
        yield started
    finally:
        docker("rm", "--force", "--volumes", container)
        docker("rmi", "--force", image)


def test_a_vessel_starts_with_its_target(host):
    host.run("systemd-run --unit=modems sh -c 'PATH=/opt/app/bin:$PATH " + EMULATOR + "'")
    host.run("rm -rf /etc/sonarpost /var/lib/sonarpost && sonarpost pki acoustic --out acoustic.key")
    host.run("sonarpost config example vessel --force --out /etc/sonarpost/vessel.toml")
    host.run("sonarpost config example router-vessel --force --out /etc/sonarpost/router-vessel.json5")
    host.run("sed -i 's|/dev/ttyUSB0|socket://127.0.0.1:4002|' /etc/sonarpost/vessel.toml")
    host.install("vessel")
    for name in ("-router", *(f"@{name}" for name in ("op_modem", "decompressor", "relay", "console"))):
        found = host.wait_for(f"sonarpost{name}", ActiveState="^active$", StatusText="^ok")
        status = host.run(f"cat /proc/{found['MainPID']}/status")
        assert re.search(r"^NoNewPrivs:\t1$", status, re.MULTILINE), name
        assert re.search(r"^CapEff:\t0+$", status, re.MULTILINE), name
        assert re.search(r"^Seccomp:\t2$", status, re.MULTILINE), name
        assert re.search(r"^Uid:\t(?!0\t)", status, re.MULTILINE), name
    assert host.run("stat -c '%U %a' /var/lib/sonarpost /var/lib/sonarpost/state") == "sonar 700\nsonar 700\n"
    assert "Modem ready" in host.journal("sonarpost@op_modem")
    assert host.run("getent passwd sonar").split(":")[5] == "/"
    assert "sonarpost@relay" in host.run("systemctl status 'sonarpost*' --no-pager")


def test_a_stopped_process_is_ended_by_the_watchdog_and_started_again(host):
    folder = "/etc/systemd/system/sonarpost@relay.service.d"
    # Two missed reports of 5 s, instead of a minute. Below three intervals the service itself would extend it.
    host.run(f"mkdir -p {folder} && printf '[Service]\\nWatchdogSec=15\\n' > {folder}/override.conf")
    host.run("systemctl daemon-reload && systemctl restart sonarpost@relay")
    before = host.wait_for("sonarpost@relay", ActiveState="^active$", StatusText="^ok", NRestarts="^0$")
    host.run(f"kill -STOP {before['MainPID']}")
    after = host.wait_for("sonarpost@relay", ActiveState="^active$", StatusText="^ok", NRestarts="^1$")
    assert after["MainPID"] != before["MainPID"]
    journal = host.journal("sonarpost@relay")
    assert "Watchdog timeout" in journal
    assert "most recent call first" in journal  # the stacks


def test_a_configuration_error_is_final(host):
    host.run("cp /etc/sonarpost/vessel.toml /etc/sonarpost/good.toml && echo 'x = 1' >> /etc/sonarpost/vessel.toml")
    host.run("systemctl restart sonarpost@console", check=False)
    failed = host.wait_for("sonarpost@console", ActiveState="^failed$")
    assert (failed["Result"], failed["ExecMainStatus"]) == ("exit-code", "2")
    # A unit that will be started again is not `failed`, but `activating`.
    assert host.show("sonarpost@console")["NRestarts"] == "0"
    assert host.journal("sonarpost@console").count("got 'an unknown key'") == 1
    host.run("mv /etc/sonarpost/good.toml /etc/sonarpost/vessel.toml && systemctl restart sonarpost-vessel.target")
    host.wait_for("sonarpost@console", ActiveState="^active$", StatusText="^ok")


def test_a_crash_is_followed_by_a_restart(host):
    host.run("systemctl kill --signal KILL sonarpost@decompressor")
    host.wait_for("sonarpost@decompressor", ActiveState="^active$", StatusText="^ok", NRestarts="^1$")


def test_stopping_the_target_stops_all_and_the_router_last(host):
    host.run("systemctl disable --now sonarpost-vessel.target")
    for name in ("-router", "@relay", "@op_modem", "@decompressor", "@console"):
        host.wait_for(f"sonarpost{name}", ActiveState="^inactive$")
    ended = host.run("journalctl --no-pager --output json --unit 'sonarpost*'")
    stopped = [json.loads(line) for line in ended.splitlines() if "topped" in line]
    last = max(
        (entry for entry in stopped if str(entry["MESSAGE"]).endswith(("Service stopped", "Router stopped"))),
        key=lambda entry: int(entry["__REALTIME_TIMESTAMP"]),
    )
    assert str(last["MESSAGE"]).endswith("Router stopped")


def test_a_vehicle_encodes_and_transmits_and_has_a_cache_folder(host, tmp_path):
    host.run("rm /etc/systemd/system/sonarpost-vessel.target && systemctl daemon-reload")
    host.run("sonarpost config example uuv --force --out /etc/sonarpost/uuv.toml")
    host.run("sonarpost config example router-uuv --force --out /etc/sonarpost/router-uuv.json5")
    changes = 's|/dev/ttyUSB0|socket://127.0.0.1:4001|; s|mode = "survey"|mode = "snippets"|'
    host.run(f"sed -i '{changes}' /etc/sonarpost/uuv.toml")
    host.install("uuv")
    write_png(tmp_path / "contact.png", snippet(1))
    incoming = "/var/lib/sonarpost/incoming"
    host.run(f"install -d -o sonar -m 700 {incoming}")
    docker("cp", str(tmp_path / "contact.png"), f"{host.container}:{incoming}/.contact.png")
    host.run(f"chown sonar {incoming}/.contact.png && mv {incoming}/.contact.png {incoming}/contact.png")
    until(lambda: "Image encoded" in host.journal("sonarpost@compressor"), "an encoded image")
    until(lambda: "Image sent" in host.journal("sonarpost@uuv_modem"), "an image on the acoustic link")
    # For machine code, which an installation with numba stores there; the image has a library instead.
    assert host.run("stat --format %U /var/cache/sonarpost").strip() == "sonar"
