"""Poses as the settings take them."""

from scipy.spatial.transform import Rotation

IN_PLACE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def pose_numbers(pose):
    """`pose` (4, 4) as x y z qx qy qz qw, for ``pose.initial``."""
    return tuple(float(n) for n in (*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()))
