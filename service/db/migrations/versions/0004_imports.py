"""Imports: how the recording of a job is made of a bag."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add to jobs what they import, and by which key it lies. Jobs of recordings have none."""
    op.add_column("jobs", sa.Column("import_options", sa.JSON(none_as_null=True), nullable=True))
    op.add_column("jobs", sa.Column("import_key", sa.Text(), nullable=True))
