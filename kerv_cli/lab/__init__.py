"""Runs studies: plans which episodes to run, lets workers run them, and stores them in the database."""
