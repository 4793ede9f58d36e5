"""Stress: disturbances of known size, by which the evaluated world differs from that of training (docs/stress.md).

The kinds of stress are in the registry. The module of a kind is imported when it is used.
"""
