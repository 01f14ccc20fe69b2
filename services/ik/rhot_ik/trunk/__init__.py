"""The body above the hips: spine, neck, head and arms."""
