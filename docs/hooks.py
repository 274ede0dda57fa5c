"""Pages at the top of the repository are shown in the site as they are; their links are written for the repository."""

import re
from typing import Any

REPOSITORY = {"ARCHITECTURE.md": "architecture.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs before snippets are inserted: inserts them here, with their links changed to those of the site."""
    return re.sub(r'^--8<-- "(\w+\.md)"$', _page, markdown, flags=re.MULTILINE)


def _page(match: re.Match[str]) -> str:
    with open(match[1], encoding="utf-8") as file:
        text = file.read().replace("](docs/", "](")
    for name, page in REPOSITORY.items():
        text = text.replace(f"]({name}", f"]({page}")
    return text
