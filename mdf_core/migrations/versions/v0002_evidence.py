"""What a redesign rests on: how far its vertices may be off, of how many prints they are the mean, their variation."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add it; nothing is known of the redesigns so far."""
    op.add_column("cycles", sa.Column("evidence", sa.LargeBinary(), nullable=True))
