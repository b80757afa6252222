"""Every Python and shell block of the documentation runs, or a comment before it says why it does not.

All blocks of a page run in order in one empty folder, Python blocks in one namespace. A block with a title is written
to a file of that name instead. The line before a block may hold a mark:

- `<!-- example: stop -->`: the command runs until Ctrl-C; the test interrupts it after its first line of output.
- `<!-- example: run by PATH -->`: another test runs it.
- `<!-- example: not run, REASON -->`: it cannot run here.

A page with the mark `<!-- extension: NAME -->` is read only if there is this extension.
"""

import importlib.util
import os
import re
import shlex
import signal
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

import pytest
from builders.common import REPOSITORY

from sonarpost.cli.main import parser

EXTENSIONS = REPOSITORY / "common/sonarpost/extensions"


def describes_what_exists(path):
    extension = re.search(r"^<!-- extension: (\w+) -->$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return extension is None or (EXTENSIONS / extension[1]).is_dir()


PAGES = sorted(
    path.relative_to(REPOSITORY).as_posix()
    for pattern in (
        "*.md",
        "docs/**/*.md",
        "services/*/README.md",
        "common/sonarpost/extensions/**/README.md",
        "examples/README.md",
        "research/**/README.md",
    )
    for path in REPOSITORY.glob(pattern)
    if path.name != "CHANGELOG.md" and describes_what_exists(path)
)
LANGUAGES = {"sh", "python", "text", "toml", "json", "json5", "yaml", "ini", "hex", "sql"}
BLOCK = re.compile(
    r"(?:^<!-- example: (?P<mark>[^>]*) -->\n)?"
    r"^ *```(?P<language>\w*)(?: title=\"(?P<title>[^\"]*)\")?\n(?P<text>.*?)^ *```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """One fenced block: its language, the file that it is written to, its mark and its text."""

    language: str
    title: str | None
    mark: str
    text: str

    @property
    def runs(self):
        """Whether the block is executed by this test."""
        return self.language in ("sh", "python") and not self.title and self.mark in ("", "stop")


def blocks(page):
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    return [Block(m["language"], m["title"], m["mark"] or "", textwrap.dedent(m["text"])) for m in BLOCK.finditer(text)]


def test_blocks_have_a_language_and_valid_marks():
    for page in PAGES:
        text = (REPOSITORY / page).read_text(encoding="utf-8")
        assert len(re.findall(r"^ *```", text, re.MULTILINE)) == 2 * len(blocks(page)), page
        assert text.count("<!-- example: ") == sum(bool(block.mark) for block in blocks(page)), page
        indented = re.findall(r"^ {4,}(?:sonarpost|python|make|docker|pip) .*$", text, re.MULTILINE)
        assert not indented, f"{page}: use a ```sh block"
        for block in blocks(page):
            assert block.language in LANGUAGES, (page, block.text)
            if block.mark.startswith("run by "):
                assert (REPOSITORY / block.mark.removeprefix("run by ")).exists(), page
            else:
                assert re.fullmatch(r"|stop|not run, .{10,}", block.mark), (page, block.mark)


def commands(text):
    """Yield every `sonarpost` and `research` command of a shell text with its arguments."""
    for line in text.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;<>()")
        lexer.whitespace_split = True
        words = []
        for word in [*lexer, ";"]:
            if not set(word) <= set("|&;<>()"):
                words.append(word)
                continue
            if word.startswith(">") and words and words[-1] in ("1", "2"):
                words.pop()
            for number, name in enumerate(words):
                is_user = words[number - 1] in ("-o", "-g", "-u")
                is_command = name in ("sonarpost", "/opt/sonarpost/bin/sonarpost") and not is_user
                if is_command or name.startswith("research."):
                    yield words[number:]
                    break
            words = []


def usage_error(arguments, capsys):
    """Return the error of the `sonarpost` command for its arguments; empty if only required ones are missing."""
    try:
        parser(arguments[0] if arguments else "").parse_args(arguments)
    except SystemExit as end:
        error = capsys.readouterr().err
        return "" if end.code == 0 or "arguments are required" in error else error
    return ""


def test_commands_have_valid_arguments(capsys):
    names = "|".join(parser().actions)
    span = re.compile(rf"`(sonarpost (?:{names})\b[^`\[…|{{]*|python -m research\.[^`\[…|{{]*)`")
    for page in PAGES:
        text = (REPOSITORY / page).read_text(encoding="utf-8")
        shells = [block.text for block in blocks(page) if block.language == "sh"]
        spans = [" ".join(found.split()) for found in span.findall(BLOCK.sub("", text))]
        for words in commands("\n".join([*shells, *spans])):
            if words[0].startswith("research."):
                assert importlib.util.find_spec(words[0]) is not None, (page, words[0])
            else:
                assert usage_error(words[1:], capsys) == "", (page, shlex.join(words))


@pytest.mark.parametrize("page", [p for p in PAGES if any(block.runs for block in blocks(p))])
def test_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    namespace = {"__name__": "example"}
    modules = set(sys.modules)
    try:
        for block in blocks(page):
            if block.title and not block.mark:
                Path(block.title).parent.mkdir(parents=True, exist_ok=True)
                Path(block.title).write_text(block.text, encoding="utf-8")
            elif block.runs and block.language == "python":
                exec(compile(block.text, page, "exec"), namespace)
            elif block.runs:
                run_shell(block)
    finally:
        for name in set(sys.modules) - modules:
            if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
                del sys.modules[name]


def run_shell(block):
    process = subprocess.Popen(
        ["bash", "-euo", "pipefail", "-c", block.text],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    with process:
        try:
            output = process.stdout.readline() if block.mark == "stop" else ""
            if block.mark == "stop":
                os.killpg(process.pid, signal.SIGINT)
            output += process.communicate()[0]
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode in ((0, 130, -signal.SIGINT) if block.mark == "stop" else (0,)), f"{block.text}\n{output}"
