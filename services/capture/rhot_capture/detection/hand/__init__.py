"""What is known of a hand in one camera: scale, extent, contact with skin, and which hand a shared paint is on."""
