"""The token of the page: made once, kept in a file that only its owner can read, written into links."""

from __future__ import annotations

import re
import secrets
import socket
from pathlib import Path
from typing import Final

from rhot.atomic_file import why_unread
from rhot.errors import ConfigError
from rhot.keys import write_private
from rhot_viewer.browser.access import MIN_TOKEN_LENGTH, TOKEN_PARAMETER, Access

_BYTES: Final = 24
_ADDRESS: Final = re.compile(rf"https?://(?P<host>\S+):\d+/\?{TOKEN_PARAMETER}=")


def new_token() -> str:
    """Return a token that nobody can guess."""
    return secrets.token_urlsafe(_BYTES)


def kept_token(file: Path, port: int, scheme: str = "http") -> str:
    """Return the token that a file keeps; where there is no file, make both.

    The file holds the links for people, one with each token; the token is that of the first. Links to another port, or
    by http where the page is served by https now, are put right.

    Raises:
        ConfigError: the file cannot be read or written, or holds no token.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        token = new_token()
        lines = links(Access(token), socket.gethostname(), port, scheme)
        write_private(file, "".join(f"{line}\n" for line in lines).encode())
        return token
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    token = text.partition(f"?{TOKEN_PARAMETER}=")[2].partition("\n")[0].strip()
    if len(token) < MIN_TOKEN_LENGTH:
        raise ConfigError(f"{file}: holds no link with a token; remove it, and a new one is made")
    corrected = _ADDRESS.sub(rf"{scheme}://\g<host>:{port}/?{TOKEN_PARAMETER}=", text)
    if corrected != text:
        write_private(file, corrected.encode())
    return token


def links(access: Access, host: str, port: int, scheme: str = "http") -> tuple[str, ...]:
    """Return the links for other machines, each with what it lets people do."""
    base = f"{scheme}://{host}:{port}/?{TOKEN_PARAMETER}="
    look = f"to look: {base}{access.view_token}"
    return (look,) if access.view_only else (f"to look and change: {base}{access.token}", look)
