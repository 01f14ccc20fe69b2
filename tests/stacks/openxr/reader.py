"""An OpenXR program with hands, on the loader and a runtime without display; it knows nothing of who tracks them.

Usage: reader.py [--no-hands]. Says what it found, then answers each line of standard input, both as JSON:
`{"do": "locate", "side": …, "space": …, "ahead_ms": …}`, `{"do": "follow", "side": …, "seconds": …}`, `{"do": "bad"}`.
"""

from __future__ import annotations

import ctypes
import json
import sys
import time
from typing import Any

import xr

JOINTS = 26
HANDS = ["XR_EXT_hand_tracking", "XR_EXT_hand_tracking_data_source", "XR_FB_hand_tracking_aim"]


class Timespec(ctypes.Structure):
    _fields_ = (("s", ctypes.c_long), ("ns", ctypes.c_long))


class Program:
    def __init__(self, hands: bool) -> None:
        self.offered = {str(p.extension_name.decode()) for p in xr.enumerate_instance_extension_properties()}
        enabled = ["XR_MND_headless", "XR_KHR_convert_timespec_time", *(HANDS if hands else [])]
        about = xr.ApplicationInfo("reader", 1, "none", 0, xr.Version(1, 0, 0))
        self.instance = xr.create_instance(
            xr.InstanceCreateInfo(application_info=about, enabled_extension_names=enabled)
        )
        self.system = xr.get_system(self.instance, xr.SystemGetInfo(xr.FormFactor.HEAD_MOUNTED_DISPLAY))
        self.session = xr.create_session(self.instance, xr.SessionCreateInfo(system_id=self.system, next=None))
        self.begin()
        kinds = xr.ReferenceSpaceType
        self.spaces = {
            name: xr.create_reference_space(
                self.session,
                xr.ReferenceSpaceCreateInfo(getattr(kinds, name), pose_in_reference_space=xr.Posef()),
            )
            for name in ("STAGE", "LOCAL", "VIEW")
        }

    def begin(self) -> None:
        while True:
            try:
                event = xr.poll_event(self.instance)
            except xr.EventUnavailable:
                time.sleep(0.01)
                continue
            if xr.StructureType(event.type) == xr.StructureType.EVENT_DATA_SESSION_STATE_CHANGED:
                changed = ctypes.cast(ctypes.byref(event), ctypes.POINTER(xr.EventDataSessionStateChanged)).contents
                if xr.SessionState(changed.state) == xr.SessionState.READY:
                    xr.begin_session(self.session, xr.SessionBeginInfo(xr.ViewConfigurationType.PRIMARY_STEREO))
                    return

    def function(self, name: str) -> Any:
        return ctypes.cast(xr.get_instance_proc_addr(self.instance, name), getattr(xr, "PFN_" + name))

    def supports(self) -> bool:
        hands = xr.SystemHandTrackingPropertiesEXT()
        properties = xr.SystemProperties(next=ctypes.cast(ctypes.pointer(hands), ctypes.c_void_p))
        get = self.function("xrGetSystemProperties")
        xr.check_result(xr.Result(get(self.instance, self.system, ctypes.byref(properties))))
        return bool(hands.supports_hand_tracking)

    def make_trackers(self) -> None:
        create = self.function("xrCreateHandTrackerEXT")
        self.locate_joints = self.function("xrLocateHandJointsEXT")
        self.convert = self.function("xrConvertTimespecTimeToTimeKHR")
        self.trackers = {}
        for side in ("LEFT", "RIGHT"):
            tracker = xr.HandTrackerEXT()
            info = xr.HandTrackerCreateInfoEXT(getattr(xr.HandEXT, side), xr.HandJointSetEXT.DEFAULT)
            xr.check_result(xr.Result(create(self.session, ctypes.byref(info), ctypes.byref(tracker))))
            self.trackers[side.lower()] = tracker
        self.joints = (xr.HandJointLocationEXT * JOINTS)()
        self.moving = (xr.HandJointVelocityEXT * JOINTS)()
        self.source = xr.HandTrackingDataSourceStateEXT()
        self.aim = xr.HandTrackingAimStateFB(next=ctypes.cast(ctypes.pointer(self.source), ctypes.c_void_p))
        self.velocities = xr.HandJointVelocitiesEXT(
            JOINTS, self.moving, next=ctypes.cast(ctypes.pointer(self.aim), ctypes.c_void_p)
        )
        self.out = xr.HandJointLocationsEXT(
            joint_count=JOINTS,
            joint_locations=self.joints,
            next=ctypes.cast(ctypes.pointer(self.velocities), ctypes.c_void_p),
        )

    def xr_time(self, ns: int) -> Any:
        spec, out = Timespec(ns // 10**9, ns % 10**9), xr.Time()
        pointer = ctypes.cast(ctypes.byref(spec), self.convert.argtypes[1])
        xr.check_result(xr.Result(self.convert(self.instance, pointer, ctypes.byref(out))))
        return out

    def locate(self, side: str, space: str, ahead_ms: float) -> dict[str, Any]:
        ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC) + round(1e6 * ahead_ms)
        info = xr.HandJointsLocateInfoEXT(base_space=self.spaces[space], time=self.xr_time(ns))
        result = self.locate_joints(self.trackers[side], ctypes.byref(info), ctypes.byref(self.out))
        stage = xr.locate_space(self.spaces["STAGE"], self.spaces[space], info.time).pose
        said = {"result": xr.Result(result).name, "active": bool(self.out.is_active), "t_ns": ns}
        said["stage"] = [*xyz(stage.position), *xyz(stage.orientation), stage.orientation.w]
        if not self.out.is_active:
            return {**said, "flags": sorted({j.location_flags for j in self.joints})}
        vectors = [(v.linear_velocity, v.angular_velocity) for v in self.moving]
        return {
            **said,
            "flags": sorted({j.location_flags for j in self.joints}),
            "positions": [list(xyz(j.pose.position)) for j in self.joints],
            "orientations": [[*xyz(j.pose.orientation), j.pose.orientation.w] for j in self.joints],
            "radii": [j.radius for j in self.joints],
            "velocity_flags": sorted({v.velocity_flags for v in self.moving}),
            "linear": [list(xyz(v)) for v, _ in vectors],
            "angular": [list(xyz(w)) for _, w in vectors],
            "source": [bool(self.source.is_active), int(self.source.data_source)],
            "aim": [int(self.aim.status), self.aim.pinch_strength_index],
        }

    def follow(self, side: str, seconds: float) -> dict[str, list[int]]:
        """Return when samples of a hand came, monotonic: at one and the same time joints move only with a new one."""
        end, came = time.monotonic() + seconds, []
        out, tracker = ctypes.byref(self.out), self.trackers[side]
        while time.monotonic() < end:
            at = self.xr_time(time.clock_gettime_ns(time.CLOCK_MONOTONIC))
            info = ctypes.byref(xr.HandJointsLocateInfoEXT(base_space=self.spaces["STAGE"], time=at))
            self.locate_joints(tracker, info, out)
            before = bytes(self.joints)
            while bytes(self.joints) == before and time.monotonic() < end:
                time.sleep(0.0002)
                self.locate_joints(tracker, info, out)
            # A hand that goes is no sample.
            if self.out.is_active:
                came.append(time.monotonic_ns())
        return {"came_ns": came[:-1]}

    def bad(self) -> dict[str, str]:
        """Mistakes that a program may make, and what it is told."""
        now = self.xr_time(time.clock_gettime_ns(time.CLOCK_MONOTONIC))
        info = xr.HandJointsLocateInfoEXT(base_space=self.spaces["STAGE"], time=now)
        tracker = self.trackers["right"]
        few = xr.HandJointLocationsEXT(joint_count=3, joint_locations=self.joints)
        few.joint_count = 3
        never = xr.HandJointsLocateInfoEXT(base_space=self.spaces["STAGE"], time=0)
        created = xr.HandTrackerEXT()
        neither = xr.HandTrackerCreateInfoEXT(xr.HandEXT(1), xr.HandJointSetEXT.DEFAULT)
        neither._hand = 7
        create, destroy = self.function("xrCreateHandTrackerEXT"), self.function("xrDestroyHandTrackerEXT")
        calls = {
            "few": self.locate_joints(tracker, ctypes.byref(info), ctypes.byref(few)),
            "never": self.locate_joints(tracker, ctypes.byref(never), ctypes.byref(self.out)),
            "hand": create(self.session, ctypes.byref(neither), ctypes.byref(created)),
            "left": destroy(self.trackers["left"]),
            "again": destroy(self.trackers["left"]),
        }
        return {name: xr.Result(result).name for name, result in calls.items()}


def xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def say(what: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def main() -> None:
    hands = "--no-hands" not in sys.argv
    program = Program(hands)
    said = {
        "runtime": xr.get_instance_properties(program.instance).runtime_name.decode(),
        "supports": program.supports(),
    }
    said["offered"] = [name for name in HANDS if name in program.offered]
    if hands:
        program.make_trackers()
    else:
        try:
            program.function("xrLocateHandJointsEXT")
            said["function"] = "there"
        except xr.FunctionUnsupportedError:
            said["function"] = "unsupported"
    say(said)
    for line in sys.stdin:
        request = json.loads(line)
        do: Any = {"locate": program.locate, "follow": program.follow, "bad": program.bad}[request.pop("do")]
        say(do(**request))
    xr.destroy_session(program.session)
    xr.destroy_instance(program.instance)


main()
