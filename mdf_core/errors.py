"""Every way in which an input can be wrong, each with a stable code.

The codes equal the constants of ``mdf_interfaces/msg/ErrorCode``; services and actions pass them on.
"""

from __future__ import annotations

from typing import ClassVar

LOOK_AT_THE_SCAN = (
    "check that the scan shows this part and nothing else (crop.box_mm), scan it from more sides, or give pose.initial"
)
"""Remedy where a scan and the design do not come together: the reason is nearly always one of these."""


class MdfError(Exception):
    """An input or a state that stops the work, told so that a user can mend it.

    Parameters
    ----------
    what : str
        What is wrong, with the offending value.
    where : str, optional
        The file, topic, field or setting at fault.
    remedy : str, optional
        What to do about it.
    """

    code: ClassVar[int] = 1
    name: ClassVar[str] = "INTERNAL"

    def __init__(self, what: str, where: str = "", remedy: str = "") -> None:
        self.what = what
        self.where = where
        self.remedy = remedy
        super().__init__("".join((f"{where}: " if where else "", what, f"; {remedy}" if remedy else "")))


class EmptyScanError(MdfError):
    """The scan has no points."""

    code = 101
    name = "EMPTY_SCAN"


class NonFiniteScanError(MdfError):
    """The scan has NaN or infinite coordinates."""

    code = 102
    name = "NON_FINITE_SCAN"


class TooFewPointsError(MdfError):
    """The scan has fewer points than a registration needs."""

    code = 103
    name = "TOO_FEW_POINTS"


class DegenerateScanError(MdfError):
    """The scan's points lie on one spot, one line or one plane."""

    code = 104
    name = "DEGENERATE_SCAN"


class CloudFormatError(MdfError):
    """A point cloud message whose fields, data types, strides or byte order cannot be read."""

    code = 105
    name = "CLOUD_FORMAT"


class ScanFileError(MdfError):
    """A scan file that is missing or cannot be read."""

    code = 106
    name = "SCAN_FILE"


class NoScanError(MdfError):
    """The latest scan was asked for and there is none yet."""

    code = 107
    name = "NO_SCAN"


class DesignFileError(MdfError):
    """A design file that is missing or cannot be read."""

    code = 201
    name = "DESIGN_FILE"


class DegenerateDesignError(MdfError):
    """A design without triangles, or without one that has an area."""

    code = 202
    name = "DEGENERATE_DESIGN"


class DesignMismatchError(MdfError):
    """A displacement that belongs to another design."""

    code = 203
    name = "DESIGN_MISMATCH"


class NoDesignError(MdfError):
    """No design is set."""

    code = 204
    name = "NO_DESIGN"


class UnitMismatchError(MdfError):
    """The scan's size differs from the design's by a factor; the message names it."""

    code = 301
    name = "UNIT_MISMATCH"


class UnknownMethodError(MdfError):
    """A registration method that does not exist."""

    code = 302
    name = "UNKNOWN_METHOD"


class RegistrationFailedError(MdfError):
    """No registration explains the scan."""

    code = 303
    name = "REGISTRATION_FAILED"


class CancelledError(MdfError):
    """The caller cancelled the work."""

    code = 304
    name = "CANCELLED"


class MemoryBudgetError(MdfError):
    """An inspection would need more memory than `memory_mib`."""

    code = 305
    name = "MEMORY_BUDGET"


class JobTimeoutError(MdfError):
    """A registration took longer than `job_timeout`, or the next view of a scan than `view_timeout`."""

    code = 306
    name = "TIMEOUT"


class NoInspectionError(MdfError):
    """A redesign was asked for and nothing has been inspected yet."""

    code = 401
    name = "NO_INSPECTION"


class CompensationRefusedError(MdfError):
    """The inspection does not carry a redesign."""

    code = 402
    name = "COMPENSATION_REFUSED"


class ReleaseRefusedError(MdfError):
    """A redesign that fails a check is not released; the message names check and place."""

    code = 403
    name = "RELEASE_REFUSED"


class CycleStateError(MdfError):
    """A step that the cycle's state does not allow, or a proposal that another release has overtaken."""

    code = 404
    name = "CYCLE_STATE"


class WorseReprintError(MdfError):
    """A print of the redesign is no better than what was printed before, or was not made from it."""

    code = 405
    name = "WORSE_REPRINT"


class OutputFolderError(MdfError):
    """The output folder cannot be written."""

    code = 501
    name = "OUTPUT_FOLDER"


class BagFileError(MdfError):
    """A bag that is missing or cannot be read."""

    code = 502
    name = "BAG_FILE"


class BagTopicError(MdfError):
    """A bag without the topic that was asked for."""

    code = 503
    name = "BAG_TOPIC"


class StorageFullError(MdfError):
    """The disk has less free space than `disk_floor_mib`, or none: nothing more is accepted."""

    code = 504
    name = "STORAGE_FULL"


class StorageError(MdfError):
    """The journal of accepted scans cannot be read or written."""

    code = 505
    name = "STORAGE"


class PathNotAllowedError(MdfError):
    """A request names a path outside `request_folders`."""

    code = 506
    name = "PATH_NOT_ALLOWED"


class LedgerError(MdfError):
    """The ledger's database cannot be read or written."""

    code = 507
    name = "LEDGER"


class InvalidSettingError(MdfError):
    """An unknown setting, or a value outside its range."""

    code = 601
    name = "INVALID_SETTING"


class NotActiveError(MdfError):
    """The node is not active, or is shutting down."""

    code = 701
    name = "NOT_ACTIVE"


class QueueFullError(MdfError):
    """Too many jobs are waiting."""

    code = 702
    name = "QUEUE_FULL"
