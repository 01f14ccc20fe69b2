"""Learning the markers' colours."""
