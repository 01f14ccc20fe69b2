"""Who may open the page: told by what a browser sends."""

from __future__ import annotations

import pytest

from rhot_viewer.browser.access import Access, PageRequest, Refusal, tokens_in

TOKEN = "0123456789abcdef0123"
LAN = Access(TOKEN, frozenset({"desk", "desk.local"}))
HERE = Access()


def request(
    peer: str = "127.0.0.1",
    host: str = "localhost:8080",
    origin: str | None = None,
    *,
    is_websocket: bool = True,
    tokens: tuple[str, ...] = (),
) -> PageRequest:
    return PageRequest(peer, host, f"http://{host}" if origin is None else origin, is_websocket, tokens)


@pytest.mark.parametrize("host", ["localhost:8080", "127.0.0.1:8080", "[::1]:8080", "localhost", "LOCALHOST:8080"])
def test_who_sits_at_the_machine_may_do_everything(host: str) -> None:
    assert HERE.judge(request(host=host)) == "control"
    assert HERE.judge(request("::ffff:127.0.0.1", host)) == "control"
    assert LAN.judge(request(host=host)) == "control"


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "https://localhost:8080.evil.example",
        "http://localhost",
        "http://localhost:9090",
        "http://127.0.0.1:8080",
        "null",
        "",
        "file://",
        "http://localhost:8080/path",
        "http://x@localhost:8080",
        "http://[",
    ],
)
def test_other_websites_may_not_talk_to_it(origin: str) -> None:
    assert isinstance(HERE.judge(request(origin=origin)), Refusal)
    assert HERE.judge(request(origin=origin, is_websocket=False)) == "control", "a file holds no secret"


@pytest.mark.parametrize("host", ["evil.example:8080", "localhost.evil.example", "", "x@localhost", "[", "a b", "a/b"])
def test_a_foreign_name_for_this_machine_is_refused(host: str) -> None:
    for access in (HERE, LAN):
        assert isinstance(access.judge(request(host=host)), Refusal)
        assert isinstance(access.judge(request(host=host, tokens=(TOKEN,))), Refusal)


def test_other_machines_need_a_token() -> None:
    def from_tablet(*tokens: str, host: str = "192.168.1.10:8080") -> object:
        return LAN.judge(request("192.168.1.77", host, tokens=tokens))

    assert isinstance(from_tablet(), Refusal)
    assert isinstance(from_tablet("", "wrong", TOKEN[:-1]), Refusal)
    assert from_tablet("", TOKEN) == "control"
    assert from_tablet(TOKEN, host="desk.local:8080") == "control"
    assert from_tablet(LAN.view_token) == "view"
    assert isinstance(HERE.judge(request("192.168.1.77", "192.168.1.10", tokens=("",))), Refusal)
    # A proxy on this machine comes from the loopback address, too, but under its own name.
    assert isinstance(LAN.judge(request(host="desk.local:8080")), Refusal)


def test_looking_only_holds_for_all() -> None:
    access = Access(TOKEN, view_only=True)
    assert access.judge(request()) == "view"
    assert access.judge(request("192.168.1.77", "192.168.1.10", tokens=(TOKEN,))) == "view"


def test_the_looking_token_does_not_give_the_other_away() -> None:
    assert LAN.view_token != Access(TOKEN + "x").view_token
    assert TOKEN not in LAN.view_token
    assert HERE.view_token == ""
    assert not HERE.knows("")


def test_tokens_come_in_links_and_cookies() -> None:
    found = tokens_in("/?a=1&token=x%20y", ["b=c; rhot_page_1=z", "rhot_page_1=w"], "rhot_page_1")
    assert found == ("x y", "z", "w")
    assert tokens_in("/", [], "rhot_page_1") == ("",)
