"""The database of the service: tables, migrations, and what rows decide (leases, keys, events)."""
