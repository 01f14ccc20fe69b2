"""How well a hand takes hold of an object."""
