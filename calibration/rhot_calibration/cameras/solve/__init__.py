"""From views of boards to cameras, with what does not fit left out by name."""
