"""What every service is made of: start, wait for `start`, run, status once a second, configuration, signals, exit code.

A service implements `Service`; `run_service` does the rest.
"""

from rhot.service.control import ControlState
from rhot.service.core_service import CoreService
from rhot.service.node import Node
from rhot.service.runner import Service, run_service
from rhot.service.status import StatusBoard

__all__ = ["ControlState", "CoreService", "Node", "Service", "StatusBoard", "run_service"]
