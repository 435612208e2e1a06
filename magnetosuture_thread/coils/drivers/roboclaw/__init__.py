"""The driver for RoboClaw boards."""

from magnetosuture_thread.coils.drivers.roboclaw.driver import RoboClawDriver

__all__ = ["RoboClawDriver"]
