"""Pages of the documentation's site that lie outside `docs`: the README as its first page, and linked source files.

A hook of MkDocs (`mkdocs.yml`): links stay as they are for who reads the files in the repository.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]


def on_files(files: Files, config: Any) -> Files:
    """Add the README, the other pages of the root and the linked source files."""
    for name in ("README.md", "CONTRIBUTING.md"):
        text = re.sub(r"(\]\()docs/", r"\1", (ROOT / name).read_text(encoding="utf-8"))
        files.append(File.generated(config, "index.md" if name == "README.md" else name, content=text))
    files.append(File.generated(config, "LICENSE.txt", content=(ROOT / "LICENSE").read_text(encoding="utf-8")))
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md"))
    for link in sorted(set(re.findall(r"\]\(((?:\.\./)+[a-z_]+/[A-Za-z_/]+\.md)\)", pages))):
        name = link.replace("../", "")
        files.append(File.generated(config, name, content=(ROOT / name).read_text(encoding="utf-8")))
    for link in sorted(set(re.findall(r"\]\(([a-z_/.]+\.py)\)", pages))):
        path = (ROOT / "docs" / link).resolve().relative_to(ROOT)
        name = link.removeprefix("../")
        files.append(File.generated(config, f"{name}.txt", content=(ROOT / path).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links that leave `docs` lead to the pages added above."""
    up = "../" * page.file.src_uri.count("/")
    markdown = re.sub(r"\]\((?:\.\./)+README\.md", f"]({up}index.md", markdown)
    markdown = re.sub(r"\]\((?:\.\./)+([a-z_]+/[A-Za-z_/]+\.md)\)", rf"]({up}\1)", markdown)
    markdown = re.sub(r"\]\((?:\.\./)*LICENSE\)", f"]({up}LICENSE.txt)", markdown)
    return re.sub(r"\]\((?:\.\./)*([a-z_/]+\.py)\)", rf"]({up}\1.txt)", markdown)
