"""The fixture of a service that is made with its defaults and not started."""

import importlib

import pytest
import reference


@pytest.fixture
def service(name, platform, tmp_path):
    """A service, made and not started."""
    model = reference.configuration_type(name)
    required = {"port": str(tmp_path / "port"), "site": "x"}
    fields = model.model_fields
    config = model(**{k: v for k, v in required.items() if k in fields and fields[k].annotation is not int})
    module = importlib.import_module(f"sonarpost.services.{name}.service")
    made = getattr(module, model.__name__.removesuffix("Config") + "Service")(platform("x"), config)
    yield made
    made.stop()
