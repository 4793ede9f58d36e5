"""What every room uses: errors, files, limits, spaces, the registry, settings. The only place that knows Hydra."""
