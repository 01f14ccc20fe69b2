"""Moments that are marked in the page."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator

import pytest
from bus_watch import settled
from page.plain_client import client, look, send

from rhot.bus import Bus
from rhot.messages import Event, decode
from rhot.rig import BusConfig
from rhot.service.clock_sync import serve_clock
from rhot_viewer.browser.access import Access
from rhot_viewer.browser.page import Page
from rhot_viewer.panels.session import Marks

TOKEN = "0123456789abcdef0123"


@pytest.fixture
async def page() -> AsyncIterator[Page]:
    opened = Page("127.0.0.1", 0, Access(TOKEN, frozenset({"desk.local"})))
    try:
        yield opened
    finally:
        opened.close()


async def marked(page: Page, router: BusConfig, token: str, count: int) -> tuple[list[Event], Marks]:
    """The events after keys 2, 9 (which has no label), new labels, key 1, a click on the second, oddly spelt one."""
    marks = Marks(page)
    marks.build(page.server.gui)
    host = f"desk.local:{page.port}"
    cookie = f"rhot_page_{page.port}={token}"
    events: list[Event] = []
    async with await Bus.open(router) as fusion, await Bus.open(router) as bus:
        serve_clock(fusion)
        heard = fusion.events("rhot/event")
        await settled(fusion)
        running = asyncio.create_task(marks.run(bus))
        try:
            async with client(page, f"http://{host}", host="desk.local", cookie=cookie) as browser:
                await look(browser)
                async with asyncio.timeout(60.0):
                    await page.looked_at()
                keys = [command._impl.uuid for command in marks._commands]
                await send(browser, "CommandTriggerMessage", uuid=keys[1])
                await send(browser, "CommandTriggerMessage", uuid=keys[8])
                labels = {"value": " rest,, pour \u2028 tea"}
                await send(browser, "GuiUpdateMessage", uuid=marks._text._impl.uuid, updates=labels)
                while count and marks._buttons.options[0] != "rest":
                    await asyncio.sleep(0.01)
                await send(browser, "CommandTriggerMessage", uuid=keys[0])
                click = {"value": marks._buttons.options[1]}
                await send(browser, "GuiUpdateMessage", uuid=marks._buttons._impl.uuid, updates=click)
                async with asyncio.timeout(60.0):
                    while len(events) < count:
                        async for sample in heard:
                            events.append(decode(sample.payload, Event))
                            break
                # Everything sent before this has been seen when the browser is gone.
                await browser.close()
                await page.left()
        finally:
            running.cancel()
    return events, marks


async def test_keys_and_clicks_mark_the_moment(page: Page, router: BusConfig) -> None:
    before_ns = time.time_ns()
    events, marks = await marked(page, router, TOKEN, 3)
    assert [event.label for event in events] == ["grasp", "rest", r"pour \u2028 tea"]
    for event in events:
        assert event.source == "page"
        assert before_ns <= event.t_ns <= time.time_ns()
        assert event.uncertainty_s is not None
        assert 0.15 <= event.uncertainty_s < 1.0
    marks.update()
    assert marks._state.content


async def test_who_only_looks_marks_nothing(page: Page, router: BusConfig) -> None:
    events, marks = await marked(page, router, Access(TOKEN).view_token, 0)
    assert events == []
    assert marks._pressed.empty()
    assert page.guard.refused["message"] == 5


async def test_a_key_that_is_held_does_not_mark_again_and_again(page: Page) -> None:
    marks = Marks(page)
    marks.build(page.server.gui)
    pressed, other = marks._key(1), marks._key(2)
    repeats_ms = [500 + 33 * number for number in range(60)]
    for ms in (0, *repeats_ms, 2700):
        pressed(None, 10**18 + ms * 10**6)
    other(None, 10**18 + 2701 * 10**6)
    times_ms = []
    while not marks._pressed.empty():
        label, at_ns = marks._pressed.get_nowait()
        times_ms.append(((at_ns - 10**18) // 10**6, label))
    assert times_ms == [(0, "grasp"), (500, "grasp"), (2700, "grasp"), (2701, "release")]
