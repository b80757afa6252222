"""MkDocs hooks: pages that are made from code, and pages that are files of the repository outside `docs`."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urljoin

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from mkdocs.utils import get_relative_url

_log = logging.getLogger("mkdocs.hooks.reference")

REPOSITORY = Path(__file__).resolve().parents[2]
SERVICES = tuple(sorted(path.parent.name for path in (REPOSITORY / "services").glob("*/README.md")))

# Files of the repository that are pages of the site, and where.
REPOSITORY_PAGES: Mapping[str, str] = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "ARCHITECTURE.md": "explanation/architecture.md",
    "examples/README.md": "how-to/subscriber.md",
    "research/README.md": "research/index.md",
    "research/training/emb/README.md": "research/training-emb.md",
    **{f"services/{name}/README.md": f"reference/services/{name}.md" for name in SERVICES},
}
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s#]*)(#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not in `docs`."""
    for source, uri in REPOSITORY_PAGES.items():
        if files.get_file_from_path(uri) is None:
            files.append(File.generated(config, uri, content=(REPOSITORY / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to files of the repository into links to pages, or into plain text where the file is no page."""
    uri = page.file.src_uri
    source = next((s for s, u in REPOSITORY_PAGES.items() if u == uri and page.file.generated_by), f"docs/{uri}")
    return _with_site_links(markdown, source, uri)


def _with_site_links(markdown: str, source: str, uri: str) -> str:
    def replace(link: re.Match[str]) -> str:
        image, text, target, fragment = link.groups()
        if not target or re.match(r"[a-z]+:", target):
            return link.group()
        path = urljoin(f"/{source}", target).strip("/")
        if not (REPOSITORY / path).exists() and not path.startswith("docs/"):
            _log.warning("%s: link: got %s, expected a file of the repository", source, target)
        if path in REPOSITORY_PAGES:
            page = REPOSITORY_PAGES[path]
        elif path.startswith("docs/"):
            page = path.removeprefix("docs/")
        else:
            return text if "`" in text else f"{text} (`{path}`)"
        return f"{image}[{text}]({get_relative_url(page, uri)}{fragment or ''})"

    parts = re.split(r"(^```.*?^```$|^    .*?$)", markdown, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if part.startswith(("```", "    ")) else _LINK.sub(replace, part) for part in parts)
