"""The token of the page: made once, kept in a file that only its owner can read, written into links."""

from __future__ import annotations

import os
import secrets
import socket
from pathlib import Path
from typing import Final

from rhot.atomic_file import sync_folder, why, why_unread
from rhot.errors import ConfigError
from rhot_viewer.browser.access import MIN_TOKEN_LENGTH, TOKEN_PARAMETER, Access

_BYTES: Final = 24


def new_token() -> str:
    """Return a token that nobody can guess."""
    return secrets.token_urlsafe(_BYTES)


def kept_token(file: Path, port: int, scheme: str = "http") -> str:
    """Return the token that a file keeps; where there is no file, make both.

    The file holds the links for people, one with each token; the token is that of the first.

    Raises:
        ConfigError: the file cannot be read or written, or holds no token.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        token = new_token()
        _write(file, "".join(f"{line}\n" for line in links(Access(token), socket.gethostname(), port, scheme)))
        return token
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    token = text.partition(f"?{TOKEN_PARAMETER}=")[2].partition("\n")[0].strip()
    if len(token) < MIN_TOKEN_LENGTH:
        raise ConfigError(f"{file}: holds no link with a token; remove it, and a new one is made")
    return token


def links(access: Access, host: str, port: int, scheme: str = "http") -> tuple[str, ...]:
    """Return the links for other machines, each with what it lets people do."""
    base = f"{scheme}://{host}:{port}/?{TOKEN_PARAMETER}="
    look = f"to look: {base}{access.view_token}"
    return (look,) if access.view_only else (f"to look and change: {base}{access.token}", look)


def _write(file: Path, text: str) -> None:
    try:
        handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.write(handle, text.encode())
            os.fsync(handle)
        finally:
            os.close(handle)
        sync_folder(file.parent)
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {why(error)}") from error
