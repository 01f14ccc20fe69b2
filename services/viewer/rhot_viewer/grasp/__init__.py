"""The page *Grasp*: the tracked hand, the twin of the tracked object, and a headset that looks at both."""
