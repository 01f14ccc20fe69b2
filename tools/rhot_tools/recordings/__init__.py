"""Commands that record a rig, play it back, track it offline and explain or export the result."""
