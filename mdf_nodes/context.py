"""What every process of the cell shares: start, stop signals, exit status, environment of child processes."""

from __future__ import annotations

import argparse
import atexit
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import RCLInvalidROSArgsError, UnknownROSArgsError
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from mdf_core.errors import MdfError

DONE, FAULT, BAD_INPUT = 0, 1, 2
"""Exit statuses: done, a fault of ours, an input that the user can mend."""

_BOOTSTRAP_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_CLEAN_STOP_SECONDS = 5.0


def child_environment(**changes: str) -> dict[str, str]:
    """The environment for a child Python process, with `changes`.

    The ROS wheels set library paths at the start of an interpreter, once; a child that inherits the note that this is
    done would go without them, or with another environment's.
    """
    environment = {name: value for name, value in os.environ.items() if name != _BOOTSTRAP_GUARD}
    return environment | changes


def positive_number(text: str) -> float:
    """A number on the command line, as `argparse` converts it; infinity is one."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text} is no number above 0")
    return value


def without_ros_arguments(argv: Sequence[str]) -> list[str]:
    """The arguments of a command, less its name, that are not meant for ROS; ends it where ROS cannot read the rest."""
    try:
        return list(remove_ros_args(argv)[1:])
    except UnknownROSArgsError as error:
        reason = f"unknown ROS arguments {error}"
    except RCLInvalidROSArgsError as error:
        reason = str(error)
    print(f"error: {reason}; see --help", file=sys.stderr)
    raise SystemExit(BAD_INPUT)


def only_ros_arguments(description: str, argv: Sequence[str]) -> None:
    """Answer --help and refuse, with status 2, whatever is not meant for ROS; `argv` begins with the program's name."""
    parser = argparse.ArgumentParser(
        description=description,
        usage="%(prog)s [-h] [--ros-args -r FROM:=TO -p PARAMETER:=VALUE --params-file FILE ...]",
        epilog="Parameters with their meaning, unit and range: ros2 param describe NODE PARAMETER",
    )
    parser.parse_args(without_ros_arguments(argv))


def tune_dds() -> None:
    """Let Fast DDS announce this process, and its children themselves, and repair what gets lost, more often than it
    does by default; unless a profile is set already.

    Has to come before the first node of the process.
    """
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(Path(__file__).with_name("fastdds.xml")))


@contextmanager
def ros_context(args: Sequence[str] | None = None) -> Iterator[threading.Event]:
    """rclpy from init to shutdown; SIGINT and SIGTERM set the event that is handed out.

    rclpy's own handlers invalidate the context at once: goals and publications under way would end in tracebacks
    instead of results. A signal seldom comes alone (the terminal and the supervisor both send one), so repeats are
    ignored until the process has ended; 5 s after the first one a further signal ends it at once.
    """
    with _stop_signals() as stop:
        tune_dds()
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        try:
            yield stop
        finally:
            rclpy.try_shutdown()


@contextmanager
def _stop_signals() -> Iterator[threading.Event]:
    """SIGINT and SIGTERM set the event that is handed out.

    Of two signals at once the second may arrive in another thread, which takes the first one along: nothing then wakes
    the main thread, the only one in which Python runs handlers. So a thread waits for what every arrival writes.
    """
    stop, asked = threading.Event(), threading.Event()
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def listen() -> None:
        last_moment = float("inf")
        while arrived := os.read(reader, 1):
            if arrived[0] not in _STOP_SIGNALS:
                continue
            if time.monotonic() > last_moment:
                os._exit(128 + arrived[0])
            last_moment = min(last_moment, time.monotonic() + _CLEAN_STOP_SECONDS)
            asked.set()
            stop.set()
        os.close(reader)

    threading.Thread(target=listen, name="stop signals", daemon=True).start()
    usual = {number: signal.signal(number, _do_nothing) for number in _STOP_SIGNALS}
    usual_writer = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    try:
        yield stop
    finally:
        if asked.is_set():
            # The end of the interpreter takes handlers away while libraries still tidy up.
            atexit.register(_ignore_stop_signals)
        else:
            signal.set_wakeup_fd(usual_writer)
            for number, handler in usual.items():
                signal.signal(number, handler)
            os.close(writer)


def _do_nothing(number: int, frame: FrameType | None) -> None:
    """A handler, without which no signal is told to the wake-up pipe."""


def _ignore_stop_signals() -> None:
    for number in _STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def spin_until(executor: SingleThreadedExecutor, condition: Callable[[], bool], stop: threading.Event) -> None:
    """Run callbacks until `condition` holds or `stop` is set."""
    while not condition() and not stop.is_set():
        executor.spin_once(timeout_sec=0.05)


def run_node(
    make_node: Callable[[], Node], args: Sequence[str] | None = None, done: Callable[[Any], bool] = lambda node: False
) -> int:
    """Run one node in one thread until it is `done` or a stop signal comes; the exit status."""

    def body() -> int:
        with ros_context(args) as stop:
            node = make_node()
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            try:
                spin_until(executor, lambda: done(node), stop)
            finally:
                executor.shutdown()
                node.destroy_node()
        return DONE

    return exit_status(body)


def exit_status(body: Callable[[], int]) -> int:
    """Run `body`: what a user can mend becomes one line on stderr and status 2, any other exception its trace and 1."""
    try:
        return body()
    except (MdfError, ParameterException, RCLInvalidROSArgsError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    except Exception:
        traceback.print_exc()
        return FAULT
