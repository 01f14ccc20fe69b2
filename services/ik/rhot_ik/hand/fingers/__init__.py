"""One finger at a time: where its marker is painted, and from the marker to its angles in closed form."""
