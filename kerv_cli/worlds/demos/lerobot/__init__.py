"""LeRobot datasets of version 3: demonstrations are exported to them and imported from them (docs/data.md)."""
