"""How well a hand takes hold of an object: phase by phase, as figures."""
