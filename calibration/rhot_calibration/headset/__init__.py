"""Where the feet's depth camera sits on the headset."""
