"""How Alembic runs the versions: with what the attributes of its configuration say, a connection or a dialect."""

from alembic import context

context.configure(version_table="ledger_version", **context.config.attributes)
with context.begin_transaction():
    context.run_migrations()
