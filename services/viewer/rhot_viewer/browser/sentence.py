"""A sentence of ours, or of a service, as HTML."""

from __future__ import annotations

import re
from html import escape


def sentence_html(text: str) -> str:
    """Return a text as HTML that shows it as it is: `code` as code, and a *Name* of the page's in italics."""
    named = re.sub(r"(?<!\*)\*([A-Z][^*`\n]{0,60})\*(?!\*)", r"<em>\1</em>", escape(text))
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", named)
