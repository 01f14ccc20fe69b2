"""Where the floor is: `rhot calibrate stage` and its step in the page."""
