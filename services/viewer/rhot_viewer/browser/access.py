"""Access control of the page, based on headers that a website cannot forge in a user's browser.

- Any website may open a WebSocket to this machine; the browser states the website in `Origin` (RFC 6455, section 10.2).
  Our pages have the same origin as `Host`; all others are refused.
- A website whose name resolves to this machine ("DNS rebinding") has its own name in `Host`: only addresses, this
  machine's names and names that the operator allows are answered.
- Other machines need a token, first from a link and then from a cookie. One token grants read-only access, another one
  full access.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal
from urllib.parse import parse_qs, urlsplit

from websockets import Headers

Role = Literal["control", "view"]

TOKEN_PARAMETER: Final = "token"
MIN_TOKEN_LENGTH: Final = 16
_LOCAL_NAMES: Final = frozenset({"localhost"})


@dataclass(frozen=True, slots=True)
class PageRequest:
    """A browser's request.

    Attributes:
        peer: address of the browser.
        host: `Host` header; empty if missing or repeated.
        origin: `Origin` header; empty if missing or repeated.
        is_websocket: whether the request opens a WebSocket rather than fetching a file.
        tokens: tokens in the request.
    """

    peer: str
    host: str
    origin: str
    is_websocket: bool
    tokens: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Refusal:
    """A refused request, with the reason and the remedy as one sentence for people."""

    reason: str


@dataclass(frozen=True, slots=True)
class Access:
    """The rules of one page.

    Attributes:
        token: grants full access; if empty, only this machine has access.
        hosts: further host names of the page, lower case.
        view_only: whether access is read-only for everybody, including this machine.
    """

    token: str = ""
    hosts: frozenset[str] = frozenset()
    view_only: bool = False

    @property
    def view_token(self) -> str:
        """Token for read-only access, a one-way function of `token`; empty without a token."""
        return hashlib.sha256(f"view {self.token}".encode()).hexdigest()[:32] if self.token else ""

    def knows(self, token: str) -> bool:
        """Return whether a token is one of the two."""
        return bool(self.token) and (_equal(token, self.token) or _equal(token, self.view_token))

    def judge(self, request: PageRequest) -> Role | Refusal:
        """Return the role of a request, or why it is refused."""
        name = _name_of(request.host)
        if not name or not (_is_address(name) or name in _LOCAL_NAMES or name in self.hosts):
            return Refusal(
                "The page is not served under this name. Open it under its address, or as http://localhost on its own "
                "machine, or start the viewer with --allow-host and this name."
            )
        if request.is_websocket and not _same_origin(request.origin, request.host):
            return Refusal("Only the page itself may talk to its server, not a page from elsewhere.")
        if _is_loopback(request.peer) and (name in _LOCAL_NAMES or _is_loopback(name)):
            return self._capped("control")
        if self.token and any(_equal(token, self.token) for token in request.tokens):
            return self._capped("control")
        if self.token and any(_equal(token, self.view_token) for token in request.tokens):
            return "view"
        return Refusal(
            "This page needs a link with a token, which `rhot viewer` writes into its log, or into the file of "
            "--token-file, when it starts."
        )

    def _capped(self, role: Role) -> Role:
        return "view" if self.view_only else role


def is_websocket(headers: Headers) -> bool:
    """Return whether request headers ask for a WebSocket; any mention of an upgrade counts."""
    return bool(headers.get_all("Upgrade") or headers.get_all("Sec-WebSocket-Key"))


def page_address(host: str, port: int, scheme: str = "http") -> str:
    """Return the URL of a page that listens on `host`, as opened on this machine."""
    shown = "localhost" if host in ("127.0.0.1", "0.0.0.0", "::", "localhost") else host
    return f"{scheme}://{shown}:{port}"


def cannot_listen(host: str, port: int, error: Exception | None = None) -> str:
    """Return the error message for a page that cannot be opened, with the system's error if there is one."""
    said = f" ({getattr(error, 'strerror', None) or error})" if error else ""
    return (
        f"the page cannot be opened on {host} port {port}: another program, perhaps another viewer, has it, or the "
        f"address is not this machine's; choose another with --port or --host{said}"
    )


def own_names() -> frozenset[str]:
    """Return this machine's names in the network."""
    name = socket.gethostname().lower()
    short = name.partition(".")[0]
    return frozenset({name, short, f"{short}.local"} - {""})


def tokens_in(path: str, cookies: Iterable[str], cookie_name: str) -> tuple[str, ...]:
    """Return the tokens of a request.

    Args:
        path: as requested, with its query.
        cookies: the `Cookie` headers.
        cookie_name: of ours.
    """
    pairs = (part.strip().partition("=") for header in cookies for part in header.split(";"))
    return (token_in_link(path), *(value for name, _, value in pairs if name == cookie_name))


def token_in_link(path: str) -> str:
    """Return the token in a requested path; empty without one."""
    try:
        return parse_qs(path.partition("?")[2]).get(TOKEN_PARAMETER, [""])[0]
    except ValueError:
        return ""


def _name_of(host: str) -> str:
    """Return the lower-case name or address in a `Host` header, without port; empty where it is none."""
    try:
        parts = urlsplit(f"//{host}")
        valid = parts.netloc == host and not (parts.username or parts.password)
        return (parts.hostname or "").rstrip(".") if valid else ""
    except ValueError:
        return ""


def _same_origin(origin: str, host: str) -> bool:
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    bare = parts.scheme in ("http", "https") and not (parts.path or parts.query or parts.fragment)
    return bare and parts.netloc.lower() == host.lower()


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_loopback(name: str) -> bool:
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback


def _equal(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(errors="replace"), other.encode())
