"""The fixture of a service that is made with its defaults and not started."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import reference

from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.runtime.service import Service


@pytest.fixture
def service(name: str, platform: Callable[[str], PlatformConfig], tmp_path: Path) -> Iterator[Service[ServiceConfig]]:
    """A service, made and not started."""
    model = reference.configuration_type(name)
    required = {"port": str(tmp_path / "port"), "site": "x"}
    fields = model.model_fields
    config = model(**{k: v for k, v in required.items() if k in fields and fields[k].annotation is not int})
    module = importlib.import_module(f"sonarpost.services.{name}.service")
    made: Service[ServiceConfig] = getattr(module, model.__name__.removesuffix("Config") + "Service")(
        platform("x"), config
    )
    yield made
    made.stop()
