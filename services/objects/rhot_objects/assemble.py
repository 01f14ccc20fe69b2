"""Creates the pose sources of a rig's objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rhot.errors import ConfigError
from rhot.object_mesh import object_shape
from rhot.plugins import load_simulated
from rhot.rig import ObjectConfig, Rig
from rhot_objects.core import ObjectCore
from rhot_objects.pose import Registration
from rhot_objects.sources import PoseSource
from rhot_objects.sources.recorded import RecordedSource
from rhot_objects.sources.steamvr import SteamVrSource


@dataclass(frozen=True, slots=True)
class SourcePlan:
    """One source and its core; the service polls each source separately.

    Attributes:
        name: for status and logs: `steamvr`, `simulated` or `recorded.<object id>`.
        rate_hz: rate of reading, the highest of its objects.
        source: not yet open.
        core: converts its readings to messages.
    """

    name: str
    rate_hz: float
    source: PoseSource
    core: ObjectCore


def plan_sources(rig: Rig) -> list[SourcePlan]:
    """Return the sources of a rig's objects: one SteamVR, one simulated world, one recording per recorded object.

    Raises:
        ConfigError: two objects share a serial number, or the file of a shape cannot be used.
    """
    objects = rig.config.objects
    plans = []
    steamvr = {name: config for name, config in objects.items() if config.source == "steamvr"}
    if steamvr:
        plans.append(_plan(rig, "steamvr", SteamVrSource(_ids_by_serial(rig, steamvr)), steamvr))
    simulated = {name: config for name, config in objects.items() if config.source == "simulated"}
    if simulated:
        registration = Registration.from_file(rig.registration_of("simulated"))
        source = load_simulated("objects")(rig, registration, frozenset(simulated))
        plans.append(_plan(rig, "simulated", source, simulated))
    return plans + recorded_sources(rig)


def recorded_sources(rig: Rig) -> list[SourcePlan]:
    """Return one source per recorded object of a rig."""
    return [
        _plan(
            rig,
            f"recorded.{name}",
            RecordedSource(name, rig.resolve(config.path), loop=config.loop),
            {name: config},
        )
        for name, config in rig.config.objects.items()
        if config.source == "recorded" and config.path is not None
    ]


def _plan(rig: Rig, name: str, source: PoseSource, configs: Mapping[str, ObjectConfig]) -> SourcePlan:
    shapes = {name: shape for name in rig.config.objects if (shape := object_shape(rig, name)) is not None}
    registration = Registration.from_file(rig.registration_of(source_kind(name)))
    rate_hz = max(config.rate_hz for config in configs.values())
    return SourcePlan(name, rate_hz, source, ObjectCore(registration, shapes=shapes))


def source_kind(name: str) -> str:
    """Return the kind of source, which selects the registration, from a plan's name: `recorded` for `recorded.cup`."""
    return name.partition(".")[0]


def _ids_by_serial(rig: Rig, objects: Mapping[str, ObjectConfig]) -> dict[str, str]:
    ids: dict[str, str] = {}
    for name, config in objects.items():
        serial = config.serial or ""
        if serial in ids:
            raise ConfigError(
                f"{rig.path / 'rig.toml'}: objects.{ids[serial]} and objects.{name} both have serial {serial!r}; "
                "one tracker can only be one object"
            )
        ids[serial] = name
    return ids
