"""The page's first step: cameras that run, locked."""
