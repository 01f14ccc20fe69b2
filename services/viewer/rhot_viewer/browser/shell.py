"""What the page is beside viser's own: its title, a panel for phones, and whether the browser wants light or dark.

viser serves one HTML file, named after itself, with a panel that covers half of a phone's screen from the right. Its
theme is the server's choice. The few lines put in front of its script here give the page its name, make the panel a
sheet along the lower edge of narrow screens, and tell by a cookie which colours the browser's owner prefers; the
WebSocket that follows brings the cookie along (`wants_light`).
"""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from functools import lru_cache
from http.cookies import CookieError, SimpleCookie
from typing import Final

from websockets.http11 import Response

_COOKIE: Final = "rhot_scheme"
_TITLE: Final = (b"<title>Viser</title>", b"<title>RHOT</title>")
_HEAD: Final = """<style>
@media (max-width: 36em) {
  /* viser's panel for narrow screens: fixed to the lower right corner, 20em wide. */
  .mantine-Paper-root[style*="position: fixed"][style*="bottom: 0px"] {
    left: 0; width: 100% !important; max-height: 50% !important; border-radius: 0.9em 0.9em 0 0;
    box-shadow: 0 0 1em rgba(0, 0, 0, 0.4);
  }
  .mantine-Paper-root[style*="position: fixed"] div[style*="width: 20em"] { width: 100% !important; }
}
</style>
<script>
{
  const light = matchMedia("(prefers-color-scheme: light)");
  const tell = () => {
    document.cookie = `COOKIE=${light.matches ? "light" : "dark"}; path=/; SameSite=Strict`;
  };
  tell();
  light.addEventListener("change", () => { tell(); location.reload(); });
}
</script>
</head>""".replace("COOKIE", _COOKIE).encode()


def dress(response: Response) -> None:
    """Put what is ours into viser's HTML file, in place; other files stay as they are."""
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    dressed = _dressed(bytes(response.body or b""), response.headers.get("Content-Encoding", "") == "gzip")
    if dressed is None:
        return
    response.body = dressed
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@lru_cache(maxsize=2)
def _dressed(body: bytes, packed: bool) -> bytes | None:
    text = gzip.decompress(body) if packed else body
    if _TITLE[0] not in text:
        return None  # a page of our own, with a policy that allows no inline script
    text = text.replace(*_TITLE, 1).replace(b"</head>", _HEAD, 1)
    return gzip.compress(text, 6) if packed else text


def wants_light(cookies: Sequence[str]) -> bool:
    """Return whether a browser with these `Cookie` headers prefers light colours."""
    for text in cookies:
        try:
            cookie = SimpleCookie(text).get(_COOKIE)
        except CookieError:
            continue
        if cookie is not None:
            return cookie.value == "light"
    return False
