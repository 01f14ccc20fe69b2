"""Where an object sits on its tracker, from touches of its faces with a tracked fingertip."""
