"""Lost, then relocalized: why other poses are tried, which, and when one is accepted."""
