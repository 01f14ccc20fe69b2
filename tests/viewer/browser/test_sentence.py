from __future__ import annotations

from rhot_viewer.browser.sentence import sentence_html


def test_what_stands_in_backticks_is_code_and_nothing_else_is_markup() -> None:
    assert sentence_html("`rhot up` starts <it>") == "<code>rhot up</code> starts &lt;it&gt;"
    assert sentence_html("`<b>` and `") == "<code>&lt;b&gt;</code> and `"
