"""What every service is made of: start, wait for `start`, run, status once a second, configuration, signals, exit code.

A service implements `Service`; `run_service` does the rest.
"""

from rhot.service.control import ControlState
from rhot.service.node import Node
from rhot.service.runner import Service, run_service
from rhot.service.stage_service import StageService
from rhot.service.status import StatusBoard

__all__ = ["ControlState", "Node", "Service", "StageService", "StatusBoard", "run_service"]
