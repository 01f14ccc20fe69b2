"""What the 3D scene shows, as plain arrays: shapes made from messages, without any web page."""
