"""glTF 2.0: skeletons and things that move, for Blender, game engines and browsers."""
