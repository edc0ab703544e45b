"""The table of cycles."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Make it."""
    op.create_table(
        "cycles",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("fingerprint", sa.String(64), nullable=False),
        sa.Column("part_id", sa.Text(), nullable=False),
        sa.Column("design_sha256", sa.String(64), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("previous", sa.Integer(), sa.ForeignKey("cycles.id", name="previous_cycle"), nullable=True),
        sa.Column("gain", sa.Double(), nullable=False),
        sa.Column("lookup", sa.Text(), nullable=False),
        sa.Column("state", sa.Text(), nullable=False),
        sa.Column("stl_path", sa.Text(), nullable=False),
        sa.Column("stl_sha256", sa.String(64), nullable=False),
        sa.Column("inputs", sa.JSON(), nullable=False),
        sa.Column("reprints", sa.JSON(), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("settings_sha256", sa.String(64), nullable=False),
        sa.Column("software_version", sa.Text(), nullable=False),
        sa.Column("checks", sa.JSON(), nullable=False),
        sa.Column("residual_before_mm", sa.Double(), nullable=False),
        sa.Column("predicted_residual_mm", sa.Double(), nullable=True),
        sa.Column("distortion_over_move", sa.Double(), nullable=True),
        sa.Column("measured_residual_mm", sa.Double(), nullable=True),
        sa.Column("measured_residual_std_mm", sa.Double(), nullable=True),
        sa.Column("created", sa.DateTime(timezone=True), nullable=False),
        sa.Column("decided", sa.DateTime(timezone=True), nullable=True),
        sa.Column("decided_by", sa.Text(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("vertex_count", sa.Integer(), nullable=False),
        sa.Column("vertices", sa.LargeBinary(), nullable=False),
        sa.CheckConstraint(
            "state IN ('proposed', 'released', 'rejected', 'superseded', 'rolled_back')", name="known_state"
        ),
    )
    op.create_index("one_cycle_of_a_fingerprint", "cycles", ["fingerprint"], unique=True)
    op.create_index("cycles_of_a_part", "cycles", ["part_id", "design_sha256"])
    op.create_index("cycles_of_a_file", "cycles", ["stl_sha256"])
    op.create_index(
        "one_released",
        "cycles",
        ["part_id", "design_sha256"],
        unique=True,
        sqlite_where=sa.text("state = 'released'"),
        postgresql_where=sa.text("state = 'released'"),
    )
