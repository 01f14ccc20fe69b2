# Hands of a RHOT rig in Godot 4. Start `rhot bridge json --transport udp`, put this script on a Node3D, run the scene.
# Each joint is a ball; hands are also XRHandTrackers (/user/hand_tracker/left and right), so XRHandModifier3D works.
extends Node3D

@export var port := 8766
var socket := PacketPeerUDP.new()
var balls := {}
var trackers := {}

func _ready() -> void:
	# "*" in place of 127.0.0.1: a rig on another machine
	if socket.bind(port, "127.0.0.1", 1 << 20) != OK:
		push_error("port %d is taken" % port)
	for side in ["left", "right"]:
		balls[side] = []
		for k in 26:
			var ball := MeshInstance3D.new()
			ball.mesh = SphereMesh.new()
			ball.mesh.radius = 1.0
			ball.mesh.height = 2.0
			ball.visible = false
			add_child(ball)
			balls[side].append(ball)
		var tracker := XRHandTracker.new()
		tracker.name = "/user/hand_tracker/" + side
		tracker.hand = XRPositionalTracker.TRACKER_HAND_LEFT if side == "left" else XRPositionalTracker.TRACKER_HAND_RIGHT
		XRServer.add_tracker(tracker)
		trackers[side] = tracker

func _process(_delta: float) -> void:
	var newest := PackedByteArray()
	while socket.get_available_packet_count() > 0:
		newest = socket.get_packet()
	if newest.is_empty():
		return
	var frame: Dictionary = JSON.parse_string(newest.get_string_from_utf8())
	for side in balls:
		trackers[side].has_tracking_data = false
		for ball in balls[side]:
			ball.visible = false
	for hand in frame["hands"]:
		var p: Array = hand["positions"]
		var q: Array = hand["orientations"]
		var tracker: XRHandTracker = trackers[hand["side"]]
		tracker.has_tracking_data = true
		for k in 26:
			# Stage axes are Godot's own: y up, -z forward, metres.
			var turned := Quaternion(q[4 * k], q[4 * k + 1], q[4 * k + 2], q[4 * k + 3]).normalized()
			var pose := Transform3D(Basis(turned), Vector3(p[3 * k], p[3 * k + 1], p[3 * k + 2]))
			var radius: float = hand["radii"][k]
			tracker.set_hand_joint_transform(k, pose)
			tracker.set_hand_joint_radius(k, radius)
			tracker.set_hand_joint_flags(k, 15)
			balls[hand["side"]][k].transform = pose.scaled_local(Vector3.ONE * radius * hand["weight"])
			balls[hand["side"]][k].visible = true

func _exit_tree() -> void:
	for side in trackers:
		XRServer.remove_tracker(trackers[side])
