"""What is put into viser's page: a name, a sheet for phones, and the browser's colours."""

from __future__ import annotations

import gzip

import pytest
from websockets.datastructures import Headers
from websockets.http11 import Response

from rhot_viewer.browser.guard import dress, wants_light
from rhot_viewer.browser.rig_scene import Shown

VISER = b"<html><head><title>Viser</title></head><body></body></html>"


@pytest.mark.parametrize("packed", [False, True])
def test_visers_page_gets_our_name_and_a_sheet_for_phones(packed: bool) -> None:
    body = gzip.compress(VISER) if packed else VISER
    headers = Headers({"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(body))})
    if packed:
        headers["Content-Encoding"] = "gzip"
    response = Response(200, "OK", headers, body)
    dress(response)
    assert response.headers["Content-Length"] == str(len(response.body))
    text = (gzip.decompress(response.body) if packed else bytes(response.body)).decode()
    assert "<title>RHOT</title>" in text
    assert "@media (max-width: 36em)" in text
    assert "prefers-color-scheme" in text


@pytest.mark.parametrize(
    ("kind", "body"), [("text/html", b"<html><head><title>Grasp</title></head></html>"), ("text/javascript", VISER)]
)
def test_pages_of_our_own_and_scripts_stay_as_they_are(kind: str, body: bytes) -> None:
    response = Response(200, "OK", Headers({"Content-Type": kind, "Content-Length": str(len(body))}), body)
    dress(response)
    assert response.body == body


@pytest.mark.parametrize(
    ("cookies", "light"),
    [
        ([], False),
        (["rhot_scheme=light"], True),
        (["a=b; rhot_scheme=light"], True),
        (["rhot_scheme=dark"], False),
        (["=;=;\x00"], False),
    ],
)
def test_colours_are_those_that_the_browser_prefers(cookies: list[str], light: bool) -> None:
    assert wants_light(cookies) is light


def test_the_ghost_of_the_truth_is_off_until_it_is_asked_for() -> None:
    assert not Shown().ghost
