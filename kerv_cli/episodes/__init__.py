"""Runs single episodes: their settings, policy and clock, and what determines their result."""
