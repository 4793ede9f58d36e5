"""Runs studies: plans which episodes to run, runs them through executors, and stores them in the database."""
