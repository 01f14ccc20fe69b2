"""What the page says in words."""

from __future__ import annotations

from stub_rig import StubRig

from rhot.messages import FootPose, HandPose, ServiceStatus
from rhot_viewer.browser.overview import Problems, feet_html, hands_html, problems_html, services_html


def status(error: str = "", problem: str = "") -> ServiceStatus:
    return ServiceStatus(
        t_ns=1,
        service="ik",
        instance="main",
        state="running",
        last_error=error,
        problem=problem,
        rates={"output": 59.9},
    )


def test_a_problem_stands_there_once_until_its_words_change() -> None:
    problems = Problems()
    for at, error in (("1", "lost"), ("2", "lost"), ("3", ""), ("4", "lost"), ("5", "late")):
        problems.add(at, {"ik/main": status(error)})
    assert [(p.at, p.text) for p in problems.newest] == [("5", "late"), ("4", "lost"), ("1", "lost")]
    problems.add("6", {"ik/main": status("late", "the cameras were bumped")})
    assert problems.newest[0].text == "the cameras were bumped"


def test_names_that_somebody_makes_up_fill_no_memory() -> None:
    problems = Problems()
    for number in range(1000):
        problems.add("1", {f"{number}/main": status("lost"), "ik/main": status("late")})
    assert len(problems._said) <= 256
    assert [p.service for p in problems.newest if p.service == "ik/main"] == [], "said once, long ago"


def test_words_of_others_are_no_markup() -> None:
    problems = Problems()
    problems.add("1", {"<i>": status("<script>alert(1)</script>")})
    html = problems_html(problems.newest) + services_html({"<b>"}, {"<i>": status()}) + hands_html({}, "<u>")
    assert not any(word in html for word in ("<script>", "<i>", "<u>", "<b>b"))
    assert "&lt;script&gt;" in html


def test_feet_are_told_by_what_they_are_seen_with() -> None:
    foot = FootPose(
        t_ns=1,
        side="left",
        frame="rig",
        position=(0.0, 0.0, 0.0),
        orientation=(0.0, 0.0, 0.0, 1.0),
        velocity=(0.0, 0.0, 0.0),
        sigma=0.0042,
        stage="depth",
        state="measured",
    )
    html = feet_html({"right": foot.model_copy(update={"stage": "lost", "state": "predicted"}), "left": foot}, "")
    assert html.index("Left foot") < html.index("by its shape in the depth picture, known to 4 mm")
    assert html.index("depth picture") < html.index("Right foot") < html.index("predicted, not seen")
    assert feet_html({}, "<i>").count("No foot") == 1
    assert "<i>" not in feet_html({}, "<i>")


def test_services_that_have_gone_and_that_have_not_spoken_yet() -> None:
    html = services_html({"new/main"}, {"ik/main": status()})
    assert "gone" in html
    assert "59.9" in html
    assert html.index("gone") < html.index("new/main") < html.rindex("no status")


def test_how_a_hand_is_tracked(stub: StubRig) -> None:
    pose = stub.messages(1.0, 10**18, 0)["rhot/hand/right"]
    assert isinstance(pose, HandPose)
    assert "little predicted, markers fit to 1.1 mm" in hands_html({"right": pose}, "")
    assert "predicted: no marker" in hands_html({"right": pose.model_copy(update={"state": "predicted"})}, "")
    assert "rhot up" in hands_html({}, "start it with rhot up")
