"""The node scan_ingest: scans from drivers, files and callers, checked and thinned, become the cell's `scan`."""

from __future__ import annotations

import os
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TransformStamped
from mdf_interfaces.srv import BeginScan, FinishScan, IngestScan
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from mdf_core.errors import (
    JobTimeoutError,
    MdfError,
    NoScanError,
    NotActiveError,
    OutputFolderError,
    QueueFullError,
    ScanFileError,
    StorageError,
    StorageFullError,
)
from mdf_core.files import write_atomically
from mdf_core.geometry import PointSet
from mdf_core.mesh_io import SCAN_FILE_TYPES, load_scan
from mdf_core.sampling import prepare
from mdf_core.units import UNITS, millimetres_per
from mdf_nodes.conversions import describe, scan_from_message, scan_message
from mdf_nodes.jobs import Job
from mdf_nodes.journal import Journal, declare_journal, open_journal
from mdf_nodes.managed_node import ManagedNode, run_managed_node
from mdf_nodes.parameters import (
    declare,
    declare_choice,
    declare_request_folders,
    declare_settings,
    require_allowed,
    settings_from,
)
from mdf_nodes.qos import POSES, SCAN, SENSOR, subscription_profile
from mdf_nodes.views import View, ViewPoses, Views
from mdf_nodes.writers import is_being_written

_POLL_SECONDS, _RETRY_SECONDS = 0.5, 10.0
_MATCH_SECONDS = 0.2
_MOST_ARRIVALS = 10_000  # that are counted
_VIEWS_SHARE = 0.25  # of memory_mib
_VIEWS_SECONDS = 5.0  # that views and poses are waited for: they and the request to finish come on different ways

FileState = tuple[int, int]
"""Size and time of the last change: a file that keeps both from one poll to the next, and that nobody writes any
more, is complete."""


class ScanIngest(ManagedNode):
    """Subscribes `points`, watches a folder, serves `ingest_scan`; publishes `scan`.

    Between `begin_scan` and `finish_scan` the clouds on `points` are views of one scan.
    """

    def __init__(self) -> None:
        super().__init__("scan_ingest")
        declare_choice(self, "scan_unit", "mm", "Unit of scan files", UNITS)
        declare(self, "scan_frame", "scanner", "Frame of scans that come from files")
        declare(
            self,
            "watch_folder",
            "",
            "Scan files that appear here are published and moved to done/ or failed/; empty: none is watched",
        )
        declare(
            self,
            "view_timeout",
            300.0,
            "Longest time without a further view, after which a scan that was begun is given up; 0: never",
            unit="s",
            minimum=0.0,
            maximum=1e6,
        )
        declare_request_folders(self)
        declare_journal(self)
        declare_settings(self)
        self._journal: Journal | None = None
        self._scan = self.create_lifecycle_publisher(PointCloud2, "scan", SCAN)
        self._points_topic = self.resolve_topic_name("points")
        self._cloud_node = self.inner_node("clouds")
        self._points_profile = _profile_for([])
        self._points = self._subscribe_points()
        self.serve(IngestScan, "ingest_scan", self._on_ingest_scan)
        self.serve(BeginScan, "begin_scan", self._on_begin_scan)
        self.serve(FinishScan, "finish_scan", self._on_finish_scan)
        self._views: Views | None = None  # None: every cloud is a scan
        self._view_poses = ViewPoses()
        self._view_came = threading.Condition()
        self.create_subscription(
            TransformStamped, "view_pose", self._on_view_pose, POSES, callback_group=MutuallyExclusiveCallbackGroup()
        )
        self._folder_due = 0.0  # when a watched folder that cannot be read is looked at again
        self._folder_lock = threading.Lock()  # of the next three
        self._seen: dict[Path, FileState] = {}
        self._taken: dict[Path, FileState] = {}
        self._retries: dict[Path, float] = {}  # when files that found no place on the disk are taken again
        self._last_scan = float("nan")
        self._arrivals: deque[float] = deque(maxlen=_MOST_ARRIVALS)
        self._clouds = self._clouds_lost = self._clouds_refused = 0
        self.create_steady_timer(_MATCH_SECONDS, self._match_publishers)
        self.create_steady_timer(_POLL_SECONDS, self._poll_folder)
        self.create_steady_timer(_POLL_SECONDS, self._give_up_views)

    def configure(self) -> None:
        """Check unit and folder, and open the journal."""
        millimetres_per(self.get_parameter("scan_unit").value)
        folder = self.get_parameter("watch_folder").value
        if folder and not Path(folder).is_dir():
            raise ScanFileError("is no folder", f"watch_folder {folder}", "create it, or name another one")
        self.close()
        self._journal = open_journal(self) if self.get_parameter("state_folder").value else None

    def close(self) -> None:
        """Close the journal."""
        journal, self._journal = self._journal, None
        if journal is not None:
            journal.close()

    def deactivate(self) -> None:
        """Drop the views of a scan that was not finished; files that were not reached are taken again."""
        self._views = None
        with self._folder_lock:
            self._taken.clear()

    def diagnostics(self) -> dict[str, object]:
        """When the last scan was published, what came of the driver's clouds, and which views are being collected."""
        since, views = time.monotonic() - 60.0, self._views
        return {
            "clouds received": self._clouds,
            "clouds received in the last minute": sum(arrival > since for arrival in tuple(self._arrivals)),
            "clouds lost on the way": self._clouds_lost,
            "clouds refused": self._clouds_refused,
            "seconds since the last scan": round(time.monotonic() - self._last_scan, 1),
            "views": _state_of(views),
            "seconds since begin_scan": round(float("nan") if views is None else views.seconds_open, 1),
        }

    def _ingest(self, job: Job[Any], read: Callable[[], PointSet], header: Header, source: str, key: str = "") -> int:
        """Read, prepare and publish; the number of points.

        `key` tells a file from every other, so that one which was taken before a crash is not taken again.
        """
        began, journal = time.monotonic(), self._journal
        raw = read()
        settings = settings_from(self)
        scan = prepare(raw, settings)
        job.finish()
        message = scan_message(scan, header)
        # On disk first: whatever ends this process or registration's, the scan is registered.
        if journal is None or journal.hand_over(key or f"{source} {uuid.uuid4()}", message):
            self._scan.publish(message)
        self._last_scan = time.monotonic()
        seconds = self._last_scan - began
        self.job_done(f"scan from {source}: {len(raw)} points, {len(scan)} published, {seconds:.2f} s")
        return len(scan)

    def _file_header(self) -> Header:
        return Header(stamp=self.get_clock().now().to_msg(), frame_id=self.get_parameter("scan_frame").value)

    # Topic

    def _on_points(self, message: PointCloud2) -> None:
        self._clouds += 1
        self._arrivals.append(time.monotonic())
        if not self.is_active:
            self._clouds_refused += 1
            return

        def on_error(error: Exception) -> None:
            self._clouds_refused += 1
            self.report(error)

        def work(job: Job[None]) -> None:
            if self._views is None:
                self._ingest(job, lambda: scan_from_message(message), message.header, self._points_topic)
            else:
                self._collect(self._views, message)

        job = Job(work, on_error=on_error)
        try:
            self.require_active().submit(job)
        except MdfError as error:
            job.answer(error=error)

    def _on_clouds_lost(self, lost: QoSMessageLostInfo) -> None:
        self._clouds_lost += lost.total_count_change

    def _subscribe_points(self) -> Subscription:
        return self._cloud_node.create_subscription(
            PointCloud2,
            self._points_topic,
            self._on_points,
            self._points_profile,
            # A mismatch is mended, not warned of.
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_clouds_lost, use_default_callbacks=False),
        )

    def _match_publishers(self) -> None:
        """Ask for what all publishers offer; best effort only if need be: it loses most clouds of tens of MB."""
        publishers = self._cloud_node.get_publishers_info_by_topic(self._points_topic)
        profile = _profile_for([each.qos_profile for each in publishers])
        if profile.reliability != self._points_profile.reliability:
            self._cloud_node.destroy_subscription(self._points)
            self._points_profile = profile
            self._points = self._subscribe_points()

    # Service

    def _on_ingest_scan(self, request: IngestScan.Request, response: IngestScan.Response) -> IngestScan.Response:
        path, unit = request.path, request.unit or self.get_parameter("scan_unit").value
        with self.error_boundary(response):
            require_allowed(self, path)
            response.points = self.run_job(
                lambda job: self._ingest(job, lambda: load_scan(path, unit), self._file_header(), path)
            )
        return response

    # Several views. Begin, views and finish are jobs like others, so they keep their order.

    def _on_begin_scan(self, request: BeginScan.Request, response: BeginScan.Response) -> BeginScan.Response:
        def begin(_: Job[Any]) -> None:
            if self._views:
                self.get_logger().warning(f"begin_scan: {len(self._views)} views that were not finished are dropped")
            most_bytes = _VIEWS_SHARE * settings_from(self).memory_mib * 2**20
            self._views = Views(request.frame_id, self._view_poses, most_bytes)

        with self.error_boundary(response):
            self.run_job(begin)
        return response

    def _on_view_pose(self, message: TransformStamped) -> None:
        with self._view_came:
            self._view_poses.add(message)
            self._view_came.notify_all()

    def _collect(self, views: Views, message: PointCloud2) -> None:
        view = View(scan_from_message(message), message.header)
        with self._view_came:
            try:
                views.add(view)
            finally:
                self._view_came.notify_all()

    def _on_finish_scan(self, request: FinishScan.Request, response: FinishScan.Response) -> FinishScan.Response:
        with self.error_boundary(response):
            self._wait_for_views(request.views)
            response.views, response.points = self.run_job(lambda job: self._finish(job, request.views))
        return response

    def _wait_for_views(self, count: int) -> None:
        deadline = time.monotonic() + _VIEWS_SECONDS
        with self._view_came:
            # A stop of the node is noticed soon, though nobody tells of it here.
            while self.is_active and (views := self._views) is not None:
                if not views.is_whole or (len(views) >= count and views.has_all_poses()):
                    return
                left = deadline - time.monotonic()
                if left < 0:
                    return
                self._view_came.wait(min(_POLL_SECONDS, left))

    def _finish(self, job: Job[Any], expected: int) -> tuple[int, int]:
        views = self._views
        if views is None:
            raise NoScanError(
                "no scan has been begun, or it was given up (view_timeout)",
                "finish_scan",
                "call begin_scan before the views",
            )
        views.require_whole()
        if len(views) < max(expected, 1):
            raise NoScanError(
                f"{len(views)} views have come, {max(expected, 1)} are expected",
                self._points_topic,
                "publish them reliably, and call finish_scan again",
            )
        merged = views.merged()
        points = self._ingest(job, lambda: merged.scan, merged.header, f"{len(views)} views")
        self._views = None
        return len(views), points

    def _give_up_views(self) -> None:
        """End a scan whose client has gone: nobody else would, and every further cloud would be a view of it."""
        jobs, views, limit = self._jobs, self._views, self.get_parameter("view_timeout").value
        if jobs is None or views is None or not 0.0 < limit < views.seconds_waited:
            return

        def give_up(_: Job[None]) -> None:
            if self._views is views and limit < views.seconds_waited:
                self._views = None
                raise JobTimeoutError(
                    f"no view for more than {limit:g} s: the {len(views)} that have come are dropped, "
                    "from now on each cloud is a scan",
                    "begin_scan",
                    "begin the scan anew and call finish_scan after its last view, or raise view_timeout",
                )

        if len(jobs) == 0:  # else a view may be among them, or this
            with suppress(NotActiveError, QueueFullError):  # the next look gives up
                jobs.submit(Job(give_up, on_error=self.report))

    # Watched folder

    def _poll_folder(self) -> None:
        folder = self.get_parameter("watch_folder").value
        if not folder or not self.is_active or time.monotonic() < self._folder_due:
            return
        with self.error_boundary(), self._folder_lock:
            # Only tells of a folder that cannot be read so often.
            self._folder_due = time.monotonic() + _RETRY_SECONDS
            before, self._seen = self._seen, _scan_files(Path(folder))
            self._folder_due = 0.0
            for path in [path for path, due in self._retries.items() if time.monotonic() > due]:
                del self._retries[path]
                self._taken.pop(path, None)
            self._taken = {path: state for path, state in self._taken.items() if path in self._seen}
            for path, state in self._seen.items():
                is_new = before.get(path) == state and self._taken.get(path) != state
                if is_new and not is_being_written(path):
                    try:
                        self._take(path, state)
                    except QueueFullError:
                        return  # it stays where it is until there is room

    def _take(self, path: Path, state: FileState) -> None:
        unit = self.get_parameter("scan_unit").value

        # Whatever lies there instead of the file that was taken has a turn of its own, and is not moved in this one.
        def work(job: Job[None]) -> None:
            status = _status_if(path, state)
            if status is None:
                return
            key = f"{path} {status.st_ino} {status.st_ctime_ns}"
            self._ingest(job, lambda: load_scan(path, unit), self._file_header(), str(path), key)
            if _status_if(path, state):
                _move(path, _destination(path, "done"))

        def on_error(error: Exception) -> None:
            reported = self.report(error)
            # What stops the node, and a disk that is full, say nothing about the file.
            if isinstance(reported, StorageError | StorageFullError):
                with self._folder_lock:
                    self._retries[path] = time.monotonic() + _RETRY_SECONDS
            elif self.is_active and _status_if(path, state):
                with self.error_boundary():
                    target = _destination(path, "failed")
                    # The reason first: whatever ends the process, no file lies there without.
                    write_atomically(_reason_for(target), f"{describe(reported)}\n".encode())
                    _move(path, target)

        self._taken[path] = state
        try:
            self.require_active().submit(Job(work, on_error=on_error))
        except MdfError:
            del self._taken[path]
            raise


def _state_of(views: Views | None) -> str:
    if views is None:
        return "each a scan"
    return str(len(views)) if views.is_whole else "too many"


def _profile_for(offered: Sequence[QoSProfile]) -> QoSProfile:
    profile = subscription_profile(offered, SENSOR.depth)
    # A latched cloud would come again with every change of the subscription.
    profile.durability = DurabilityPolicy.VOLATILE
    return profile


def _scan_files(folder: Path) -> dict[Path, FileState]:
    """The scan files in `folder`, oldest first."""
    found = {}
    try:
        for path in folder.iterdir():
            with suppress(FileNotFoundError):  # moved meanwhile
                if _is_scan_file(path):
                    found[path] = path.stat()
    except OSError as error:
        raise ScanFileError(
            f"cannot be read: {error.strerror}", f"watch_folder {folder}", "restore the folder"
        ) from None
    in_order = sorted(found.items(), key=lambda item: (item[1].st_mtime_ns, item[0]))
    return {path: _file_state(status) for path, status in in_order}


def _file_state(status: os.stat_result) -> FileState:
    return status.st_size, status.st_mtime_ns


def _status_if(path: Path, state: FileState) -> os.stat_result | None:
    """None: the file in this state has been taken away, replaced or changed."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status if _file_state(status) == state else None


def _is_scan_file(path: Path) -> bool:
    return not path.name.startswith(".") and path.suffix.lower() in SCAN_FILE_TYPES and path.is_file()


def _destination(path: Path, where: str) -> Path:
    """A free name for a file in the folder `where` beside it, which is made if it is missing."""
    folder = path.parent / where
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise _cannot_move(path, folder, error) from None
    target, number = folder / path.name, 1
    while target.exists() or _reason_for(target).exists():
        number += 1
        target = folder / f"{path.stem}-{number}{path.suffix}"
    return target


def _reason_for(target: Path) -> Path:
    """Beside a file that failed."""
    return target.with_name(f"{target.name}.txt")


def _move(path: Path, target: Path) -> None:
    try:
        path.rename(target)
    except OSError as error:
        raise _cannot_move(path, target.parent, error) from None


def _cannot_move(path: Path, folder: Path, error: OSError) -> OutputFolderError:
    return OutputFolderError(f"cannot move {path.name}: {error.strerror}", str(folder), "make the folder writable")


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit status."""
    return run_managed_node(ScanIngest, "Publish checked and thinned scans from drivers, files and callers.", args)


if __name__ == "__main__":
    raise SystemExit(main())
