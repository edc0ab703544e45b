"""The only place between ROS messages (metres) and the types of the core (mm)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import Quaternion, Transform, Vector3
from mdf_interfaces.action import RegisterScan
from mdf_interfaces.msg import Cycle as CycleMessage
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.msg import RedesignedMesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

import mdf_core
from mdf_core.errors import CloudFormatError, MdfError
from mdf_core.geometry import Array, Design, PointSet
from mdf_core.inspection import Inspection, Verdict
from mdf_core.point_cloud2 import columns_of_scan, pack_cloud, scan_from_cloud, unpack_cloud
from mdf_core.progress import Progress
from mdf_core.rigid import homogeneous
from mdf_core.units import metres_to_millimetres, millimetres_to_metres

if TYPE_CHECKING:  # the database is of no use to a node that only converts
    from mdf_core.cycles import Checked
    from mdf_core.ledger_entries import Cycle

_POSITION = ("x", "y", "z")
_DISPLACEMENT = ("dx", "dy", "dz")
_INVERSE = ("ux", "uy", "uz")
_VERDICTS = {
    Verdict.NO_DECISION: InspectionMessage.NO_DECISION,
    Verdict.PASS: InspectionMessage.PASS,
    Verdict.FAIL: InspectionMessage.FAIL,
}


def _metres(length: float) -> float:
    return float(millimetres_to_metres(np.asarray(length)))


def cloud_message(columns: Mapping[str, NDArray[np.generic]], header: Header) -> PointCloud2:
    """A cloud with one field per column."""
    packed = pack_cloud(columns)
    fields = [
        PointField(name=name, offset=offset, datatype=datatype, count=count)
        for name, offset, datatype, count in packed.fields
    ]
    message = PointCloud2(header=header, height=1, width=packed.width, fields=fields, is_dense=True)
    message.point_step = packed.point_step
    message.row_step = packed.width * packed.point_step
    # An array.array is taken over as it is; a NumPy array would be copied byte by byte, seconds for a large cloud.
    message.data = packed.data
    return message


def scan_message(scan: PointSet, header: Header) -> PointCloud2:
    """A scan: x y z, and normal_x normal_y normal_z, area where it has them."""
    return cloud_message(columns_of_scan(scan), header)


def scan_from_message(message: PointCloud2) -> PointSet:
    """A scan, see `mdf_core.point_cloud2.scan_from_cloud`."""
    return scan_from_cloud(message)


def displacement_message(inspection: Inspection, header: Header) -> PointCloud2:
    """The displacement, one point per design vertex, in their order.

    Metres: x y z the vertex's nominal position, dx dy dz the displacement, ux uy uz the inverse displacement (of the
    material now found at the nominal position, which is what the spatial redesign looks up), std; supported 0 or 1.
    """
    columns = _columns(_POSITION, inspection.design.vertices, np.float32)
    columns |= _columns(_DISPLACEMENT, inspection.displacement, np.float64)
    columns |= _columns(_INVERSE, inspection.inverse_displacement, np.float64)
    columns["std"] = millimetres_to_metres(inspection.std)
    columns["supported"] = inspection.supported.astype(np.uint8)
    return cloud_message(columns, header)


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """What a redesign needs of an inspection, in mm: see `mdf_core.inspection.Inspection`."""

    displacement: Array
    inverse_displacement: Array
    std: Array
    supported: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.displacement)


def displacement_from_message(message: PointCloud2) -> DisplacementField:
    """The displacement from the cloud of `displacement_message`.

    Raises
    ------
    CloudFormatError
        A field is missing, or the cloud cannot be read.
    """
    columns = unpack_cloud(message)
    missing = [name for name in (*_DISPLACEMENT, *_INVERSE, "std", "supported") if name not in columns]
    if missing:
        raise CloudFormatError(
            f"no field {', '.join(missing)}", "displacement cloud", "send the cloud that registration publishes"
        )
    return DisplacementField(
        metres_to_millimetres(np.column_stack([columns[name] for name in _DISPLACEMENT])),
        metres_to_millimetres(np.column_stack([columns[name] for name in _INVERSE])),
        metres_to_millimetres(columns["std"]),
        columns["supported"] != 0,
    )


def deviation_message(inspection: Inspection, header: Header) -> PointCloud2:
    """The registered scan for viewers: x y z, deviation (m, positive outside the material), outlier 0 or 1."""
    deviation = inspection.deviation
    columns = _columns(_POSITION, deviation.points, np.float32)
    columns["deviation"] = millimetres_to_metres(deviation.signed_distance).astype(np.float32)
    columns["outlier"] = deviation.is_outlier.astype(np.uint8)
    return cloud_message(columns, header)


def _columns(names: tuple[str, ...], vectors: Array, dtype: type) -> dict[str, NDArray[np.generic]]:
    return dict(zip(names, millimetres_to_metres(vectors).astype(dtype).T, strict=True))


def inspection_message(
    inspection: Inspection, header: Header, job_id: str, part_id: str, is_simulated: bool
) -> InspectionMessage:
    """The scalars of an inspection."""
    verdict, reasons = inspection.verdict
    judged = inspection.region_verdicts
    return InspectionMessage(
        header=header,
        job_id=job_id,
        part_id=part_id,
        method=inspection.settings.method,
        verdict=_VERDICTS[verdict],
        reasons=list(reasons),
        tolerance=_metres(inspection.settings.verdict.tolerance_mm),
        rms_displacement=_metres(inspection.rms_displacement),
        p95_displacement=_metres(inspection.p95_displacement),
        max_displacement=_metres(inspection.max_displacement),
        rms_deviation=_metres(inspection.deviation.rms),
        p95_deviation=_metres(inspection.deviation.p95),
        max_deviation=_metres(inspection.deviation.max),
        coverage=inspection.coverage,
        residual_scale=_metres(inspection.residual_scale),
        outlier_share=inspection.outlier_share,
        pose_ambiguous=bool(inspection.pose_ambiguous),
        pose=transform_message(inspection.pose),
        points=len(inspection.deviation.points),
        iterations=int(inspection.iterations),
        stop_reason=inspection.stop_reason,
        stage_names=list(inspection.stage_seconds),
        stage_seconds=[float(seconds) for seconds in inspection.stage_seconds.values()],
        design_path=inspection.design.path,
        design_sha256=inspection.design.file_sha256,
        scan_sha256=inspection.scan_sha256,
        settings_hash=inspection.settings.sha256(),
        software_version=mdf_core.__version__,
        is_simulated=is_simulated,
        profile=_metres(inspection.deviation.profile),
        regions=[region.name for region in judged],
        region_verdicts=[_VERDICTS[region.verdict] for region in judged],
        region_tolerances=[_metres(region.tolerance) for region in judged],
        region_max_displacements=[_metres(region.max_displacement) for region in judged],
        region_coverages=[region.coverage for region in judged],
    )


def describe(error: MdfError) -> str:
    """Name, code and message in one line."""
    return f"{error.name} ({error.code}): {error}"


def refusal_message(
    error: MdfError, header: Header, job_id: str, part_id: str, method: str, is_simulated: bool
) -> InspectionMessage:
    """The answer to a scan that could not be inspected."""
    return InspectionMessage(
        header=header,
        job_id=job_id,
        part_id=part_id,
        method=method,
        verdict=InspectionMessage.NO_DECISION,
        reasons=[describe(error)],
        software_version=mdf_core.__version__,
        is_simulated=is_simulated,
        error_code=error.code,
        error_msg=str(error),
    )


def feedback_message(progress: Progress) -> RegisterScan.Feedback:
    """Where a registration is."""
    return RegisterScan.Feedback(
        stage=progress.stage,
        progress=float(progress.fraction),
        iteration=progress.iteration,
        sigma=_metres(progress.sigma_mm),
    )


def redesigned_mesh_message(checked: Checked, cycle: Cycle, inspection: InspectionMessage) -> RedesignedMesh:
    """A redesign that has been saved and is in the ledger; `inspection` is the last that it was made from."""
    redesign = checked.redesign
    return RedesignedMesh(
        header=inspection.header,
        job_id=inspection.job_id,
        part_id=inspection.part_id,
        path=cycle.stl_path,
        unit="mm",
        sha256=cycle.stl_sha256,
        design_sha256=cycle.design_sha256,
        gain=cycle.gain,
        lookup=cycle.lookup,
        max_move=_metres(redesign.max_move),
        compensated_vertices=int(redesign.compensated.sum()),
        cycle_id=cycle.id,
        cycle=cycle.number,
        state=cycle.state.value,
        prints=redesign.prints.count,
        predicted_residual=_metres(redesign.predicted_residual),
        checks=[check.name for check in checked.checks],
        findings=[check.finding for check in checked.checks],
    )


def cycle_message(cycle: Cycle, header: Header) -> CycleMessage:
    """A redesign as the ledger has it."""
    return CycleMessage(
        header=header,
        cycle_id=cycle.id,
        part_id=cycle.part_id,
        number=cycle.number,
        state=cycle.state.value,
        path=cycle.stl_path,
        sha256=cycle.stl_sha256,
        gain=cycle.gain,
        residual_before=_metres(cycle.residual_before_mm),
        predicted_residual=_metres_or_nan(cycle.predicted_residual_mm),
        measured_residual=_metres_or_nan(cycle.measured_residual_mm),
        decided_by=cycle.decided_by,
        reason=cycle.reason,
    )


def design_cycle_message(design: Design, part_id: str, header: Header) -> CycleMessage:
    """The design itself, where no redesign is printed."""
    nan = float("nan")
    return CycleMessage(
        header=header,
        part_id=part_id,
        path=design.path,
        sha256=design.file_sha256,
        residual_before=nan,
        predicted_residual=nan,
        measured_residual=nan,
    )


def _metres_or_nan(millimetres: float | None) -> float:
    return float("nan") if millimetres is None else _metres(millimetres)


def marker_message(path: Path, header: Header) -> Marker:
    """An STL file in mm for viewers, whose unit is the metre."""
    marker = Marker(header=header, ns="redesign", type=Marker.MESH_RESOURCE, action=Marker.ADD)
    marker.mesh_resource = path.as_uri()
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = marker.scale.z = _metres(1.0)
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = 0.4, 0.7, 1.0, 0.8
    return marker


def transform_message(motion: Array) -> Transform:
    """A rigid motion (4, 4), mm, as a message."""
    x, y, z = (float(value) for value in millimetres_to_metres(motion[:3, 3]))
    qx, qy, qz, qw = (float(value) for value in Rotation.from_matrix(motion[:3, :3]).as_quat())
    return Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def transform_from_message(message: Transform) -> Array:
    """A rigid motion (4, 4), mm, from a message.

    Raises
    ------
    CloudFormatError
        No rotation, or numbers that are not finite.
    """
    rotation, shift = message.rotation, message.translation
    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    metres = np.array([shift.x, shift.y, shift.z])
    if not (np.isfinite(metres).all() and 0.0 < np.linalg.norm(quaternion) < np.inf):
        raise CloudFormatError("a rotation of length 0 or numbers that are not finite", "pose", "send a rigid motion")
    return homogeneous(Rotation.from_quat(quaternion).as_matrix(), metres_to_millimetres(metres))
