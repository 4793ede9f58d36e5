"""Certificates of success: what they are tested by."""
