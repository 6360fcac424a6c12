"""Lost, then found: why other poses are tried, which ones, and when one is taken."""
