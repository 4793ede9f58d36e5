"""Measure how long a target's forwards take, compared with what the device could do at best."""
