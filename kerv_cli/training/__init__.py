"""Train targets and drafters, build datastores, and calibrate methods."""
