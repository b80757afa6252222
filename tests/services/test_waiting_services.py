"""Every service reports its health before it has reached a router."""

import importlib
import inspect

import pytest

from sonarpost.cli.deployment.config_files import example_files
from sonarpost.config import ServiceConfig, load, service_packages
from sonarpost.runtime.service import Service


def class_of(service, module_name, base):
    module = importlib.import_module(f"{service_packages()[service]}.{module_name}")
    classes = [c for _, c in inspect.getmembers(module, inspect.isclass) if c.__module__ == module.__name__]
    [found] = [c for c in classes if issubclass(c, base) and c.__name__.endswith(("Config", "Service"))]
    return found


@pytest.mark.parametrize("name", service_packages())
def test_health_has_the_reason_for_which_the_router_is_not_reached(name, tmp_path, capsys):
    text = next(t for path in example_files().values() if f"[{name}]" in (t := path.read_text()))
    text = text.replace("/var/lib/sonarpost", str(tmp_path)).replace('"key"', '"none"').replace("acoustic_key", "# ")
    path = tmp_path / "platform.toml"
    path.write_text(text)
    service = class_of(name, "service", Service)(*load(path, name, class_of(name, "config", ServiceConfig), {}))
    try:
        service._report_waiting("no connection")
        health = service.health("degraded")
    finally:
        service.stop()
    assert health.state == "degraded"
    assert "router not reached: no connection" in health.detail
