"""What the page shows in the browser."""
