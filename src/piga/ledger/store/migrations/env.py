"""Entry point of Alembic: migrate in the connection and transaction of the store."""

from alembic import context

from piga.ledger.store.rows import metadata

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    version_table="piga_schema_version",
    transactional_ddl=True,
)
context.run_migrations()
