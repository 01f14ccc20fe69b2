"""The program's root: the table of commands and the logging that all share."""

from __future__ import annotations

import logging
from typing import Final

import click

from rhot.cli.group import LazyCommand, LazyGroup, MainGroup
from rhot.text import PrintableFormatter

_COMMANDS: Final = {
    "Try it": {
        "sim": LazyCommand("Run a whole simulated rig on this machine and show how well it tracks.", extra="sim"),
    },
    "Set up": {
        "init": LazyCommand("Make a new rig folder with a commented rig.toml.", "rhot_tools.operate.init:init"),
        "doctor": LazyCommand(
            "Check this machine, a rig folder and the running rig, and say what to do.",
            "rhot_tools.operate.doctor:doctor",
        ),
        "calibrate": LazyCommand("Calibrate a part of the rig.", "rhot.cli.main:calibrate"),
        "openxr": LazyCommand("Give OpenXR programs the hands: install the layer, look at it.", extra="bridge"),
        "keys": LazyCommand("Secure the bus: certificates for machines and people.", "rhot_tools.keys.command:keys"),
    },
    "Run": {
        "up": LazyCommand(
            "Run everything on the PC: router, fusion, ik, objects, feet, web page.", "rhot_tools.operate.up:up", "pc"
        ),
        "start": LazyCommand(
            "Tell every service of the rig to start at the same moment.", "rhot_tools.operate.run:start"
        ),
        "stop": LazyCommand("Tell every service of the rig to stop.", "rhot_tools.operate.run:stop"),
        "status": LazyCommand(
            "Show which services are running, with their rates, losses, latency and errors.",
            "rhot_tools.operate.run:status",
        ),
        "config": LazyCommand(
            "Show or change a running service's configuration.", "rhot_tools.operate.configure:config"
        ),
    },
    "Look": {
        "evaluate": LazyCommand("Measure how well a part of the rig works.", "rhot.cli.main:evaluate"),
        "get": LazyCommand("Print the last value of keys as JSON.", "rhot_tools.operate.inspect:get"),
        "watch": LazyCommand("Print messages as JSON as they arrive.", "rhot_tools.operate.inspect:watch"),
        "report": LazyCommand(
            "Say on one page whether trials can be used, and why.", "rhot_tools.trial.report:report", "pc"
        ),
        "explain": LazyCommand(
            "Explain on one page why a moment of a recording was tracked as it was.",
            "rhot_tools.explain.command:explain",
            "pc",
        ),
    },
    "Record and export": {
        "record": LazyCommand(
            "Record all that a running rig publishes into an MCAP file.",
            "rhot_tools.recordings.record:record",
            "record",
        ),
        "mark": LazyCommand("Mark this moment, such as the start of a trial.", "rhot_tools.recordings.mark:mark"),
        "replay": LazyCommand(
            "Put a recording back on the bus, as if live.", "rhot_tools.recordings.replay:replay", "record"
        ),
        "process": LazyCommand(
            "Track a recording offline and write the result as JSON Lines.",
            "rhot_tools.recordings.process:process",
            "pc",
        ),
        "export": LazyCommand(
            "Turn a recording into tables, animations (glTF, BVH) or files for labs (TRC, MOT, C3D).",
            "rhot_tools.recordings.export:export",
            "record",
        ),
    },
    "Develop": {
        "bench": LazyCommand("Measure speed, and compare with the 2018 thesis's algorithms.", extra="bench"),
    },
    "": {
        "capture": LazyCommand("Service: find the markers in one camera's pictures.", extra="capture"),
        "fusion": LazyCommand("Service: turn the cameras' markers into points in space.", extra="fusion"),
        "ik": LazyCommand("Service: turn points into a hand.", extra="ik"),
        "objects": LazyCommand("Service: track objects and the headset.", extra="objects"),
        "feet": LazyCommand("Service: track feet with a depth camera on the head and ankle sensors.", extra="feet"),
        "viewer": LazyCommand("Service: serve the web page that shows the running rig.", extra="viewer"),
        "bridge": LazyCommand("Service: send what is tracked to other programs: VMC, VRChat, JSON, ….", extra="bridge"),
        "router": LazyCommand("Service: the Zenoh router that others connect to.", "rhot_tools.operate.run:router"),
        "truth": LazyCommand("Service: publish the truth of the simulated world.", extra="sim"),
    },
}
"""By what a person wants. The last are services: `rhot up` and systemd start them."""

_CALIBRATIONS: Final = {
    "cameras": LazyCommand("Calibrate the lenses and positions of all cameras from pictures of a board.", extra="pc"),
    "board": LazyCommand("Draw a calibration board, to print.", extra="pc"),
    "markers": LazyCommand("Draw the markers for the feet, to print.", extra="pc"),
    "colors": LazyCommand("Learn the markers' colours from pictures, or import them.", extra="capture"),
    "depth": LazyCommand("Fit the disparity-to-depth law to measured distances.", extra="fusion"),
    "hand": LazyCommand("Measure a hand: bone lengths and where its markers are.", extra="pc"),
    "objects": LazyCommand("Register the space of a tracking system to the rig.", extra="objects"),
    "stage": LazyCommand("Find the floor, from a board on the desk or a registered tracking system.", extra="pc"),
    "headset": LazyCommand("Find where the feet's camera sits on the headset.", extra="feet"),
}

_EVALUATIONS: Final = {
    "Your own rig": {
        "rig": LazyCommand("Measure your own rig: jitter, latency, depth and grasping, as one report.", extra="pc"),
        "calibration": LazyCommand("Check whether the cameras have moved since they were calibrated.", extra="pc"),
        "paints": LazyCommand("Choose paints that cameras can tell apart.", extra="pc"),
    },
    "The tracker, for developers": {
        "recording": LazyCommand("Record a session at full rate, replay it, and compare.", extra="bench"),
        "tracking": LazyCommand("Track simulated pictures and compare with the truth.", extra="bench"),
        "two-hands": LazyCommand("Track two simulated hands that touch and cross.", extra="bench"),
        "hands": LazyCommand("Predict the inner joints of recorded real hands.", extra="bench"),
        "motion": LazyCommand("Track recorded hand motion before a family of random rigs.", extra="bench"),
        "pictures": LazyCommand("Track photo-real pictures of another rig and hand.", extra="bench"),
        "ablation": LazyCommand("Switch off each term and vary each number of the estimators.", extra="bench"),
        "grasp": LazyCommand("Measure how well a hand takes hold of an object.", extra="bench"),
        "streams": LazyCommand("Fuse recorded marker tracks: measure steps, delay and noise at rest.", extra="bench"),
        "feet": LazyCommand(
            "Track the feet of a simulated person, and compare with the 2021 thesis's tracker.", extra="bench"
        ),
        "headset": LazyCommand("Find the feet's camera on simulated headsets; compare with the truth.", extra="bench"),
        "steps": LazyCommand("Track feet on recordings of real sensors and cameras.", extra="bench"),
        "thesis": LazyCommand("Repeat the 2018 thesis's tables, with our figures beside them.", extra="bench"),
        "page": LazyCommand("Write measured figures as a page of the documentation.", extra="bench"),
    },
}


def _show_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from rhot.cli.version import full_version  # noqa: PLC0415  # it starts git

        click.echo(f"rhot {full_version()}")
        context.exit()


@click.group(cls=MainGroup, lazy=_COMMANDS, plugins="rhot.commands", context_settings={"max_content_width": 110})
@click.option(
    "--version", is_flag=True, expose_value=False, is_eager=True, callback=_show_version, help="Show the version."
)
@click.option("-v", "--verbose", count=True, help="Log more; for debugging.")
@click.option("-q", "--quiet", is_flag=True, help="Log only what goes wrong; results and progress are shown as ever.")
def main(verbose: int, quiet: bool) -> None:
    """RHOT tracks a hand with painted fingertips, and the objects it holds, with two cameras.

    To see it work without any hardware, run: rhot sim. For a rig of your own, run rhot init RIG, then rhot doctor
    --rig RIG.

    Services that `rhot up` and systemd start have commands of their own: capture, fusion, ik, objects, feet, viewer,
    bridge, router, truth (rhot SERVICE --help).
    """
    level = logging.DEBUG if verbose else logging.WARNING if quiet else logging.INFO
    handler = logging.StreamHandler()
    handler.setFormatter(PrintableFormatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])
    logging.getLogger("zenoh").setLevel(logging.ERROR)


@click.group(cls=LazyGroup, lazy={"Commands": _CALIBRATIONS}, plugins="rhot.calibrations")
def calibrate() -> None:
    """Calibrate a part of the rig; each writes its own file into the rig folder."""


@click.group(cls=LazyGroup, lazy=_EVALUATIONS, plugins="rhot.evaluations")
def evaluate() -> None:
    """Measure how well a part of the rig works."""
