"""A sentence of ours, or of a service, as HTML."""

from __future__ import annotations

import re
from html import escape


def sentence_html(text: str) -> str:
    """Return a text as HTML that shows it as it is, with what stands in backticks as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))
