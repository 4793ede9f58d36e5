"""Stress: disturbances of known size, by which the evaluated world differs from the training's (docs/stress.md).

The kinds of stress are in the registry. The module of a kind is imported when it is used.
"""
