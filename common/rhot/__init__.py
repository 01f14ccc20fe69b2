"""RHOT: an open-source tracker of hands and objects from two cameras and painted fingertips.

`rhot.messages` holds the wire schemas, `rhot.bus` the connection to a running rig; see the README for a
ten-line reader.
"""

__version__ = "0.1.0"
