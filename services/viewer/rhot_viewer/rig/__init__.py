"""What the page knows of the running rig, without any web page."""
