"""Surfaces of the product on which an outside source acts, enumerated from its code.

Names: `zenoh:KEY` for each record that a service receives; `queryable:MODULE`, `subscriber:MODULE`, `port:MODULE` and
`exchange:MODULE` for each module that declares one, listens or connects; `route:METHOD PATH` for each route of the
console; `folder:TABLE.FIELD` for each path of the configuration.
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

from pydantic import BaseModel
from starlette.routing import Mount, Route

from builders.common import REPOSITORY
from sonarpost.config import SERVICES
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.database import Database
from sonarpost.services.console.store.users import Users
from sonarpost.services.console.web.server import ConsoleApp

sys.path.insert(0, str(REPOSITORY / "packaging" / "docs"))
import reference  # type: ignore[import-not-found]  # packaging/docs is no package

LISTENING = {"bind", "listen", "create_server", "start_server"}
OUTSIDE = ("watchers", "the configured consumers")
"""Receivers that are no service of the product."""
SIMULATED = "extensions.simulation"
"""Package for tests and demonstrations, which listens on the local host only."""


def surfaces() -> set[str]:
    """Return the names of all surfaces."""
    found = {f"zenoh:{row.key}" for row in reference.key_rows() if row.to not in ("", *OUTSIDE)}
    found |= {f"route:{method} {path}" for method, path in console_routes()}
    for name in ("platform", "modem", *SERVICES):
        found |= {f"folder:{name}.{field}" for field in _paths(reference.configuration_type(name))}
    for path, package in ((REPOSITORY / "common/sonarpost", ""), (REPOSITORY / "services", "services.")):
        for file in sorted(path.rglob("*.py")):
            if file.is_symlink() or "services" in file.relative_to(path).parts[:1]:
                continue
            module = package + ".".join(file.relative_to(path).with_suffix("").parts)
            if not module.startswith(SIMULATED):
                found |= {f"{kind}:{module}" for kind in _kinds(ast.parse(file.read_text(encoding="utf-8")))}
    return found


def console_routes() -> list[tuple[str, str]]:
    """Return (method, path) of all routes of the console."""
    with TemporaryDirectory() as folder:
        users, database = Users(Path(folder) / "users.db"), Database(Path(folder) / "review.db")
        app: Any = ConsoleApp(ConsoleState(ConsoleConfig(), database), users, "vessel-1").asgi._app
        users.close()
        database.close()
    found = []
    for route in app.routes:
        methods = (route.methods or {"GET"}) - {"HEAD"} if isinstance(route, Route) else {"GET"}
        assert isinstance(route, (Route, Mount))
        found += [(method, route.path) for method in sorted(methods)]
    return sorted(found)


def _kinds(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if node.func.attr in ("declare_queryable", "declare_subscriber"):
                yield node.func.attr.removeprefix("declare_")
            elif node.func.attr in LISTENING:
                yield "port"
            elif node.func.attr == "create_connection" or ast.unparse(node.func) == "http_client.post":
                yield "exchange"
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "").endswith("Server"):
            yield "port"
        elif isinstance(node, ast.ClassDef):
            bases = [base.attr if isinstance(base, ast.Attribute) else getattr(base, "id", "") for base in node.bases]
            if any(base.endswith("Server") for base in bases):
                yield "port"


def _paths(model: type[BaseModel]) -> Iterator[str]:
    """Yield the names of the fields that are paths, of nested tables too."""
    for name, field in model.model_fields.items():
        kinds = list(_leaves(field.annotation))
        if Path in kinds:
            yield name
        for kind in kinds:
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from (f"{name}.{inner}" for inner in _paths(kind))


def _leaves(annotation: Any) -> Iterator[Any]:
    arguments = get_args(annotation)
    if not arguments:
        yield annotation
    for argument in arguments:
        yield from _leaves(argument)
