"""LeRobot datasets of version 3: written from our demonstrations, read into them (docs/data.md)."""
