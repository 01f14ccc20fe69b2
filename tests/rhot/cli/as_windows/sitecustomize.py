"""Python as Windows has it, as far as that can be had elsewhere: without what only Unix has.

In a folder of `PYTHONPATH`, every Python process begins with it, children too. The standard library and large packages
are loaded first, because they choose their halves when they load; our modules then find `sys.platform` "win32", no
`fcntl`, `termios` or `resource`, no event loop that takes signal handlers or waits for files, and an empty keyboard.
"""

from __future__ import annotations

import asyncio
import asyncio.subprocess
import concurrent.futures.thread
import ctypes
import http.server
import importlib.metadata
import logging.handlers
import mmap
import multiprocessing.pool
import multiprocessing.shared_memory
import os
import platform
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import types
import webbrowser
import zipfile
from typing import Any, NoReturn

import click
import cv2
import numpy as np
import pydantic
import rich.console
import rich.live
import rich.progress
import tomlkit
import zenoh

LOADED = (
    asyncio.subprocess, concurrent.futures.thread, ctypes, http.server, importlib.metadata, logging.handlers, mmap,
    multiprocessing.pool, multiprocessing.shared_memory, shutil, subprocess, tempfile, webbrowser, zipfile,
    click, cv2, np, pydantic, rich.console, rich.live, rich.progress, tomlkit, zenoh,
)  # fmt: skip
MODULES = ("fcntl", "termios", "tty", "resource", "pwd", "grp", "pty", "syslog")
FUNCTIONS = (
    "fork", "memfd_create", "nice", "getuid", "geteuid", "getgid", "setsid", "killpg", "mkfifo", "sync", "uname",
    "sched_setscheduler", "sched_getaffinity", "SCHED_FIFO", "sched_param", "sysconf", "getloadavg",
    "O_DIRECTORY", "O_NONBLOCK", "O_NOFOLLOW", "chown",
)  # fmt: skip
SIGNALS = ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGQUIT", "pthread_sigmask", "SIG_BLOCK", "SIG_SETMASK", "setitimer")
LOOP = ("add_signal_handler", "remove_signal_handler", "add_reader", "remove_reader", "add_writer", "remove_writer")


def refuse(*_: object, **__: object) -> NoReturn:
    """Do as an event loop of Windows."""
    raise NotImplementedError("event loops of Windows have no such thing")


class Policy(asyncio.DefaultEventLoopPolicy):
    """Makes such loops."""

    def new_event_loop(self) -> asyncio.AbstractEventLoop:
        loop = super().new_event_loop()
        for name in LOOP:
            setattr(loop, name, refuse)
        return loop


def become_windows() -> None:
    """Take away what Windows lacks."""
    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    for place, names in ((os, FUNCTIONS), (signal, SIGNALS)):
        for name in names:
            if hasattr(place, name):
                delattr(place, name)
    os.process_cpu_count = os.cpu_count  # type: ignore[attr-defined]  # from Python 3.13 on
    # What opens files beside an open folder; Windows has no such thing.
    shutil._use_fd_functions = False  # type: ignore[attr-defined]
    keyboard: Any = types.ModuleType("msvcrt")
    keyboard.kbhit = lambda: False
    keyboard.getwch = lambda: ""
    keyboard.LK_NBLCK = 2
    keyboard.locking = lambda *_: None
    sys.modules["msvcrt"] = keyboard
    asyncio.set_event_loop_policy(Policy())
    # Of which only Windows has the name.
    subprocess.CREATE_NEW_PROCESS_GROUP = 0  # type: ignore[attr-defined]
    sys.platform = "win32"


sysconfig.get_config_vars()
platform.uname()
become_windows()
