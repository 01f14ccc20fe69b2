from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml

RHOT_SERVICES = (
    "fusion",
    "ik",
    "objects",
    "feet",
    "viewer",
    "grasp",
    "bridge",
    "truth",
    "capture-left",
    "capture-right",
)
ON_THE_BUS = {"grasp": "viewer-grasp", "bridge": "bridge-*"}
"""Those whose name there is another one."""
VOLUMES = {
    "viewer": ["rig:/rig", "recordings:/recordings"],
    "capture-left": ["rig:/rig"],
    "capture-right": ["rig:/rig"],
}
"""Those that save write into the rig; for all others it is read-only."""


@pytest.fixture(scope="module")
def compose(deploy: Path) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load((deploy / "compose.yaml").read_text(encoding="utf-8"))
    return data


@pytest.fixture(scope="module")
def dockerfile(deploy: Path) -> list[list[str]]:
    """Instructions as words, continuation lines joined."""
    text = (deploy / "Dockerfile").read_text(encoding="utf-8")
    text = re.sub(r"^#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ")
    return [shlex.split(line) for line in text.splitlines() if line.strip()]


def rhot_commands(words: list[str]) -> list[list[str]]:
    """The rhot commands in a container's command, also inside of `sh -c`, without the leading `rhot`."""
    if words[:2] == ["sh", "-c"]:
        parts = re.split(r"&&|\|\||;", words[2])
        lines = [shlex.split(part.strip().removeprefix("exec ")) for part in parts]
        return [line[1:] for line in lines if line[0] == "rhot"]
    return [words[1:]] if words[0] == "rhot" else []


def all_commands(compose: dict[str, Any]) -> dict[str, list[list[str]]]:
    found: dict[str, list[list[str]]] = {}
    for name, service in compose["services"].items():
        if not service["image"].startswith("rhot:"):
            continue
        entry = service.get("entrypoint", ["rhot"])
        commands = rhot_commands([*entry, *service.get("command", [])])
        test = service.get("healthcheck", {}).get("test", ["CMD", "true"])
        commands += rhot_commands(test[1:])
        found[name] = commands
    return found


def test_every_command_in_it_exists(compose: dict[str, Any], resolve_command: Callable[[list[str]], str]) -> None:
    resolved = {name: [resolve_command(words) for words in lines] for name, lines in all_commands(compose).items()}
    assert resolved == {
        "rig": ["init"],
        **{name: [name.partition("-")[0], "get"] for name in RHOT_SERVICES},
        "grasp": ["viewer", "get"],
        "start": ["start", "watch"],
    }


def test_cameras_are_those_of_a_new_rig(compose: dict[str, Any]) -> None:
    cameras = {name: service["command"][-1] for name, service in compose["services"].items() if "capture" in name}
    assert cameras == {"capture-left": "left", "capture-right": "right"}


@pytest.mark.parametrize("name", RHOT_SERVICES)
def test_each_service_runs_alone_restarts_and_can_do_little(compose: dict[str, Any], name: str) -> None:
    service = compose["services"][name]
    assert service["restart"] == "unless-stopped"
    assert service["stop_grace_period"] == "5s"
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["volumes"] == VOLUMES.get(name, ["rig:/rig:ro"])
    assert service["environment"] == {"RHOT_RIG": "/rig", "RHOT_CONNECT": "tcp/router:7447"}
    kind, _, instance = ON_THE_BUS.get(name, name).partition("-")
    assert service["healthcheck"]["test"] == ["CMD", "rhot", "get", f"rhot/status/{kind}/{instance or 'main'}"]


def test_services_wait_for_the_rig_only(compose: dict[str, Any]) -> None:
    for name in RHOT_SERVICES:
        assert compose["services"][name]["depends_on"] == {
            "rig": {"condition": "service_completed_successfully"},
            "router": {"condition": "service_started"},
        }


def test_the_rig_is_made_once_and_kept(compose: dict[str, Any]) -> None:
    rig = compose["services"]["rig"]
    assert rig["entrypoint"][-1].startswith("test -e /rig/rig.toml || ")
    assert rig["volumes"] == ["rig:/rig"]
    assert "rig" in compose["volumes"]


def test_the_router_is_zenohd_listening_where_the_services_look(compose: dict[str, Any]) -> None:
    router = compose["services"]["router"]
    assert router["image"].startswith("eclipse/zenoh:")
    assert router["command"] == ["--listen", "tcp/0.0.0.0:7447", "--no-multicast-scouting"]
    assert router["healthcheck"]["test"][-1] == "7447"
    # Open to this machine only; whoever reaches the router can steer the rig.
    assert router["ports"] == ["127.0.0.1:7447:7447"]


def test_the_router_is_as_new_as_our_zenoh(compose: dict[str, Any]) -> None:
    version = re.search(r":-([\d.]+)}", compose["services"]["router"]["image"])
    assert version is not None
    assert version[1].split(".")[:2] == metadata.version("eclipse-zenoh").split(".")[:2]


def test_images_stand_still(compose: dict[str, Any], dockerfile: list[list[str]], repository: Path) -> None:
    """A full version or a digest: what runs today runs tomorrow."""
    version = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    for service in compose["services"].values():
        if service["image"].startswith("rhot:"):
            assert service["image"] == f"rhot:${{RHOT_VERSION:-{version}}}"
        else:
            assert re.fullmatch(r"eclipse/zenoh:\$\{ZENOH_VERSION:-\d+\.\d+\.\d+}", service["image"])
    (base,) = [words[1] for words in dockerfile if words[0] == "ARG"]
    assert re.fullmatch(r"PYTHON_IMAGE=python:\d+\.\d+\.\d+-slim-\w+", base)


def test_the_page_is_open_to_this_machine_only(compose: dict[str, Any]) -> None:
    viewer = compose["services"]["viewer"]
    assert viewer["ports"] == ["127.0.0.1:8080:8080"]
    assert viewer["command"] == ["viewer", "--host", "0.0.0.0", "--recordings", "/recordings"]
    grasp = compose["services"]["grasp"]
    assert grasp["ports"] == ["127.0.0.1:8081:8081"]
    assert grasp["command"] == ["viewer", "--xr", "--host", "0.0.0.0", "--port", "8081"]
    assert {"rig", "recordings"} == set(compose["volumes"])


def test_the_rig_starts_again_when_the_machine_does(compose: dict[str, Any]) -> None:
    assert compose["services"]["start"]["restart"] == "unless-stopped"


def test_the_image_is_built_from_this_checkout(compose: dict[str, Any], repository: Path) -> None:
    build = compose["services"]["rig"]["build"]
    context = (repository / "deploy" / build["context"]).resolve()
    assert context == repository
    assert (context / build["dockerfile"]).is_file()


def test_everything_that_is_copied_exists(dockerfile: list[list[str]], repository: Path) -> None:
    ignored = (repository / ".dockerignore").read_text(encoding="utf-8").split()
    sources = [
        source for words in dockerfile if words[0] == "COPY" and "--from=build" not in words for source in words[1:-1]
    ]
    assert {"pyproject.toml", "common", "services"} <= set(sources)
    for source in sources:
        assert (repository / source).exists(), source
        assert f"!{source}" in ignored, f"{source} is kept from the builder by .dockerignore"
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {project["readme"], *project["license-files"]} <= set(sources), "the build needs these"


def test_extras_in_image_and_script_exist(dockerfile: list[list[str]], repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = set(project["optional-dependencies"])
    named = [match[1] for words in dockerfile for word in words if (match := re.fullmatch(r"\.\[(\w+)]", word))]
    assert named == ["sim"]
    # install.sh installs the extra that has the role's name.
    assert {*named, "capture", "pc"} <= extras


def test_the_image_is_small_and_not_root(dockerfile: list[list[str]]) -> None:
    stages = [words for words in dockerfile if words[0] == "FROM"]
    assert [words[1] for words in stages] == ["${PYTHON_IMAGE}"] * 2
    last = dockerfile[dockerfile.index(stages[-1]) :]
    assert ["USER", "rhot"] in last
    assert not [words for words in last if "pip" in words]
    assert ["ENTRYPOINT", "[rhot]"] in last


def test_every_service_has_its_secured_form(compose: dict[str, Any], deploy: Path) -> None:
    secure = yaml.safe_load((deploy / "compose.secure.yaml").read_text(encoding="utf-8"))["services"]
    assert secure.keys() == compose["services"].keys()
    for name in secure.keys() - {"rig", "router"}:
        assert secure[name]["environment"]["RHOT_CONNECT"] == "tls/router:7447"
