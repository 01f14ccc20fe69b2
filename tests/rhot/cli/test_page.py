"""Which pages are opened beside a rig, and on which ports."""

from __future__ import annotations

import socket

import pytest

from rhot.cli import page
from rhot.cli.page import Pages, free_pages


def test_both_pages_link_to_each_other() -> None:
    commands = Pages(8080, 8081).commands()
    assert list(commands) == ["viewer/main", "viewer/grasp"]
    assert "--xr" not in commands["viewer/main"]
    assert "--xr" in commands["viewer/grasp"]
    assert commands["viewer/main"][-2:] == ["--other-page", "http://localhost:8081"]
    assert commands["viewer/grasp"][-2:] == ["--other-page", "http://localhost:8080"]


def test_without_grasp_there_is_one_page_and_no_link() -> None:
    commands = Pages(8080).commands()
    assert list(commands) == ["viewer/main"]
    assert "--other-page" not in commands["viewer/main"]
    assert Pages().commands() == {}
    assert Pages().lines() == []


def test_grasp_is_opened_where_it_is_built(monkeypatch: pytest.MonkeyPatch, free_port: int) -> None:
    monkeypatch.setattr(page, "_grasp_is_built", lambda: True)
    both = free_pages(free_port)
    assert both.working == free_port
    assert both.grasp not in (None, both.working)
    assert free_pages(free_port, grasp=False).grasp is None
    monkeypatch.setattr(page, "_grasp_is_built", lambda: False)
    assert free_pages(free_port).grasp is None


def test_a_busy_port_is_left_alone(monkeypatch: pytest.MonkeyPatch, free_port: int) -> None:
    monkeypatch.setattr(page, "_grasp_is_built", lambda: True)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", free_port))
        taken.listen()
        assert free_pages(free_port).working not in (None, free_port)
