"""``cell_demo``: a cell at work on a recorded scan, from the first start to the redesigned part."""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mdf_interfaces.msg import Inspection, RedesignedMesh
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from mdf_core.bag import Bag, BagTopic, open_bag
from mdf_core.command import PICTURE_FILE
from mdf_core.distortion import distortion_left
from mdf_core.errors import BagFileError, NoScanError, OutputFolderError
from mdf_core.files import write_atomically
from mdf_core.geometry import Design
from mdf_core.mesh_io import load_design
from mdf_core.picture import draw, measured_row, reprint_row
from mdf_core.report import REPORT_FILE, json_bytes
from mdf_core.units import metres_to_millimetres
from mdf_core.virtual_cell import Printer, Warp
from mdf_nodes.bag_player import BagPlayer
from mdf_nodes.cell import NODES, READY
from mdf_nodes.context import DONE, FAULT, child_environment, exit_status, ros_context
from mdf_nodes.conversions import displacement_from_message
from mdf_nodes.qos import LATCHED, SCAN, subscription_profile

LOG_FILE = "cell.log"
INTERRUPTED = 130

_BAG = Path(__file__).resolve().parents[1] / "bags" / "bracket_rough"
_DEADLINE_SECONDS = 120.0
_STOP_SECONDS = 10.0
_TITLE_WIDTH = 26
_DOMAINS = range(1, 102)
_DOMAIN_LOCK_PORT = 23_000


class _DemoError(Exception):
    """The demonstration cannot go on; the text says why."""


class _Interrupted(Exception):
    """Ctrl-C."""


@dataclass(frozen=True)
class _Recording:
    """What the bag's folder holds.

    Attributes
    ----------
    bag : Bag
    design : Design
    topic : BagTopic
        The scans.
    last_stamp : (int, int)
        Of the last scan, s and ns.
    printer : Printer, or None
        The virtual printer that made the scanned part, where the folder tells it.
    """

    bag: Bag
    design: Design
    topic: BagTopic
    last_stamp: tuple[int, int]
    printer: Printer | None


@dataclass
class _Seen:
    """What has come out of the cell so far, and when."""

    points: float = 0.0
    scan: float = 0.0
    inspected: float = 0.0
    displacement: PointCloud2 | None = None
    inspection: Inspection | None = None
    redesign: RedesignedMesh | None = None
    path: str = ""
    redesigned: float = 0.0
    error: str = ""
    ready: set[str] = field(default_factory=set)


class _Observer(Node):
    """Notes the last scan on its way through the cell."""

    def __init__(self, recording: _Recording, seen: _Seen) -> None:
        super().__init__("cell_demo", enable_rosout=False, start_parameter_services=False)
        self._stamp, self._seen = recording.last_stamp, seen
        # As reliable as the bag is played: best effort loses large clouds.
        played = [each.qos_profile for each in self.get_publishers_info_by_topic("points")]
        self._reliability = {each.reliability for each in played}
        profile = subscription_profile(played, SCAN.depth)
        self.create_subscription(PointCloud2, "points", lambda message: self._note(message, "points"), profile)
        self.create_subscription(PointCloud2, "scan", lambda message: self._note(message, "scan"), SCAN)
        self.create_subscription(PointCloud2, "displacement", self._on_displacement, LATCHED)
        self.create_subscription(Inspection, "inspection", self._on_inspection, LATCHED)
        self.create_subscription(RedesignedMesh, "redesigned_mesh", self._on_redesign, LATCHED)
        self.create_subscription(String, "redesigned_mesh_path", self._on_path, LATCHED)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    @property
    def cell_listens(self) -> bool:
        """Whether the cell subscribes to the scans, beside us, as reliably as they are published."""
        listening = [each.qos_profile.reliability for each in self.get_subscriptions_info_by_topic("points")]
        return len(listening) > 1 and set(listening) == self._reliability

    def _is_last(self, message: Any) -> bool:
        return (message.header.stamp.sec, message.header.stamp.nanosec) == self._stamp

    def _note(self, message: Any, what: str) -> None:
        if self._is_last(message):
            setattr(self._seen, what, time.monotonic())

    def _on_displacement(self, message: PointCloud2) -> None:
        if self._is_last(message):
            self._seen.displacement = message

    def _on_inspection(self, message: Inspection) -> None:
        if self._is_last(message) and message.error_code != 0:
            self._seen.error = f"the scan is refused: {message.error_msg}"
        elif self._is_last(message):
            self._seen.inspection, self._seen.inspected = message, time.monotonic()

    def _on_redesign(self, message: RedesignedMesh) -> None:
        if self._is_last(message):
            self._seen.redesign = message

    def _on_path(self, message: String) -> None:
        self._seen.path, self._seen.redesigned = message.data, time.monotonic()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.level == DiagnosticStatus.ERROR:
                self._seen.error = f"{status.name}: {status.message}"


def _read_recording(folder: Path) -> _Recording:
    """The bag and what lies beside it.

    Raises
    ------
    MdfError
        Something is missing or cannot be read.
    """
    bag = open_bag(folder)
    topic = bag.find_cloud_topic()
    last = deque(bag.messages([topic.name]), maxlen=1)
    if not last:
        raise NoScanError(f"no scan on {topic.name}", str(folder), "give another bag")
    stamp = last[0].message.header.stamp
    home = folder if folder.is_dir() else folder.parent
    design = load_design(home / "design.stl")
    return _Recording(bag, design, topic, (stamp.sec, stamp.nanosec), _read_printer(home / "expected.json", design))


def _read_printer(path: Path, design: Design) -> Printer | None:
    if not path.is_file():
        return None
    try:
        described = json.loads(path.read_bytes())["printer"]
        warp = Warp(design, described["amplitude_mm"], described["correlation_length_mm"], described["seed"])
        return Printer(warp, described["model"])
    except (ValueError, KeyError, TypeError) as error:
        raise BagFileError(f"no description of a virtual printer: {error!r}", str(path), "remove the file") from error


@contextmanager
def _private_domain() -> Iterator[None]:
    """A ROS domain on this machine that no other demonstration uses.

    A bound port is the lock: it goes with the process, whatever happens to it.
    """
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    for domain in _DOMAINS:
        with socket.socket() as lock:
            try:
                lock.bind(("127.0.0.1", _DOMAIN_LOCK_PORT + domain))
            except OSError:
                continue
            os.environ["ROS_DOMAIN_ID"] = str(domain)
            yield
            return
    raise _DemoError("all ROS domains are in use on this machine")


@contextmanager
def _process(module: str, *arguments: str, **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """A command of ours in a process of its own, ended with the block and killed with us, however we end."""
    command = ("setpriv", "--pdeathsig", "KILL", sys.executable, "-m", f"mdf_nodes.{module}", *arguments)
    process = subprocess.Popen(
        command,
        env=child_environment(PYTHONUNBUFFERED="1"),
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        text=True,
        **options,
    )
    try:
        yield process
    finally:
        # Not SIGINT: a Python that is still importing answers it with a trace.
        for number in (signal.SIGTERM, signal.SIGKILL):
            if process.poll() is None:
                process.send_signal(number)
                try:
                    process.wait(_STOP_SECONDS)
                except subprocess.TimeoutExpired:
                    continue


def _follow(cell: subprocess.Popen[str], log: Path, seen: _Seen) -> None:
    """From now on, copy the cell's words to the log and note which nodes are ready."""

    def copy() -> None:
        assert cell.stderr is not None
        with log.open("w") as file:
            for line in cell.stderr:
                file.write(line)
                file.flush()
                for name in NODES:
                    if line.strip() == f"cell: {name}: {READY}":
                        seen.ready.add(name)

    threading.Thread(target=copy, name="cell log", daemon=True).start()


class _Steps:
    """One line per step: what goes on, and how long it took."""

    def __init__(self, console: Console, executor: SingleThreadedExecutor, stop: threading.Event) -> None:
        self.bar = Progress(
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description}", table_column=Column(no_wrap=True, min_width=_TITLE_WIDTH)),
            BarColumn(bar_width=12),
            TimeElapsedColumn(),
            TextColumn("{task.fields[note]}", style="dim"),
            console=console,
        )
        self._executor, self._stop = executor, stop
        self._deadline = time.monotonic() + _DEADLINE_SECONDS

    def until(
        self, title: str, done: Callable[[], int], total: int, faults: Callable[[], str], note: Callable[[], str]
    ) -> None:
        """Wait until `done` reaches `total`, showing `note`.

        Raises
        ------
        _DemoError
            `faults` tells one, or the deadline has passed.
        _Interrupted
            Ctrl-C.
        """
        # A bar that knows one step only moves to show that somebody waits.
        task = self.bar.add_task(title, total=total if total > 1 else None, note="")
        while (count := done()) < total:
            self._executor.spin_once(timeout_sec=0.05)
            self.bar.update(task, completed=count, note=note())
            if self._stop.is_set():
                raise _Interrupted
            if fault := faults():
                raise _DemoError(f"{title}: {fault}")
            if time.monotonic() > self._deadline:
                raise _DemoError(f"{title}: not done within {_DEADLINE_SECONDS:g} s of the start")
        self.bar.update(task, total=total, completed=total, note=note())


def _show(recording: _Recording, out: Path, console: Console) -> _Seen:
    """Run the cell on the recording."""
    seen = _Seen()
    remapping = ["--ros-args", "-r", f"{recording.topic.name}:=points"]
    with _private_domain(), ros_context(["cell_demo", *remapping]) as stop:
        player = BagPlayer(recording.bag, [recording.topic], stop)
        observer = _Observer(recording, seen)
        executor = SingleThreadedExecutor()
        executor.add_node(observer)
        steps = _Steps(console, executor, stop)
        options = ("--design", str(recording.design.path), "--output-folder", str(out))
        try:
            with _process("cell", *options, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as cell, steps.bar:
                _follow(cell, out / LOG_FILE, seen)
                _watch_the_scan(player, observer, steps, seen, cell)
        finally:
            stop.set()
            executor.shutdown()
            observer.destroy_node()
            player.destroy_node()
    return seen


def _watch_the_scan(
    player: BagPlayer, observer: _Observer, steps: _Steps, seen: _Seen, cell: subprocess.Popen[str]
) -> None:
    def ended() -> str:
        return f"the cell ended with exit status {cell.poll()}" if cell.poll() is not None else ""

    def faults() -> str:
        return ended() or seen.error

    def ready() -> str:
        return ", ".join(name for name in NODES if name in seen.ready)

    # Until a node is active, its diagnostics tell what keeps it.
    steps.until("start the nodes", lambda: len(seen.ready), len(NODES), ended, ready)
    steps.until("connect to the cell", lambda: observer.cell_listens, 1, faults, str)

    def play() -> None:
        try:
            player.play(rate=1.0)
        except Exception as error:
            seen.error = f"the bag cannot be played: {error}"

    playing = threading.Thread(target=play, name="bag player", daemon=True)
    playing.start()
    steps.until("play the bag", lambda: seen.points > 0 or seen.scan > 0, 1, faults, str)
    steps.until("check and thin the scan", lambda: seen.scan > 0, 1, faults, str)
    steps.until(
        "register it to the design",
        lambda: seen.inspection is not None and seen.displacement is not None,
        1,
        faults,
        lambda: _stages(seen.inspection),
    )
    steps.until(
        "redesign the part", lambda: seen.redesign is not None and seen.path == seen.redesign.path, 1, faults, str
    )
    playing.join()


def _stages(inspection: Inspection | None) -> str:
    if inspection is None:
        return ""
    return ", ".join(f"{n} {s:.2f} s" for n, s in zip(inspection.stage_names, inspection.stage_seconds, strict=True))


def _entries(value: Any) -> Any:
    """A message's fields by name, for JSON."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _entries(getattr(value, name)) for name in value.get_fields_and_field_types()}
    return value if isinstance(value, bool | int | float | str) else list(value)


def _tell(recording: _Recording, seen: _Seen, out: Path, console: Console) -> None:
    """Print the redesign, and what came of it."""
    inspection, redesign = seen.inspection, seen.redesign
    assert inspection is not None and redesign is not None and seen.displacement is not None
    found = displacement_from_message(seen.displacement)
    rms, largest = metres_to_millimetres([inspection.rms_displacement, inspection.max_displacement])  # type: ignore[arg-type]
    rows = [measured_row(found.displacement, found.supported, rms, largest, inspection.coverage)]

    lengths = {"measured on the scan": (float(rms), float(largest))}
    if recording.printer is not None:
        redesigned = load_design(redesign.path, redesign.unit)
        reprinted = recording.printer.print_part(redesigned.vertices)
        printed = recording.printer.print_part(recording.design.vertices)
        lengths["printed from the design (virtual printer)"] = distortion_left(recording.design, printed)
        lengths["printed from the redesign (virtual printer)"] = distortion_left(recording.design, reprinted)
        rows.append(reprint_row(recording.design, reprinted))
    stages = dict(zip(inspection.stage_names, inspection.stage_seconds, strict=True))
    # Without reliable delivery the scan may have reached the cell and not us.
    began, beginning = (seen.points, "scan message") if seen.points else (seen.scan, "checked scan")
    seconds = {
        **({"ingest": seen.scan - seen.points} if seen.points else {}),
        **{f"registration: {name}": duration for name, duration in stages.items()},
        "compensation": seen.redesigned - seen.inspected,
        f"last {beginning} to redesigned_mesh_path": seen.redesigned - began,
    }
    write_atomically(out / PICTURE_FILE, draw(recording.design, rows))
    entries = {
        "bag": str(recording.bag.path),
        "inspection": _entries(inspection),
        "redesigned_mesh": _entries(redesign),
        "distortion_mm": {name: {"rms": each[0], "largest": each[1]} for name, each in lengths.items()},
        "seconds": seconds,
    }
    write_atomically(out / REPORT_FILE, json_bytes(entries))

    distortion = Table("distortion", title="before and after", title_justify="left")
    distortion.add_column("RMS mm", justify="right")
    distortion.add_column("largest mm", justify="right")
    for name, pair in lengths.items():
        distortion.add_row(name, *(f"{length:.3f}" for length in pair))
    times = Table("stage", title="from the scan to the redesign", title_justify="left")
    times.add_column("seconds", justify="right")
    for name, duration in seconds.items():
        times.add_row(name, f"{duration:.2f}")

    console.print(distortion)
    console.print(times)
    for title, path in {
        "redesigned part": redesign.path,
        "report": out / REPORT_FILE,
        "picture": out / PICTURE_FILE,
        "log of the nodes": out / LOG_FILE,
    }.items():
        console.print(f"{title + ':':<18}{path}", soft_wrap=True, highlight=False)


def _arguments(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("cell_demo", description=__doc__, allow_abbrev=False)
    parser.add_argument(
        "--bag", type=Path, default=_BAG, metavar="DIR", help="bag with design.stl; default: %(default)s"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("demo_output"),
        metavar="DIR",
        help="folder for the results; default: %(default)s",
    )
    return parser.parse_args(argv[1:])


def main(argv: Sequence[str] = sys.argv) -> int:
    """Run the demonstration; the exit status."""
    arguments = _arguments(argv)
    console = Console()

    def body() -> int:
        recording = _read_recording(arguments.bag)
        out = arguments.out.absolute()
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputFolderError(
                f"cannot be made: {error.strerror}", str(out), "choose a writable folder"
            ) from error
        try:
            seen = _show(recording, out, console)
            _tell(recording, seen, out, console)
        except _DemoError as error:
            print(f"error: {error}; the nodes' log is {out / LOG_FILE}", file=sys.stderr)
            return FAULT
        except (_Interrupted, KeyboardInterrupt):
            print("interrupted", file=sys.stderr)
            return INTERRUPTED
        return DONE

    return exit_status(body)


if __name__ == "__main__":
    sys.exit(main())
