"""Stress: disturbances of known size that make the evaluated world differ from the training's (docs/stress.md).

The kinds of stress are in the registry. The module of a kind is imported when it is used.
"""
