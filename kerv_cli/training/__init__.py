"""Trainings, datastores and calibrations."""
