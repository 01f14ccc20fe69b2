"""The page's files, as they were bundled; a sentence in their place where nobody has built them."""

from __future__ import annotations

import http
from collections.abc import Callable
from pathlib import Path
from typing import Final

from websockets import Headers
from websockets.http11 import Request, Response

BUNDLE: Final = Path(__file__).parents[1] / "static"
INDEX: Final = "index.html"
NOT_BUILT: Final = (
    "<!doctype html><meta charset='utf-8'><title>RHOT</title><body style='font:16px/1.6 sans-serif;margin:3em'>"
    "<h1>The page <i>Grasp</i> is not built</h1><p>This is a source checkout, and the page is made by npm once: run "
    "<code>make web</code> (needs <code>node</code> and <code>npm</code>: <code>apt install nodejs npm</code>), then "
    "load this page again.</p><p>Everything else works without it.</p>"
)
_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".glb": "model/gltf-binary",
}
_POLICY: Final = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self' blob:; "
    "base-uri 'none'"
)
"""Nothing comes from elsewhere, and nothing goes there; pictures on an object's surface come out of its own file."""
MESHES: Final = "mesh."
"""Before the name of an object in the address of its surface."""


def is_built() -> bool:
    """Return whether the bundle is there."""
    return (BUNDLE / INDEX).is_file()


def answer(request: Request, meshes: Callable[[str], bytes | None]) -> Response | None:
    """Return a file; None for what is none of the page's.

    Args:
        request: of a browser.
        meshes: the surface of an object, by its name.
    """
    name = request.path.partition("?")[0].lstrip("/") or INDEX
    if name.startswith(MESHES) and name.endswith(".glb"):
        content = meshes(name[len(MESHES) : -len(".glb")])
        return None if content is None else _response(content, ".glb")
    if name == INDEX and not is_built():
        return _response(NOT_BUILT.encode(), ".html")
    # One flat folder: a name with a slash or a leading dot can be none of its files.
    if "/" in name or "\\" in name or name.startswith(".") or Path(name).suffix not in _TYPES:
        return None
    try:
        return _response((BUNDLE / name).read_bytes(), Path(name).suffix)
    except (OSError, ValueError):  # ValueError: no file can be named so
        return None


def _response(body: bytes, suffix: str) -> Response:
    headers = Headers()
    headers["Content-Type"] = _TYPES[suffix]
    headers["Content-Length"] = str(len(body))
    headers["Content-Security-Policy"] = _POLICY
    headers["Permissions-Policy"] = "xr-spatial-tracking=(self)"
    headers["Connection"] = "close"
    return Response(http.HTTPStatus.OK.value, http.HTTPStatus.OK.phrase, headers, body)
