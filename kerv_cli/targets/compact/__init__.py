"""The compact policy that kerv trains: encoder, trunk, head, and their compiled form (docs/methods.md §0.1)."""
