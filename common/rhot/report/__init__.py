"""What reports are made of: HTML pages and SVG plots in one file."""
