"""``cell``: starts the nodes of a print cell, one process each, and keeps them running."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from lifecycle_msgs.srv import GetState
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from mdf_core.mesh_io import load_design
from mdf_core.units import UNITS
from mdf_nodes.context import (
    BAD_INPUT,
    DONE,
    FAULT,
    child_environment,
    exit_status,
    ros_context,
    without_ros_arguments,
)
from mdf_nodes.parameters import OUTPUT_FOLDER
from mdf_nodes.shared_memory import discard_abandoned_segments

NODES = {"scan_ingest": "ScanIngest", "registration": "Registration", "compensation": "Compensation"}
"""The nodes of a cell, each a module of this package and a node of that name, and their classes."""

READY = "ready"
"""What the status line of a node that has become active ends in."""

_ACTIVE = "active"
_ASK_SECONDS = 0.3
_TWINS_SECONDS = 15.0
_LINGER_SECONDS = 25.0  # a process that was killed stays in the graph for 20 s
_POLL_SECONDS = 0.05
_SHORTEST_LIFE_SECONDS = 10.0
_MOST_QUICK_DEATHS = 5
_FIRST_DELAY_SECONDS, _LONGEST_DELAY_SECONDS = 0.5, 5.0
# What is under way ends within an iteration; the rest is for a machine under load.
_STOP_STEPS = ((signal.SIGINT, 4.0), (signal.SIGTERM, 2.0), (signal.SIGKILL, 2.0))


class _Child:
    """One node's process.

    Parameters
    ----------
    name : str
    ros_arguments : sequence of str
    """

    def __init__(self, name: str, ros_arguments: Sequence[str]) -> None:
        self.name = name
        self.due = 0.0
        self._state = ""
        self._has_worked = False
        self._ros_arguments = ros_arguments
        self._quick_deaths = 0
        self.start()

    def start(self) -> None:
        """Start the process; it is killed with ours, however ours ends."""
        discard_abandoned_segments()
        guard = ("setpriv", "--pdeathsig", "KILL")
        command = (*guard, sys.executable, "-m", f"mdf_nodes.{self.name}", *self._ros_arguments)
        # A session of its own: Ctrl-C in the terminal reaches the supervisor alone, which then ends them in order.
        self.process = subprocess.Popen(
            command, env=child_environment(), stdin=subprocess.DEVNULL, start_new_session=True
        )
        self.state, self._started = "starting", time.monotonic()

    @property
    def state(self) -> str:
        """starting, dead, or the node's lifecycle state."""
        return self._state

    @state.setter
    def state(self, state: str) -> None:
        self._state = state
        self._has_worked = self._has_worked or state == _ACTIVE

    @property
    def is_running(self) -> bool:
        """Whether the process has not ended."""
        return self.process.poll() is None

    @property
    def age(self) -> float:
        """Seconds since the process was started."""
        return time.monotonic() - self._started

    def died(self) -> bool:
        """Tell of the process's end and when the next one is due; false: it will never work.

        One that has been active before is started again for ever: bad scans that kill it are given up one by one.
        """
        self.state = "dead"
        quick = self.age < _SHORTEST_LIFE_SECONDS
        self._quick_deaths = self._quick_deaths + 1 if quick else 0
        status = self.process.returncode
        how = f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
        if status == BAD_INPUT or (self._quick_deaths >= _MOST_QUICK_DEATHS and not self._has_worked):
            _tell(self.name, f"ended by {how}; giving up")
            return False
        doublings = min(max(self._quick_deaths - 1, 0), _MOST_QUICK_DEATHS)
        delay = min(_FIRST_DELAY_SECONDS * 2**doublings, _LONGEST_DELAY_SECONDS)
        _tell(self.name, f"ended by {how}; starting it again in {delay:g} s")
        self.due = time.monotonic() + delay
        return True


class _Watch(Node):
    """Asks the nodes for their lifecycle state until they are active, and tells of others that have their names."""

    def __init__(self, children: Sequence[_Child]) -> None:
        super().__init__("cell", enable_rosout=False, start_parameter_services=False)
        self._children = children
        self._asking = {child.name: self.create_client(GetState, f"{child.name}/get_state") for child in children}
        self._pending: dict[str, Any] = {}
        self._told: set[str] = set()
        self.create_timer(_ASK_SECONDS, self._ask)
        self.create_timer(_TWINS_SECONDS, self._look_for_twins)

    def _ask(self) -> None:
        for child in self._children:
            client = self._asking[child.name]
            # A node that was killed takes its answers with it.
            if (future := self._pending.pop(child.name, None)) is not None:
                client.remove_pending_request(future)
            if child.is_running and child.state != _ACTIVE and client.service_is_ready():
                self._pending[child.name] = future = client.call_async(GetState.Request())
                future.add_done_callback(
                    lambda done, child=child, process=child.process: self._note(child, process, done)
                )

    def _look_for_twins(self) -> None:
        names = self.get_node_names_and_namespaces()
        for child in self._children:
            # Of a younger process the one before may be meant.
            is_twin = child.age > _LINGER_SECONDS and names.count((child.name, self.get_namespace())) > 1
            if is_twin and child.name not in self._told:
                self._told.add(child.name)
                _tell(
                    child.name,
                    "another node has this name and answers too; give each cell a --namespace or ROS_DOMAIN_ID",
                )

    def _note(self, child: _Child, process: subprocess.Popen[bytes], future: Any) -> None:
        if future.cancelled() or child.process is not process or not child.is_running:
            return
        label = future.result().current_state.label
        if label != child.state and label in (_ACTIVE, "inactive", "unconfigured", "finalized"):
            child.state = label
            _tell(child.name, READY if label == _ACTIVE else f"not active ({label})")


def _tell(name: str, text: str) -> None:
    # In one piece: nodes of this process log to the same stream, and print may write the end of the line apart.
    sys.stderr.write(f"cell: {name}: {text}\n")
    sys.stderr.flush()


def _supervise(ros_arguments: Sequence[str]) -> int:
    with ros_context(["cell", *ros_arguments]) as stop:
        children = [_Child(name, ros_arguments) for name in NODES]
        try:
            watch = _Watch(children)
            executor = SingleThreadedExecutor()
            executor.add_node(watch)
            while not stop.is_set():
                executor.spin_once(timeout_sec=_POLL_SECONDS)
                for child in children:
                    if child.is_running:
                        continue
                    if child.state == "dead":
                        if time.monotonic() >= child.due:
                            child.start()
                    elif not child.died():
                        return BAD_INPUT if child.process.returncode == BAD_INPUT else FAULT
            executor.shutdown()
            watch.destroy_node()
        finally:
            clean = _stop(children)
    return DONE if clean else FAULT


def _stop(children: Sequence[_Child]) -> bool:
    """End all processes; whether none had to be killed."""
    for number, seconds in _STOP_STEPS:
        running = [child for child in children if child.is_running]
        for child in running:
            # A Python that is still importing answers SIGINT with a trace.
            gentle = signal.SIGTERM if number == signal.SIGINT and child.state != _ACTIVE else number
            child.process.send_signal(gentle)
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and any(child.is_running for child in running):
            time.sleep(_POLL_SECONDS)
        if number == signal.SIGKILL and running:
            _tell(", ".join(child.name for child in running), "had to be killed")
            return False
    return True


def _run_here(ros_arguments: Sequence[str]) -> int:
    """All nodes in this process, each with its own threads."""
    with ros_context(["cell", *ros_arguments]) as stop:
        nodes = [getattr(import_module(f"mdf_nodes.{name}"), class_name)() for name, class_name in NODES.items()]
        try:
            for node in nodes:
                node.start()
                _tell(node.get_name(), READY if node.is_active else "not active")
            stop.wait()
        finally:
            enders = [threading.Thread(target=node.stop) for node in nodes]
            for ender in enders:
                ender.start()
            for ender in enders:
                ender.join()
    return DONE


@dataclass(frozen=True)
class _Line:
    """The command line: our options, and the arguments that go to every node."""

    options: argparse.Namespace
    ros_arguments: tuple[str, ...]


def _read(argv: Sequence[str]) -> _Line:
    parser = argparse.ArgumentParser(
        "cell",
        description=__doc__,
        epilog="What follows --ros-args goes to every node: remappings, parameters, log levels.",
        allow_abbrev=False,
    )
    parser.add_argument("--design", type=Path, metavar="FILE", help="design to inspect against")
    parser.add_argument("--design-unit", choices=UNITS, help="unit of that file; default: mm")
    parser.add_argument("--output-folder", type=Path, metavar="DIR", help="where results are written")
    parser.add_argument(
        "--state-folder",
        type=Path,
        metavar="DIR",
        help="journal of accepted scans, which outlives the cell; default: what the parameters file says, or state"
        " in the output folder",
    )
    parser.add_argument("--watch-folder", type=Path, metavar="DIR", help="scan files put here are inspected")
    parser.add_argument("--scan-unit", choices=UNITS, help="unit of scan files; default: mm")
    parser.add_argument("--params-file", type=Path, metavar="YAML", help="parameters of the nodes")
    parser.add_argument("--namespace", default="", metavar="NS", help="namespace of the cell")
    parser.add_argument(
        "--single-process", action="store_true", help="all nodes in this process; nothing restarts them"
    )
    options = parser.parse_args(without_ros_arguments(argv))
    if options.params_file is not None and not options.params_file.is_file():
        parser.error(f"--params-file {options.params_file}: no such file")
    if options.design_unit is not None and options.design is None:
        parser.error("--design-unit says nothing without --design; of a design in the parameters file give it there")
    options.design_unit = options.design_unit or "mm"

    state_folder = options.state_folder
    if state_folder is None and options.params_file is None:
        state_folder = (options.output_folder or Path(OUTPUT_FOLDER)) / "state"
    given: list[str] = []
    if options.namespace:
        given += ["-r", f"__ns:=/{options.namespace.strip('/')}"]
    if options.params_file is not None:
        given += ["--params-file", str(options.params_file.absolute())]
    parameters = {
        "design_path": options.design,
        "design_unit": options.design and options.design_unit,
        "output_folder": options.output_folder,
        "state_folder": state_folder,
        "watch_folder": options.watch_folder,
        "scan_unit": options.scan_unit,
    }
    for name, value in parameters.items():
        if value is not None:
            text = str(value.absolute() if isinstance(value, Path) else value)
            # The value is YAML: quoted, a path stays text whatever it looks like.
            given += ["-p", f"{name}:={json.dumps(text, ensure_ascii=False)}"]
    ours = ("--ros-args", *given, "--") if given else ()
    return _Line(options, (*ours, *_ros_part(argv)))


def _ros_part(argv: Sequence[str]) -> tuple[str, ...]:
    """What `without_ros_arguments` removes."""
    part: list[str] = []
    inside = False
    for argument in argv[1:]:
        inside = inside or argument == "--ros-args"
        if inside:
            part.append(argument)
            inside = argument != "--"
    return tuple(part)


def main(argv: Sequence[str] = sys.argv) -> int:
    """Run the cell until SIGINT or SIGTERM; the exit status."""
    line = _read(argv)

    def body() -> int:
        if line.options.design is not None:
            load_design(line.options.design, line.options.design_unit)
        return (_run_here if line.options.single_process else _supervise)(line.ros_arguments)

    return exit_status(body)


if __name__ == "__main__":
    sys.exit(main())
