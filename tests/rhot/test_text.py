"""What a stranger writes reaches neither a terminal nor a log as anything but text."""

from __future__ import annotations

import io
import json
import logging
import shlex

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from rhot.errors import WireError
from rhot.messages import Control, MarkerFrame, ServiceStatus, decode, first_problem
from rhot.messages.codec import encode
from rhot.text import PrintableFormatter, as_argument, printable, printable_lines

HOSTILE = "\x1b[2J\x1b]0;owned\x07\nroot: all is well\r\u202egnp.exe\x9b31m\U000e0041\ud800"


def harmless(text: str) -> bool:
    return not any(character in "\r\n\t\x1b\x07\x9b\u202e\U000e0041\ud800" for character in text)


def test_ordinary_text_stays_as_it_is() -> None:
    for text in ("", "camera left: no picture for 3 s", "[bus] in rig.toml", "± 2 ms · Gerät 日本 …"):
        assert printable(text) == text


def test_what_acts_on_a_terminal_is_written_out() -> None:
    assert printable("a\x1b[31m\n") == "a\\u001b[31m\\n"
    assert harmless(printable(HOSTILE))
    assert len(printable("x" * 10_000)) == 2000
    assert printable_lines("one\ntwo\x1b") == "one\ntwo\\u001b"


@given(st.text())
def test_no_text_survives_as_a_command_and_json_stays_json(text: str) -> None:
    assert all(character.isprintable() or character.isspace() for character in printable(text))
    assert len(printable(text).splitlines()) <= 1
    line = json.dumps({"key": text}, ensure_ascii=False)
    assert json.loads(printable(line, 10_000)) == {"key": text}


def test_a_log_has_one_line_a_record_whatever_is_logged() -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(PrintableFormatter("%(levelname)s %(message)s"))
    logger = logging.Logger("test")  # noqa: LOG001  # of its own: nothing reaches the root logger
    logger.addHandler(handler)
    logger.warning("invalid sample dropped: %s", HOSTILE)
    assert stream.getvalue().count("\n") == 1
    try:
        raise ValueError("\x1b[2Jboo")
    except ValueError:
        logger.exception("failed")
    assert "\x1b" not in stream.getvalue()
    assert "Traceback" in stream.getvalue()


def test_errors_about_payloads_hold_nothing_of_them_unescaped() -> None:
    assert harmless(str(WireError(f"cannot use {HOSTILE}")))
    markers = {HOSTILE[:20]: {"u": 1.0, "v": 1.0, "area": 1.0, "score": 1.0}}
    with pytest.raises(ValidationError) as caught:
        MarkerFrame.model_validate({"t_ns": 1, "camera": "left", "width": 9, "height": 9, "markers": markers})
    assert harmless(first_problem(caught.value))


def test_texts_in_messages_are_made_harmless_as_they_arrive() -> None:
    status = ServiceStatus(t_ns=1, service="ik", instance="main", state="running")
    hostile = status.model_copy(
        update=dict.fromkeys(("session", "problem", "last_error", "config_digest"), "\x1b[2J\n")
    )
    received = decode(encode(hostile), ServiceStatus)
    for text in (received.session, received.problem, received.last_error, received.config_digest):
        assert text == "\\u001b[2J\\n"
    control = Control(t_ns=1, action="start").model_copy(update={"session": "a\nb"})
    assert decode(encode(control), Control).session == "a\\nb"


@pytest.mark.parametrize("path", ["rig", "/tmp/my rig", "Übung", "it's", "a;rm -rf b", "$HOME"])
def test_a_path_in_a_command_is_one_word_of_it(path: str) -> None:
    assert shlex.split(f"rhot doctor --rig {as_argument(path)}")[-1] == path
    assert as_argument("rigs/left-1") == "rigs/left-1"
