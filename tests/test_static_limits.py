"""Calls that can wait, allocate or collect without limit occur at reviewed places only; each has its reason here.

Those of an extension are in `reviewed.toml` beside its tests: a table for each variable here, for example `[THREADS]`,
with paths from the folder of the extension.
"""

import ast
import builtins
import re
import tomllib

import pytest
from builders.common import REPOSITORY

SOCKETS = {
    "common/sonarpost/bus/connectivity.py": "probes: three waits of at most 3 s; the signal thread ends the process",
    "common/sonarpost/network/connections.py": "limits of a server's connections",
    "common/sonarpost/network/http_client.py": "one deadline for the whole exchange",
    "common/sonarpost/runtime/modem_port.py": "datagrams; the socket has a time limit",
    "common/sonarpost/stop_signals.py": "signals of this process",
}
THREADS = {
    "common/sonarpost/bus/router.py": "health of the router",
    "common/sonarpost/cli/c2/tasking.py": "timer that sets an event",
    "common/sonarpost/cli/run.py": "copies the output of a process",
    "common/sonarpost/cli/progress.py": "prints progress",
    "common/sonarpost/delivery/inbox.py": "guarded: accepts records",
    "common/sonarpost/delivery/queue_sender.py": "guarded: sends records",
    "common/sonarpost/monitoring/fleet.py": "guarded: queries the fleet",
    "common/sonarpost/network/http_client.py": "passes every exception to the thread that waits",
    "common/sonarpost/runtime/modem_runner.py": "guarded: runs a driver",
    "common/sonarpost/runtime/process.py": "timer that ends the process",
    "common/sonarpost/runtime/serial_port.py": "guarded: reads a port",
    "common/sonarpost/runtime/service.py": "`start_thread`, whose exceptions stop the service; probe of the router",
    "common/sonarpost/stop_signals.py": "reads signals",
    "services/console/web/server.py": "web server",
}
PROCESSES = {
    "common/sonarpost/archive/decode_worker.py": "after SIGKILL",
    "common/sonarpost/cli/deployment/processes.py": "after SIGKILL",
}

OWN_SETTINGS = "a file that the user of this computer names"
SHIPPED = "a file of this package"
READS = {
    "common/sonarpost/archive/codebook_transfer.py": "written by this function, in pieces up to the limit",
    "common/sonarpost/archive/image_files.py": "side-car of the archive",
    "common/sonarpost/archive/address.py": OWN_SETTINGS,
    "common/sonarpost/runtime/serial_device.py": "/proc of the kernel",
    "common/sonarpost/bus/router.py": OWN_SETTINGS,
    "common/sonarpost/cli/deployment/config_files.py": SHIPPED,
    "common/sonarpost/cli/deployment/install_units.py": SHIPPED,
    "common/sonarpost/cli/detection/options.py": OWN_SETTINGS,
    "common/sonarpost/cli/encode.py": "its size is compared with MAX_STREAM_FILE_BYTES first",
    "common/sonarpost/codec/code_cache.py": SHIPPED,
    "common/sonarpost/codec/compiled_library.py": SHIPPED,
    "common/sonarpost/codec/emb/model.py": SHIPPED,
    "common/sonarpost/codec/vq/codebook.py": SHIPPED,
    "common/sonarpost/config.py": OWN_SETTINGS,
    "common/sonarpost/detection/difficulty.py": SHIPPED,
    "common/sonarpost/monitoring/healthcheck.py": "heartbeat of a service on this computer",
    "common/sonarpost/network/http_client.py": "the connection delivers at most MAX_REPLY_BYTES",
    "common/sonarpost/registry.py": SHIPPED,
    "common/sonarpost/security/client_tls.py": OWN_SETTINGS,
    "common/sonarpost/security/fleet.py": OWN_SETTINGS,
    "common/sonarpost/security/tls_files.py": OWN_SETTINGS,
    "common/sonarpost/sonar/options.py": "its size is compared with 64 KiB first",
    "common/sonarpost/cli/console.py": "keyboard",
    "services/console/web/server.py": SHIPPED,
}
QUEUES = {
    "common/sonarpost/bus/catch_up.py": "MAX_BUFFERED; c2 is queried again after an overflow",
    "common/sonarpost/cli/deployment/modem_ping.py": "a command for a modem at this computer; it ends after its pings",
    "common/sonarpost/delivery/queue_sender.py": "queries that have ended, at most WINDOW",
    "common/sonarpost/delivery/scheduler.py": "records of the store, at most `lookahead`",
    "common/sonarpost/modem/micromodem/supervisor.py": "commands of the configuration",
    "common/sonarpost/modem/packet_queue.py": "its `limit`",
    "common/sonarpost/network/connections.py": "MAX_REFUSED",
    "common/sonarpost/sonar/navigation.py": "_COURSE_PINGS",
    "common/sonarpost/sonar/readers/humminbird.py": "three pings",
    "services/console/events.py": "BUFFERED_EVENTS and MAX_BUFFERED_BYTES",
    "services/op_modem/reception.py": "MAX_UNSAVED; the source with the most loses its oldest",
    "services/uuv_modem/service.py": "MAX_EVENTS",
}
ALLOCATIONS = {
    "common/sonarpost/archive/decoder.py: Decoder.decode": "MAX_SIDE_PX of a record",
    "common/sonarpost/archive/image_parts.py": "MAX_STREAM_BYTES: `z` and the ends of the pieces are checked",
    "common/sonarpost/codec/emb/": "MAX_SIDE_PX of a stream header; levels of the shipped models",
    "common/sonarpost/codec/interface.py: DecodedImage.all_missing": "MAX_SIDE_PX of a stream header",
    "common/sonarpost/codec/vq/codec.py: _padded_body": "one index for each tile of MAX_SIDE_PX",
    "common/sonarpost/codec/vq/tile_search.py": "tiles of a codebook in memory, in blocks",
    "common/sonarpost/codec/vq/tiles.py: TileDatabase.nearest_in_basis": "tiles of a codebook in memory",
    "common/sonarpost/detection/classifier.py: _convolution": "chips of the classifier",
    "common/sonarpost/detection/matched_filter.py": "cells of a strip, see STRIP_BYTES and MIN_ROW_M",
    "common/sonarpost/detection/normalisation.py: _best_path": "cells of a strip, see STRIP_BYTES",
    "common/sonarpost/detection/picks.py: _StripPicks._single_sample": "pings of a strip",
    "common/sonarpost/detection/snippets.py": "sides of a snippet, from the settings",
    "common/sonarpost/detection/structures.py: find_water_structures": "a gap of some metres in pings of MIN_ROW_M",
    "common/sonarpost/link/coding/byte_ranges.py": "MAX_PARTIAL_BYTES; pieces end at MAX_STREAM_BYTES",
    "common/sonarpost/link/coding/channel_capacity.py: received_distribution": "frames of a plan",
    "common/sonarpost/link/frames/paper/receiver.py: PendingImage.add_half": "16 bits, MAX_CANDIDATES times",
    "common/sonarpost/messages/image.py: ReconstructedImage.missing": "pixels of the record",
    "common/sonarpost/sonar/geometry.py: _moving_average": "at most half the fixes",
    "common/sonarpost/sonar/readers/jsf.py: JsfSource._channel": "_MAX_LEAD times the samples of the ping",
    "common/sonarpost/sonar/readers/svlog.py: SvlogSource._channel": "_MAX_LEAD times the samples of the ping",
    "common/sonarpost/sonar/readers/xtf_packets.py: _with_delay": "four times the samples of the ping",
    "common/sonarpost/sonar/survey.py: Survey.waterfall": "STRIP_BYTES counts each ping as the longest one",
}


def packages(*names):
    return tuple(f"common/sonarpost/{name}/" for name in names)


CALLERS = ("services/", *packages("archive", "cli", "delivery", "extensions", "monitoring", "runtime"))
MAPPED = "its caller `main` reports it"
RAISES = {
    "common/sonarpost/cli/pki.py: run_acoustic: create_key": MAPPED,
    "common/sonarpost/cli/pki.py: run_router_config: write_new": MAPPED,
    "services/atd_stub/service.py: AtdStubService._process: _content_of": "its caller tries the file again",
    "services/atd_stub/service.py: AtdStubService._process: _identities": "its caller tries the file again",
    "services/atd_stub/service.py: _known_parts: recording_parts": "the listing of the folder reports the recording",
}

for path in (REPOSITORY / "tests" / "extensions").glob("*/reviewed.toml"):
    for table, reviewed in tomllib.loads(path.read_text()).items():
        (folder,) = packages(f"extensions/{path.parent.name}")
        globals()[table].update({folder + place: reason for place, reason in reviewed.items()})

ACCEPTS = ("super().accept", "listener.accept", "self._listener.accept", "server.accept")


def name_of(call):
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def opens_or_reads_a_socket(call):
    name = name_of(call)
    is_accept = name == "accept" and ast.unparse(call.func) in ACCEPTS
    return is_accept or name in ("urlopen", "create_connection", "recv", "recvfrom", "wrap_socket", "SMTP")


def starts_a_thread(call):
    return name_of(call) in ("Thread", "Timer")


def waits_for_a_process(call):
    name = name_of(call)
    if name not in ("communicate", "wait", "run", "check_output") or any(
        word.arg == "timeout" for word in call.keywords
    ):
        return False
    text = ast.unparse(call.func)
    is_wait = text.endswith("process.wait") and not call.args
    return is_wait or name == "communicate" or text in ("subprocess.run", "subprocess.check_output")


def reads_all(call):
    """A read without a limit of its size; `database.read()` begins a transaction."""
    name = name_of(call)
    if name in ("read_bytes", "read_text"):
        return True
    if name not in ("read", "readline", "readlines") or call.args or not isinstance(call.func, ast.Attribute):
        return False
    return not ast.unparse(call.func).endswith(("database.read", "self.read"))


def is_unlimited_queue(call):
    name, limits = name_of(call), {word.arg for word in call.keywords} & {"maxlen", "maxsize"}
    if name == "defaultdict":
        return bool(call.args) and ast.unparse(call.args[0]) == "deque"
    return not limits and (name in ("deque", "SimpleQueue") or (name == "Queue" and not call.args))


def is_known(size):
    """Whether a size consists of constants and sizes of what is in memory."""
    if isinstance(size, ast.Call):
        measures = name_of(size) in ("max", "min", "round") and all(map(is_known, size.args))
        return name_of(size) == "len" or measures
    if isinstance(size, (ast.Name, ast.Attribute)):
        name = size.id if isinstance(size, ast.Name) else size.attr
        return name.lstrip("_").isupper() or name == "size" or (name == "shape" and isinstance(size, ast.Attribute))
    return all(is_known(part) for part in ast.iter_child_nodes(size) if isinstance(part, ast.expr))


def allocates_a_computed_size(call):
    """An array or bytes whose size is not that of something in memory; `bytes(text)` copies."""
    if not call.args or name_of(call) not in ("zeros", "empty", "ones", "full", "bytes", "bytearray"):
        return False
    size, text = call.args[0], ast.unparse(call.func)
    if text in ("np.zeros", "np.empty", "np.ones", "np.full"):
        return not is_known(size)
    is_number = isinstance(size, ast.BinOp) and isinstance(size.op, (ast.Sub, ast.Mult))
    name = ast.unparse(size.func if isinstance(size, ast.Call) else size)
    is_number |= name.endswith(("length", "length_of", "count", "_bytes", "size", "max", "min"))
    return text in ("bytes", "bytearray") and len(call.args) == 1 and is_number and not is_known(size)


PARSERS = (
    *packages("archive", "codec", "detection", "extensions", "link", "messages", "modem", "sonar"),
    *("services/c2/", "services/console/web/", "services/op_modem/"),
)
KINDS = [(opens_or_reads_a_socket, SOCKETS), (starts_a_thread, THREADS), (waits_for_a_process, PROCESSES)]
COLLECTING = [
    (reads_all, READS, ""),
    (is_unlimited_queue, QUEUES, ""),
    (allocates_a_computed_size, ALLOCATIONS, PARSERS),
]


@pytest.fixture(scope="module")
def modules():
    """Syntax tree of each module of the product; the services have a second path, as a symbolic link."""
    paths = [path for folder in ("common/sonarpost", "services") for path in (REPOSITORY / folder).rglob("*.py")]
    names = {str(path.relative_to(REPOSITORY)): path for path in paths}
    return {
        name: ast.parse(path.read_text())
        for name, path in names.items()
        if not name.startswith("common/sonarpost/services/")
    }


@pytest.fixture(scope="module")
def nodes(modules):
    """Calls and imports of each module."""
    return {
        name: [node for node in ast.walk(tree) if isinstance(node, (ast.Call, ast.Import))]
        for name, tree in modules.items()
    }


@pytest.fixture(scope="module")
def calls(modules):
    """Each call with its module, class and function."""
    return [found for name, tree in modules.items() for found in calls_of(tree, name)]


def calls_of(node, path):
    """Yield each call with the path of its module, class and function."""
    for child in ast.iter_child_nodes(node):
        inner = path
        if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
            inner = path + (".", ": ")[": " not in path] + child.name
        if isinstance(child, ast.Call):
            yield path, child
        yield from calls_of(child, inner)


@pytest.mark.parametrize(("matches", "reviewed", "within"), COLLECTING)
def test_unlimited_reads_queues_and_allocations_are_reviewed(matches, reviewed, within, calls):
    found = {place: call.lineno for place, call in calls if place.startswith(within) and matches(call)}
    new = [f"{place} (line {line})" for place, line in found.items() if not place.startswith(tuple(reviewed))]
    assert not new, f"{matches.__name__}: give it a limit, and a reason in this file: {new}"
    unused = [prefix for prefix in reviewed if not any(place.startswith(prefix) for place in found)]
    assert not unused, "a reviewed call is no longer there"


def documented(node):
    """Names of the exceptions in `Raises:` of a docstring."""
    _, _, section = (ast.get_docstring(node) or "").partition("Raises:\n")
    return frozenset(re.findall(r"^    (\w+):", section.split("\n\n")[0], re.MULTILINE))


class Exceptions:
    """What functions raise according to their docstrings, by name: what all functions of one name have in common."""

    def __init__(self, trees):
        self.bases, self.raised, self.tuples = {"ValidationError": ["ValueError"]}, {}, {}
        for node in (node for tree in trees for node in ast.walk(tree)):
            if isinstance(node, ast.ClassDef):
                self.bases[node.name] = [ast.unparse(base).rpartition(".")[2] for base in node.bases]
            elif isinstance(node, ast.FunctionDef):
                self.raised[node.name] = self.raised.get(node.name, documented(node)) & documented(node)
            elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
                self.tuples[ast.unparse(node.targets[0])] = node.value

    def ancestors(self, name):
        own = getattr(builtins, name, None)
        builtin = {kind.__name__ for kind in own.__mro__} if isinstance(own, type) else set()
        return {name, *builtin}.union(*map(self.ancestors, self.bases.get(name, ())))

    def caught(self, node):
        if isinstance(node, ast.Tuple):
            return set().union(*map(self.caught, node.elts))
        text = ast.unparse(node).lstrip("*") if node else "BaseException"
        return self.caught(self.tuples[text]) if text in self.tuples else {text.rpartition(".")[2]}

    def escaping(self, node, path, handled=frozenset(), passed=frozenset()):
        """Yield each call in a `try` of which an exception is neither caught nor documented by the function around."""
        for child in ast.iter_child_nodes(node):
            inner, inner_handled, inner_passed = path, handled, passed
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                inner = path + (".", ": ")[": " not in path] + child.name
                is_constructor = child.name in ("__init__", "__enter__", "__iter__")
                inner_handled, inner_passed = (
                    frozenset(),
                    documented(child) | (passed if is_constructor else frozenset()),
                )
            elif isinstance(child, ast.Try) and child.handlers:
                caught = handled.union(*(self.caught(handler.type) for handler in child.handlers))
                yield from self.escaping(ast.Module(child.body, []), path, caught, passed)
                rest = [*child.handlers, *child.orelse, *child.finalbody]
                yield from self.escaping(ast.Module(rest, []), path, handled, passed)
                continue
            elif isinstance(child, ast.Call) and handled:
                raised = self.raised.get(name_of(child), ())
                if any(not self.ancestors(name) & (handled | passed) for name in raised):
                    yield f"{path}: {name_of(child)}"
            yield from self.escaping(child, inner, inner_handled, inner_passed)


def test_handlers_catch_what_the_called_functions_raise(modules):
    exceptions = Exceptions(modules.values())
    found = {
        place for name, tree in modules.items() if name.startswith(CALLERS) for place in exceptions.escaping(tree, name)
    }
    assert found - set(RAISES) == set(), "catch the exception, document it, or give a reason in this file"
    assert set(RAISES) - found == set(), "a reviewed call is no longer there"


@pytest.mark.parametrize(("matches", "reviewed"), KINDS)
def test_calls_that_can_wait_without_end_are_reviewed(matches, reviewed, nodes):
    found = {
        name: node.lineno
        for name, found_in in nodes.items()
        for node in found_in
        if isinstance(node, ast.Call) and matches(node)
    }
    new = [f"{name}:{line}" for name, line in found.items() if name not in reviewed]
    assert not new, f"{matches.__name__}: give it a limit of time and a reason in this file: {new}"
    assert set(reviewed) == set(found), "a reviewed call is no longer there"


def test_http_is_spoken_by_one_module(nodes):
    clients = {
        name
        for name, found_in in nodes.items()
        for node in found_in
        if isinstance(node, ast.Import) and {alias.name for alias in node.names} & {"http.client", "urllib.request"}
    }
    assert clients == {"common/sonarpost/network/http_client.py"}


def meanings(path, tree):
    """Yield each class and type alias of a module with its meaning; equal aliases of several modules have one."""
    yield from ((node.name, f"{path}:{node.lineno}") for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    for node in tree.body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value:
            yield ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target), ast.unparse(node.value)


def test_public_class_name_has_one_meaning(modules):
    found = {}
    for path, tree in modules.items():
        for name, meaning in meanings(path, tree):
            if re.fullmatch(r"[A-Z]+[a-z]\w*", name):
                found.setdefault(name, set()).add(meaning)
    assert {name: places for name, places in found.items() if len(places) > 1} == {}
