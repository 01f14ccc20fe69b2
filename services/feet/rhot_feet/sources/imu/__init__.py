"""Where inertial samples come from: the seam between the feet service and a sensor on an ankle.

`open` and `read` may block for a moment and come from one thread at a time; `close` may come from another thread while
`read` still runs, because a thread cannot be cancelled.
"""

from rhot_feet.imu.samples import ImuSamples, ImuSource

__all__ = ["ImuSamples", "ImuSource"]
