"""Studies: plans, blocks, executors and the database."""
