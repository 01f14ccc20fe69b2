"""From picks and clicks to a marker's own pixels."""
