"""MkDocs hooks: adds pages that are files outside `docs`, rewrites their links, links terms and fills in the tables."""

import logging
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urljoin

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from mkdocs.utils import get_relative_url

sys.path.insert(0, str(Path(__file__).parent))
import glossary
import packages  # noqa: F401 `reference` imports it and `rates` later, when MkDocs has restored the path
import rates  # noqa: F401
import reference

from sonarpost.config import service_packages

_log = logging.getLogger("mkdocs.hooks.pages")

REPOSITORY = Path(__file__).resolve().parents[2]

# Files outside `docs` that are pages of the site.
REPOSITORY_PAGES: Mapping[str, str] = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "ARCHITECTURE.md": "explanation/architecture.md",
    "examples/README.md": "how-to/subscriber.md",
    "research/README.md": "research/index.md",
    "research/training/emb/README.md": "research/training-emb.md",
    **{
        f"common/{package.replace('.', '/')}/README.md".replace("common/sonarpost/services", "services"): (
            f"reference/services/{name}.md"
        )
        for name, package in service_packages().items()
    },
}
# Pages whose text consists of names.
WITHOUT_TERMS = frozenset({"changelog.md"})
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s#]*)(#[^)\s]*)?\)")
_CODE = re.compile(r"(^```.*?^```$|^    .*?$)", re.MULTILINE | re.DOTALL)
_GENERATED = re.compile(r"^<!-- generated: (\w+)(?: (\w+))? -->$", re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are files outside `docs`."""
    for source, uri in REPOSITORY_PAGES.items():
        if files.get_file_from_path(uri) is None:
            files.append(File.generated(config, uri, content=(REPOSITORY / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite links to files outside `docs`, link terms, and replace each mark `<!-- generated: NAME ARGUMENT -->`."""
    uri = page.file.src_uri
    source = next((s for s, u in REPOSITORY_PAGES.items() if u == uri and page.file.generated_by), f"docs/{uri}")
    linked = "".join(
        part if index % 2 else _LINK.sub(lambda link: _site_link(link, source, uri), part)
        for index, part in enumerate(_CODE.split(markdown))
    )
    terms = glossary.anchors((REPOSITORY / "docs" / glossary.PAGE).read_text(encoding="utf-8"))
    if uri == glossary.PAGE:
        linked = glossary.with_anchors(linked)
    elif uri not in WITHOUT_TERMS:
        linked = glossary.with_links(linked, terms, get_relative_url(glossary.PAGE, uri))
    return _GENERATED.sub(lambda mark: reference.generate(*mark.groups(default="")), linked)


def _site_link(link: re.Match[str], source: str, uri: str) -> str:
    """Return a link to a page of the site, or plain text for a file that is not one."""
    image, text, target, fragment = link.groups()
    if not target or re.match(r"[a-z]+:", target):
        return link.group()
    path = urljoin(f"/{source}", target).strip("/")
    if path in REPOSITORY_PAGES:
        page = REPOSITORY_PAGES[path]
    elif path.startswith("docs/"):
        page = path.removeprefix("docs/")
    else:
        if not (REPOSITORY / path).exists():
            _log.warning("%s: link: got %s, expected a file of the repository", source, target)
        return text if "`" in text else f"{text} (`{path}`)"
    return f"{image}[{text}]({get_relative_url(page, uri)}{fragment or ''})"
