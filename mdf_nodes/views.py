"""Several views of one part, and the poses that bring them into one frame."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import TransformStamped
from std_msgs.msg import Header

from mdf_core.errors import CloudFormatError, MemoryBudgetError
from mdf_core.geometry import Array, PointSet
from mdf_core.rigid import rotate, transform
from mdf_nodes.conversions import transform_from_message

_MOST_POSES = 1000


@dataclass(frozen=True, eq=False)
class View:
    """What the scanner sees from one side."""

    scan: PointSet
    header: Header


class ViewPoses:
    """The latest poses of views, as they come: `child_frame_id` is the view's frame, the header's that of the scan.

    A pose holds for the view with its stamp. One with stamp 0 is of a frame that does not move, as on /tf_static: it
    holds for every view there, until another one comes.
    """

    def __init__(self) -> None:
        self._latest: deque[TransformStamped] = deque(maxlen=_MOST_POSES)
        self._static: dict[tuple[str, str], TransformStamped] = {}

    def add(self, pose: TransformStamped) -> None:
        """Keep one pose; of a thousand with a stamp the oldest is forgotten."""
        if pose.header.stamp.sec == pose.header.stamp.nanosec == 0:
            self._static[pose.header.frame_id, pose.child_frame_id] = pose
        else:
            self._latest.append(pose)

    def find(self, view: Header, frame_id: str) -> TransformStamped | None:
        """The pose that brings a view into `frame_id`."""
        for pose in reversed(tuple(self._latest)):
            is_between = (pose.header.frame_id, pose.child_frame_id) == (frame_id, view.frame_id)
            if is_between and pose.header.stamp == view.stamp:
                return pose
        return self._static.get((frame_id, view.frame_id))


class Views:
    """The views of one scan.

    One view too many spoils the scan: neither the others nor those to come show the whole part. None of them is kept,
    and the scan has to be begun anew.

    Parameters
    ----------
    frame_id : str
        Of the scan; empty: that of the first view.
    poses : ViewPoses
        Of views in other frames.
    most_bytes : int
        Of all points together.
    """

    def __init__(self, frame_id: str, poses: ViewPoses, most_bytes: float) -> None:
        self._frame_id = frame_id
        self._poses = poses
        self._most_bytes = most_bytes
        self._views: list[View] = []
        self._began = self._last = time.monotonic()
        self._error: MemoryBudgetError | None = None

    def __len__(self) -> int:
        return len(self._views)

    def add(self, view: View) -> None:
        """Keep one view.

        Raises
        ------
        MemoryBudgetError
            This view, or one before, is more than the views may hold.
        """
        self.require_whole()
        held = sum(each.scan.points.nbytes for each in (*self._views, view))
        if held > self._most_bytes:
            self._error = MemoryBudgetError(
                f"{len(self) + 1} views hold {held / 2**20:.2f} MiB, more than {self._most_bytes / 2**20:.2f} MiB",
                "begin_scan",
                "begin the scan anew with fewer views, or raise memory_mib before",
            )
            self._views.clear()
            raise self._error
        self._views.append(view)
        self._last = time.monotonic()

    @property
    def seconds_open(self) -> float:
        """Since the beginning."""
        return time.monotonic() - self._began

    @property
    def seconds_waited(self) -> float:
        """Since the last view that was kept; without one since the beginning."""
        return time.monotonic() - self._last

    @property
    def is_whole(self) -> bool:
        """Whether every view that has come is kept."""
        return self._error is None

    def require_whole(self) -> None:
        """Refuse a scan of which one view too many has come.

        Raises
        ------
        MemoryBudgetError
        """
        if self._error is not None:
            raise self._error

    @property
    def _frame(self) -> str:
        return self._frame_id or self._views[0].header.frame_id

    def has_all_poses(self) -> bool:
        """Whether every view can be brought into the frame of the scan."""
        return all(self._in_frame(view) or self._poses.find(view.header, self._frame) for view in self._views)

    def _in_frame(self, view: View) -> bool:
        return bool(view.header.frame_id == self._frame)

    def merged(self) -> View:
        """One scan in one frame, with the stamp of the last view.

        Where views overlap their points are closer together, so the areas they bring hold no more.

        Raises
        ------
        CloudFormatError
            A view in another frame, without a pose.
        """
        scans = [self._placed(view) for view in self._views]
        points = np.concatenate([scan.points for scan in scans])
        areas = scans[0].areas if len(scans) == 1 else None
        header = Header(stamp=self._views[-1].header.stamp, frame_id=self._frame)
        return View(PointSet(points, _all_or_none([scan.normals for scan in scans]), areas), header)

    def _placed(self, view: View) -> PointSet:
        if self._in_frame(view):
            return view.scan
        pose, stamp = self._poses.find(view.header, self._frame), view.header.stamp
        if pose is None:
            raise CloudFormatError(
                f"a view in frame {view.header.frame_id!r} at {stamp.sec}.{stamp.nanosec:09d}, the scan is in "
                f"{self._frame!r}, and no pose tells how they lie",
                "finish_scan",
                "publish view_pose with the stamp of the view or 0, and call finish_scan again; or begin_scan anew",
            )
        motion, scan = transform_from_message(pose.transform), view.scan
        normals = None if scan.normals is None else rotate(motion, scan.normals)
        return PointSet(transform(motion, scan.points), normals, scan.areas)


def _all_or_none(normals: Sequence[Array | None]) -> Array | None:
    known = [each for each in normals if each is not None]
    return np.concatenate(known) if len(known) == len(normals) else None
